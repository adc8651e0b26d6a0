"""Where a training run's batches come from: worlds of this process, or of workers (:mod:`agents.worker_pools`)."""

import dataclasses
from collections.abc import Callable, Generator, Sequence
from typing import Any, Protocol, cast

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from agents.learners import Learner
from agents.noise import ExplorationNoise
from agents.pipeline import collect
from agents.training_config import Config
from agents.worker_pools import Pool, ProcessPool, RayPool, WorkerLostError
from agents.workers import Weights, WorkerTask, copied, dumps, loads, unflat, weights_of
from envs import SurveillanceEnv

MOST_LOSSES = 3
"""How often in a row the same batch of a worker may be lost."""


class Block(Protocol):
    """The worlds of a seed, as checkpoints see them."""

    def state_dict(self) -> dict:
        """Their state, and that of their random streams."""
        ...

    def load_state_dict(self, state_dict: dict) -> None:
        """Go on from what :meth:`state_dict` returned."""
        ...


class Collection(Protocol):
    """What the learner takes its batches from."""

    @property
    def blocks(self) -> Sequence[Block]:
        """The worlds of each seed."""
        ...

    def batches(self, frames: int, *, resumed: bool) -> Generator[TensorDictBase, None, None]:
        """Batches ``(seeds * num_envs, T)`` until there are so many frames, each seed's worlds after the other's.

        A batch may be gone once the next one is asked for.
        """
        ...


def make_collection(
    config: Config,
    seeds: Sequence[int],
    learners: Sequence[Learner],
    explore_policy: TensorDictModuleBase,
    noises: Sequence[ExplorationNoise],
    device: torch.device,
    tell: Callable[[str], None],
) -> Collection:
    """The collection that a configuration asks for.

    Args:
        config: the run.
        seeds: that are trained.
        learners: of each seed.
        explore_policy: of all seeds, where they collect in this process.
        noises: of each seed; they count the frames where others draw the noise.
        device: the learner's.
        tell: shows a line to the user.
    """
    warmup, frames = config.train.warmup_frames, config.collector.total_frames
    if warmup > frames:
        tell(f"nothing is learnt: train.warmup_frames={warmup} is more than collector.total_frames={frames}.")
    if not config.workers.count:
        if device.type == "cuda" and not config.cuda_graphs and config.safety.may_fix_sizes:
            tell("a GPU waits for the launch of each small kernel: cuda_graphs=true is several times as fast.")
        return LocalCollection(config, seeds, explore_policy, device)
    tasks = [worker_task(config, seeds, k, device) for k in range(config.workers.count)]

    def make_pool() -> Pool:
        if config.workers.backend == "ray":
            return RayPool(tasks, config.workers.ray_address, config.workers.gpus)
        return ProcessPool(tasks)

    return WorkerCollection(config, make_pool, learners, noises, device, tell)


def seeds_of_streams(seed: int) -> list[int]:
    """Seeds of a run's own random streams: worlds, noise, replay sampling, evaluation."""
    return np.random.SeedSequence(seed).generate_state(4).tolist()


def worker_task(config: Config, seeds: Sequence[int], k: int, device: torch.device) -> WorkerTask:
    """What worker ``k`` collects: its part of every seed's worlds, each with streams of its own.

    The first worker's streams are those of a run without workers, so one worker collects just that.
    """
    sequences = [np.random.SeedSequence(seed, spawn_key=(k,) if k else ()) for seed in seeds]
    streams = [sequence.generate_state(2).tolist() for sequence in sequences]
    workers, frames = config.workers, config.agent.noise_frames
    agent = dataclasses.replace(config.agent, noise_frames=max(1, round(frames / workers.count)) if frames else 0)
    return WorkerTask(
        *(config.env, agent, config.safety),
        env_seeds=[own[0] for own in streams],
        noise_seeds=[own[1] for own in streams],
        num_envs=config.collector.num_envs // workers.count,
        steps=config.collector.steps_per_batch,
        device="cuda" if workers.gpus or (device.type == "cuda" and workers.backend == "processes") else "cpu",
        threads=config.threads,
        computing=config.computing,
        deterministic=config.deterministic,
    )


class LocalCollection:
    """Worlds of this process.

    Args:
        config: the run.
        seeds: that are trained.
        explore_policy: of all seeds.
        device: where they live.
    """

    def __init__(
        self, config: Config, seeds: Sequence[int], explore_policy: TensorDictModuleBase, device: torch.device
    ) -> None:
        n_worlds = len(seeds) * config.collector.num_envs
        env_seeds = [seeds_of_streams(seed)[0] for seed in seeds]
        self.env = SurveillanceEnv(config.env, n_worlds, device, seed=env_seeds, **config.computing)
        self.blocks = self.env.blocks
        self.policy = explore_policy
        self.frames_per_batch = config.collector.frames_per_batch * len(seeds)

    def batches(self, frames: int, *, resumed: bool) -> Generator[TensorDictBase, None, None]:
        """As :class:`Collection`."""
        return collect(self.env, self.policy, self.frames_per_batch, frames, resumed=resumed)


class WorkerCollection:
    """Worlds of workers, all of which answer before a batch is complete: the same bits however long each takes.

    With ``workers.overlap`` they collect the next batch while the learner updates, with the policy of one batch before.
    A worker that dies is started anew from the state after its last batch and collects again what was lost: the run goes on
    to the same bits.

    Args:
        config: the run.
        make_pool: starts the workers' pool.
        learners: of each seed, whose actors they get.
        noises: of each seed; they count the workers' frames.
        device: of the batches.
        tell: shows a line for each worker that is lost.
    """

    def __init__(
        self,
        config: Config,
        make_pool: Callable[[], Pool],
        learners: Sequence[Learner],
        noises: Sequence[ExplorationNoise],
        device: torch.device,
        tell: Callable[[str], None],
    ) -> None:
        self.config, self.make_pool, self.learners, self.noises = config, make_pool, learners, noises
        self.device, self.tell = device, tell
        self.blocks = [WorkerBlock() for _ in learners]
        self.count = config.workers.count

    def batches(self, frames: int, *, resumed: bool) -> Generator[TensorDictBase, None, None]:
        """As :class:`Collection`."""
        per_batch = self.config.collector.frames_per_batch * len(self.learners)
        if not frames:
            return
        pool = self.make_pool()
        try:
            for k in range(self.count):
                pool.start(k, self._states(k))
            self._request(pool)
            for left in range(frames // per_batch - 1, -1, -1):
                batch = self._receive(pool)
                if left and self.config.workers.overlap:
                    self._request(pool)
                yield batch
                if left and not self.config.workers.overlap:
                    self._request(pool)
        finally:
            pool.close()

    def _states(self, k: int) -> bytes | None:
        states = [block.states[k] for block in self.blocks if block.states]
        return dumps(states) if states else None

    def _request(self, pool: Pool) -> None:
        for block, learner in zip(self.blocks, self.learners, strict=True):
            block.acting = block.acting or copied(weights_of(learner.actor))  # a checkpoint's batch is asked for again
        self._weights = dumps([block.acting for block in self.blocks])
        for k in range(self.count):
            pool.request(k, self._weights)

    def _receive(self, pool: Pool) -> TensorDictBase:
        parts, states = zip(*(loads(self._answer(pool, k)) for k in range(self.count)), strict=True)
        pieces = [unflat(*part).chunk(len(self.blocks)) for part in parts]
        for s, block in enumerate(self.blocks):
            block.states, block.acting = [own[s] for own in states], None
            self.noises[s].frames = sum(own["noise"]["frames"] for own in block.states)
        by_seed = [own[s] for s in range(len(self.blocks)) for own in pieces]
        return cast(TensorDictBase, torch.cat(by_seed)).to(self.device)  # pyright: ignore[reportCallIssue, reportArgumentType]

    def _answer(self, pool: Pool, k: int) -> bytes:
        for _ in range(MOST_LOSSES):
            try:
                return pool.answer(k)
            except WorkerLostError as error:
                for block in self.blocks:
                    block.lost += 1
                self.tell(f"worker {k} was lost ({error}): started anew, it collects its last batch again.")
                pool.start(k, self._states(k))
                pool.request(k, self._weights)
        raise OSError(
            f"worker {k} died {MOST_LOSSES} times at the same batch. Out of memory? Take fewer workers.count or "
            "collector.num_envs; the same command goes on from the last checkpoint."
        )


class WorkerBlock:
    """A seed's worlds in all workers: their states after the last batch, and the policy of a batch on its way."""

    def __init__(self) -> None:
        self.states: list[dict[str, Any]] = []
        self.acting: Weights | None = None
        self.lost = 0
        """Workers that died."""

    def state_dict(self) -> dict:
        """What the workers go on from."""
        acting = None if self.acting is None else {".".join(name): value for name, value in self.acting.items()}
        return {"states": self.states, "acting": acting, "lost": self.lost}

    def load_state_dict(self, state_dict: dict) -> None:
        """Go on from what :meth:`state_dict` returned."""
        acting = state_dict["acting"]
        self.states, self.lost = state_dict["states"], state_dict["lost"]
        self.acting = None if acting is None else {tuple(name.split(".")): value for name, value in acting.items()}

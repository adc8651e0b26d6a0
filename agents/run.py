"""The run of one seed: its replay buffer, counters, curves and checkpoints; several of them share collector and updates."""

import functools
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import cast

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential
from torch import Tensor

from agents.board import Board
from agents.checkpoint import CheckpointError
from agents.collection import Block, WorkerBlock, seeds_of_streams
from agents.divergence import DivergedError, check_batch, check_finite, check_weights
from agents.evaluation import Evaluation, Evaluator, evaluation_scalars, rollout_steps
from agents.incident import ViolationError, broken_promises, check_violations
from agents.learners import Learner
from agents.noise import ExplorationNoise
from agents.pipeline import WaitingSteps, draw, make_buffer, store
from agents.recorder import Counted, Every, Seconds, TrainingRecorder
from agents.training_config import Config
from agents.training_state import TrainingState, valid_ages
from envs import keys
from envs.rendering import save_training_curve

FAILURES = (CheckpointError, DivergedError, ViolationError, OSError)
"""What ends one seed's run and not the others' of its program."""
MOST_AT_ONCE = 16
"""Minibatches that are drawn at a time."""


class SeedsFailedError(RuntimeError):
    """Some seeds of a program failed; the message names them and quotes the first error.

    Args:
        errors: what ended each, by seed.
        others: number of the seeds that did not fail.
    """

    def __init__(self, errors: dict[int, str], others: int) -> None:
        super().__init__(errors, others)  # all arguments: the error of a run in another process is pickled
        self.errors, self.others = errors, others

    def __str__(self) -> str:
        """The message."""
        seeds = ", ".join(map(str, self.errors))
        first, error = next(iter(self.errors.items()))
        return f"{len(self.errors)} of {len(self.errors) + self.others} seeds failed: {seeds}.\nseed {first}: {error}"


class TrainingRun:
    """One seed's run in its folder.

    Args:
        folder: where it writes.
        config: the configuration; the seed is this run's.
        seed: its seed.
        origin: where it comes from, for summary and checkpoints, "config" and "world" aside.
        settings: the hashed configuration, nested.
        learner: its networks and optimisers.
        worlds: its worlds.
        waiting: its steps that wait for n-step transitions.
        noise: its exploration noise.
        sizes: of the networks, by :func:`agents.checkpoint.world_sizes`.
        seconds: where the program's time goes.
    """

    def __init__(
        self,
        folder: Path,
        config: Config,
        seed: int,
        origin: dict,
        settings: dict,
        *,
        learner: Learner,
        worlds: Block,
        waiting: WaitingSteps,
        noise: ExplorationNoise,
        sizes: dict,
        seconds: Seconds,
    ) -> None:
        self.folder, self.config, self.seed, self.origin, self.settings = folder, config, seed, origin, settings
        self.worlds, self.learner, self.noise = worlds, learner, noise
        self.error: Exception | None = None
        """What ended the run before its time, where it shares its program with others."""
        _, _, buffer_seed, self.eval_seed = seeds_of_streams(seed)
        device, agent = noise.generator.device, config.agent
        self.batch_size = config.buffer.batch_size * (config.env.n_agents if agent.minibatch == "per_agent" else 1)
        self.buffer = make_buffer(config.buffer.capacity, device, buffer_seed)
        self.recorder = TrainingRecorder(config.env, config.collector.num_envs, device)
        self.clocks = {
            "log": Every(max(1, config.collector.total_frames // config.log.points)),
            "evaluate": Every(config.eval.interval_frames),
            "save_frames": Every(config.checkpoint.interval_frames),
            "save_episodes": Every(config.checkpoint.interval_episodes),
        }
        parts = {"actor": learner.actor, "loss": learner.loss, "optimizers": learner.optimizers, "env": worlds}
        parts |= {"noise": noise, "multi_step": waiting, "recorder": self.recorder, "clocks": self.clocks}
        parts |= {"seconds": seconds}
        made_for = {"config": settings, "world": sizes}
        keep, with_buffer = config.checkpoint.keep, config.checkpoint.buffer
        self.state = TrainingState(folder, parts, self.buffer, origin | made_for, keep=keep, with_buffer=with_buffer)
        self.check = functools.partial(check_violations, world=config.env, safety=config.safety, folder=folder)
        self.learns_from = config.train.warmup_frames
        self.progress = ""
        """What the progress bar shows."""

    def begin(self, tell: Callable[[str], None], latest: int | None) -> None:
        """Go on from a checkpoint if there is one (see :meth:`TrainingState.resume`), and open the curves.

        Args:
            tell: shows a line to the user.
            latest: frames at which the program's runs begin together, -1 for the start; None for a run alone.

        Raises:
            CheckpointError: if it has no checkpoint of just these frames.
        """
        kept_rows = self.state.resume(self.config.resume, tell, latest)
        if latest is not None and self.recorder.frames != max(latest, 0):
            raise CheckpointError(
                f"seed {self.seed}: its checkpoint of {latest} frames is gone. Start the program again."
            )
        if self.recorder.frames > self.config.collector.total_frames:
            raise CheckpointError(
                f"resume={self.config.resume}: its checkpoint is at {self.recorder.frames} frames, beyond "
                f"collector.total_frames={self.config.collector.total_frames}: ask for more, or take an older one."
            )
        self.learns_from += 0 if kept_rows else self.recorder.frames
        log, settings = self.config.log, self.settings | {"seed": self.seed}
        self.board = Board(self.folder, self.recorder.frames, settings, figures=log.figures, gif=log.gif)

    def take_evaluation(self, found: Evaluation) -> None:
        """Log what came of the policy's rollout; the best policy so far is kept."""
        self.board.scalars(evaluation_scalars(found.metrics), self.recorder.frames)
        self.board.world(found.trajectory, self.recorder.frames)
        if self.recorder.evaluated(found.metrics | {"filter": found.statistics}):
            self.state.save_best()

    def take(self, counted: Counted, batch: TensorDictBase, steps: TensorDictBase, rewards: Tensor) -> None:
        """Take in a collected batch: check it and store its transitions.

        Args:
            counted: what was found in it.
            batch: ``(num_envs, T)``.
            steps: ``(M,)``, what :class:`agents.pipeline.MultiStep` made of it.
            rewards: ``(num_envs, T, N, 1)``, those of the objective.

        Raises:
            DivergedError: if an observation, action or reward is not finite.
            ViolationError: at a violation behind the certified filter.
        """
        if self.recorder.update(batch, counted):
            self.check(batch)
            check_batch(batch, self.recorder.frames)
        if len(steps):
            store(self.buffer, steps)
        self.batch, self.rewards = batch, rewards

    @property
    def learns(self) -> bool:
        """Whether warm-up is over (and the run has not failed)."""
        return self.error is None and self.recorder.frames >= self.learns_from and len(self.buffer) > 0

    def log(self, losses: dict[str, Tensor], seconds: Seconds, k: int) -> None:
        """Add a point to the curves if one is due.

        Args:
            losses: of :func:`agents.maddpg.update_step`.
            seconds: where the program's time went.
            k: which of several learners this one is.

        Raises:
            DivergedError: if a loss is not finite.
        """
        frames = self.recorder.frames
        if not self.clocks["log"](frames):
            return
        scalars = self.recorder.scalars() | {"train/noise": self.noise.sigma}
        scalars["train/reward"] = float(self.rewards.mean())  # the objective's
        numbers = {name: float(value[k] if value.dim() else value) for name, value in losses.items()}
        check_finite(numbers, frames)
        scalars |= {f"loss/{name}": value for name, value in numbers.items()}
        self.board.scalars(scalars | seconds.scalars(frames), frames)
        if self.config.log.histograms:
            self.board.histogram("train/energy", self.batch["next"][keys.ENERGY], frames)
        self.progress = self.recorder.progress(scalars)

    @property
    def ends(self) -> bool:
        """Whether the last frame is collected."""
        return self.recorder.frames == self.config.collector.total_frames

    @property
    def evaluates(self) -> bool:
        """Whether an evaluation is due, at the interval of ``eval`` and at the end; asking starts the next interval."""
        return self.clocks["evaluate"](self.recorder.frames) | self.ends

    @property
    def saves(self) -> bool:
        """Whether a checkpoint is due; asking starts the next interval."""
        frames, episodes = self.recorder.frames, self.recorder.episodes.episodes
        return self.clocks["save_frames"](frames) | self.clocks["save_episodes"](episodes) | self.ends

    def save(self) -> None:
        """Write a checkpoint.

        Raises:
            DivergedError: if a weight is not finite; the earlier checkpoints are kept.
        """
        check_weights(self.learner.loss, self.recorder.frames)
        self.board.flush()  # what it has logged is on disk before the checkpoint that says so
        self.state.save(ended=self.ends)

    def tidy(self) -> None:
        """Delete the checkpoints that are no longer kept."""
        self.state.tidy()

    def conclude(self) -> None:
        """Draw the training curve and delete the replay files."""
        curves = {name: np.array(values) for name, values in self.recorder.episodes.finished.items()}
        save_training_curve(curves, self.folder / "figures" / "training.png")
        self.state.finish()
        self.board.close()

    def summary(self, seconds: Seconds, n_seeds: int) -> dict:
        """The content of summary.json; the time is that of the program, which trained ``n_seeds`` runs."""
        wall_time, frames = seconds.total(), self.recorder.frames
        speed = {"wall_time_s": wall_time, "frames_per_second": frames / wall_time, "time": seconds.totals}
        speed |= {"n_seeds": n_seeds} if n_seeds > 1 else {}
        speed |= {"workers_lost": self.worlds.lost} if isinstance(self.worlds, WorkerBlock) else {}
        kept = {"checkpoint": {"buffer": self.config.checkpoint.buffer}}
        return self.origin | self.recorder.summary() | speed | kept | {"eval": self.recorder.evaluation}


def equally_far(
    folders: Mapping[int, Path], resume: str, tell: Callable[[str], None]
) -> list[tuple[int, dict[int, Path]]]:
    """Seeds that can be trained as one batch, because all have a valid checkpoint of the same frames and updates, or none.

    A program that was killed between its seeds' checkpoints goes on where all of them have one; seeds with another history
    (of single runs, or one that failed) form groups of their own.

    Args:
        folders: the folder of each seed's run.
        resume: ``auto``; anything else does not look for checkpoints.
        tell: shows a line for each damaged checkpoint.

    Returns:
        Frames to go on from and folders by seed, the largest group first.
    """
    if len(folders) == 1 or resume != "auto":
        return [(0, dict(folders))]
    ages = {seed: valid_ages(folder / "checkpoints", tell) or {(0, 0)} for seed, folder in folders.items()}
    groups = []
    while ages:
        counts = Counter(age for own in ages.values() for age in own)
        age = max(counts, key=lambda age: (counts[age], age))
        group = [seed for seed, own in ages.items() if age in own]
        groups.append((age[0], {seed: folders[seed] for seed in group}))
        ages = {seed: own for seed, own in ages.items() if seed not in group}
    return groups


def for_each(runs: Sequence[TrainingRun], act: Callable[..., object], *arguments: Sequence) -> None:
    """Call ``act(run, argument, ..)`` for every run that has not failed; one that fails does not end the others.

    Args:
        runs: the program's runs.
        act: what to do.
        arguments: lists with an entry per run.

    Raises:
        Exception: what ``act`` raises, where there is no other run to go on with.
    """
    for run, *own in zip(runs, *arguments, strict=True):
        if run.error is not None:
            continue
        try:
            act(run, *own)
        except FAILURES as error:
            if len(runs) == 1:
                raise
            run.error = error
            run.board.close()
    if all(run.error is not None for run in runs):
        check_seeds(runs)


def evaluate(runs: Sequence[TrainingRun], evaluator: Evaluator, policy: TensorDictSequential) -> None:
    """Measure the policies of all runs as one batch, each from its own start states, the same every time.

    Args:
        runs: the program's runs.
        evaluator: with a block of worlds for each.
        policy: the deployment policy of all learners.
    """
    config = runs[0].config

    def check(td: TensorDictBase, alive: Tensor) -> None:
        if config.safety.mode == "certified" and broken_promises(td, alive).any():
            for_each(runs, lambda run, *own: run.check(*own), td.chunk(len(runs)), alive.chunk(len(runs)))

    found = evaluator(
        policy,
        config.eval.steps or rollout_steps(config.env.horizon),
        seeds=[run.eval_seed for run in runs],
        record=runs[0].board.records,
        check=check,
    )
    for_each(runs, TrainingRun.take_evaluation, found)


def stopped_at(runs: Sequence[TrainingRun]) -> str:
    """How far a program is that was asked to stop, and where its checkpoints are, for the message."""
    good = [run for run in runs if run.error is None]
    where = good[0].folder if len(runs) == 1 else f"the folders of {len(good)} seeds"
    lost = "".join(f"; seed {run.seed} had failed: {run.error}" for run in runs if run.error is not None)
    return f"at {good[0].recorder.frames} frames, checkpoint written in {where}{lost}"


def shares(rows: TensorDictBase | Tensor, runs: Sequence[TrainingRun]) -> Sequence:
    """Each run's part of ``rows``, which hold the runs' worlds one after the other."""
    return rows.chunk(len(runs)) if len(runs) > 1 and len(rows) else [rows] * len(runs)


def minibatches(runs: Sequence[TrainingRun], count: int) -> Iterator[TensorDictBase]:
    """Transitions for so many updates: ``(batch,)`` each of the only run, ``(K, batch)`` of several."""
    for first in range(0, count, MOST_AT_ONCE):
        some = min(MOST_AT_ONCE, count - first)
        samples = [_sample(run, some) if run.error is None else None for run in runs]
        stand_in = next(sample for sample in samples if sample is not None)  # for failed runs, whose networks are lost
        parts = [stand_in if sample is None else sample for sample in samples]
        whole = cast(TensorDictBase, parts[0] if len(runs) == 1 else torch.stack(parts))  # pyright: ignore[reportCallIssue, reportArgumentType]
        yield from whole.split(runs[0].batch_size, dim=-1)


def _sample(run: TrainingRun, count: int) -> TensorDictBase:
    """``count`` minibatches, drawn as one: the same as one after the other, in less time."""
    return draw(run.buffer, count * run.batch_size, run.learner.loss.reads)


def errors_by_seed(error: Exception, seeds: Iterable[int]) -> dict[int, str]:
    """What ended each seed of a program that ``error`` has ended."""
    return error.errors if isinstance(error, SeedsFailedError) else {seed: str(error) for seed in seeds}


def check_seeds(runs: Sequence[TrainingRun]) -> None:
    """Raise a :class:`SeedsFailedError` if a run failed."""
    if failed := {run.seed: run.error for run in runs if run.error is not None}:
        raise SeedsFailedError({seed: str(error) for seed, error in failed.items()}, len(runs) - len(failed))

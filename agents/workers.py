"""Processes that collect for one learner: on this machine, or a Ray cluster's.

A worker steps its worlds behind the filter, with the policy it is sent. It answers with the batch and the state its worlds
and noise are in after it, so that whoever holds the last answer can start a dead worker anew just where it was.
"""

import multiprocessing
import os
import pickle
import signal
import threading
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from typing import Any, Protocol, cast

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.collectors import Collector

from agents.config import AgentConfig
from agents.networks import ExplorationNoise, make_actor, make_policies
from agents.pipeline import COLLECTOR_OPTIONS, use_threads
from envs import SurveillanceConfig, SurveillanceEnv
from safety import SafetyConfig

Weights = dict[tuple[str, ...], Tensor]


@dataclass(frozen=True)
class WorkerTask:
    """What a worker collects: a block of worlds of each seed.

    Args:
        world: the worlds.
        agent: the actors; ``noise_frames`` are the block's.
        safety: the filter.
        env_seeds: seed of each block's start states.
        noise_seeds: seed of each block's noise.
        num_envs: worlds of a block.
        steps: vector steps of a batch.
        device: where it computes.
        threads: CPU threads.
        compile: run pure tensor functions through torch.compile.
        deterministic: refuse operations that may differ between runs.
    """

    world: SurveillanceConfig
    agent: AgentConfig
    safety: SafetyConfig
    env_seeds: list[int]
    noise_seeds: list[int]
    num_envs: int
    steps: int
    device: str = "cpu"
    threads: int = 1
    compile: bool = False
    deterministic: bool = False


class WorldsCollector(Collector):
    """TorchRL's collector in a worker.

    Args:
        task: a function that returns the :class:`WorkerTask` (TorchRL's collectors are given functions that make things).
        states: of :meth:`collect`, to go on from; None starts the worlds anew.
        options: TorchRL's, most of them those of its :class:`torchrl.collectors.distributed.RayCollector`.
    """

    def __init__(self, task: Any, *, states: bytes | None, **options: Any) -> None:
        options.pop("policy_factory", None)
        task = task()
        use_threads(task.threads, deterministic=task.deterministic)
        n_blocks, device = len(task.env_seeds), torch.device(task.device)
        worlds = SurveillanceEnv(
            *(task.world, n_blocks * task.num_envs, device, task.env_seeds), compile_functions=task.compile
        )
        actor = make_actor(worlds.n_observation, task.world, task.agent, n_blocks).to(device)
        _, policy = make_policies(
            *(actor, task.world, task.safety, task.agent, task.noise_seeds, device), compile=task.compile
        )
        self.actor_weights = weights_of(actor)
        self.noises = [module for module in policy.modules() if isinstance(module, ExplorationNoise)]
        going_on: list[dict] = [] if states is None else loads(states)
        for block, state in zip(worlds.blocks, going_on, strict=bool(going_on)):
            block.continue_from(state["worlds"])
        own = {"frames_per_batch": worlds.batch_size[0] * task.steps, "total_frames": -1, "device": device}
        super().__init__(worlds, policy, **options | COLLECTOR_OPTIONS | own)
        for noise, state in zip(
            self.noises, going_on, strict=bool(going_on)
        ):  # after the collector's trial, which draws some
            noise.set_extra_state(state["noise"])

    def collect(self, weights: bytes) -> bytes:
        """Collect a batch.

        Args:
            weights: pickled list of the actor's weights of each seed (:func:`weights_of`).

        Returns:
            Pickled batch (batch size and :func:`flat`) and list of each block's state after it, "worlds" and "noise".
        """
        own = loads(weights)
        for name, value in self.actor_weights.items():
            value.copy_(torch.stack([part[name] for part in own]).view_as(value))
        batch = cast(TensorDictBase, self.next())
        blocks = zip(self.env.blocks, self.noises, strict=True)
        states = [{"worlds": block.state_dict(), "noise": noise.get_extra_state()} for block, noise in blocks]
        return dumps(((list(batch.batch_size), flat(batch)), states))


def weights_of(actor: TensorDictModuleBase) -> Weights:
    """The tensors of an actor, by name; no copies."""
    return flat(TensorDict.from_module(actor).data)


def copied(weights: Weights) -> Weights:
    """Copies on the CPU, which later updates leave alone."""
    return {name: value.to("cpu", copy=True) for name, value in weights.items()}


def flat(rows: TensorDictBase) -> Weights:
    """The tensors of a tensordict by tuple of names."""
    items = rows.items(include_nested=True, leaves_only=True)
    return {(name,) if isinstance(name, str) else name: value for name, value in items}


def unflat(shape: Sequence[int], tensors: Weights) -> TensorDict:
    """The tensordict of this batch size whose tensors :func:`flat` returned."""
    rows = TensorDict(batch_size=shape)
    for name, value in tensors.items():
        rows.set(name, value)
    return rows


def dumps(tree: Any) -> bytes:
    """Pickle nested lists, tuples and dictionaries of tensors as arrays: several times faster, and of any device."""
    return pickle.dumps(_mapped(tree, lambda leaf: leaf.cpu().numpy() if isinstance(leaf, Tensor) else leaf))


def loads(data: bytes) -> Any:
    """What :func:`dumps` was given, its tensors on the CPU."""
    return _mapped(pickle.loads(data), lambda leaf: torch.from_numpy(leaf) if isinstance(leaf, np.ndarray) else leaf)


def _mapped(tree: Any, change: Callable[[Any], Any]) -> Any:
    if isinstance(tree, dict):
        return {name: _mapped(value, change) for name, value in tree.items()}
    if isinstance(tree, (list, tuple)):
        return type(tree)(_mapped(value, change) for value in tree)
    return change(tree)


class WorkerLostError(RuntimeError):
    """A worker's process or machine is gone."""


class Pool(Protocol):
    """Workers, each with one request at a time."""

    def start(self, k: int, states: bytes | None) -> None:
        """Start worker ``k``, or start it anew, from these states."""
        ...

    def request(self, k: int, weights: bytes) -> None:
        """Ask worker ``k`` for a batch with this policy."""
        ...

    def answer(self, k: int) -> bytes:
        """What worker ``k`` was asked for; waits for it.

        Raises:
            WorkerLostError: if the worker is gone.
        """
        ...

    def close(self) -> None:
        """End all workers."""
        ...


class ProcessPool:
    """Workers as processes of this machine.

    Args:
        tasks: of each worker.
    """

    def __init__(self, tasks: Sequence[WorkerTask]) -> None:
        self.tasks = tasks
        forks = "forkserver" in multiprocessing.get_all_start_methods()  # from a server that has PyTorch: at once
        self.context = multiprocessing.get_context("forkserver" if forks else "spawn")
        if forks:
            self.context.set_forkserver_preload([__name__])
        self._executors: dict[int, ProcessPoolExecutor] = {}
        self._pending: dict[int, Future] = {}

    def start(self, k: int, states: bytes | None) -> None:
        """As :class:`Pool`."""
        if k in self._executors:
            self._executors[k].shutdown(wait=False)
        self._executors[k] = ProcessPoolExecutor(1, self.context, initializer=_serve, initargs=(self.tasks[k], states))

    def request(self, k: int, weights: bytes) -> None:
        """As :class:`Pool`."""
        try:
            self._pending[k] = self._executors[k].submit(_collect, weights)
        except BrokenProcessPool as error:  # it died in its sleep: answer tells
            self._pending[k] = Future()
            self._pending[k].set_exception(error)

    def answer(self, k: int) -> bytes:
        """As :class:`Pool`."""
        try:
            return self._pending.pop(k).result()
        except BrokenProcessPool as error:
            raise WorkerLostError("its process died") from error

    def close(self) -> None:
        """As :class:`Pool`."""
        for executor in self._executors.values():
            executor.shutdown(cancel_futures=True)


_own: dict[str, Any] = {}  # of a worker's process


def _serve(task: WorkerTask, states: bytes | None) -> None:
    for number in (signal.SIGINT, signal.SIGTERM):  # sent to the whole group: the learner ends its workers
        signal.signal(number, signal.SIG_IGN)
    threading.Thread(target=_end_with_learner, daemon=True).start()
    _own.update(task=task, states=states)


def _end_with_learner() -> None:
    learner = multiprocessing.parent_process()
    if learner is not None:
        learner.join()
        os._exit(1)


def _collect(weights: bytes) -> bytes:
    if "collector" not in _own:  # here and not in _serve, whose errors reach the learner without their message
        _own["collector"] = WorldsCollector(lambda: _own["task"], states=_own["states"])
    return _own["collector"].collect(weights)


class RayPool:
    """Workers as actors of TorchRL's Ray collector.

    Args:
        tasks: of each worker.
        address: of a running cluster; None starts one on this machine.
        gpus: share of a GPU that each worker reserves.
    """

    def __init__(self, tasks: Sequence[WorkerTask], address: str | None, gpus: float) -> None:
        import ray  # pyright: ignore[reportMissingImports]
        from torchrl.collectors.distributed import RayCollector

        self.tasks, self.ray = tasks, ray
        self.resources = {"num_cpus": max(1, tasks[0].threads), "num_gpus": gpus}
        init = {"address": address or "local", "log_to_driver": False, "logging_level": "error"}
        own_cluster = {"num_cpus": len(tasks) * self.resources["num_cpus"], "include_dashboard": False}
        with warnings.catch_warnings():  # that it is given no policy: each worker makes its own
            warnings.simplefilter("ignore", UserWarning)
            self.collector = RayCollector(
                *([], None),  # no workers yet
                frames_per_batch=len(tasks),
                collector_class=WorldsCollector,
                weight_sync_schemes={},
                ray_init_config=init | ({} if address else own_cluster),
            )
        self._check_resources(address)
        self._actors: dict[int, Any] = {}
        self._pending: dict[int, Any] = {}

    def _check_resources(self, address: str | None) -> None:
        there = self.ray.cluster_resources()
        for ray_name, name in (("CPU", "num_cpus"), ("GPU", "num_gpus")):
            needed, offered = len(self.tasks) * self.resources[name], there.get(ray_name, 0)
            if needed > offered:
                self.close()
                raise OSError(
                    f"workers.count={len(self.tasks)} need {needed:g} {ray_name}s, and the Ray cluster "
                    f"{address or 'of this machine'} has {offered:g}: take fewer workers, threads or workers.gpus, or add nodes."
                )

    def start(self, k: int, states: bytes | None) -> None:
        """As :class:`Pool`."""
        if k in self._actors:
            self.collector.remote_collectors.remove(self._actors[k])
        task = self.tasks[k]
        self.collector.add_collectors([lambda: task], 1, None, [{"states": states}], [self.resources])
        self._actors[k] = self.collector.remote_collectors[-1]

    def request(self, k: int, weights: bytes) -> None:
        """As :class:`Pool`."""
        self._pending[k] = self._actors[k].collect.remote(weights)

    def answer(self, k: int) -> bytes:
        """As :class:`Pool`."""
        errors = self.ray.exceptions
        try:
            return self.ray.get(self._pending.pop(k))
        except errors.RayTaskError:  # an error of the worker's own code
            raise
        except errors.RayError as error:
            raise WorkerLostError(str(error).splitlines()[0]) from error

    def close(self) -> None:
        """As :class:`Pool`."""
        self.collector.shutdown()

"""Where workers (:mod:`agents.workers`) run: processes of this machine, or actors of a Ray cluster."""

import contextlib
import multiprocessing
import os
import pickle
import signal
import threading
import warnings
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import Any, Protocol

from agents.ray_cluster import reach_ray
from agents.workers import WorkerTask, WorldsCollector


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
            _start_server()
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


# What is sent to a whole process group is the learner's business: Ctrl-C, a batch system's end and its warning before it.
GROUP_SIGNALS = {getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGUSR2") if hasattr(signal, name)}


def _start_server() -> None:
    """Start the server that workers are forked from, with these signals blocked, as they are in its children then."""
    from multiprocessing import forkserver

    before = signal.pthread_sigmask(signal.SIG_BLOCK, GROUP_SIGNALS)
    try:
        forkserver.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


_worker: dict[str, Any] = {}  # of a worker's process


def _serve(task: WorkerTask, states: bytes | None) -> None:
    for number in GROUP_SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    threading.Thread(target=_end_with_learner, daemon=True).start()
    _worker["collector"] = WorldsCollector(lambda: task, states=states)


def _end_with_learner() -> None:
    learner = multiprocessing.parent_process()
    if learner is not None:
        learner.join()
        os._exit(1)


def _collect(weights: bytes) -> bytes:
    try:
        return _worker["collector"].collect(weights)
    except Exception as error:
        try:
            pickle.loads(pickle.dumps(error))
        except Exception:  # it would break the pipe, and look like a dead worker
            raise RuntimeError(f"in a worker: {type(error).__name__}: {error}") from None
        raise


@contextlib.contextmanager
def kept_handlers() -> Iterator[None]:
    """Context that ends with the signal handlers it began with: Ray's own ends a program without a checkpoint."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        if threading.current_thread() is threading.main_thread():
            for number, handler in before.items():
                signal.signal(number, handler)


class RayPool:
    """Workers as actors of TorchRL's Ray collector.

    Args:
        tasks: of each worker.
        address: of a running cluster; None starts one on this machine.
        gpus: share of a GPU that each worker reserves.
    """

    def __init__(self, tasks: Sequence[WorkerTask], address: str | None, gpus: float) -> None:
        import ray  # pyright: ignore[reportMissingImports]

        if ray.is_initialized():
            raise OSError(
                "workers.backend=ray in a program that Ray runs already, which keeps the cores (hydra/launcher=ray_local?): take "
                "workers.backend=processes, or another launcher."
            )
        if address is not None:
            reach_ray(address, "workers.ray_address")
        from torchrl.collectors.distributed import RayCollector

        self.tasks, self.ray = tasks, ray
        self.resources = {"num_cpus": max(1, tasks[0].threads), "num_gpus": gpus}
        init = {"address": address or "local", "log_to_driver": False, "logging_level": "error"}
        own_cluster = {"num_cpus": len(tasks) * self.resources["num_cpus"], "include_dashboard": False}
        with warnings.catch_warnings(), kept_handlers():  # that it is given no policy: each worker makes its own
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
        if address is not None:  # others may be at work there
            there = self.ray.available_resources()
        for ray_name, name in (("CPU", "num_cpus"), ("GPU", "num_gpus")):
            needed, offered = len(self.tasks) * self.resources[name], there.get(ray_name, 0)
            if needed > offered:
                self.close()
                raise OSError(
                    f"workers.count={len(self.tasks)} need {needed:g} {ray_name}s, and the Ray cluster "
                    f"{address or 'of this machine'} has {offered:g} free: fewer workers, threads or workers.gpus, or more nodes."
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

"""Sweeps: what is checked before the first run starts, and what is collected after the last one.

Hydra's sweeper makes the list of runs, one of its launchers (the basic one, joblib, submitit, Ray) starts them. Between the
two stands :class:`SweepLauncher`, the same for all of them: it refuses a list in which two runs would write one folder, leaves
finished runs alone, keeps the others apart from one that fails, and remembers which failed and why.
"""

import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import FrameType
from typing import Any

from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn, JobStatus, env_override
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException
from tqdm import tqdm

from agents.interruption import STOP_FILE, InterruptedRunError
from agents.report_runs import is_reported, is_training
from agents.training_config import seeds_of
from conf.job_log import LOG, FailedRunError, read_failure
from conf.launching import SweepError, beside_others, check_launcher, is_broken_pool, patient, replaced
from conf.run_folder import finished_run, foreign_run, objective, run_folders
from conf.sweep_jobs import (
    FAILED_JOBS,
    FailedJob,
    Job,
    conclusion,
    ending,
    is_listed,
    list_jobs,
    own_names,
    refuse_shared_folders,
)

EXPECTED = (ValueError, OSError, OmegaConfBaseException)  # of a configuration that is being checked


class SweepLauncher(Launcher):
    """The chosen launcher, with the checks before it and the failures after it.

    Args:
        inner: the launcher that starts the runs.
        config: the sweep's configuration.
        hydra_context: Hydra's configuration loader and callbacks.

    Raises:
        SweepError: the list of runs, where it is known before the sweep, is refused; nothing has been written.
    """

    def __init__(self, inner: Launcher, config: DictConfig, hydra_context: HydraContext) -> None:
        self.inner, self.config, self.hydra_context = inner, config, hydra_context
        self.beside = beside_others(config)
        self.remote = "Slurm" in type(inner).__name__ or "Ray" in type(inner).__name__  # other machines, other devices
        self.stopped: int | None = None
        self.launched: list[Job] = []
        folder = Path(str(config.hydra.sweep.dir)).absolute()
        self.missing = [path for path in (folder, *folder.parents) if not path.exists()]
        subdir = OmegaConf.to_container(config.hydra.sweep, resolve=False)["subdir"]  # pyright: ignore
        self.numbered = "hydra.job" in str(subdir)  # folders by number: no run may be left out of the list
        self._planned: dict[tuple[str, ...], Job] = {}
        if (listed := list_jobs(config, hydra_context)) is not None:
            jobs = [self._plan(overrides, number) for number, overrides in enumerate(listed)]
            refuse_shared_folders(jobs)
            self._planned = {tuple(job.overrides): job for job in jobs}

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        """Nothing: the inner launcher is set up already."""

    def launch(self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int) -> Sequence[JobReturn]:
        """Run the jobs that are neither finished nor refused.

        Args:
            job_overrides: one list of overrides per run.
            initial_job_idx: number of the first.

        Returns:
            One result per run, in that order; those that failed are in :data:`FAILED_JOBS` too.
        """
        jobs = []
        for number, overrides in enumerate(job_overrides, initial_job_idx):
            jobs.append(self._planned.get(tuple(overrides)) or self._plan(overrides, number))
        self.launched += jobs
        todo, first = [], {}
        for job in jobs:
            if job.error is None and first.setdefault(job.folder, job) is not job:
                continue  # a sweeper that makes runs up (Optuna) may repeat itself: one run, two results
            if job.error is not None:
                job.end(JobStatus.FAILED, job.error)
            elif job.finished and not self.numbered:
                tqdm.write(job.finished)
                job.end(JobStatus.COMPLETED, objective(job.folders))
            else:
                todo.append(job)
        if todo:
            with self._stop_file(), _progress(todo, tell=self.beside), _importable(), patient(self.inner):
                self._start_all(todo, initial_job_idx)
        return self._conclude(jobs, first)

    def leave_nothing(self) -> None:
        """Delete the sweep's folder, and those made for it, if the sweeper has written its configuration there and no run came."""
        if not self.missing or not self.missing[0].is_dir():
            return
        if [path.name for path in self.missing[0].iterdir()] == ["multirun.yaml"]:
            (self.missing[0] / "multirun.yaml").unlink()
            with contextlib.suppress(OSError):  # not empty: somebody else's by now
                for path in self.missing:
                    path.rmdir()

    def _plan(self, overrides: Sequence[str], number: int) -> Job:
        """Compose one run and check it, as its own process will."""
        config = self.hydra_context.config_loader.load_sweep_config(self.config, list(overrides))
        with open_dict(config):
            config.hydra.job.num, config.hydra.job.id = number, str(number)
        job = Job(list(overrides), Path(), reported=is_reported(config))
        try:
            job.folder = Path(str(config.hydra.sweep.dir), str(config.hydra.sweep.subdir)).absolute()
            if self.remote and "device" in config:
                config.device = "auto"  # this machine need not have the GPU
            for callback in self.hydra_context.callbacks.callbacks:
                if check := getattr(callback, "check", None):
                    check(config)
        except EXPECTED as error:
            job.error = error
            return job
        job.folders = [job.folder]
        if is_training(config):
            own = run_folders(config, seeds_of(config), job.folder)
            for seed, folder in own.items():
                if message := foreign_run(folder, config, seed):
                    raise SweepError(f"{message} Nothing was started.")
            job.folders = list(own.values())
            messages = [finished_run(folder, config.resume) for folder in job.folders]
            job.finished = "\n".join(map(str, messages)) if all(messages) else None
        return job

    def _start(self, jobs: Sequence[Job], first: int) -> None:
        results = self.inner.launch([job.overrides for job in jobs], first)
        for job, result in zip(jobs, results, strict=True):
            result.overrides = list(job.overrides)  # those of a process that died are empty
            job.result = result

    def _start_all(self, jobs: Sequence[Job], first: int) -> None:
        """Start jobs that run in other processes, again if joblib loses them.

        A process that dies (of memory, say) takes all of joblib's with it. Those that were at work go on from their checkpoints,
        one at a time and last, so that the culprit harms nobody else.
        """
        rest, suspects = list(jobs), []
        while rest or suspects:
            now = rest or [suspects[0]]
            since = time.time()
            try:
                self._start(now, first)
            except Exception as error:
                if not is_broken_pool(error):
                    raise SweepError(f"{type(self.inner).__name__}: {type(error).__name__}: {error}") from error
                sys.stderr.write(
                    f"warning: a run's process died ({type(error).__name__}); what it took with it goes on.\n"
                )
                self._lost(now, since)
            left = [job for job in now if job.result is None]
            for job in left:
                if self.stopped is not None:
                    job.end(JobStatus.FAILED, InterruptedRunError(self.stopped, "stopped before it ended"))
                elif not rest or self.numbered:
                    message = (
                        "its process died (killed, or out of memory?); the same command goes on from its checkpoint"
                    )
                    job.end(JobStatus.FAILED, FailedRunError(message, "BrokenProcessPool", True))
            left = [job for job in left if job.result is None]
            begun = [job for job in left if job.started(since)] or left
            suspects = [*(suspects if rest else suspects[1:]), *begun]
            rest = [job for job in left if job not in begun]

    def _lost(self, jobs: Sequence[Job], since: float) -> None:
        """Results of the jobs that had ended when joblib gave up."""
        for job in jobs:
            if job.done(since) and (error := read_failure(job.folder)):
                job.end(JobStatus.FAILED, error)
            elif job.done(since):
                job.end(JobStatus.COMPLETED, objective(job.folders))

    def _conclude(self, jobs: Sequence[Job], first: dict[Path, Job]) -> Sequence[JobReturn]:
        for job in jobs:
            job.result = job.result or first[job.folder].result
        results = [job.result for job in jobs if job.result is not None]
        stopped = 0
        for job, result in zip(jobs, results, strict=True):
            error = result._return_value
            if result.status != JobStatus.FAILED:
                continue
            if self.stopped is not None and isinstance(error, InterruptedRunError):
                stopped += 1
                continue
            FAILED_JOBS.append(FailedJob(job.overrides, error, log if (log := job.folder / LOG).is_file() else None))
            if is_listed(self.config):
                # it would raise the first of them and leave out the batches that follow
                result.status, result._return_value = JobStatus.COMPLETED, None
        if self.stopped is not None:
            ended = len(jobs) - stopped
            sys.stderr.write(
                f"sweep stopped: {ended} of {len(jobs)} runs have ended. The same command goes on from there.\n"
            )
            sys.exit(128 + self.stopped)
        return results

    @contextlib.contextmanager
    def _stop_file(self) -> Iterator[None]:
        """Context in which SIGINT and SIGTERM ask the runs to write a checkpoint and stop; a second signal acts at once."""
        if threading.current_thread() is not threading.main_thread() or "Slurm" in type(self.inner).__name__:
            yield  # the queue's jobs are not ended with this program
            return
        path = Path(str(self.config.hydra.sweep.dir), f".stop_{os.getpid()}").absolute()
        path.unlink(missing_ok=True)
        before: dict[int, Any] = {}

        def restore() -> None:
            for signum, handler in before.items():
                signal.signal(signum, handler)
            before.clear()

        def stop(signum: int, frame: FrameType | None) -> None:
            self.stopped = signum
            path.touch()
            restore()
            sys.stderr.write("stopping: the runs write their checkpoints; again to end them at once.\n")

        with env_override({STOP_FILE: str(path)}):
            for signum in (signal.SIGINT, signal.SIGTERM):
                before[signum] = signal.signal(signum, stop)
            try:
                yield
            finally:
                restore()
                path.unlink(missing_ok=True)


@contextlib.contextmanager
def _importable() -> Iterator[None]:
    """Context in which the processes that are started find this project, wherever the program was called."""
    root = str(Path(__file__).resolve().parents[1])
    with env_override({"PYTHONPATH": os.pathsep.join(filter(None, [root, os.environ.get("PYTHONPATH")]))}):
        yield


@contextlib.contextmanager
def _progress(jobs: Sequence[Job], *, tell: bool) -> Iterator[None]:
    """A bar that counts the runs that have ended, by what is in their folders; with ``tell`` a line for each, whose own output
    is in its log.
    """
    since, ends, rest = time.time(), threading.Event(), list(zip(own_names(jobs), jobs, strict=True))
    with tqdm(total=len(jobs), unit="run", disable=None) as bar:

        def look() -> None:
            for name, job in [entry for entry in rest if entry[1].done(since)]:
                rest.remove((name, job))
                bar.update()
                if tell:
                    tqdm.write(f"{len(jobs) - len(rest)} of {len(jobs)} ended: {name} {ending(job)}")

        def watch() -> None:
            while not ends.wait(1.0):
                look()

        thread = threading.Thread(target=watch, daemon=True)
        thread.start()
        try:
            yield
        finally:
            ends.set()
            thread.join()
            look()


@contextlib.contextmanager
def checked_sweeps() -> Iterator[None]:
    """Context in which Hydra's sweepers start their runs through :class:`SweepLauncher`; its end says what has come of runs
    in other processes, whose output nobody has seen.
    """
    instantiate, launchers = Plugins.instantiate_launcher, []

    def wrapped(
        plugins: Plugins, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig
    ) -> Launcher:
        check_launcher(str(config.hydra.runtime.choices["hydra/launcher"]), config.hydra.launcher)
        inner = instantiate(plugins, hydra_context=hydra_context, task_function=task_function, config=config)
        launchers.append(SweepLauncher(inner, config, hydra_context))
        return launchers[-1]

    FAILED_JOBS.clear()
    try:
        with replaced(Plugins, "instantiate_launcher", wrapped):
            yield
    finally:
        for launcher in launchers:
            launcher.leave_nothing()
    for launcher in launchers:
        if launcher.beside and not all(job.error for job in launcher.launched):
            tqdm.write(conclusion(launcher.launched, len(FAILED_JOBS)))

"""The runs of a sweep as a list: what is known of each before it starts and when it ends, and lists that are refused."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.utils import JobReturn, JobStatus
from hydra.types import HydraContext
from omegaconf import DictConfig

from conf.job_log import FAILED, LOG
from conf.launching import SweepError
from conf.run_folder import objective

SUMMARIES = ("summary.json", "eval.json")


@dataclass
class FailedJob:
    """One run of a sweep that failed."""

    overrides: Sequence[str]
    error: BaseException
    log: Path | None = None


FAILED_JOBS: list[FailedJob] = []
"""Those of this process's sweep, in the order of its list."""


@dataclass
class Job:
    """One run of a sweep, before it starts."""

    overrides: Sequence[str]
    folder: Path
    folders: Sequence[Path] = ()
    """Of its runs: that folder, or where it trains several seeds at once one of each."""
    finished: str | None = None
    """What to tell the user if it is finished and left alone."""
    error: BaseException | None = None
    """What is wrong with its configuration."""
    reported: bool = False
    """Whether report.py reads its runs: trainings and controllers' evaluations."""
    result: JobReturn | None = None

    def done(self, since: float) -> bool:
        """Whether it has ended since that time."""

        def written(folder: Path, *names: str) -> bool:
            return any(path.exists() and path.stat().st_mtime >= since for path in map(folder.joinpath, names))

        return written(self.folder, FAILED) or all(written(folder, *SUMMARIES) for folder in self.folders)

    def started(self, since: float) -> bool:
        """Whether it has begun since that time."""
        path = self.folder / ".hydra" / "config.yaml"
        return path.exists() and path.stat().st_mtime >= since

    def end(self, status: JobStatus, value: Any) -> None:
        """Set its result."""
        self.result = JobReturn(overrides=list(self.overrides), status=status, _return_value=value)


def own_names(jobs: Sequence[Job]) -> list[str]:
    """What the user would call each: its overrides, without those that all have where there are several."""
    shared = set.intersection(*(set(job.overrides) for job in jobs)) if len(jobs) > 1 else set()
    return [" ".join(entry for entry in job.overrides if entry not in shared) for job in jobs]


def ending(job: Job) -> str:
    """How a job that has ended did so, in a few words."""
    if (job.folder / FAILED).is_file():
        return f"failed ({job.folder / LOG})"
    cost = objective(job.folders)
    return "complete" if cost is None else f"complete, J = {cost:.4g} m²"


def conclusion(jobs: Sequence[Job], failed: int) -> str:
    """What a sweep's end tells the user: how many runs are complete, where they are, and what reads them."""
    folder = os.path.commonpath([job.folder.parent for job in jobs])
    near = os.path.relpath(folder)
    where = folder if near.startswith("..") else near
    text = f"{len(jobs) - failed} of {len(jobs)} runs complete in {where} (each run's output: {LOG})"
    read = len(jobs) > failed and all(job.reported for job in jobs)
    return f"{text}; python report.py sweep={where}" if read else text


def is_listed(config: DictConfig) -> bool:
    """Whether Hydra's own sweeper makes the list of runs, before the first one starts."""
    return str(config.hydra.sweeper._target_).endswith(".BasicSweeper")


def list_jobs(config: DictConfig, hydra_context: HydraContext) -> list[list[str]] | None:
    """The runs that Hydra's own sweeper will start; None for one that makes them up on the way."""
    if not is_listed(config):
        return None
    given = [f"{name}={value}" for name, value in (config.hydra.sweeper.params or {}).items()]
    parser = OverridesParser.create(config_loader=hydra_context.config_loader)
    overrides = parser.parse_overrides(given + list(config.hydra.overrides.task))
    for override in {override.get_key_element(): override for override in overrides}.values():
        if override.is_discrete_sweep():
            values = [str(value) for value in override.sweep_string_iterator()]
            if twice := next((value for value in values if values.count(value) > 1), None):
                raise SweepError(
                    f"{override.input_line} lists {twice} more than once, and two runs cannot write the same folder: leave the "
                    "duplicate out. Nothing was started."
                )
    return [job for batch in BasicSweeper.split_arguments(overrides, None) for job in batch]


def refuse_shared_folders(jobs: Sequence[Job]) -> None:
    """Raise :class:`SweepError` if two jobs would write one folder."""
    seen: dict[Path, Job] = {}
    for job in jobs:
        if job.error is not None:
            continue
        others = [seen.setdefault(folder.resolve(), job) for folder in {job.folder, *job.folders}]
        other = next((other for other in others if other is not job), None)
        if other is None:
            continue
        its = " ".join(entry for entry in other.overrides if entry not in job.overrides)
        mine = " ".join(entry for entry in job.overrides if entry not in other.overrides)
        raise SweepError(
            f"'{its}' and '{mine}' are the same run, or would write the same folder {job.folder}: leave one of them out, "
            "or give the runs different folders (hydra.sweep.subdir). Nothing was started."
        )

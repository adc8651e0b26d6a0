"""Checks before Hydra creates a folder, and errors in one message instead of a traceback."""

import functools
import shutil
import signal
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.core.utils import JobReturn, JobStatus
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from agents.checkpoint import CheckpointError
from agents.divergence import DivergedError
from agents.incident import ViolationError
from agents.interruption import InterruptedRunError
from agents.report_runs import ReportError
from agents.run import SeedsFailedError
from conf.command_line import FAILED_JOBS, fail, wants_traceback
from conf.run_folder import finished_program
from conf.schema import check_evaluation, check_training, to_config

EXPECTED = (ValueError, OSError, OmegaConfBaseException)  # of a configuration that is being checked
EXPECTED_IN_RUN = (
    CheckpointError,
    DivergedError,
    ReportError,
    SeedsFailedError,
    ViolationError,
    OSError,
    OmegaConfBaseException,
)  # anything else is a programming error


class ValidateConfig(Callback):
    """Validates the composed configuration before anything is written.

    Hydra swallows exceptions of callbacks, so a bad value ends the program here. Jobs of a multirun are validated one
    by one when they start: a bad one must not end the others.
    """

    check = staticmethod(to_config)

    def on_run_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Before the run folder exists."""
        message = None
        try:
            self.check(config)
            message = self.finished(config)
        except EXPECTED as error:
            if config.get("debug", False):
                traceback.print_exception(error)
                sys.exit(1)
            fail(error)
        if message:  # before Hydra rewrites .hydra/
            sys.stderr.write(message + "\n")
            sys.exit(0)

    @staticmethod
    def finished(cfg: DictConfig) -> str | None:
        """What to say where there is nothing left to do."""
        return None

    def on_job_end(self, config: DictConfig, job_return: JobReturn, **kwargs: Any) -> None:
        """Remember a failed job of a multirun: Hydra itself only raises the first one's error, at the end."""
        if job_return.status == JobStatus.FAILED and config.hydra.mode == RunMode.MULTIRUN:
            FAILED_JOBS.append((job_return.overrides or (), job_return._return_value))
            folder = Path(config.hydra.runtime.output_dir)
            if {path.name for path in folder.glob("*")} <= {".hydra"}:  # refused before it began
                shutil.rmtree(folder, ignore_errors=True)


class ValidateTraining(ValidateConfig):
    """The same for train.py, with the checkpoint that ``resume`` names."""

    check = staticmethod(check_training)
    finished = staticmethod(finished_program)


class ValidateEvaluation(ValidateConfig):
    """The same for evaluate.py, with the run that it names."""

    check = staticmethod(check_evaluation)


def one_clear_error(main: Callable[[DictConfig], None]) -> Callable[[DictConfig], None]:
    """Decorate a Hydra main: an expected error ends a single run with one message, and fails one job of a multirun.

    Tracebacks are shown with ``debug=true`` or ``HYDRA_FULL_ERROR=1``; programming errors always show theirs.
    """

    @functools.wraps(main)
    def wrapper(cfg: DictConfig) -> None:
        try:
            main(cfg)
        except InterruptedRunError as stop:  # ends a multirun too
            sys.stderr.write(f"{stop}\n")
            sys.exit(stop.exit_code)
        except KeyboardInterrupt:  # before the first batch, or a second Ctrl-C
            sys.stderr.write("stopped by SIGINT.\n")
            sys.exit(128 + signal.SIGINT)
        except EXPECTED_IN_RUN as error:
            multirun = HydraConfig.get().mode == RunMode.MULTIRUN
            if multirun or cfg.get("debug", False) or wants_traceback():
                raise
            fail(error)

    return wrapper

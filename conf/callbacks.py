"""Checks before Hydra creates a folder, and errors in one message instead of a traceback."""

import functools
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
from agents.interruption import InterruptedRunError, sweep_stops
from agents.report_runs import ReportError
from agents.seeds import SeedsFailedError
from conf.command_line import fail, wants_traceback
from conf.job_log import FAILED, LOG, JobLog, keep_failure
from conf.launching import beside_others
from conf.run_folder import BusyFolderError, finished_program, only_writer
from conf.schema import check_evaluation, check_training, to_config
from conf.tuning import go_on

EXPECTED = (ValueError, OSError, OmegaConfBaseException)  # of a configuration that is being checked
EXPECTED_IN_RUN = (
    BusyFolderError,
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
    _log: JobLog | None = None

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

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Before the sweeper exists."""
        go_on(config.hydra.sweeper)

    def on_job_start(self, config: DictConfig, **kwargs: Any) -> None:
        """A run beside others writes to a log of its own."""
        if config.hydra.mode == RunMode.MULTIRUN:
            folder = Path(config.hydra.runtime.output_dir)
            (folder / FAILED).unlink(missing_ok=True)
            self._log = JobLog(folder / LOG) if beside_others(config) else None

    def on_job_end(self, config: DictConfig, job_return: JobReturn, **kwargs: Any) -> None:
        """Keep a failed run's traceback in its folder, and make of its error one that other processes can read."""
        if config.hydra.mode != RunMode.MULTIRUN:
            return
        error = job_return._return_value
        if job_return.status == JobStatus.FAILED and not isinstance(error, InterruptedRunError):
            folder = Path(config.hydra.runtime.output_dir)
            expected = isinstance(error, (*EXPECTED, *EXPECTED_IN_RUN))
            if self._log is None and (config.get("debug", False) or wants_traceback()):
                traceback.print_exception(error)
            job_return._return_value = keep_failure(folder, job_return.overrides or (), error, expected)
        if self._log is not None:
            self._log.close()


class ValidateTraining(ValidateConfig):
    """The same for train.py, with the checkpoint that ``resume`` names."""

    check = staticmethod(check_training)
    finished = staticmethod(finished_program)


class ValidateEvaluation(ValidateConfig):
    """The same for evaluate.py, with the run that it names."""

    check = staticmethod(check_evaluation)


def one_clear_error(main: Callable[[DictConfig], Any]) -> Callable[[DictConfig], Any]:
    """Decorate a Hydra main: an expected error ends a single run with one message, and fails one job of a multirun.

    Tracebacks are shown with ``debug=true`` or ``HYDRA_FULL_ERROR=1``; programming errors always show theirs.
    """

    @functools.wraps(main)
    def wrapper(cfg: DictConfig) -> Any:
        beside = beside_others(HydraConfig.instance().cfg)  # pyright: ignore[reportArgumentType]
        try:
            if sweep_stops():
                raise InterruptedRunError(signal.SIGTERM, "stopped with its sweep before it began")
            with only_writer(Path(HydraConfig.get().runtime.output_dir)):
                return main(cfg)
        except InterruptedRunError as stop:  # ends a multirun too, if it is this process's
            if beside:
                raise
            sys.stderr.write(f"{stop}\n")
            sys.exit(stop.exit_code)
        except KeyboardInterrupt:  # before the first batch, or a second Ctrl-C
            if beside:
                raise InterruptedRunError(signal.SIGINT, "stopped by SIGINT.") from None
            sys.stderr.write("stopped by SIGINT.\n")
            sys.exit(128 + signal.SIGINT)
        except EXPECTED_IN_RUN as error:
            multirun = HydraConfig.get().mode == RunMode.MULTIRUN
            if multirun or cfg.get("debug", False) or wants_traceback():
                raise
            fail(error)

    return wrapper

"""Checks before Hydra creates a folder, and errors in one message instead of a traceback."""

import functools
import os
import signal
import sys
import textwrap
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from agents.checkpoint import CheckpointError
from agents.divergence import DivergedError
from agents.incident import ViolationError
from agents.interruption import InterruptedRunError
from agents.report_runs import ReportError
from conf.run_folder import finished_run
from conf.schema import check_evaluation, check_training, to_config

EXPECTED = (ValueError, OSError, OmegaConfBaseException)  # of a configuration that is being checked
EXPECTED_IN_RUN = (
    CheckpointError,
    DivergedError,
    ReportError,
    ViolationError,
    OSError,
    OmegaConfBaseException,
)  # anything else is a programming error


def fail(error: BaseException) -> None:
    """Print one message of at most 8 lines and leave with exit code 1."""
    text = str(error).splitlines() or [type(error).__name__]
    lines = [line for part in text for line in textwrap.wrap(part, 110)][:7]
    sys.stderr.write("\n".join(["error: " + lines[0], *("  " + line for line in lines[1:])]) + "\n")
    sys.exit(1)


class ValidateConfig(Callback):
    """Validates the composed configuration before anything is written.

    Hydra swallows exceptions of callbacks, so a bad value ends the program here. Jobs of a multirun are validated one
    by one when they start: a bad one must not end the others.
    """

    check = staticmethod(to_config)

    def on_run_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Before the run folder exists."""
        try:
            self.check(config)
        except EXPECTED as error:
            if config.get("debug", False):
                traceback.print_exception(error)
                sys.exit(1)
            fail(error)
        message = finished_run(Path(str(config.hydra.run.dir)), config.get("resume"))
        if message:  # before Hydra rewrites .hydra/
            sys.stderr.write(message + "\n")
            sys.exit(0)


class ValidateTraining(ValidateConfig):
    """The same for train.py, with the checkpoint that ``resume`` names."""

    check = staticmethod(check_training)


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
            if multirun or cfg.get("debug", False) or os.environ.get("HYDRA_FULL_ERROR") == "1":
                raise
            fail(error)

    return wrapper

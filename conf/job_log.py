"""Output of a sweep's run: what it prints goes to a file of its own where several runs work at once; failures are kept."""

import contextlib
import json
import os
import signal
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path

from tqdm import tqdm

from agents.interruption import STOP_FILE

LOG = "run.log"
"""In the run's folder: all output of a run beside others; of any failed run of a sweep, the traceback."""
FAILED = "failed.json"
"""In the folder of a failed run, until it is started again."""


class FailedRunError(RuntimeError):
    """What made a run of a sweep fail, as text: the error itself may not survive the way back from another process."""

    def __init__(self, message: str, kind: str, expected: bool) -> None:
        super().__init__(message, kind, expected)
        self.kind = kind
        """Name of the error's class."""
        self.expected = expected
        """Whether the message says all; other errors are this program's fault, and their traceback is in the log."""

    def __str__(self) -> str:
        """The message, with the error's name where it does not say all."""
        return str(self.args[0]) if self.expected else f"{self.kind}: {self.args[0]}"


class JobLog:
    """Sends this process's standard output and error, those of its libraries included, to the end of a file."""

    def __init__(self, path: Path) -> None:
        self._flush()
        self._kept = [os.dup(1), os.dup(2)]
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("ab") as file:
            os.dup2(file.fileno(), 1)
            os.dup2(file.fileno(), 2)
        own = os.environ.get(STOP_FILE, "").endswith(
            f"_{os.getpid()}"
        )  # joblib with one run at once takes no other process
        # Ctrl-C is the sweep's, which asks the runs to stop
        if not own:
            signal.signal(signal.SIGINT, signal.SIG_IGN)

    def close(self) -> None:
        """Back to where the output went before."""
        for bar in list(getattr(tqdm, "_instances", ())):
            bar.close()  # of a run that failed; it would draw itself once more when it is collected
        self._flush()
        for target, kept in zip((1, 2), self._kept, strict=True):
            os.dup2(kept, target)
            os.close(kept)

    @staticmethod
    def _flush() -> None:
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError, ValueError):
                stream.flush()


def keep_failure(folder: Path, overrides: Sequence[str], error: BaseException, expected: bool) -> FailedRunError:
    """Write the traceback to the end of the run's log and the message to ``failed.json``; both as an error to hand on."""
    failure = FailedRunError(str(error) or type(error).__name__, type(error).__name__, expected)
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / LOG).open("a", encoding="utf-8") as file:
        file.writelines(traceback.format_exception(error))
    content = {"error": failure.args[0], "kind": failure.kind, "expected": expected, "overrides": list(overrides)}
    (folder / FAILED).write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    return failure


def read_failure(folder: Path) -> FailedRunError | None:
    """What :func:`keep_failure` left in ``folder``."""
    try:
        content = json.loads((folder / FAILED).read_text(encoding="utf-8"))
        return FailedRunError(content["error"], content["kind"], content["expected"])
    except (OSError, ValueError, KeyError):
        return None

"""Asking a run to stop: SIGTERM (batch systems) and SIGINT (Ctrl-C) let it finish its batch and write a checkpoint.

So does SIGUSR2 where a batch system's own handler waits for it (submitit: the time limit is near). A sweep whose runs
are in other processes stops them by a file, which each run looks for: :data:`STOP_FILE` names it.
"""

import os
import signal
import threading
import time
from pathlib import Path
from types import FrameType

STOP_FILE = "SURVEILLANCE_STOP_FILE"
"""Environment variable: path whose existence asks the runs of a sweep to stop."""


class InterruptedRunError(RuntimeError):
    """A run that was asked to stop, and did after writing a checkpoint."""

    def __init__(self, signum: int, message: str) -> None:
        super().__init__(signum, message)  # all arguments: the error of a run in another process is pickled
        self.exit_code = 128 + signum
        """The shell's convention for a program that a signal has ended."""

    def __str__(self) -> str:
        """The message alone."""
        return str(self.args[1])


def sweep_stops() -> bool:
    """Whether the sweep that this run is part of has been asked to stop."""
    path = os.environ.get(STOP_FILE)
    return path is not None and Path(path).exists()


class StopSignals:
    """Context in which the first signal is only noted; the second one acts as usual.

    A handler that was there before (submitit's) is called once the checkpoint is written: it may end the process, or
    return, and the run goes on.
    """

    def __init__(self) -> None:
        self._signum: int | None = None
        self._looked = time.monotonic()
        self._before: dict[int, object] = {}
        self._handlers: dict[int, object] = {}

    @property
    def received(self) -> int | None:
        """Number of the signal that asks the run to stop; None without one. Looks for the sweep's stop file once a second."""
        if self._signum is None and time.monotonic() - self._looked > 1.0:
            self._looked = time.monotonic()
            if sweep_stops():
                self._signum, self._handlers = signal.SIGTERM, {}
        return self._signum

    def __enter__(self) -> "StopSignals":
        """Take over the signals (only the main thread may)."""
        if threading.current_thread() is threading.main_thread():
            waits = callable(signal.getsignal(signal.SIGUSR2))
            for signum in (signal.SIGTERM, signal.SIGINT, *((signal.SIGUSR2,) if waits else ())):
                self._before[signum] = signal.signal(signum, self._note)
        return self

    def __exit__(self, *exception: object) -> None:
        """Hand them back."""
        for signum, handler in self._before.items():
            signal.signal(signum, handler)  # pyright: ignore[reportArgumentType]
        self._before.clear()

    def _note(self, signum: int, frame: FrameType | None) -> None:
        self._signum = signum
        self._handlers = dict(self._before)
        self.__exit__()

    def check(self, where: str) -> None:
        """Act on a signal that has come.

        Args:
            where: how far the run is and what it has saved, for the message.

        Raises:
            InterruptedRunError: unless another handler had been waiting for the signal.
        """
        if self._signum is None:
            return
        signum, handler = self._signum, self._handlers.get(self._signum)
        if callable(handler) and handler is not signal.default_int_handler:
            handler(signum, None)
            self._signum = None
            self.__enter__()
            return
        name = signal.Signals(signum).name
        raise InterruptedRunError(signum, f"stopped by {name} {where}. The same command goes on from there.")

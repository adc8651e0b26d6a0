"""Asking a run to stop: SIGTERM (batch systems) and SIGINT (Ctrl-C) let it finish its batch and write a checkpoint."""

import signal
import threading
from types import FrameType


class InterruptedRunError(RuntimeError):
    """A run that was asked to stop, and did after writing a checkpoint."""

    def __init__(self, signum: int, message: str) -> None:
        super().__init__(message)
        self.exit_code = 128 + signum
        """The shell's convention for a program that a signal has ended."""


class StopSignals:
    """Context in which the first SIGTERM or SIGINT is only noted; the second one acts as usual."""

    def __init__(self) -> None:
        self.received: int | None = None
        self._before: dict[int, object] = {}

    def __enter__(self) -> "StopSignals":
        """Take over the signals (only the main thread may)."""
        if threading.current_thread() is threading.main_thread():
            for signum in (signal.SIGTERM, signal.SIGINT):
                self._before[signum] = signal.signal(signum, self._note)
        return self

    def __exit__(self, *exception: object) -> None:
        """Hand them back."""
        for signum, handler in self._before.items():
            signal.signal(signum, handler)  # pyright: ignore[reportArgumentType]
        self._before.clear()

    def _note(self, signum: int, frame: FrameType | None) -> None:
        self.received = signum
        self.__exit__()

    def check(self, where: str) -> None:
        """Raise :class:`InterruptedRunError` if a signal has come.

        Args:
            where: how far the run is and what it has saved, for the message.
        """
        if self.received is not None:
            name = signal.Signals(self.received).name
            raise InterruptedRunError(self.received, f"stopped by {name} {where}. The same command goes on from there.")

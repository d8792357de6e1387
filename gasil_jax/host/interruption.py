"""SIGINT and SIGTERM as something to look at, between two chunks of training."""

import contextlib
import signal
from types import FrameType, TracebackType
from typing import Any


class Interrupted(Exception):
    """A signal ended a run before its time; all that was done is saved.

    Attributes:
      signal: which one.
    """

    def __init__(self, number: signal.Signals):
        super().__init__(f"interrupted by {number.name}; all that was done is saved")
        self.signal = number


class Interruption:
    """While it is entered, notes the first of these signals; a second one kills.

    Attributes:
      signal: the one that came, or None.
    """

    def __init__(self) -> None:
        self.signal: signal.Signals | None = None
        self._before: dict[int, Any] = {}

    def __enter__(self) -> "Interruption":
        # Outside the main thread Python takes no handlers, and gets no signals.
        with contextlib.suppress(ValueError):
            for number in (signal.SIGINT, signal.SIGTERM):
                self._before[number] = signal.signal(number, self._note)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._restore()

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.signal = signal.Signals(number)
        self._restore()

    def _restore(self) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._before = {}

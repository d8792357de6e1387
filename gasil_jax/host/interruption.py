"""Record SIGINT and SIGTERM, so that training can save before it stops."""

import contextlib
import signal
import sys
from collections.abc import Iterator
from types import FrameType
from typing import Any

#: What a signal is answered with at once: a compilation or a chunk ends before.
ANSWER = "stopping soon; Ctrl-C again quits now"


class Interrupted(Exception):
    """Raised when a signal has stopped a run early; its progress is saved."""

    def __init__(self, number: signal.Signals):
        super().__init__(f"interrupted by {number.name}; all that was done is saved")
        self.signal = number


@contextlib.contextmanager
def noted(how_to_continue: str) -> Iterator[None]:
    """Add to an `Interrupted` from the `with` block how to continue."""
    try:
        yield
    except Interrupted as interrupted:
        interrupted.add_note(how_to_continue)
        raise


class Interruption:
    """Records the first signal in the `with` block; a second one ends the process."""

    def __init__(self) -> None:
        self.signal: signal.Signals | None = None
        self._before: dict[int, Any] = {}

    def __enter__(self) -> "Interruption":
        # Python allows signal handlers only in the main thread.
        with contextlib.suppress(ValueError):
            for number in (signal.SIGINT, signal.SIGTERM):
                self._before[number] = signal.signal(number, self._record)
        return self

    def __exit__(self, *exception: object) -> None:
        self._restore()

    def _record(self, number: int, frame: FrameType | None) -> None:
        self.signal = signal.Signals(number)
        self._restore()
        print(ANSWER, file=sys.stderr, flush=True)

    def _restore(self) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._before = {}

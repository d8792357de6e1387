"""Show the progress of a run, in lines on stderr; a terminal's is rewritten."""

import contextlib
import datetime
import math
import shutil
import sys
import threading
import time
from collections.abc import Iterator

import numpy as np

from gasil_jax.statistics import interquartile_mean

_SECONDS_BETWEEN_LINES = 10.0
_SECONDS_BETWEEN_ANNOUNCEMENTS = 30.0
_SECONDS_BEFORE_ANNOUNCEMENT = 1.0


@contextlib.contextmanager
def announced(title: str, name: str, *, at_once: bool = False) -> Iterator[None]:
    """Print what the `with` block does if it takes more than a second, and how long."""
    ended, started = threading.Event(), time.monotonic()

    def tell() -> None:
        text, wait = name, 0.0 if at_once else _SECONDS_BEFORE_ANNOUNCEMENT
        while not ended.wait(wait):
            _line(title, text)
            wait = _SECONDS_BETWEEN_ANNOUNCEMENTS
            text = f"{name} ({time.monotonic() + wait - started:.0f} s)"

    thread = threading.Thread(target=tell, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def _line(title: str, text: str, *, kept: bool = True) -> None:
    line = f"{title}: {text}"
    if sys.stderr.isatty():
        width = shutil.get_terminal_size().columns - 1
        # A longer one would take two rows; what is at its end changes most.
        line = f"\r{' ' * width}\r{line if kept else line[-width:]}"
    # One write, so that other threads' lines are not mixed with it.
    sys.stderr.write(line + "\n" * kept)
    sys.stderr.flush()


class Progress:
    """Shows one member's steps, the members' mean return, steps/s and the time left."""

    def __init__(
        self,
        title: str,
        total_steps: int,
        num_members: int = 1,
        *,
        members: str = "seeds",
        shown: bool = True,
    ):
        self._title, self._shown = title, shown
        self._total, self._num_members = total_steps, num_members
        times = f" x {num_members} {members}" if num_members > 1 else ""
        self._amount = f"{total_steps // num_members:,} steps{times}"
        self._training_since = self._last_line = time.monotonic()
        self._steps_before = 0
        self._return, self._kept = "(none ended)", True

    def phase(self, name: str, steps: int = 0) -> None:
        """Show the name of a phase that begins after `steps` environment steps."""
        self._training_since = self._last_line = time.monotonic()
        self._steps_before = steps
        self._tell(name)

    @contextlib.contextmanager
    def aside(self, name: str, *, at_once: bool = False) -> Iterator[None]:
        """Show what the `with` block does; its time does not count in the speed."""
        started = time.monotonic()
        with contextlib.ExitStack() as stack:
            if self._shown:
                stack.enter_context(announced(self._title, name, at_once=at_once))
            yield
        self._training_since += time.monotonic() - started

    def warn(self, text: str) -> None:
        """Print a warning."""
        self._tell(f"warning: {text}")

    def update(self, steps: int, returns: np.ndarray) -> None:
        """Show all members' steps, and the last returns, (members, iterations)."""
        each = [row[np.isfinite(row)] for row in returns]
        each = [row.mean() for row in each if row.size]
        if each:
            self._return = f"{interquartile_mean(np.array(each)):.1f}"
        now = time.monotonic()
        rewritten = sys.stderr.isatty() and steps < self._total
        waited = rewritten or now - self._last_line > _SECONDS_BETWEEN_LINES
        if waited or steps >= self._total:
            self._last_line = now
            seconds = max(now - self._training_since, 1e-9)
            speed = (steps - self._steps_before) / seconds
            left = datetime.timedelta(seconds=math.ceil((self._total - steps) / speed))
            self._tell(
                f"{steps // self._num_members:,}/{self._amount}, return "
                f"{self._return}, {speed:,.0f} steps/s, {left} left",
                kept=not rewritten,
            )

    def close(self) -> None:
        """End a line that would have been rewritten."""
        if not self._kept:
            sys.stderr.write("\n")

    def _tell(self, text: str, *, kept: bool = True) -> None:
        if self._shown:
            _line(self._title, text, kept=kept)
            self._kept = kept

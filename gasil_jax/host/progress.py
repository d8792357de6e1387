"""Show the progress of a run: as a bar on a terminal, as plain lines elsewhere."""

import contextlib
import datetime
import math
import sys
import threading
import time
from collections.abc import Iterator

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, SpinnerColumn, TextColumn
from rich.progress import Progress as RichProgress
from rich.table import Column

from gasil_jax.statistics import interquartile_mean

_SECONDS_BETWEEN_LINES = 10.0
_SECONDS_BETWEEN_ANNOUNCEMENTS = 30.0
_SECONDS_BEFORE_ANNOUNCEMENT = 1.0


@contextlib.contextmanager
def announced(title: str, name: str, *, at_once: bool = False) -> Iterator[None]:
    """Print a line to stderr if the `with` block takes more than a second.

    While it lasts, further lines say for how long it has.
    """
    ended, activity = threading.Event(), _Activity(name)

    def tell() -> None:
        text, wait = name, 0.0 if at_once else _SECONDS_BEFORE_ANNOUNCEMENT
        while not ended.wait(wait):
            _line(title, text)
            wait = _SECONDS_BETWEEN_ANNOUNCEMENTS
            text = str(activity)

    thread = threading.Thread(target=tell, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def _line(title: str, text: str) -> None:
    # One write, so that other threads' lines are not mixed with it.
    sys.stderr.write(f"{title}: {text}\n")
    sys.stderr.flush()


class _Activity:
    """A name that is shown with the seconds since it was first shown."""

    def __init__(self, name: str):
        self._name, self._started = name, time.monotonic()

    def __str__(self) -> str:
        return f"{self._name} ({time.monotonic() - self._started:.0f} s)"


class Progress:
    """Shows the share of the steps, the return, steps/s and the time left.

    The return is the interquartile mean over members.

    Args:
      title: name of what is trained.
      total_steps: environment steps over all members.
      num_members: number of members; the steps of one member are shown.
      members: what to call the members.
      shown: whether anything is shown at all.
    """

    def __init__(
        self,
        title: str,
        total_steps: int,
        num_members: int = 1,
        *,
        members: str = "seeds",
        shown: bool = True,
    ):
        self._console = Console(stderr=True)
        self._title = title
        self._total = total_steps
        self._num_members = num_members
        times = f" x {num_members} {members}" if num_members > 1 else ""
        self._amount = f"{total_steps // num_members:,} steps{times}"
        self._live = shown and self._console.is_terminal
        self._in_lines = shown and not self._live
        self._training_since = self._last_line = time.monotonic()
        self._steps_before = 0
        self._return: str | None = None
        # In a narrow terminal only the bar shrinks.
        fixed = Column(no_wrap=True)
        self._bar = RichProgress(
            SpinnerColumn(table_column=fixed),
            TextColumn("{task.percentage:3.0f}%", table_column=fixed),
            BarColumn(bar_width=None, table_column=Column(ratio=1)),
            TextColumn("{task.fields[status]}", table_column=fixed),
            console=self._console,
            disable=not self._live,
            expand=True,
        )
        self._task = self._bar.add_task(title, total=total_steps, status="")

    def __enter__(self) -> "Progress":
        if self._live:
            self._console.print(f"{self._title}: {self._amount}", highlight=False)
        self._bar.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._bar.stop()

    def phase(self, name: str, steps: int = 0) -> None:
        """Show the name of a phase that begins after `steps` environment steps."""
        self._training_since = self._last_line = time.monotonic()
        self._steps_before = steps
        self._bar.update(self._task, status=_Activity(name))
        if self._in_lines:
            _line(self._title, name)

    @contextlib.contextmanager
    def aside(self, name: str, *, at_once: bool = False) -> Iterator[None]:
        """Show what the `with` block does, if it takes more than a second or at once.

        Its time does not count towards the training speed.
        """
        started = time.monotonic()
        status = self._bar.tasks[0].fields["status"]
        self._bar.update(self._task, status=_Activity(name))
        with contextlib.ExitStack() as stack:
            if self._in_lines:
                stack.enter_context(announced(self._title, name, at_once=at_once))
            yield
        self._bar.update(self._task, status=status)
        self._training_since += time.monotonic() - started

    def warn(self, text: str) -> None:
        """Print a warning above the progress."""
        if self._live:
            self._console.print(f"warning: {text}", highlight=False)
        elif self._in_lines:
            _line(self._title, f"warning: {text}")

    def update(self, steps: int, returns: np.ndarray) -> None:
        """Show all members' steps, and the last returns, (members, iterations)."""
        each = [row[np.isfinite(row)] for row in returns]
        each = [row.mean() for row in each if row.size]
        if each:
            self._return = f"{interquartile_mean(np.array(each)):.1f}"
        now = time.monotonic()
        speed = (steps - self._steps_before) / max(now - self._training_since, 1e-9)
        left = datetime.timedelta(seconds=math.ceil((self._total - steps) / speed))
        status = (
            f"return {self._return or '(none ended)'}, {speed:,.0f} steps/s, "
            f"{left} left"
        )
        self._bar.update(self._task, completed=steps, status=status)
        due = now - self._last_line > _SECONDS_BETWEEN_LINES or steps >= self._total
        if self._in_lines and due:
            self._last_line = now
            done = f"{steps // self._num_members:,}/{self._amount}"
            _line(self._title, f"{done}, {status}")

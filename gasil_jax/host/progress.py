"""Show the progress of a run: as a bar on a terminal, as plain lines elsewhere."""

import contextlib
import sys
import threading
import time
from collections.abc import Iterator
from types import TracebackType

import numpy as np
from rich.console import Console
from rich.progress import (
    BarColumn,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.progress import (
    Progress as RichProgress,
)

_SECONDS_BETWEEN_LINES = 10.0
_SECONDS_OF_SILENCE = 1.0


@contextlib.contextmanager
def announced(title: str, name: str) -> Iterator[None]:
    """Print a line to stderr if the `with` block takes more than a second.

    Args:
      title: name of the program or run, the part before the colon.
      name: name of the work, the part after the colon.
    """
    timer = threading.Timer(_SECONDS_OF_SILENCE, _line, (title, name))
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def _line(title: str, text: str) -> None:
    # A single write, so that no line of another thread comes in between.
    sys.stderr.write(f"{title}: {text}\n")
    sys.stderr.flush()


class Progress:
    """Shows steps, return (mean and spread over seeds), steps/s and the time left."""

    def __init__(self, title: str, total_steps: int):
        self._console = Console(stderr=True)
        self._title = title
        self._total = total_steps
        self._live = self._console.is_terminal
        self._training_since = self._last_line = time.monotonic()
        self._steps_before = 0
        self._return = np.nan
        self._spread = np.nan
        self._bar = RichProgress(
            SpinnerColumn(),
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.fields[status]}"),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            console=self._console,
            disable=not self._live,
        )
        self._task = self._bar.add_task(title, total=total_steps, status="")

    def __enter__(self) -> "Progress":
        self._bar.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._bar.stop()

    def phase(self, name: str, steps: int = 0) -> None:
        """Show the name of the phase that begins after `steps` environment steps."""
        self._training_since = self._last_line = time.monotonic()
        self._steps_before = steps
        self._bar.update(self._task, status=name)
        if not self._live:
            _line(self._title, name)

    @contextlib.contextmanager
    def aside(self, name: str) -> Iterator[None]:
        """Show the name of work between two pieces of training, if it takes long.

        Its time does not count towards the training speed.
        """
        started = time.monotonic()
        status = self._bar.tasks[0].fields["status"]
        self._bar.update(self._task, status=name)
        with contextlib.ExitStack() as stack:
            if not self._live:
                stack.enter_context(announced(self._title, name))
            yield
        self._bar.update(self._task, status=status)
        self._training_since += time.monotonic() - started

    def update(self, steps: int, returns: np.ndarray) -> None:
        """Show progress.

        Args:
          steps: environment steps so far, over all seeds.
          returns: (seeds, iterations) of the last chunk, NaN where no episode ended.
        """
        per_seed = [row[np.isfinite(row)] for row in returns]
        per_seed = [row.mean() for row in per_seed if row.size]
        if per_seed:
            self._return, self._spread = np.mean(per_seed), np.std(per_seed)
        now = time.monotonic()
        speed = (steps - self._steps_before) / max(now - self._training_since, 1e-9)
        status = (
            f"{steps:,}/{self._total:,} steps, "
            f"return {self._return:.1f} ± {self._spread:.1f}, {speed:,.0f} steps/s"
        )
        self._bar.update(self._task, completed=steps, status=status)
        due = now - self._last_line > _SECONDS_BETWEEN_LINES or steps >= self._total
        if not self._live and due:
            self._last_line = now
            left = (self._total - steps) / speed
            _line(self._title, f"{status}, {left:,.0f} s left")

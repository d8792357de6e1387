"""Write checkpoints during training: when, and which ones are kept."""

import dataclasses
import math
import pathlib
import time
from collections.abc import Mapping
from typing import Any

from gasil_jax.host import checkpoint
from gasil_jax.host.members import Members

_SECONDS_BETWEEN_CHECKPOINTS = 600.0


@dataclasses.dataclass(frozen=True)
class CheckpointSchedule:
    """The times of checkpoints and the number to keep.

    Attributes:
      every: environment steps per seed between two checkpoints, rounded up to whole
        iterations; None writes one every ten minutes.
      keep: number of newest checkpoints to keep. One more is kept: the one with the
        best evaluation or, without evaluations, with the best returns since the
        checkpoint before it. 0 writes none.
    """

    every: int | None
    keep: int


class PeriodicCheckpoints:
    """Writes the checkpoints of training, and decides when.

    Args:
      members: the members in training.
      root: the folder of the checkpoints.
      schedule: the times of checkpoints and the number to keep.
    """

    def __init__(
        self, members: Members, root: pathlib.Path, schedule: CheckpointSchedule
    ):
        self._members, self._root = members, root
        self._keep, self._interval = schedule.keep, None
        if schedule.every is not None:
            self._interval = math.ceil(schedule.every / members.config.batch_steps)
        self._saved_at = time.monotonic()
        self._best_score = checkpoint.best_score(root)

    def check(self) -> None:
        """Raise `checkpoint.WriteError` if no checkpoint can be written."""
        if self._keep:
            checkpoint.check_writable(self._root)

    def iterations_left(self, done: int) -> float:
        """Return the iterations to the next checkpoint; infinity if time decides."""
        if self._interval is None:
            return math.inf
        return self._interval - done % self._interval

    def is_due(self, done: int, score: float | None) -> bool:
        """Return whether it is time for a checkpoint or the score is the best yet."""
        if score is not None and score > self._best_score:
            return True
        if self._interval is None:
            return time.monotonic() - self._saved_at > _SECONDS_BETWEEN_CHECKPOINTS
        return done % self._interval == 0

    def save(
        self,
        iteration: int,
        states: Any,
        *,
        record: Mapping[str, Any],
        score: float | None,
    ) -> None:
        """Write a checkpoint, and delete older ones that need not be kept.

        Args:
          iteration: number of iterations so far.
          states: the members' states, padded.
          record: what the checkpoint records beside them.
          score: the mean score of the current policies; None if they were not
            evaluated.
        """
        if score is not None:
            self._best_score = max(self._best_score, score)
        if self._keep:
            states = self._members.trim(states)
            checkpoint.write(self._root, iteration, states, record)
            checkpoint.prune(self._root, self._keep)
            self._saved_at = time.monotonic()

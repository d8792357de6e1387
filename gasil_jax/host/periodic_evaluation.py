"""Score the policies of a batch at set times while it trains.

The scores are in evaluations.csv, beside metrics.csv: a row for each member and
evaluation, with the mean, least and greatest return of its episodes and their mean
length. Training is the same, bit for bit, with and without.
"""

import math
import pathlib
import time
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from gasil_jax.evaluation import evaluate
from gasil_jax.host import metrics_files, trackers
from gasil_jax.host.members import Batch
from gasil_jax.train import TrainState

#: Columns of evaluations.csv after those that tell the members apart.
COLUMNS = ("env_steps", "mean", "min", "max", "length")
# Far from the seed numbers in use, whose keys are those of training.
_ROOT = 2**32 - 1


class EvaluationSchedule(NamedTuple):
    """When policies are scored, and in how many episodes.

    Attributes:
      every: environment steps of a seed between two evaluations, rounded up to whole
        iterations; the last policy is scored in any case.
      num_episodes: of each policy, from fresh starts.
    """

    every: int
    num_episodes: int


def evaluation_key(seed: jax.Array | int, iteration: jax.Array | int) -> jax.Array:
    """The key of a seed's evaluation after so many iterations.

    It depends on these two numbers alone: not on training's keys, and not on the
    members beside it.
    """
    return jax.random.fold_in(
        jax.random.fold_in(jax.random.key(_ROOT), seed), iteration
    )


class PeriodicEvaluation:
    """Scores all members with one compiled program, sharded as their training is.

    Args:
      runs: what is trained.
      schedule: when, and in how many episodes.
      path: of evaluations.csv.
      labels: columns that tell the members apart, (members,) each.
      size: where the file goes on, as of `metrics_files.MetricsWriter`.
      following: trackers that are given the scores too.

    Attributes:
      seconds: spent on evaluations in this process, compiling included.

    Raises:
      FileExistsError: a new file would replace one.
      ValueError: the file that is to go on is missing or shorter than `size`.
    """

    def __init__(
        self,
        runs: Batch,
        schedule: EvaluationSchedule,
        path: pathlib.Path,
        *,
        labels: Mapping[str, Sequence[Any]],
        size: int | None = None,
        following: Sequence[trackers.Tracker] = (),
    ):
        def score(state: TrainState, seed: jax.Array) -> dict[str, jax.Array]:
            return evaluate(
                runs.env,
                runs.config,
                state,
                evaluation_key(seed, state.iteration),
                num_episodes=schedule.num_episodes,
            )

        self.seconds = 0.0
        self._interval = math.ceil(schedule.every / runs.config.batch_steps)
        self._runs, self._labels, self._trackers = runs, labels, following
        self._seeds = runs.place(np.array(runs.seeds, np.uint32))
        self._score = runs.of_members(score)
        self._writer = metrics_files.MetricsWriter(path, labels, size, columns=COLUMNS)

    def iterations_left(self, done: int) -> int:
        """Iterations from `done` to the next evaluation, one at least."""
        return self._interval - done % self._interval

    def is_due(self, done: int) -> bool:
        """Whether the policies after so many iterations are to be scored."""
        return done % self._interval == 0 or done == self._runs.config.num_iterations

    def score(self, states: Any, done: int) -> float:
        """Score the policies, write the scores and give them to the trackers.

        Args:
          states: of the members, padded, as training has them; they stay as they are.
          done: iterations that they have behind them.

        Returns:
          the mean return over episodes and members.
        """
        started = time.monotonic()
        episodes = jax.tree.map(np.asarray, self._score(states, self._seeds))
        episodes = self._runs.trim(episodes)
        returns, length = episodes["episode_return"], episodes["episode_length"]
        scores = {
            "env_steps": np.full(len(returns), done * self._runs.config.batch_steps),
            "mean": returns.mean(axis=1),
            "min": returns.min(axis=1),
            "max": returns.max(axis=1),
            "length": length.mean(axis=1),
        }
        self._writer.write({name: x[:, None] for name, x in scores.items()})
        trackers.log_evaluation(self._trackers, self._labels, scores)
        self.seconds += time.monotonic() - started
        return float(scores["mean"].mean(dtype=np.float64))

    def size(self) -> int:
        """Bytes of evaluations.csv, all of them on the disk."""
        return self._writer.size()

    def close(self) -> None:
        """Close evaluations.csv."""
        self._writer.close()

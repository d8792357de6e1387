"""Train a batch for a command line: chunk by chunk, logged, saved and interruptible.

The folder that it is given gets metrics.csv, checkpoints/ and, where policies are
evaluated on the way, evaluations.csv. What a checkpoint has seen of the two tables is
recorded in it, so that a run that goes on from it cuts them there and writes the same
rows again.
"""

import dataclasses
import math
import pathlib
import sys
import time
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np

from gasil_jax.host import checkpoint, command_line, metrics_files
from gasil_jax.host.interruption import Interrupted, Interruption
from gasil_jax.host.members import Batch
from gasil_jax.host.periodic_evaluation import EvaluationSchedule, PeriodicEvaluation
from gasil_jax.host.progress import Progress
from gasil_jax.host.trackers import Tracker, log

# Between two calls of the compiled program: time to react to Ctrl-C, and between two
# updates of the display.
_SECONDS_OF_A_CHUNK = 5.0
_SECONDS_BETWEEN_CHECKPOINTS = 600.0


@dataclasses.dataclass(frozen=True)
class CheckpointSchedule:
    """When checkpoints are written and how many are kept.

    Attributes:
      every: environment steps of a seed between two of them; None for ten minutes.
      keep: so many of the newest, and the one with the best evaluation or, where
        there is none, the best returns since the one before.
    """

    every: int | None
    keep: int


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What training has given.

    Attributes:
      states: of the members after the last iteration.
      new_steps: environment steps over all members that this process took.
      compile_seconds: spent in this process on compiling the training.
      train_seconds: spent in this process on training, without its evaluations.
      evaluation_seconds: spent in this process on evaluations, compiling included;
        None without evaluations.
    """

    states: Any
    new_steps: int
    compile_seconds: float
    train_seconds: float
    evaluation_seconds: float | None


class _Tables:
    """metrics.csv and evaluations.csv of a folder, and the trackers beside them.

    Args:
      runs: what is trained.
      folder: of the files.
      labels: columns that tell the members apart, (members,) each.
      evaluation_schedule: of evaluations; None for none.
      trackers: given the same numbers.
      record: of the checkpoint that training goes on from: the tables are cut where
        it was written. None without a checkpoint.
    """

    def __init__(
        self,
        runs: Batch,
        folder: pathlib.Path,
        labels: Mapping[str, Sequence[Any]],
        *,
        evaluation_schedule: EvaluationSchedule | None,
        trackers: Sequence[Tracker],
        record: Mapping[str, Any] | None,
    ):
        self._labels, self._trackers = labels, trackers
        path = folder / "metrics.csv"
        self._metrics = metrics_files.MetricsWriter(path, labels, _size(path, record))
        self.evaluation = None
        if evaluation_schedule is not None:
            path = folder / "evaluations.csv"
            self.evaluation = PeriodicEvaluation(
                runs,
                evaluation_schedule,
                path,
                labels=labels,
                size=_size(path, record),
                following=trackers,
            )

    def write(self, metrics: Mapping[str, np.ndarray]) -> None:
        """Add the metrics of a chunk, (members, iterations) each."""
        self._metrics.write(metrics)
        log(self._trackers, self._labels, metrics)

    def sizes(self) -> dict[str, int]:
        """Bytes of each table on the disk, as a checkpoint's record has them."""
        sizes = {"metrics_size": self._metrics.size()}
        if self.evaluation is not None:
            sizes["evaluations_size"] = self.evaluation.size()
        return sizes

    def close(self) -> None:
        """Close the files and the trackers."""
        self._metrics.close()
        if self.evaluation is not None:
            self.evaluation.close()
        for tracker in self._trackers:
            tracker.close()


class _Checkpoints:
    """When checkpoints of a run are due, and writing them.

    Args:
      root: folder of the checkpoints.
      schedule: when they are written and how many are kept.
      runs: what is trained.
    """

    def __init__(self, root: pathlib.Path, schedule: CheckpointSchedule, runs: Batch):
        self.root, self._schedule, self._runs = root, schedule, runs
        every = schedule.every
        # None: by the clock.
        self._interval = every and math.ceil(every / runs.config.batch_steps)
        self._saved_at = time.monotonic()

    def iterations_left(self, done: int) -> float:
        """Iterations from `done` to the next checkpoint; infinity if by the clock."""
        if self._interval is None:
            return math.inf
        return self._interval - done % self._interval

    def is_due(self, done: int) -> bool:
        """Whether a checkpoint is to be written after so many iterations."""
        if self._interval is None:
            return time.monotonic() - self._saved_at > _SECONDS_BETWEEN_CHECKPOINTS
        return done % self._interval == 0

    def save(self, done: int, states: Any, record: Mapping[str, Any]) -> None:
        """Write a checkpoint, and delete those that are not kept."""
        checkpoint.write(self.root, done, self._runs.trim(states), record)
        checkpoint.prune(self.root, self._schedule.keep)
        self._saved_at = time.monotonic()


def _restored(
    runs: Batch, root: pathlib.Path, progress: Progress, tables: Sequence[str]
) -> tuple[Any, int, Mapping[str, Any] | None]:
    """The states of the newest whole checkpoint, its iteration and its record.

    Without one the states and the record are None, and the iteration is 0. What is
    newer is damaged, told and set aside.
    """
    with progress.aside("reading the checkpoints"):
        newest, damages = checkpoint.latest(root, [f"{table}_size" for table in tables])
    for damage in damages:
        instead = "starting anew" if newest is None else f"using {newest.folder.name}"
        print(f"warning: {damage}; {instead}", file=sys.stderr)
    checkpoint.set_aside(root, newer_than=-1 if newest is None else newest.iteration)
    if newest is None:
        return None, 0, None
    with progress.aside(f"restoring {newest.folder.name}"):
        like = jax.eval_shape(lambda: runs.trim(runs.init()))
        with command_line.input_checked():
            return newest.restore(like), newest.iteration, newest.record


def _size(path: pathlib.Path, record: Mapping[str, Any] | None) -> int | None:
    """Where a table goes on: what the checkpoint has seen of it; None where it begins.

    Args:
      path: of the table, such as metrics.csv.
      record: of the checkpoint that training goes on from; None without one.
    """
    if record is not None:
        return record[f"{path.stem}_size"]
    return 0 if path.exists() else None


def drive(
    runs: Batch,
    folder: pathlib.Path,
    labels: Mapping[str, Sequence[Any]],
    *,
    schedule: CheckpointSchedule,
    progress: Progress,
    interruption: Interruption,
    evaluation_schedule: EvaluationSchedule | None = None,
    steps_before: int = 0,
    trackers: Sequence[Tracker] = (),
) -> Outcome:
    """Train to the end, from the newest whole checkpoint in the folder if it has one.

    Args:
      runs: what to train.
      folder: of metrics.csv, evaluations.csv and checkpoints/.
      labels: what the tables call the members, (members,) each.
      schedule: of the checkpoints.
      progress: told what is going on.
      interruption: looked at after each chunk; a checkpoint is written then.
      evaluation_schedule: of evaluations on the way; None for none.
      steps_before: environment steps that `progress` has counted already.
      trackers: given the metrics too, and closed.

    Raises:
      Interrupted: after the checkpoint that an interruption asks for.
      InputError: the checkpoint is of another state, or a table is damaged.
      OSError: the folder can't be written, or the disk is full.
    """
    config, last = runs.config, runs.config.num_iterations
    steps_of = lambda done: done * config.batch_steps * runs.num_members
    checkpoints = _Checkpoints(folder / "checkpoints", schedule, runs)
    names = ("metrics",) if evaluation_schedule is None else ("metrics", "evaluations")
    states, first, record = _restored(runs, checkpoints.root, progress, names)
    with command_line.input_checked():
        tables = _Tables(
            runs,
            folder,
            labels,
            evaluation_schedule=evaluation_schedule,
            trackers=trackers,
            record=record,
        )
    evaluation = tables.evaluation

    started = time.monotonic()
    if first < last:
        progress.phase("compiling", steps_before + steps_of(first))
        states, advance = runs.compile(states)
    compile_seconds = time.monotonic() - started

    progress.phase("training", steps_before + steps_of(first))
    started = time.monotonic()
    done, seconds_of_one = first, math.inf
    # Since the last checkpoint, and of the states as they are now.
    returns: list[np.ndarray] = []
    evaluated: float | None = None

    def save() -> None:
        # Where policies are evaluated, one that was not has no score.
        score = _mean(returns) if evaluation is None else evaluated
        with progress.aside("saving a checkpoint"):
            checkpoints.save(done, states, tables.sizes() | {"score": score})

    while done < last and interruption.signal is None:
        count = min(
            runs.chunk,
            last - done,
            max(1, int(_SECONDS_OF_A_CHUNK / seconds_of_one)),
            checkpoints.iterations_left(done),
            math.inf if evaluation is None else evaluation.iterations_left(done),
        )
        chunk_started = time.monotonic()
        states, metrics = runs.train(advance, states, done, int(count))
        seconds_of_one = (time.monotonic() - chunk_started) / count
        done += int(count)
        tables.write(metrics)
        returns.append(metrics["episode_return"])
        progress.update(steps_before + steps_of(done), metrics["episode_return"])
        due, evaluated = checkpoints.is_due(done), None
        if evaluation is not None and evaluation.is_due(done):
            with progress.aside("evaluating the policies"):
                evaluated = evaluation.score(states, done)
            due |= evaluated > checkpoint.best_score(checkpoints.root)
        if due:
            save()
            returns = []
    train_seconds = time.monotonic() - started
    save()
    with progress.aside("closing the trackers"):
        tables.close()
    if interruption.signal is not None and done < last:
        raise Interrupted(interruption.signal)
    evaluation_seconds = None if evaluation is None else evaluation.seconds
    return Outcome(
        states=runs.trim(states),
        new_steps=steps_of(done - first),
        compile_seconds=compile_seconds,
        train_seconds=train_seconds - (evaluation_seconds or 0.0),
        evaluation_seconds=evaluation_seconds,
    )


def _mean(returns: Sequence[np.ndarray]) -> float | None:
    """The mean of all that are finite; None where none is."""
    finite = [x[np.isfinite(x)] for x in returns]
    every = np.concatenate(finite) if finite else np.empty(0)
    return float(every.mean()) if every.size else None

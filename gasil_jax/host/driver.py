"""Train members in chunks; log, save and evaluate them between chunks.

`drive` writes metrics.csv, checkpoints/ and, if policies are evaluated during training,
evaluations.csv. A checkpoint records the sizes of the two tables and their hashes.
Training that continues from it cuts the tables to these sizes and writes the same rows
again.
"""

import dataclasses
import functools
import math
import pathlib
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np

from gasil_jax.errors import InputError
from gasil_jax.host import checkpoint, command_line, metrics_files, run_folder
from gasil_jax.host.interruption import Interrupted, Interruption
from gasil_jax.host.members import Members
from gasil_jax.host.periodic_checkpoints import CheckpointSchedule, PeriodicCheckpoints
from gasil_jax.host.periodic_evaluation import EvaluationSchedule, PeriodicEvaluation
from gasil_jax.host.progress import Progress
from gasil_jax.host.trackers import Tracker, log
from gasil_jax.train import TrainState

# Largest duration of a chunk. The progress display is updated, and Ctrl-C takes effect,
# after each chunk.
_SECONDS_PER_CHUNK = 5.0
_AFTER_COMPILATION = "stopping after compilation; Ctrl-C again quits now"

_Columns = Mapping[str, np.ndarray]


@dataclasses.dataclass(frozen=True)
class FitProgress:
    """The progress of training after a chunk of iterations.

    Attributes:
      iteration: number of iterations so far.
      env_steps: number of environment steps of each seed so far.
      metrics: the metrics of the chunk, (seeds, iterations) each.
      evaluation: columns of evaluations.csv, (seeds,) each; None if the policies were
        not evaluated after this chunk.
      copy_states: makes the copy that `states` returns; works only in the callback.
    """

    iteration: int
    env_steps: int
    metrics: Mapping[str, np.ndarray]
    evaluation: Mapping[str, np.ndarray] | None
    copy_states: Callable[[], TrainState]

    @functools.cached_property
    def states(self) -> TrainState:
        """A copy of the training states, (seeds, ...), as in `fitting.FitResult`.

        Read it in the callback; the copy may be kept.

        Raises:
          RuntimeError: if it is first read after training has gone on.
        """
        return self.copy_states()


#: Called after each chunk, on the host; training stops if it returns true.
Callback = Callable[[FitProgress], bool | None]


@dataclasses.dataclass(frozen=True)
class Outcome:
    """The result of training.

    Attributes:
      states: the members' states after the last iteration.
      measured: how this process trained, for a JSON file: "env_steps" over all members,
        the seconds of compiling, of training without evaluations and of evaluations
        (None without any), devices and versions.
      unsaved: why the last checkpoint could not be written, to raise once the results
        are written; None if it was.
    """

    states: Any
    measured: Mapping[str, Any]
    unsaved: checkpoint.WriteError | None


@dataclasses.dataclass
class _Training:
    """Members in training.

    Attributes:
      members: the members.
      states: their states, padded once training is compiled; None for the first ones.
      done: number of iterations so far.
    """

    members: Members
    states: Any = None
    done: int = 0
    _seconds_per_iteration: float = math.inf

    @property
    def left(self) -> int:
        """The number of iterations that are left."""
        return max(0, self.members.config.num_iterations - self.done)

    def compile(self) -> None:
        """Compile the training and move the states to the devices."""
        self.states, self._advance = self.members.compile(self.states)

    def train_chunk(self, most: float) -> _Columns:
        """Train for some seconds, `most` iterations or fewer; return their metrics."""
        in_time = max(1, int(_SECONDS_PER_CHUNK / self._seconds_per_iteration))
        count = int(min(most, in_time, self.left, self.members.chunk))
        started = time.monotonic()
        self.states, metrics = self.members.train(
            self._advance, self.states, self.done, count
        )
        self._seconds_per_iteration = (time.monotonic() - started) / count
        self.done += count
        return metrics

    def progress(self, metrics: _Columns, evaluation: _Columns | None) -> FitProgress:
        """Return the progress after a chunk, with its metrics and evaluation."""
        done, env_steps = self.done, self.done * self.members.config.batch_steps

        def copy_states() -> TrainState:
            if done != self.done:
                raise RuntimeError(
                    f"the states of iteration {done} are gone: read FitProgress.states "
                    "in the callback"
                )
            return jax.tree.map(lambda x: x.copy(), self.members.trim(self.states))

        return FitProgress(done, env_steps, metrics, evaluation, copy_states)


class _Tables:
    """Writes metrics to metrics.csv, scores to evaluations.csv, and both to trackers.

    Its arguments are those of `drive`, and the record of the checkpoint that training
    continues from, None without one.

    Attributes:
      evaluation: the periodic evaluation; None for none.
      score: the mean score of the current policies; None if they are not evaluated.
    """

    def __init__(
        self,
        members: Members,
        folder: pathlib.Path,
        labels: Mapping[str, Sequence[Any]],
        *,
        evaluation_schedule: EvaluationSchedule | None,
        trackers: Sequence[Tracker],
        record: Mapping[str, Any] | None,
    ):
        self._trackers = trackers
        # The finite returns since the last record, after an empty array.
        self._returns = [np.empty(0, np.float32)]
        self.score: float | None = None
        path = folder / "metrics.csv"
        self._metrics = metrics_files.MetricsWriter(path, labels, record)
        self.evaluation = None
        if evaluation_schedule is not None:
            self.evaluation = PeriodicEvaluation(
                members,
                evaluation_schedule,
                folder / "evaluations.csv",
                labels=labels,
                checkpoint=record,
                trackers=trackers,
            )

    def write(self, metrics: _Columns) -> None:
        """Write and log the metrics of a chunk, (members, iterations) each."""
        self._metrics.write(metrics)
        log(self._trackers, metrics)
        returns = metrics["episode_return"]
        self._returns.append(returns[np.isfinite(returns)])

    def iterations_left(self, done: int) -> float:
        """Return the iterations to the next evaluation; infinity if there is none."""
        evaluation = self.evaluation
        return math.inf if evaluation is None else evaluation.iterations_left(done)

    def evaluate(self, training: _Training, progress: Progress) -> _Columns | None:
        """Evaluate the policies if it is time; write, log and return their scores."""
        self.score = None
        if self.evaluation is None or not self.evaluation.is_due(training.done):
            return None
        with progress.aside("evaluating the policies"):
            scores = self.evaluation.score(training.states, training.done)
        self.score = float(scores["mean"].mean(dtype=np.float64))
        return scores

    def record(self) -> dict[str, Any]:
        """Write everything to the disk; return a record of it for a checkpoint.

        It has each file's size, rows and hash and, as "score", the mean score of the
        current policies or, without evaluations, the mean of all returns since the last
        record.
        """
        record = self._metrics.record()
        returns = np.concatenate(self._returns)
        del self._returns[1:]
        if self.evaluation is None:
            return record | {"score": float(returns.mean()) if returns.size else None}
        return record | self.evaluation.writer.record() | {"score": self.score}

    def close(self) -> None:
        """Close the files and the trackers."""
        self._metrics.close()
        if self.evaluation is not None:
            self.evaluation.writer.close()
        for tracker in self._trackers:
            tracker.close()


def _restored(
    members: Members, root: pathlib.Path, progress: Progress, *, tables: Sequence[str]
) -> tuple[_Training, Mapping[str, Any] | None]:
    """Return the training after the newest undamaged checkpoint, and its record.

    Without one, training is at its beginning and the record is None. Newer, damaged
    checkpoints are renamed with a warning, and partial ones are deleted.

    Args:
      members: the members to train.
      root: the folder of the checkpoints.
      progress: the progress display.
      tables: names of the tables whose sizes the checkpoint must have recorded.

    Raises:
      InputError: if the checkpoint has another state or no size of a table, or if there
        is none although the folder holds the results of training that has ended.
    """
    folder = root.parent
    with progress.aside("reading the checkpoints"):
        newest, errors = checkpoint.latest(root)
    for name in [f"{table}_size" for table in tables]:
        if newest is not None and name not in newest.record:
            raise InputError(
                f"{newest.folder} has no {name}: it was written with other options, "
                "for example without evaluate_every"
            )
    if newest is None and run_folder.has_results(folder):
        why = f" ({errors[0]})" if errors else ""
        raise InputError(
            f"{folder} holds the results of training that has ended, and no undamaged "
            f"checkpoint to continue from{why}: name another folder"
        )
    for error in errors:
        start = "the beginning" if newest is None else newest.folder.name
        print(f"warning: {error}; training starts from {start}", file=sys.stderr)
    checkpoint.delete_partial(root)
    checkpoint.set_aside(root, newer_than=-1 if newest is None else newest.iteration)
    if newest is None:
        if not errors and (folder / "metrics.csv").exists():
            print(
                f"warning: {folder} has no checkpoint: training starts from the "
                "beginning, and the old tables are kept under other names",
                file=sys.stderr,
            )
        return _Training(members), None
    with progress.aside(f"restoring {newest.folder.name}"):
        with command_line.input_checked():
            states = newest.restore(members.shapes())
    return _Training(members, states, newest.iteration), newest.record


def drive(
    members: Members,
    folder: pathlib.Path,
    labels: Mapping[str, Sequence[Any]],
    *,
    schedule: CheckpointSchedule,
    progress: Progress,
    interruption: Interruption,
    evaluation_schedule: EvaluationSchedule | None = None,
    steps_before: int = 0,
    trackers: Sequence[Tracker] = (),
    callback: Callback | None = None,
    on_restored: Callable[[], None] = lambda: None,
) -> Outcome:
    """Train to the end, from the newest undamaged checkpoint if the folder has one.

    Args:
      members: the members to train.
      folder: the folder of metrics.csv, evaluations.csv and checkpoints/.
      labels: columns that identify the members in the tables, (members,) each.
      schedule: the times of checkpoints and the number to keep.
      progress: the progress display.
      interruption: checked after each chunk; if it has a signal, a checkpoint is
        written.
      evaluation_schedule: the times of evaluations; None for none.
      steps_before: environment steps that `progress` has already counted.
      trackers: trackers that also get the metrics; they are closed at the end.
      callback: called after each chunk; if it returns true, training ends there.
      on_restored: called once training can begin or continue without an error.

    Raises:
      Interrupted: if a signal was received; a checkpoint was written first.
      InputError: if the checkpoint has another state or no size of a table, if a table
        is damaged, or if the folder holds results but no undamaged checkpoint.
      OSError: if the folder can't be written, or if the disk is full. If only the last
        checkpoint can't, the outcome has the error.
    """
    root = folder / "checkpoints"
    names = ("metrics",) if evaluation_schedule is None else ("metrics", "evaluations")
    training, record = _restored(members, root, progress, tables=names)
    with command_line.input_checked():
        tables = _Tables(
            members,
            folder,
            labels,
            evaluation_schedule=evaluation_schedule,
            trackers=trackers,
            record=record,
        )
    on_restored()
    checkpoints = PeriodicCheckpoints(members, root, schedule)
    checkpoints.check()
    first = training.done

    def steps_of(done: int) -> int:
        return steps_before + members.env_steps(done)

    def save() -> None:
        with progress.aside("saving a checkpoint"):
            done, states = training.done, training.states
            record = tables.record()
            checkpoints.save(done, states, record=record, score=tables.score)

    started = time.monotonic()
    if training.left:
        progress.phase("compiling", steps_of(first))
        with interruption.answering(_AFTER_COMPILATION):
            training.compile()
    compile_seconds = time.monotonic() - started

    progress.phase("training", steps_of(first))
    started, stopped, warned = time.monotonic(), False, False
    # A checkpoint from before the first iteration may have a score already.
    has_scores = record is not None and record.get("evaluations_size")
    if first == 0 and interruption.signal is None and not has_scores:
        tables.evaluate(training, progress)
    while training.left and not stopped and interruption.signal is None:
        done = training.done
        most = min(checkpoints.iterations_left(done), tables.iterations_left(done))
        metrics = training.train_chunk(most)
        tables.write(metrics)
        progress.update(steps_of(training.done), metrics["episode_return"])
        if not warned and np.any(metrics["skipped_updates"] > 0):
            warned = True
            progress.warn(
                "an update was undone because a number in it was not finite: see "
                "skipped_updates in metrics.csv"
            )
        scores = tables.evaluate(training, progress)
        if checkpoints.is_due(training.done, tables.score):
            save()
        if callback is not None:
            stopped = bool(callback(training.progress(metrics, scores)))
    train_seconds = time.monotonic() - started
    unsaved = None
    try:
        save()
    except checkpoint.WriteError as error:
        unsaved = error
    with progress.aside("closing the trackers"):
        tables.close()
    if interruption.signal is not None and training.left and not stopped:
        raise unsaved or Interrupted(interruption.signal)
    evaluation = tables.evaluation
    evaluation_seconds = None if evaluation is None else evaluation.seconds
    return Outcome(
        states=members.trim(training.states),
        measured={
            "env_steps": members.env_steps(training.done - first),
            "compile_seconds": compile_seconds,
            "train_seconds": train_seconds - (evaluation_seconds or 0.0),
            "evaluation_seconds": evaluation_seconds,
            "device": members.device_kind,
            "device_count": len(members.devices),
            "versions": metrics_files.versions(),
        },
        unsaved=unsaved,
    )

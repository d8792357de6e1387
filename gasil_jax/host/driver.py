"""Train the members of a program in chunks; log, save and evaluate them in between.

A checkpoint records the number of rows of metrics.csv and evaluations.csv. Training
that continues from it cuts the tables to these rows and writes the later ones again.
"""

import dataclasses
import functools
import importlib.metadata
import math
import pathlib
import platform
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np

from gasil_jax.errors import InputError
from gasil_jax.host import checkpoint
from gasil_jax.host.evaluations import Evaluation
from gasil_jax.host.interruption import Interrupted, Interruption
from gasil_jax.host.members import Interval, Members
from gasil_jax.host.output_file import note
from gasil_jax.host.programs import Training
from gasil_jax.host.progress import Progress
from gasil_jax.host.sweep import Recording
from gasil_jax.host.tables import TableWriter
from gasil_jax.host.trackers import Tracker, log
from gasil_jax.train import TrainState

# Largest duration of a chunk. The progress display is updated, and Ctrl-C takes effect,
# after each chunk.
_SECONDS_PER_CHUNK = 5.0
_SECONDS_BETWEEN_CHECKPOINTS = 600.0

_Columns = Mapping[str, np.ndarray]


def versions() -> dict[str, str | None]:
    """Return the versions of Python and packages; None if one is not installed."""

    def version(package: str) -> str | None:
        try:
            return importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            return None

    packages = "gasil_jax jax jaxlib flax optax brax mujoco mujoco-mjx gymnasium numpy"
    every = {name: version(name) for name in packages.split()}
    return {"python": platform.python_version(), **every}


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
    """The result of training."""

    states: Any  # the members' states after the last iteration
    training: Training  # how this process trained
    # Why the last checkpoint could not be written, to raise once the results are
    # written; None if it was.
    unsaved: checkpoint.WriteError | None


@dataclasses.dataclass
class _Training:
    """Members in training."""

    members: Members
    # Their states, padded once training is compiled; None for the first ones.
    states: Any = None
    done: int = 0  # number of iterations so far
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
            # JAX may crash at arrays whose memory training has used since.
            if done != self.done:
                raise RuntimeError(
                    f"the states of iteration {done} are gone: read FitProgress.states "
                    "in the callback"
                )
            return jax.tree.map(lambda x: x.copy(), self.members.trim(self.states))

        return FitProgress(done, env_steps, metrics, evaluation, copy_states)


class _Checkpoints:
    """Writes the checkpoints of training, and decides when."""

    def __init__(self, members: Members, root: pathlib.Path, recording: Recording):
        self._members, self._root = members, root
        self._keep = recording.keep_checkpoints
        self.interval = Interval(recording.checkpoint_every, members.config)
        self._saved_at = time.monotonic()
        self._best_score = checkpoint.best_score(root)
        if self._keep:
            checkpoint.check_writable(root)

    def is_due(self, done: int, score: float | None) -> bool:
        """Return whether it is time for a checkpoint or the score is the best yet."""
        if score is not None and score > self._best_score:
            return True
        if math.isinf(self.interval.length):
            return time.monotonic() - self._saved_at > _SECONDS_BETWEEN_CHECKPOINTS
        return self.interval.ends(done)

    def save(self, done: int, states: Any, record: checkpoint.Record) -> None:
        """Write a checkpoint, and delete older ones that need not be kept."""
        if (score := record["score"]) is not None:
            self._best_score = max(self._best_score, score)
        if self._keep:
            states = self._members.trim(states)
            checkpoint.write(self._root, done, states, record)
            checkpoint.prune(self._root, self._keep)
            self._saved_at = time.monotonic()


def _restored(
    members: Members, root: pathlib.Path, progress: Progress
) -> tuple[_Training, checkpoint.Record | None]:
    """Return the training after the newest undamaged checkpoint, and its record."""
    with progress.aside("reading the checkpoints"):
        newest, errors = checkpoint.latest(root)
    if newest is None and (root.parent / "training.json").exists():
        raise InputError(
            f"{root.parent} holds training that has ended, and no undamaged checkpoint "
            "to continue from: name another folder"
        )
    for error in errors:
        start = "the beginning" if newest is None else newest.folder.name
        print(f"warning: {error}; training starts from {start}", file=sys.stderr)
    checkpoint.delete_partial(root)
    checkpoint.set_aside(root, newer_than=-1 if newest is None else newest.iteration)
    if newest is None:
        if not errors and (root.parent / "metrics.csv").exists():
            note(f"{root.parent} has no checkpoint: training starts from the beginning")
        return _Training(members), None
    with progress.aside(f"restoring {newest.folder.name}"):
        states = newest.restore(members.shapes())
    return _Training(members, states, newest.iteration), newest.record


def drive(
    members: Members,
    folder: pathlib.Path,
    labels: Mapping[str, Sequence[int]],
    *,
    recording: Recording,
    progress: Progress,
    interruption: Interruption,
    steps_before: int = 0,
    trackers: Sequence[Tracker] = (),
    callback: Callback | None = None,
) -> Outcome:
    """Train to the end, from the newest undamaged checkpoint if the folder has one."""
    root = folder / "checkpoints"
    training, record = _restored(members, root, progress)
    rows: Mapping[str, Any] = record or {}
    table = TableWriter(folder / "metrics.csv", labels, rows.get("metrics_rows", 0))
    evaluation = None
    if recording.evaluate_every is not None:
        evaluation = Evaluation(
            members,
            every=recording.evaluate_every,
            num_episodes=recording.evaluate_episodes,
            table=TableWriter(
                folder / "evaluations.csv",
                labels,
                rows.get("evaluations_rows", 0),
                columns=Evaluation.COLUMNS,
            ),
            trackers=trackers,
        )
    checkpoints = _Checkpoints(members, root, recording)
    videos = None
    if recording.video_every is not None:
        # It imports MuJoCo, which not every training needs.
        from gasil_jax.host.video import Videos

        every, where = recording.video_every, folder / "videos"
        videos = Videos(members, where, every=every, trackers=trackers)
    intervals = [x.interval for x in (checkpoints, evaluation, videos) if x is not None]
    first, score = training.done, None
    # The finite returns since the last checkpoint, after an empty array.
    returns = [np.empty(0, np.float32)]

    def steps_of(done: int) -> int:
        return steps_before + members.env_steps(done)

    def evaluate() -> _Columns | None:
        nonlocal score
        score = None
        if evaluation is None or not evaluation.interval.is_due(training.done):
            return None
        first = "" if evaluation.seconds else "compiling and "
        with progress.aside(f"{first}evaluating the policies"):
            scores = evaluation.score(training.states, training.done)
        mean = float(scores["mean"].mean(dtype=np.float64))
        score = mean if math.isfinite(mean) else None
        return scores

    def save() -> None:
        every = np.concatenate(returns)
        del returns[1:]
        own = score
        if evaluation is None and every.size:
            own = float(every.mean())
        with progress.aside("saving a checkpoint"):
            table.flush()
            if evaluation is not None:
                evaluation.table.flush()
            record = checkpoint.Record(
                metrics_rows=table.rows,
                evaluations_rows=0 if evaluation is None else evaluation.table.rows,
                score=own,
            )
            checkpoints.save(training.done, training.states, record)

    started = time.monotonic()
    if training.left:
        with progress.aside("compiling training and first states", at_once=True):
            training.compile()
    compile_seconds = time.monotonic() - started

    progress.phase("training", steps_of(first))
    started, stopped, warned = time.monotonic(), False, False
    # A checkpoint from before the first iteration may have a score already.
    if first == 0 and interruption.signal is None and not rows.get("evaluations_rows"):
        evaluate()
    while training.left and not stopped and interruption.signal is None:
        done = training.done
        metrics = training.train_chunk(min(x.left(done) for x in intervals))
        table.write(metrics)
        log(trackers, metrics)
        ended = metrics["episode_return"]
        returns.append(ended[np.isfinite(ended)])
        progress.update(steps_of(training.done), ended)
        if not warned and np.any(metrics["skipped_updates"] > 0):
            warned = True
            progress.warn(
                "an update was undone because a number in it was not finite: see "
                "skipped_updates in metrics.csv"
            )
        scores = evaluate()
        if checkpoints.is_due(training.done, score):
            save()
        if videos is not None and videos.interval.is_due(training.done):
            videos.film(training.states, training.done, progress)
        if callback is not None:
            stopped = bool(callback(training.progress(metrics, scores)))
    train_seconds = time.monotonic() - started - (videos.seconds if videos else 0.0)
    unsaved = None
    try:
        save()
    except checkpoint.WriteError as error:
        unsaved = error
    with progress.aside("closing the trackers"):
        table.close()
        if evaluation is not None:
            evaluation.table.close()
        for tracker in trackers:
            tracker.close()
    if interruption.signal is not None and training.left and not stopped:
        raise unsaved or Interrupted(interruption.signal)
    evaluation_seconds = None if evaluation is None else evaluation.seconds
    return Outcome(
        states=members.trim(training.states),
        training=Training(
            iterations=training.done,
            env_steps=members.env_steps(training.done - first),
            compile_seconds=compile_seconds,
            train_seconds=train_seconds - (evaluation_seconds or 0.0),
            evaluation_seconds=evaluation_seconds,
            device=members.device_kind,
            device_count=len(members.devices),
            versions=versions(),
        ),
        unsaved=unsaved,
    )

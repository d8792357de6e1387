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

# Time to a reaction to Ctrl-C, and between two updates of the display.
_SECONDS_BETWEEN_LOOKS = 5.0
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
    """What came of it.

    Attributes:
      states: of the members, after the last iteration.
      new_steps: environment steps over all members, without those of a checkpoint.
      compile_seconds: of this process, for training.
      train_seconds: of this process, without its evaluations.
      evaluation_seconds: of this process, compiling included; None without evaluations.
    """

    states: Any
    new_steps: int
    compile_seconds: float
    train_seconds: float
    evaluation_seconds: float | None


def _restored(
    runs: Batch, root: pathlib.Path, progress: Progress
) -> tuple[Any, int, Mapping[str, Any] | None]:
    """The states of the newest whole checkpoint, its iteration and its record.

    Without one the states and the record are None, and the iteration is 0. What is
    newer is damaged, told and set aside.
    """
    with progress.aside("reading the checkpoints"):
        newest, damages = checkpoint.latest(root)
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
    until: int | None = None,
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
      until: pause after so many iterations; a checkpoint is written then.

    Raises:
      Interrupted: after the checkpoint that an interruption asks for.
      InputError: the checkpoint is of another state, or a table is damaged.
      OSError: the folder can't be written, or the disk is full.
    """
    config, root = runs.config, folder / "checkpoints"
    last = config.num_iterations if until is None else until
    steps_of = lambda done: done * config.batch_steps * runs.num_members
    states, first, record = _restored(runs, root, progress)
    evaluation = None
    with command_line.input_checked():
        path = folder / "metrics.csv"
        writer = metrics_files.MetricsWriter(path, labels, _size(path, record))
        if evaluation_schedule is not None:
            path = folder / "evaluations.csv"
            evaluation = PeriodicEvaluation(
                runs,
                evaluation_schedule,
                path,
                labels=labels,
                size=_size(path, record),
                following=trackers,
            )

    started = time.monotonic()
    if first < last:
        progress.phase("compiling", steps_before + steps_of(first))
        states, advance = runs.compile(states)
    compile_seconds = time.monotonic() - started

    progress.phase("training", steps_before + steps_of(first))
    saved_at = started = time.monotonic()
    done, pace = first, math.inf
    recent: list[np.ndarray] = []
    # Of the evaluation of the states as they are now.
    evaluated: float | None = None
    every = schedule.every and math.ceil(schedule.every / config.batch_steps)

    def save() -> None:
        record = {"metrics_size": writer.size(), "score": _mean(recent)}
        if evaluation is not None:
            # Where policies are evaluated, one that was not has no score.
            record |= {"evaluations_size": evaluation.size(), "score": evaluated}
        with progress.aside("saving a checkpoint"):
            checkpoint.write(root, done, runs.trim(states), record)
            checkpoint.prune(root, schedule.keep)

    while done < last and interruption.signal is None:
        counts = [runs.chunk, last - done]
        counts.append(max(1, int(_SECONDS_BETWEEN_LOOKS / pace)))
        if every is not None:
            counts.append(every - done % every)
        if evaluation is not None:
            counts.append(evaluation.iterations_left(done))
        count = min(counts)
        looked = time.monotonic()
        states, metrics = runs.train(advance, states, done, count)
        pace = (time.monotonic() - looked) / count
        done += count
        writer.write(metrics)
        log(trackers, labels, metrics)
        recent.append(metrics["episode_return"])
        progress.update(steps_before + steps_of(done), metrics["episode_return"])
        if every is None:
            due = time.monotonic() - saved_at > _SECONDS_BETWEEN_CHECKPOINTS
        else:
            due = done % every == 0
        evaluated = None
        if evaluation is not None and evaluation.is_due(done):
            with progress.aside("evaluating the policies"):
                evaluated = evaluation.score(states, done)
            due |= evaluated > checkpoint.best_score(root)
        if due:
            save()
            saved_at, recent = time.monotonic(), []
    train_seconds = time.monotonic() - started
    save()
    writer.close()
    if evaluation is not None:
        evaluation.close()
        train_seconds -= evaluation.seconds
    with progress.aside("closing the trackers"):
        for tracker in trackers:
            tracker.close()
    if interruption.signal is not None and done < last:
        raise Interrupted(interruption.signal)
    return Outcome(
        states=runs.trim(states),
        new_steps=steps_of(done - first),
        compile_seconds=compile_seconds,
        train_seconds=train_seconds,
        evaluation_seconds=None if evaluation is None else evaluation.seconds,
    )


def _mean(returns: Sequence[np.ndarray]) -> float | None:
    """The mean of all that are finite; None where none is."""
    finite = [x[np.isfinite(x)] for x in returns]
    every = np.concatenate(finite) if finite else np.empty(0)
    return float(every.mean()) if every.size else None

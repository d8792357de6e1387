"""Train a batch for a command line: chunk by chunk, logged, saved and interruptible.

The folder that it is given gets metrics.csv and checkpoints/. What a checkpoint has
seen of metrics.csv is recorded in it, so that a run that goes on from it cuts the file
there and writes the same rows again.
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

from gasil_jax import checkpoint, command_line, logging
from gasil_jax.batch import Batch
from gasil_jax.interruption import Interrupted, Interruption
from gasil_jax.progress import Progress
from gasil_jax.trackers import Tracker, log

# Time to a reaction to Ctrl-C, and between two updates of the display.
_SECONDS_BETWEEN_LOOKS = 5.0
_SECONDS_BETWEEN_CHECKPOINTS = 600.0


@dataclasses.dataclass(frozen=True)
class CheckpointSchedule:
    """When checkpoints are written and how many are kept.

    Attributes:
      every: environment steps of a seed between two of them; None for ten minutes.
      keep: so many of the newest, and the one with the best returns.
    """

    every: int | None
    keep: int


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What came of it.

    Attributes:
      states: of the members, after the last iteration.
      new_steps: environment steps over all members, without those of a checkpoint.
      compile_seconds: of this process.
      train_seconds: of this process.
    """

    states: Any
    new_steps: int
    compile_seconds: float
    train_seconds: float


def drive(
    runs: Batch,
    folder: pathlib.Path,
    labels: Mapping[str, Sequence[Any]],
    *,
    schedule: CheckpointSchedule,
    progress: Progress,
    interruption: Interruption,
    steps_before: int = 0,
    trackers: Sequence[Tracker] = (),
    until: int | None = None,
) -> Outcome:
    """Train to the end, from the newest whole checkpoint in the folder if it has one.

    Args:
      runs: what to train.
      folder: of metrics.csv and checkpoints/.
      labels: what metrics.csv calls the members, (members,) each.
      schedule: of the checkpoints.
      progress: told what is going on.
      interruption: looked at after each chunk; a checkpoint is written then.
      steps_before: environment steps that `progress` has counted already.
      trackers: given the metrics too, and closed.
      until: pause after so many iterations; a checkpoint is written then.

    Raises:
      Interrupted: after the checkpoint that an interruption asks for.
      InputError: the checkpoint is of another state, or metrics.csv is damaged.
      OSError: the folder can't be written, or the disk is full.
    """
    config, root = runs.config, folder / "checkpoints"
    last = config.num_iterations if until is None else until
    steps_of = lambda done: done * config.batch_steps * runs.num_members
    with progress.aside("reading the checkpoints"):
        found, damages = checkpoint.latest(root)
    for damage in damages:
        instead = "starting anew" if found is None else f"using {found.folder.name}"
        print(f"warning: {damage}; {instead}", file=sys.stderr)
    checkpoint.set_aside(root, newer_than=-1 if found is None else found.iteration)
    first, states, size = 0, None, None
    if found is not None:
        with progress.aside(f"restoring {found.folder.name}"):
            like = jax.eval_shape(lambda: runs.trim(runs.init()))
            first = found.iteration
            with command_line.input_checked():
                states = found.restore(like)
        size = found.record["metrics_size"]
    elif (folder / "metrics.csv").exists():
        size = 0
    with command_line.input_checked():
        writer = logging.MetricsWriter(folder / "metrics.csv", labels, size)

    started = time.monotonic()
    if first < last:
        progress.phase("compiling", steps_before + steps_of(first))
        states, advance = runs.compile(states)
    compile_seconds = time.monotonic() - started

    progress.phase("training", steps_before + steps_of(first))
    saved_at = started = time.monotonic()
    done, pace = first, math.inf
    recent: list[np.ndarray] = []
    every = schedule.every and math.ceil(schedule.every / config.batch_steps)

    def save() -> None:
        returns = np.concatenate(recent, axis=1) if recent else np.full((1, 1), np.nan)
        score = float(np.nanmean(returns)) if np.isfinite(returns).any() else None
        record = {"metrics_size": writer.size(), "score": score}
        with progress.aside("saving a checkpoint"):
            checkpoint.write(root, done, runs.trim(states), record)
            checkpoint.prune(root, schedule.keep)

    while done < last and interruption.signal is None:
        counts = [runs.chunk, last - done]
        counts.append(max(1, int(_SECONDS_BETWEEN_LOOKS / pace)))
        if every is not None:
            counts.append(every - done % every)
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
        if due:
            save()
            saved_at, recent = time.monotonic(), []
    train_seconds = time.monotonic() - started
    save()
    writer.close()
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
    )

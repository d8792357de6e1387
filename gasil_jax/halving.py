"""Successive halving: ``python -m gasil_jax.halving --env hopper --random 16 ...``.

A point, with all its seeds, trains to a rung of environment steps (first_rung, then
reduction times as many, and so on), reports its mean return there, and pauses. It goes
on from its checkpoint once it is among the best at that rung, by the rule of Optuna's
SuccessiveHalvingPruner; new points are begun where none is (Li et al. 2020, "A system
for massively parallel hyperparameter tuning"). Schedules are those of the whole
training.

Any number of processes with the same command share OUT and take points that nobody
has; nobody waits for anybody. A point whose process died goes on from its checkpoint
in another. The folder holds config.json, optuna.journal, for each point a folder under
points/ with its metrics.csv and checkpoints, and in the end results.csv and
summary.json.
"""

import contextlib
import csv
import dataclasses
import importlib.metadata
import math
import pathlib
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from gasil_jax import command_line, run, run_folder, shards, sweep, trackers
from gasil_jax.command_line import InputError
from gasil_jax.config import Config
from gasil_jax.interruption import Interrupted, Interruption
from gasil_jax.points import Point
from gasil_jax.shards import Program

_PROGRAM = "gasil_jax.halving"
_STUDY = "halving"

#: Of each point that has begun, its mean return by environment steps of a seed.
Scores = Mapping[int, Mapping[int, float]]


@dataclasses.dataclass(frozen=True)
class Options(sweep.PointOptions):
    """Train many points for a short time and the better ones for longer.

    Attributes:
      first_rung: environment steps of a seed before a point is compared first; default
        a sixteenth of total_steps.
      reduction: one in so many points goes on from a rung, to so many times its steps.
    """

    first_rung: int | None = None
    reduction: int = 4


def rungs(total_steps: int, first_rung: int, reduction: int) -> list[int]:
    """Environment steps of a seed at which points are compared, and the whole.

    Raises:
      InputError: there is no rung below the whole.
    """
    if reduction < 2:
        raise InputError(f"reduction is {reduction}: it must be 2 or more")
    if not 1 <= first_rung < total_steps:
        raise InputError(
            f"first_rung is {first_rung}: it must be 1 or more, and less than "
            f"total_steps {total_steps}"
        )
    steps = [first_rung]
    while steps[-1] * reduction < total_steps:
        steps.append(steps[-1] * reduction)
    return [*steps, total_steps]


def _rungs(options: Options) -> list[int]:
    total = options.config.total_steps
    first = options.first_rung
    return rungs(
        total, max(1, total // 16) if first is None else first, options.reduction
    )


def _optuna() -> Any:
    try:
        import optuna
    except ImportError:
        raise InputError(
            'halving needs the package optuna (pip install "gasil_jax[optuna]")'
        ) from None
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    return optuna


class Study:
    """The points as trials of an Optuna study in a file that processes share.

    Args:
      folder: of the file.
      points: all of them.
    """

    def __init__(self, folder: pathlib.Path, points: Sequence[Point]):
        self._optuna = _optuna()
        from optuna.storages import JournalStorage
        from optuna.storages.journal import JournalFileBackend

        self._points = points
        self._study = self._optuna.create_study(
            study_name=_STUDY,
            storage=JournalStorage(JournalFileBackend(str(folder / "optuna.journal"))),
            direction="maximize",
            sampler=self._optuna.samplers.RandomSampler(),
            load_if_exists=True,
        )

    def _trials(self) -> dict[int, Any]:
        trials = self._study.get_trials(deepcopy=False)
        return {trial.user_attrs["point"]: trial for trial in trials}

    def scores(self) -> Scores:
        """What has been reported so far."""
        return {i: dict(x.intermediate_values) for i, x in self._trials().items()}

    def begin(self, index: int) -> None:
        """Have a trial for a point, if there is none."""
        if index in self._trials():
            return
        point = self._points[index]
        choices = {
            name: tuple({x[name]: None for x in self._points if name in x})
            for name in point
        }
        categorical = self._optuna.distributions.CategoricalDistribution
        self._study.add_trial(
            self._optuna.trial.create_trial(
                state=self._optuna.trial.TrialState.RUNNING,
                params=dict(point),
                distributions={n: categorical(x) for n, x in choices.items()},
                user_attrs={"point": index},
            )
        )

    def report(self, index: int, steps: int, score: float) -> None:
        """Note the score of a point at a rung."""
        trial_id = self._trials()[index]._trial_id
        self._optuna.trial.Trial(self._study, trial_id).report(score, steps)

    def close(self, last: int) -> None:
        """Tell Optuna which points have come to the last rung, and which have not."""
        states = self._optuna.trial.TrialState
        for trial in self._trials().values():
            score = trial.intermediate_values[trial.last_step]
            if not math.isfinite(score):
                told = {"state": states.FAIL}
            elif trial.last_step == last:
                told = {"values": score}
            else:
                told = {"state": states.PRUNED}
            self._study.tell(trial.number, skip_if_finished=True, **told)


def _goes_on(others: Sequence[float], score: float, reduction: int, least: int) -> bool:
    """What Optuna's pruner says to a point that is seen last of those at its rung."""
    optuna = _optuna()
    study = optuna.create_study(
        direction="maximize",
        pruner=optuna.pruners.SuccessiveHalvingPruner(
            min_resource=1, reduction_factor=reduction, bootstrap_count=least - 1
        ),
    )
    for value in (*others, score):
        trial = study.ask()
        trial.report(value if math.isfinite(value) else -math.inf, 1)
        stops = trial.should_prune()
    return not stops


def candidates(
    scores: Scores, steps: Sequence[int], num_points: int, reduction: int, least: int
) -> Iterator[int]:
    """Points that may train to their next rung, the most worthy one first.

    Args:
      scores: of `Study.scores`.
      steps: of `rungs`.
      num_points: how many there are.
      reduction: one in so many goes on.
      least: from a rung that fewer have reached none goes on.

    Yields:
      those that are among the best at the highest rung, and so on down; then those that
      have no score yet.
    """
    for rung in reversed(steps[:-1]):
        there = {
            i: by_steps[rung] for i, by_steps in scores.items() if rung in by_steps
        }
        paused = [
            i for i in there if max(scores[i]) == rung and math.isfinite(there[i])
        ]
        for index in sorted(paused, key=lambda i: there[i], reverse=True):
            others = [score for i, score in there.items() if i != index]
            if not _goes_on(others, there[index], reduction, least):
                break
            yield index
    yield from (i for i in range(num_points) if not scores.get(i))


@contextlib.contextmanager
def _claimed(folder: pathlib.Path) -> Iterator[bool]:
    """Whether a point's folder is this process' while this is entered."""
    folder.mkdir(parents=True, exist_ok=True)
    with contextlib.ExitStack() as stack:
        try:
            stack.enter_context(run_folder.lock(folder))
        except InputError:
            yield False
        else:
            yield True


def _score(metrics: dict[str, np.ndarray]) -> float:
    """`run.final_returns`, the mean over seeds.

    NaN where one diverged or has not ended an episode.
    """
    if (metrics["skipped_updates"] > 0).any():
        return math.nan
    return float(run.final_returns(metrics["episode_return"]).mean())


def climb(
    options: Options, env: Any, points: Sequence[Point], folder: pathlib.Path
) -> Study | None:
    """Train points from rung to rung as long as there is one for this process.

    Returns:
      the study; None while another process trains a point, which goes on then.

    Raises:
      Interrupted: by a signal.
      OSError: the folder can't be written any more.
      ValueError: what is there to go on with does not fit.
    """
    steps, study = _rungs(options), Study(folder, points)
    places = [folder / "points" / str(index) for index in range(len(points))]
    batch_of = _batches(options, env, points)

    def advance(least: int) -> bool | None:
        """Whether a point came to its next rung; None where others have those left."""
        now = study.scores()
        others = False
        for index in candidates(now, steps, len(points), options.reduction, least):
            with _claimed(places[index]) as mine:
                if not mine:
                    others = True
                    continue
                reached = study.scores().get(index, {})
                # Another process may have been there just now: look again.
                if reached == now.get(index, {}):
                    study.begin(index)
                    rung = steps[len(reached)]
                    runs, place = batch_of(index), places[index]
                    score = _train(options, index, runs, place, rung, interruption)
                    study.report(index, rung, score)
                return True
        return None if others else False

    # One for all: a signal while a rung ends must not be forgotten by the next.
    with Interruption() as interruption:
        while True:
            if advance(options.reduction):
                continue
            if not all(map(_is_free, places)):
                return None
            # Nobody is left to compare with: the best of few go on, one at least.
            went_on = advance(1)
            if went_on is None:
                return None
            if not went_on:
                study.close(steps[-1])
                return study


def _is_free(place: pathlib.Path) -> bool:
    with _claimed(place) as mine:
        return mine


def _batches(
    options: Options, env: Any, points: Sequence[Point]
) -> Callable[[int], Any]:
    """A function from a point to its seeds' batch; programs compile once."""
    from gasil_jax import batch

    seeds = list(sweep.seeds_of(options))
    programs: dict[Config, batch.Batch] = {}
    every = shards.programs(options.config, points, [0], options.share_counts)
    of_point = {
        index: (program.config, floats)
        for program in every
        for (index, _), floats in zip(program.members, program.hyperparameters)
    }

    def batch_of(index: int) -> batch.Batch:
        config, floats = of_point[index]
        members = (seeds, [floats] * len(seeds))
        if config not in programs:
            programs[config] = batch.make_batch(env, config, *members)
        return programs[config].of(*members)

    return batch_of


def _train(
    options: Options,
    index: int,
    runs: Any,
    place: pathlib.Path,
    rung: int,
    interruption: Interruption,
) -> float:
    """Train a point to a rung; returns its score there."""
    from gasil_jax import driver, logging
    from gasil_jax.progress import Progress

    config, seeds = runs.config, sweep.seeds_of(options)
    title = f"{options.env} {config.agent} point {index}"
    until = math.ceil(rung / config.batch_steps)
    total = until * config.batch_steps * len(seeds)
    with Progress(title, total) as progress:
        driver.drive(
            runs,
            place,
            {"seed": seeds},
            schedule=driver.CheckpointSchedule(
                options.checkpoint_every, options.keep_checkpoints
            ),
            progress=progress,
            interruption=interruption,
            trackers=trackers.make(options.log, place, run_folder.flat(vars(options))),
            until=until,
        )
    metrics = logging.read_metrics(place / "metrics.csv", ("seed",), len(seeds))
    return _score(metrics)


def write(
    folder: pathlib.Path, points: Sequence[Point], study: Study, last: int, seeds: int
) -> dict[str, Any]:
    """Write results.csv and summary.json of a study that is done.

    Args:
      folder: where to.
      points: all of them.
      study: with a score of each.
      last: environment steps of the whole training.
      seeds: how many a point has.

    Returns:
      the summary: "best" is the index of the point that ended with the highest mean
      return, or None; "env_steps" were trained, over all points and seeds.
    """
    from gasil_jax import logging

    names = sorted({name for point in points for name in point})
    results: list[dict[str, Any]] = []
    scores = study.scores()
    for index, point in enumerate(points):
        reached = max(scores[index])
        score = scores[index][reached]
        if not math.isfinite(score):
            state = "diverged"
        else:
            state = "finished" if reached == last else "paused"
        results.append(
            {
                "point": index,
                **{name: point.get(name) for name in names},
                "env_steps": reached,
                "mean_return": score if math.isfinite(score) else None,
                "state": state,
            }
        )
    with (folder / "results.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(results[0]))
        writer.writeheader()
        writer.writerows(results)
    finished = [row for row in results if row["state"] == "finished"]
    best = max(finished, key=lambda row: row["mean_return"], default={"point": None})
    summary = {
        "points": results,
        "best": best["point"],
        "env_steps": seeds * sum(row["env_steps"] for row in results),
        "versions": logging.versions()
        | {"optuna": importlib.metadata.version("optuna")},
    }
    logging.write_json(folder / "summary.json", summary)
    return summary


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    return command_line.exit_status(lambda: _main(arguments))


def _main(arguments: Sequence[str] | None) -> None:
    out = run.out_of(arguments)
    began = out if out is not None and run_folder.is_described(out) else None
    options = run.parse(Options, arguments, _PROGRAM, began)
    if out is None:
        raise InputError("halving needs --out and a folder that its processes share")
    _rungs(options)
    _optuna()
    points, programs = sweep.plan(options)
    seeds = sweep.seeds_of(options)
    # What is there already when it goes on is not to be written again.
    saved = programs if began is None else []
    env = sweep.prepare(options, _of_a_point(programs, seeds), saved)
    folder = run_folder.create(out, out.name)
    with run_folder.wait_for_lock(folder):
        if not run_folder.is_described(folder):
            run_folder.refuse_used(folder)
            run.write_config(options, folder, points=points)
    # Another process may have been first, with other settings.
    options = run.parse(Options, arguments, _PROGRAM, folder)
    sweep.check_points(points, folder)
    total, before = (
        x.total_steps for x in (options.config, run_folder.read(folder)["config"])
    )
    if total != before:
        raise InputError(f"total_steps was {before}, is {total}: rungs can't move")
    try:
        study = climb(options, env, points, folder)
    except Interrupted as interrupted:
        interrupted.add_note("go on with the same command")
        raise
    if study is None:
        print("the points that are left are other processes': the last one reports")
        return
    with run_folder.wait_for_lock(folder):
        summary = write(folder, points, study, options.config.total_steps, len(seeds))
    for row in summary["points"]:
        score = row["mean_return"]
        told = "none" if score is None else f"{score:.1f}"
        point = points[row["point"]]
        print(
            f"{', '.join(f'{name}={value:g}' for name, value in point.items())}: "
            f"{told} after {row['env_steps']:,} steps, {row['state']}"
        )
    print(f"best: {summary['best']}, in {folder}")


def _of_a_point(programs: Sequence[Program], seeds: Sequence[int]) -> list[Program]:
    """The programs, each with the members of one point."""
    return [program.part(0, len(seeds)) for program in programs]


if __name__ == "__main__":
    sys.exit(main())

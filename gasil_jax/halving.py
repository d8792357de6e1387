"""Successive halving: ``python -m gasil_jax.halving --env hopper --random 16 ...``.

A point, with all its seeds, trains to a rung of environment steps (first_rung, then
reduction times as many, and so on), reports its mean return, and either stops there or
goes on: Optuna's SuccessiveHalvingPruner decides by the points that have reached that
rung so far, so nobody waits for anybody. Schedules are those of the whole training.

Any number of processes with the same command share OUT and take points that nobody
has. A point whose process died goes on from its checkpoint in the next process that
comes by. The folder holds config.json, optuna.journal, for each point a folder under
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
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from gasil_jax import run, run_folder, shards, sweep, trackers
from gasil_jax.command_line import InputError
from gasil_jax.config import Config
from gasil_jax.interruption import Interrupted
from gasil_jax.shards import Point, Program

_PROGRAM = "gasil_jax.halving"
_STUDY = "halving"


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
      first_rung: environment steps.
      reduction: one in so many goes on.
    """

    def __init__(
        self,
        folder: pathlib.Path,
        points: Sequence[Point],
        first_rung: int,
        reduction: int,
    ):
        self._optuna = _optuna()
        from optuna.storages import JournalStorage
        from optuna.storages.journal import JournalFileBackend

        self._points = points
        self._study = self._optuna.create_study(
            study_name=_STUDY,
            storage=JournalStorage(JournalFileBackend(str(folder / "optuna.journal"))),
            direction="maximize",
            sampler=self._optuna.samplers.RandomSampler(),
            pruner=self._optuna.pruners.SuccessiveHalvingPruner(
                min_resource=first_rung, reduction_factor=reduction
            ),
            load_if_exists=True,
        )

    def trial(self, index: int) -> Any | None:
        """The trial of a point, as it is now; None if nobody has begun it."""
        for trial in self._study.get_trials(deepcopy=False):
            if trial.user_attrs["point"] == index:
                return trial
        return None

    def is_done(self, index: int) -> bool:
        """Whether a point is stopped or trained to its end."""
        trial = self.trial(index)
        return trial is not None and trial.state.is_finished()

    def begin(self, index: int) -> None:
        """Have a trial for a point, if there is none."""
        if self.trial(index) is not None:
            return
        point = self._points[index]
        choices = {
            name: tuple({point[name]: None for point in self._points}) for name in point
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

    def goes_on(self, index: int, steps: int, score: float) -> bool:
        """Report the score of a point at a rung; returns whether it goes on."""
        trial = self._optuna.trial.Trial(self._study, self.trial(index)._trial_id)
        trial.report(score, steps)
        if not trial.should_prune():
            return True
        state = self._optuna.trial.TrialState.PRUNED
        self._study.tell(trial, state=state)
        return False

    def end(self, index: int, steps: int, score: float) -> None:
        """Report the score of a point that is trained to its end."""
        trial = self._optuna.trial.Trial(self._study, self.trial(index)._trial_id)
        trial.report(score, steps)
        if math.isfinite(score):
            self._study.tell(trial, score)
        else:
            self._study.tell(trial, state=self._optuna.trial.TrialState.FAIL)


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
    """Mean return of the last tenth, over seeds; NaN where one diverged."""
    if (metrics["skipped_updates"] > 0).any():
        return math.nan
    return float(run.final_returns(metrics["episode_return"]).mean())


def climb(
    options: Options, env: Any, points: Sequence[Point], folder: pathlib.Path
) -> Study:
    """Train every point that nobody else has, from rung to rung.

    Raises:
      Interrupted: by a signal.
      OSError: the folder can't be written any more.
      ValueError: what is there to go on with does not fit.
    """
    from gasil_jax import batch

    steps = _rungs(options)
    study = Study(folder, points, steps[0], options.reduction)
    seeds = sweep.seeds_of(options)
    batches: dict[Config, batch.Batch] = {}
    for program in shards.programs(options.config, points, [0]):
        for index, _ in program.members:
            place = folder / "points" / str(index)
            with _claimed(place) as mine:
                if not mine or study.is_done(index):
                    continue
                study.begin(index)
                floats = options.config.updated(points[index]).hyperparameters
                members = (list(seeds), [floats] * len(seeds))
                if program.config not in batches:
                    batches[program.config] = batch.make_batch(
                        env, program.config, *members
                    )
                runs = batches[program.config].of(*members)
                _climb_point(options, study, index, runs, place, steps)
    return study


def _climb_point(
    options: Options,
    study: Study,
    index: int,
    runs: Any,
    place: pathlib.Path,
    steps: Sequence[int],
) -> None:
    from gasil_jax import driver, logging
    from gasil_jax.interruption import Interruption
    from gasil_jax.progress import Progress

    config, seeds = runs.config, sweep.seeds_of(options)
    title = f"{options.env} {config.agent} point {index}"
    total = config.num_iterations * config.batch_steps * len(seeds)
    for number, rung in enumerate(steps):
        with Interruption() as interruption, Progress(title, total) as progress:
            driver.drive(
                runs,
                place,
                {"seed": seeds},
                schedule=driver.Schedule(
                    options.checkpoint_every, options.keep_checkpoints
                ),
                progress=progress,
                interruption=interruption,
                trackers=trackers.make(
                    options.log, place, run_folder.flat(vars(options))
                ),
                until=math.ceil(rung / config.batch_steps),
            )
        metrics = logging.read_metrics(place / "metrics.csv", ("seed",), len(seeds))
        score = _score(metrics)
        if number == len(steps) - 1:
            study.end(index, rung, score)
        elif not study.goes_on(index, rung, score):
            return


def write(
    folder: pathlib.Path, points: Sequence[Point], study: Study, seeds: int
) -> dict[str, Any]:
    """Write results.csv and summary.json of a study that is done.

    Returns:
      the summary: "best" is the index of the point that ended with the highest mean
      return, or None; "env_steps" were trained, over all points and seeds.
    """
    from gasil_jax import logging

    names = sorted({name for point in points for name in point})
    results = []
    for index, point in enumerate(points):
        trial = study.trial(index)
        score = trial.intermediate_values[trial.last_step]
        state = {"COMPLETE": "finished", "PRUNED": "stopped", "FAIL": "diverged"}
        results.append(
            {
                "point": index,
                **{name: point[name] for name in names},
                "env_steps": trial.last_step,
                "mean_return": score if math.isfinite(score) else None,
                "state": state[trial.state.name],
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
    return run.exit_status(lambda: _main(arguments))


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
    env = sweep.prepare(options, _of_a_point(programs, seeds))
    folder = run_folder.create(out, out.name)
    with run_folder.wait_for_lock(folder):
        if not run_folder.is_described(folder):
            run_folder.refuse_used(folder)
            run.write_config(options, folder, points=points)
    # Another process may have been first.
    before = run.parse(Options, arguments, _PROGRAM, folder)
    described = run_folder.read(folder)["config"].total_steps
    if before.config.total_steps != described:
        raise InputError(
            f"total_steps was {described}, is {before.config.total_steps}: rungs can't "
            "move"
        )
    try:
        study = climb(options, env, points, folder)
    except Interrupted as interrupted:
        interrupted.add_note("go on with the same command")
        raise
    others = [str(i) for i in range(len(points)) if not study.is_done(i)]
    if others:
        print(f"points {', '.join(others)} are other processes': the last one reports")
        return
    with run_folder.wait_for_lock(folder):
        summary = write(folder, points, study, len(seeds))
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
    return [
        dataclasses.replace(program, members=program.members[: len(seeds)])
        for program in programs
    ]


if __name__ == "__main__":
    sys.exit(main())

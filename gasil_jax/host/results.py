"""Make the tables, plots and policies of a folder from its trained programs."""

import csv
import dataclasses
import functools
import math
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any, TypedDict

import numpy as np

from gasil_jax.errors import InputError
from gasil_jax.host import json_files, output_file, plotting, policy_file, tables
from gasil_jax.host.points import in_words
from gasil_jax.host.programs import Program, Training
from gasil_jax.host.runs import Run
from gasil_jax.host.sweep import LABELS, Sweep
from gasil_jax.host.tables import Columns
from gasil_jax.statistics import Estimate, estimate


@dataclasses.dataclass(frozen=True)
class Results:
    """The results of all points and seeds."""

    sweep: Sweep
    trainings: Sequence[Training]  # how each program was trained
    # Every metric by name, (points, seeds, iterations) each.
    metrics: dict[str, np.ndarray]
    # The columns of evaluations.csv, (points, seeds, evaluations) each; empty without
    # evaluations.
    evaluations: dict[str, np.ndarray]
    # The last columns of results.csv by their names, (points, seeds) each; NaN in seeds
    # in which no episode ended.
    finals: dict[str, np.ndarray]
    # "faulty_steps" (simulation) and "skipped_updates" (learning) over training in
    # which numbers were not finite, int (points, seeds) each.
    faults: dict[str, np.ndarray]

    @property
    def mean(self) -> np.ndarray:
        """The mean final return of each point, (points,); NaN where it is unknown."""
        return self.finals["final_return"].mean(axis=1)

    @property
    def diverged(self) -> np.ndarray:
        """Whether an update was undone, bool (points, seeds)."""
        return self.faults["skipped_updates"] > 0

    @functools.cached_property
    def summary(self) -> dict[str, Any]:
        """The content of summary.json."""
        return _summary(self)

    def best(self, scores: np.ndarray) -> int | None:
        """Return the point with the highest score, (points,), None if there is none.

        Points with a seed that diverged, or in which no episode ended, do not count.
        """
        sound = np.isfinite(scores) & ~self.diverged.any(axis=1)
        return int(np.where(sound, scores, -np.inf).argmax()) if sound.any() else None


def read(sweep: Sweep, trained: Sequence[Program]) -> Results:
    """Return the results of a sweep from programs whose training has ended."""
    if missing := sweep.missing(trained):
        point, seed = missing[0]
        raise InputError(
            f"{len(missing)} of {len(sweep.runs)} runs are missing, the first of point "
            f"{point} and seed {seed}: train them with --resume"
        )
    stored: dict[Run, tuple[Columns, Columns]] = {}
    for each in trained:
        for run, own in zip(each.runs, each.tables(), strict=True):
            if not _equal(stored.setdefault(run, own)[0], own[0]):
                raise InputError(
                    f"{each.path} and another program have different results for seed "
                    f"{run.seed} of {run.experiment}: move one of the two folders away"
                )
    every = [stored[run] for run in sweep.runs.values()]
    last = [tables.finals(*own) for own in every]
    shape = len(sweep.points), len(sweep.seeds)
    metrics = _curves(sweep, [own for own, _ in every])
    faults = ("faulty_steps", "skipped_updates")
    return Results(
        sweep=sweep,
        trainings=[x for each in trained if (x := each.training) is not None],
        metrics=metrics,
        evaluations=_curves(sweep, [scores for _, scores in every]),
        finals={name: np.reshape([x[name] for x in last], shape) for name in last[0]},
        faults={x: np.nansum(metrics[x], axis=2).astype(int) for x in faults},
    )


def _equal(first: Columns, second: Columns) -> bool:
    return first.keys() == second.keys() and all(
        np.array_equal(first[name], second[name], equal_nan=True) for name in first
    )


def _curves(sweep: Sweep, every: Sequence[Columns]) -> Columns:
    """Return all runs' columns, (points, seeds, rows); NaN after a run's last row."""
    curves = {}
    for name in dict.fromkeys(name for own in every for name in own):
        columns = [own.get(name, np.empty(0)) for own in every]
        # Points may differ in batch_steps, and so in iterations.
        values = np.full((len(every), max(map(len, columns))), np.nan)
        for row, own in zip(values, columns, strict=True):
            row[: len(own)] = own
        curves[name] = values.reshape(len(sweep.points), len(sweep.seeds), -1)
    return curves


def write(folder: pathlib.Path, results: Results) -> dict[str, Any]:
    """Write results.csv, curves.npz, the plots and summary.json; return the summary."""
    sweep = results.sweep
    _write_results(folder / "results.csv", results)
    curves: dict[str, Any] = {**results.metrics}
    curves |= {f"evaluation_{name}": x for name, x in results.evaluations.items()}
    with output_file.atomic(folder / "curves.npz") as partial:
        np.savez_compressed(partial, **curves)
    told = results.summary
    json_files.write(folder / "summary.json", told)
    best = told["best_by_mean"]
    shown = 0 if best is None else best
    scores = {x: y[shown] for x, y in results.evaluations.items()}
    title = ", ".join([sweep.env, *sweep.agent.split(",")])
    with output_file.atomic(folder / "learning_curve.png") as partial:
        plotting.learning_curve(
            partial,
            results.metrics["env_steps"][shown, 0],
            results.metrics["episode_return"][shown],
            title=f"{sweep.env}, {_agents(results)[shown]}",
            evaluations=scores or None,
        )
    if len(sweep.points) > 1:
        with output_file.atomic(folder / "sweep.png") as partial:
            plotting.final_returns(
                partial,
                _labels(results),
                results.finals["final_return"],
                title=title,
                env_steps=results.metrics["env_steps"][:, 0],
                curves=results.metrics["episode_return"],
            )
        known = np.flatnonzero(np.isfinite(results.mean)).tolist()
        varied = {
            name: values
            for name in sweep.points[0]
            if len(set(values := [sweep.points[i][name] for i in known])) > 1
        }
        if varied:
            with output_file.atomic(folder / "hyperparameters.png") as partial:
                plotting.marginals(
                    partial,
                    varied,
                    results.mean[known],
                    title=title,
                    best=None if best is None else known.index(best),
                    left_out=len(sweep.points) - len(known),
                )
    return told


def write_policies(
    folder: pathlib.Path, results: Results, states: Any, env: Any
) -> None:
    """Write policy.npz: the policies of states (seeds, ...) of the best point."""
    best = results.best(results.mean)
    final = results.finals["final_return"][0 if best is None else best]
    policy_file.save(folder / "policy.npz", states, env, results.sweep.seeds, final)


def _write_results(path: pathlib.Path, results: Results) -> None:
    """Write results.csv, a row for each point and seed."""
    with output_file.atomic(path) as partial, partial.open("w", newline="") as file:
        writer = csv.writer(file)
        names = list(results.sweep.points[0])
        writer.writerow([*LABELS, *names, *results.finals, *results.faults])
        for index, point in enumerate(results.sweep.points):
            for position, seed in enumerate(results.sweep.seeds):
                values = (x[index, position] for x in results.finals.values())
                cells = ["" if math.isnan(x) else f"{x:.7g}" for x in values]
                faults = (x[index, position] for x in results.faults.values())
                writer.writerow([index, seed, *point.values(), *cells, *faults])


def _summary(results: Results) -> dict[str, Any]:
    """Return the content of summary.json."""
    final = results.finals["final_return"]
    trainings, sweep = results.trainings, results.sweep

    def finite(value: float) -> float | None:
        return float(value) if math.isfinite(value) else None

    return {
        "env": sweep.env,
        "agent": sweep.agent,
        "env_steps_per_seed": int(np.nanmax(results.metrics["env_steps"])),
        "points": [
            {
                **point,
                "mean": finite(results.mean[i]),
                # Nothing is told where a final return is unknown.
                **estimate(
                    final[i] if np.isfinite(final[i]).all() else final[i][:0]
                )._asdict(),
                **{
                    name: finite(values[i].mean())
                    for name, values in results.finals.items()
                    if name != "final_return"
                },
                "diverged_seeds": int(results.diverged[i].sum()),
            }
            for i, point in enumerate(sweep.points)
        ],
        "best_by_mean": results.best(results.mean),
        "best_of_agents": {
            each: results.best(np.where(_agents(results) == each, results.mean, np.nan))
            for each in sweep.agent.split(",")
        },
        **_speed(trainings),
        "versions": _joined([x["versions"] for x in trainings]),
    }


def _agents(results: Results) -> np.ndarray:
    """Return the name of each point's agent."""
    sweep = results.sweep
    return np.array([str(x.get("agent", sweep.agent)) for x in sweep.points])


def _speed(trainings: Sequence[Training]) -> dict[str, Any]:
    """Return seconds, steps/s and devices of programs trained one after the other."""
    evaluations = [x["evaluation_seconds"] for x in trainings]
    seconds = sum(x["train_seconds"] for x in trainings)
    steps = sum(x["env_steps"] for x in trainings)
    return {
        "compile_seconds": sum(x["compile_seconds"] for x in trainings),
        "train_seconds": seconds,
        "evaluation_seconds": sum(x for x in evaluations if x is not None),
        "env_steps_per_second": steps / (seconds or 1) or None,
        **_joined([{"device": x["device"]} for x in trainings]),
        "device_count": max(x["device_count"] for x in trainings),
    }


def _joined(records: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the common value of each field, or one string of all different values."""
    every = {name: {record.get(name) for record in records} for name in records[0]}
    return {
        name: values.pop() if len(values) == 1 else ", ".join(sorted(map(str, values)))
        for name, values in every.items()
    }


def speed_in_words(trainings: Sequence[Training]) -> str:
    """Return what a command prints of the devices, and of the speed if it is known."""
    speed = _speed(trainings)
    steps = speed["env_steps_per_second"]
    return f"{f'{steps:,.0f} steps/s ' if steps else ''}on {speed['device']}"


def best_in_words(results: Results) -> str:
    """Return what is printed of several points."""
    if (best := results.summary["best_by_mean"]) is None:
        return (
            "best mean: none, because every point has a seed that diverged or in which "
            "no episode ended"
        )
    scores = results.summary["points"][best]
    middle = Estimate(scores["interquartile_mean"], scores["interval"])
    return (
        f"best mean: point {best}, {_labels(results)[best]}: mean "
        f"{scores['mean']:.1f}, interquartile mean {middle}"
    )


def _labels(results: Results) -> list[str]:
    """Return a label for each point: the values in which points differ."""
    points = results.sweep.points
    varied = [x for x in points[0] if len({point[x] for point in points}) > 1]
    varied = varied or [*points[0]]
    return [in_words({x: point[x] for x in varied}) for point in points]


class _Best(TypedDict, total=False):
    """What other commands read of summary.json."""

    best_by_mean: int | None
    best_of_agents: dict[str, int | None]


def best_points(folder: pathlib.Path) -> tuple[int | None, dict[str, int | None]]:
    """Return the best point by mean, of all and of each agent; None if unknown."""
    try:
        best: _Best = json_files.read(folder / "summary.json", _Best)
    except FileNotFoundError:
        return None, {}
    return best.get("best_by_mean"), best.get("best_of_agents", {})

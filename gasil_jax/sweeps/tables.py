"""Make a sweep's tables, such as results.csv, from the folders of its programs."""

import csv
import dataclasses
import math
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from gasil_jax.errors import InputError
from gasil_jax.figures import plotting
from gasil_jax.host import (
    command_line,
    metrics_files,
    output_file,
    policy_file,
    run_folder,
)
from gasil_jax.host.metrics_files import Columns
from gasil_jax.statistics import FEW_POINTS, Estimate, estimate, importance
from gasil_jax.sweeps import run_results, saved_states
from gasil_jax.sweeps.plan import LABELS, Plan
from gasil_jax.sweeps.points import Point
from gasil_jax.sweeps.programs import Program
from gasil_jax.sweeps.runs import Run


@dataclasses.dataclass(frozen=True)
class Results:
    """The results of all points and seeds of a sweep.

    Attributes:
      plan: the points and seeds.
      trainings: what `Program.training` says of each program.
      curves: every metric and score by its name in curves.npz, (points, seeds,
        iterations or evaluations) each.
      finals: the last columns of results.csv by their names, (points, seeds) each; NaN
        in seeds in which no episode ended.
      diverged: whether an update was undone, bool (points, seeds).
    """

    plan: Plan
    trainings: Sequence[Mapping[str, Any]]
    curves: dict[str, Any]
    finals: dict[str, np.ndarray]
    diverged: np.ndarray

    @property
    def names(self) -> list[str]:
        """The names of all values that points change."""
        return sorted({name for point in self.plan.points for name in point})

    @property
    def mean(self) -> np.ndarray:
        """The mean final return of each point, (points,); NaN where it is unknown."""
        return self.finals["final_return"].mean(axis=1)

    @property
    def ended(self) -> list[int]:
        """The indices of the points that have a mean final return."""
        return np.flatnonzero(np.isfinite(self.mean)).tolist()

    @property
    def varied(self) -> dict[str, list[Any]]:
        """The values of the names in which the points of `ended` differ, (points,)."""
        seed = self.plan.seeds[0]
        trained = [self.plan.runs[i, seed].algorithm.settings for i in self.ended]
        values = {name: [own[name] for own in trained] for name in self.names}
        return {name: listed for name, listed in values.items() if len(set(listed)) > 1}


def read(plan: Plan, trained: Sequence[Program]) -> Results:
    """Return the results of a sweep from the programs that are trained to their end.

    Raises:
      InputError: if a run is missing or has two different results, if a table is
        damaged, or if one has other columns than the others.
    """
    if missing := plan.missing(trained):
        point, seed = missing[0]
        raise InputError(
            f"{len(missing)} of {len(plan.runs)} runs are missing, the first of point "
            f"{point} and seed {seed}: train them with python -m gasil_jax.sweep "
            "--resume"
        )
    stored: dict[Run, tuple[Columns, Columns]] = {}
    for each in trained:
        for run, own in zip(each.runs, each.tables(), strict=True):
            if not _equal(stored.setdefault(run, own)[0], own[0]):
                raise InputError(
                    f"{each.path} and another program have different results for seed "
                    f"{run.seed} of {run.experiment}: move one of the two folders away"
                )
    every = [stored[run] for run in plan.runs.values()]
    curves = _curves(plan, [metrics for metrics, _ in every])
    for name, values in _curves(plan, [scores for _, scores in every]).items():
        curves[f"evaluation_{name}"] = values
    last = [metrics_files.finals(*own) for own in every]
    shape = len(plan.points), len(plan.seeds)
    finals = {name: np.reshape([x[name] for x in last], shape) for name in last[0]}
    diverged = np.any(curves["skipped_updates"] > 0, axis=2)
    # A program may be in several folders.
    trainings = {each.path.name: each.training for each in trained}
    return Results(plan, list(trainings.values()), curves, finals, diverged)


def _equal(first: Columns, second: Columns) -> bool:
    return first.keys() == second.keys() and all(
        np.array_equal(first[name], second[name], equal_nan=True) for name in first
    )


def _curves(plan: Plan, every: Sequence[Columns]) -> Columns:
    """Return all runs' columns, (points, seeds, rows); NaN after a run's last row.

    Raises:
      InputError: if runs have other columns than the first one.
    """
    (first, *_), columns = plan.runs, every[0]
    for (point, seed), own in zip(plan.runs, every, strict=True):
        if differing := ", ".join(sorted(columns.keys() ^ own.keys())):
            raise InputError(
                f"point {point}, seed {seed} was trained with other metrics than point "
                f"{first[0]}, seed {first[1]}: {differing}"
            )
    curves = {}
    for name in columns:
        # Points may differ in batch_steps, and so in iterations.
        values = np.full((len(every), max(len(own[name]) for own in every)), np.nan)
        for row, own in zip(values, every, strict=True):
            row[: len(own[name])] = own[name]
        curves[name] = values.reshape(len(plan.points), len(plan.seeds), -1)
    return curves


def finish(folder: pathlib.Path, results: Results) -> None:
    """Write the tables of a sweep that is trained, and print what they tell."""
    with run_folder.wait_for_lock(folder):
        summary = write(folder, results)
    print(*report(results.plan.points, summary), f"in {folder}", sep="\n")


def write(folder: pathlib.Path, results: Results) -> dict[str, Any]:
    """Write results.csv, curves.npz, summary.json and the plots; return the summary.

    hyperparameters.png is written only if a hyperparameter varies among the points that
    have a final return, and policy.npz, with the policies of the best point by mean,
    only if there is one whose checkpoints are there.
    """
    _write_results(folder / "results.csv", results)
    with output_file.atomic(folder / "curves.npz") as partial:
        np.savez_compressed(partial, **results.curves)
    summary = _summary(results)
    metrics_files.write_json(folder / "summary.json", summary)
    best, points = summary["best_by_mean"], results.plan.points
    final, ended = results.finals["final_return"], results.ended
    with output_file.atomic(folder / "sweep.png") as partial:
        plotting.final_returns(partial, _labels(points), final, best=best)
    if results.varied:
        with output_file.atomic(folder / "hyperparameters.png") as partial:
            plotting.marginals(
                partial,
                results.varied,
                results.mean[ended],
                importance=summary["importance"],
                best=None if best is None else ended.index(best),
                left_out=len(points) - len(ended),
            )
    if best is not None:
        try:
            env, _, seeds, states = saved_states.load(folder, point=best)
        except InputError as error:
            command_line.note(f"policy.npz is not written: {error}")
        else:
            policy_file.save(folder / "policy.npz", states, env, seeds, final[best])
    return summary


def _write_results(path: pathlib.Path, results: Results) -> None:
    """Write results.csv, a row for each point and seed.

    A cell is empty where a point does not change the sweep's value, or where a final
    value is NaN.
    """
    names = results.names
    with output_file.atomic(path) as partial, partial.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow([*LABELS, *names, *results.finals, "diverged"])
        for index, point in enumerate(results.plan.points):
            own = [point.get(name, "") for name in names]
            for position, seed in enumerate(results.plan.seeds):
                values = (x[index, position] for x in results.finals.values())
                cells = ["" if math.isnan(x) else f"{x:.7g}" for x in values]
                bad = int(results.diverged[index, position])
                writer.writerow([index, seed, *own, *cells, bad])


def _summary(results: Results) -> dict[str, Any]:
    """Return the content of summary.json."""
    mean, diverged = results.mean, results.diverged
    others = dict(results.finals)
    final = others.pop("final_return")
    ended = np.isfinite(final).all(axis=1)
    sound = np.flatnonzero(~diverged.any(axis=1) & ended)

    def best(scores: np.ndarray) -> int | None:
        return int(sound[scores[sound].argmax()]) if sound.size else None

    returns = mean[results.ended]
    every = {name: importance(x, returns) for name, x in results.varied.items()}
    # The estimate is noisy and may be below 0.
    shares = {name: x if x is None else max(0.0, x) for name, x in every.items()}
    return {
        "points": [
            {
                **point,
                "mean": _finite(mean[i]),
                # Nothing is told where a final return is unknown.
                **estimate(final[i] if ended[i] else final[i][:0])._asdict(),
                "worst_seed": _finite(final[i].min()),
                **{name: _finite(values[i].mean()) for name, values in others.items()},
                "diverged_seeds": int(diverged[i].sum()),
            }
            for i, point in enumerate(results.plan.points)
        ],
        "best_by_mean": best(mean),
        "best_by_worst_seed": best(final.min(axis=1)),
        "importance": shares,
        **run_results.speed(results.trainings),
        "versions": run_results.joined([x["versions"] for x in results.trainings]),
    }


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def report(points: Sequence[Point], summary: Mapping[str, Any]) -> list[str]:
    """Return the lines that a sweep prints at its end: speed and best points."""
    seconds = f"{summary['train_seconds']:,.0f} s of training"
    if "evaluation_seconds" in summary:
        seconds += f", {summary['evaluation_seconds']:,.0f} s of evaluations"
    lines = [f"{run_results.speed_in_words(summary)} ({seconds})"]
    for title in ("best_by_mean", "best_by_worst_seed"):
        told = "none, because every point has a seed that diverged or in which no "
        told += "episode ended"
        if (best := summary[title]) is not None:
            scores = summary["points"][best]
            middle = Estimate(scores["interquartile_mean"], scores["interval"])
            told = f"{_label(points[best])} (mean {scores['mean']:.1f}, interquartile "
            told += f"mean {middle}, worst seed {scores['worst_seed']:.1f})"
        lines.append(f"{title}: {told}")
    shares = summary["importance"].items()
    shown = [f"{name} {share:.0%}" for name, share in shares if share is not None]
    few = len(points) < FEW_POINTS
    uncertain = f" (uncertain with {len(points)} points)" if few else ""
    return lines + ([f"importance: {', '.join(shown)}{uncertain}"] if shown else [])


def _labels(points: Sequence[Point]) -> list[str]:
    """Return a label for each point: the values in which it differs from others."""
    names = {name for point in points for name in point}
    varied = {x for x in names if len({point.get(x) for point in points}) > 1}
    return [_label({x: point[x] for x in point if x in varied}) for point in points]


def _label(point: Point) -> str:
    changes = ", ".join(f"{name}={value:g}" for name, value in point.items())
    return changes or "the sweep's own values"

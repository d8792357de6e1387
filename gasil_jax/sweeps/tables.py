"""Make a sweep's tables, such as results.csv, from the folders of its programs.

They are made from the programs' files alone, whether one process trained all programs
or shards did on many hosts.
"""

import csv
import dataclasses
import math
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from gasil_jax.errors import InputError
from gasil_jax.figures import plotting
from gasil_jax.host import metrics_files, output_file
from gasil_jax.statistics import FEW_POINTS, Estimate, estimate, importance
from gasil_jax.sweeps.points import Point
from gasil_jax.sweeps.trained_programs import LABELS, Member, TrainedPrograms


@dataclasses.dataclass(frozen=True)
class Results:
    """The results of all points and seeds of a sweep.

    Attributes:
      parts: the parts of the sweep that they were read from.
      points: the points.
      seeds: absolute seed numbers.
      curves: every metric and score by its name in curves.npz, (points, seeds,
        iterations or evaluations) each.
      finals: the last columns of results.csv by their names, (points, seeds) each; NaN
        in seeds in which no episode ended.
      diverged: whether an update was undone, bool (points, seeds).
    """

    parts: Sequence[TrainedPrograms]
    points: Sequence[Point]
    seeds: Sequence[int]
    curves: dict[str, Any]
    finals: dict[str, np.ndarray]
    diverged: np.ndarray

    @property
    def names(self) -> list[str]:
        """The names of all values that points change."""
        return sorted({name for point in self.points for name in point})

    @property
    def mean(self) -> np.ndarray:
        """The mean final return of each point, (points,); NaN where it is unknown."""
        return self.finals["final_return"].mean(axis=1)

    @property
    def ended(self) -> list[int]:
        """The indices of the points that have a mean final return."""
        return np.flatnonzero(np.isfinite(self.mean)).tolist()


def read(
    points: Sequence[Point], seeds: Sequence[int], parts: Sequence[TrainedPrograms]
) -> Results:
    """Return the results that the tables of a sweep's parts hold.

    Args:
      points: all points of the sweep.
      seeds: absolute seed numbers.
      parts: the finished parts, which together hold every point with every seed.

    Raises:
      InputError: if a table is damaged, or if one has other columns than the others.
    """
    members: dict[Member, dict[str, np.ndarray]] = {}
    evaluations: dict[Member, dict[str, np.ndarray]] = {}
    for part in parts:
        members |= part.members()
        evaluations |= part.evaluations()
    curves = _curves(points, seeds, members)
    of_point = lambda name, i: np.stack([members[i, seed][name] for seed in seeds])
    finals_of = lambda name: np.array(
        [metrics_files.final_returns(of_point(name, i)) for i in range(len(points))]
    )
    final, length = finals_of("episode_return"), finals_of("episode_length")
    finals = {"final_return": final, "final_length": length}
    if evaluations:
        scores = _curves(points, seeds, evaluations)
        curves |= {f"evaluation_{name}": values for name, values in scores.items()}
        last = lambda member: evaluations[member]["mean"][-1]
        finals["final_evaluation"] = np.array(
            [[last((i, seed)) for seed in seeds] for i in range(len(points))]
        )
    diverged = np.any(curves["skipped_updates"] > 0, axis=2)
    return Results(parts, points, seeds, curves, finals, diverged)


def write(folder: pathlib.Path, results: Results) -> dict[str, Any]:
    """Write results.csv, curves.npz, summary.json and the plots; return the summary.

    hyperparameters.png is written only if a hyperparameter varies among the points that
    have a final return.

    Args:
      folder: folder to write to.
      results: the results, from `read`.
    """
    _write_results(folder / "results.csv", results)
    with output_file.atomic(folder / "curves.npz") as partial:
        np.savez_compressed(partial, **results.curves)
    varied = _varied(results.parts, results.names, results.ended)
    trainings = [training for part in results.parts for training in part.trainings()]
    summary = _summary(results, varied, trainings)
    metrics_files.write_json(folder / "summary.json", summary)
    with output_file.atomic(folder / "sweep.png") as partial:
        final, best = results.finals["final_return"], summary["best_by_mean"]
        plotting.final_returns(partial, _labels(results.points), final, best=best)
    if varied:
        with output_file.atomic(folder / "hyperparameters.png") as partial:
            _draw_hyperparameters(partial, results, varied, summary=summary)
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
        for index, point in enumerate(results.points):
            own = [point.get(name, "") for name in names]
            for position, seed in enumerate(results.seeds):
                values = (x[index, position] for x in results.finals.values())
                cells = ["" if math.isnan(x) else f"{x:.7g}" for x in values]
                bad = int(results.diverged[index, position])
                writer.writerow([index, seed, *own, *cells, bad])


def _summary(
    results: Results,
    varied: Mapping[str, Sequence[Any]],
    trainings: Sequence[Mapping[str, Any]],
) -> dict[str, Any]:
    """Return the content of summary.json.

    Args:
      results: the results.
      varied: the values of the hyperparameters that vary, from `_varied`.
      trainings: what `TrainedPrograms.trainings` returns, for all parts.
    """
    mean, diverged = results.mean, results.diverged
    others = dict(results.finals)
    final = others.pop("final_return")
    sound = np.flatnonzero(~diverged.any(axis=1) & np.isfinite(final).all(axis=1))
    best = lambda scores: int(sound[scores[sound].argmax()]) if sound.size else None
    returns = mean[results.ended]
    shares = {name: importance(values, returns) for name, values in varied.items()}
    # The estimate is noisy and may be below 0.
    shares = {name: x if x is None else max(0.0, x) for name, x in shares.items()}
    return {
        "points": [
            {
                **point,
                "mean": _finite(mean[i]),
                **_estimate(final[i])._asdict(),
                "worst_seed": _finite(final[i].min()),
                **{name: _finite(values[i].mean()) for name, values in others.items()},
                "diverged_seeds": int(diverged[i].sum()),
            }
            for i, point in enumerate(results.points)
        ],
        "best_by_mean": best(mean),
        "best_by_worst_seed": best(final.min(axis=1)),
        "importance": shares,
        **speed(trainings),
        "versions": _joined([training["versions"] for training in trainings]),
    }


def _draw_hyperparameters(
    path: pathlib.Path,
    results: Results,
    varied: Mapping[str, Sequence[Any]],
    *,
    summary: Mapping[str, Any],
) -> None:
    """Draw the mean final returns over each hyperparameter that `_varied` returns."""
    ended, best = results.ended, summary["best_by_mean"]
    plotting.marginals(
        path,
        varied,
        results.mean[ended],
        importance=summary["importance"],
        best=None if best is None else ended.index(best),
        left_out=len(results.points) - len(ended),
    )


def _varied(
    parts: Sequence[TrainedPrograms], names: Sequence[str], points: Sequence[int]
) -> dict[str, list[Any]]:
    """Return the values of the names in which points differ, (points,) each."""
    trained: dict[int, dict[str, Any]] = {}
    for program in (program for part in parts for program in part.programs):
        for (point, _), own in zip(program.members, program.hyperparameters):
            trained[point] = program.algorithm.settings | dict(own)
    values = {name: [trained[point][name] for point in points] for name in names}
    return {name: listed for name, listed in values.items() if len(set(listed)) > 1}


def speed(trainings: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the seconds, steps/s and devices of programs trained one after the other.

    "evaluation_seconds" is included if policies were evaluated. For shards, which run
    in parallel, "env_steps_per_second" is the average speed of one shard.
    """
    total = lambda name: sum(training[name] for training in trainings)
    devices = _joined([{"device": training["device"]} for training in trainings])
    evaluated = all(x.get("evaluation_seconds") is not None for x in trainings)
    return {
        "compile_seconds": total("compile_seconds"),
        "train_seconds": total("train_seconds"),
        "env_steps_per_second": total("env_steps") / max(total("train_seconds"), 1e-9),
        **({"evaluation_seconds": total("evaluation_seconds")} if evaluated else {}),
        **devices,
        "device_count": max(training["device_count"] for training in trainings),
    }


def _joined(records: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the common value of each field, or one string of all different values."""
    every = {name: {record.get(name) for record in records} for name in records[0]}
    return {
        name: values.pop() if len(values) == 1 else ", ".join(sorted(map(str, values)))
        for name, values in every.items()
    }


def _curves(
    points: Sequence[Point],
    seeds: Sequence[int],
    members: Mapping[Member, Mapping[str, np.ndarray]],
) -> dict[str, Any]:
    """Return every metric, (points, seeds, iterations); NaN after a member's last.

    Raises:
      InputError: if members have other metrics than the first one.
    """
    names = members[0, seeds[0]].keys()
    for (point, seed), metrics in members.items():
        if differing := ", ".join(sorted(names ^ metrics.keys())):
            raise InputError(
                f"point {point}, seed {seed} was trained with other metrics than point "
                f"0, seed {seeds[0]}: {differing}"
            )
    # Points may differ in batch_steps, and so in iterations.
    length = max(len(metrics["env_steps"]) for metrics in members.values())
    pad = lambda x: np.concatenate([x, np.full(length - len(x), np.nan)])
    return {
        name: np.array(
            [
                [pad(members[i, seed][name]) for seed in seeds]
                for i in range(len(points))
            ]
        )
        for name in names
    }


def _estimate(final: np.ndarray) -> Estimate:
    """Return what a point's final returns tell; nothing if one is unknown."""
    return estimate(final if np.isfinite(final).all() else final[:0])


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def report(points: Sequence[Point], summary: Mapping[str, Any]) -> list[str]:
    """Return the lines that a sweep prints at its end: speed and best points."""
    seconds = f"{summary['train_seconds']:,.0f} s of training"
    if "evaluation_seconds" in summary:
        seconds += f", {summary['evaluation_seconds']:,.0f} s of evaluations"
    lines = [
        f"{summary['env_steps_per_second']:,.0f} steps/s on {summary['device']}"
        f" ({seconds})"
    ]
    for title in ("best_by_mean", "best_by_worst_seed"):
        best = summary[title]
        if best is None:
            lines.append(
                f"{title}: none, because every point has a seed that diverged or in "
                "which no episode ended"
            )
            continue
        scores = summary["points"][best]
        told = Estimate(scores["interquartile_mean"], scores["interval"])
        lines.append(
            f"{title}: {_label(points[best])} (mean {scores['mean']:.1f}, "
            f"interquartile mean {told}, worst seed {scores['worst_seed']:.1f})"
        )
    shares = summary["importance"].items()
    shown = [f"{name} {share:.0%}" for name, share in shares if share is not None]
    uncertain = ""
    if len(points) < FEW_POINTS:
        uncertain = f" (uncertain with {len(points)} points)"
    return lines + ([f"importance: {', '.join(shown)}{uncertain}"] if shown else [])


def _labels(points: Sequence[Point]) -> list[str]:
    """Return a label for each point: the values in which it differs from others."""
    names = {name for point in points for name in point}
    varied = {x for x in names if len({point.get(x) for point in points}) > 1}
    return [_label({x: point[x] for x in point if x in varied}) for point in points]


def _label(point: Point) -> str:
    changes = ", ".join(f"{name}={value:g}" for name, value in point.items())
    return changes or "the sweep's own values"

"""Sweeps: ``python -m gasil_jax.sweep --env hopper --seeds 5 --grid alpha=0.02,0.1``.

Points that differ only in `Hyperparameters` run in one compiled program, seeds x
points vmapped and sharded; those that differ in a field of `Config` (buffer size,
discriminator updates) are grouped, and each group compiles once.

The sweep's folder holds config.json, results.csv (a row for each point and seed),
curves.npz (every metric, (points, seeds, iterations)), summary.json and sweep.png, and
for each program a folder under programs/ with its metrics.csv and checkpoints.
"""

import csv
import dataclasses
import itertools
import json
import math
import pathlib
import sys
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from gasil_jax import run, run_folder, trackers
from gasil_jax.command_line import InputError
from gasil_jax.config import Config, Hyperparameters, nearest

Point = Mapping[str, Any]

_HYPERPARAMETERS = {f.name: float for f in dataclasses.fields(Hyperparameters)}
_CONFIG = {
    f.name: int
    for f in dataclasses.fields(Config)
    if f.type in (int, "int") and f.name not in ("total_steps", "num_envs")
}

#: The ranges of the paper's appendix, from which `--random` draws.
PAPER_RANGES: Mapping[str, tuple[Any, ...]] = {
    "learning_rate": (3e-4, 1e-4, 5e-5, 3e-5),
    "discriminator_updates": (1, 5, 10, 20),
    "discriminator_learning_rate": (3e-4, 1e-4, 2e-5, 1e-5),
    "buffer_steps": (1000, 10000),
    "alpha": (0.02, 0.1, 0.2, 1.0),
}


@dataclasses.dataclass(frozen=True)
class Options(run.Options):
    """Train every point of a grid, or random points, with many seeds each.

    Attributes:
      grid: NAME=VALUE,VALUE,... for each hyperparameter or count that varies.
      random: draw so many points, from the grid's values or, without one, from the
        ranges of the paper's appendix.
      points_file: a JSON file with a list of points, {"NAME": VALUE, ...} each, in
        place of grid and random.
    """

    grid: tuple[str, ...] = ()
    random: int | None = None
    points_file: str | None = None


def parse_grid(grid: Sequence[str]) -> dict[str, tuple[Any, ...]]:
    """From NAME=VALUE,VALUE,... to values by name.

    Raises:
      InputError: no such name, or not a number.
    """
    kinds = {**_HYPERPARAMETERS, **_CONFIG}
    values = {}
    for entry in grid:
        name, _, listed = entry.partition("=")
        name = name.replace("-", "_")
        if name not in kinds:
            raise InputError(f"grid: {_unknown_name(name)}")
        try:
            values[name] = tuple(kinds[name](value) for value in listed.split(","))
        except ValueError:
            kind = "numbers" if kinds[name] is float else "whole numbers"
            raise InputError(
                f"grid has {entry!r}: it must be {name}= and {kind}, commas between"
            ) from None
    return values


def read_points(path: pathlib.Path) -> list[dict[str, Any]]:
    """The points that a file lists.

    Raises:
      InputError: it can't be read, or has something else in it.
    """
    try:
        points = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise InputError(
            f"points_file is {path}, which can't be read: {error}"
        ) from None
    if not isinstance(points, list) or not points:
        raise InputError(
            f"points_file is {path}: it must hold a list of points, one or more"
        )
    kinds = {**_HYPERPARAMETERS, **_CONFIG}
    for point in points:
        if not isinstance(point, dict):
            raise InputError(f"points_file is {path}: {point!r} is not a point")
        for name, value in point.items():
            if name not in kinds:
                raise InputError(f"points_file is {path}: {_unknown_name(name)}")
            whole = kinds[name] is int
            if isinstance(value, bool) or not isinstance(
                value, int if whole else int | float
            ):
                kind = "a whole number" if whole else "a number"
                raise InputError(
                    f"points_file is {path}: {name} is {value!r}, not {kind}"
                )
    return [
        {name: kinds[name](value) for name, value in point.items()} for point in points
    ]


def _unknown_name(name: str) -> str:
    kinds = (*_HYPERPARAMETERS, *_CONFIG)
    return (
        f"{name!r} can't vary: did you mean {nearest(name, kinds)!r}? "
        f"(one of {', '.join(kinds)})"
    )


def make_points(options: Options) -> list[dict[str, Any]]:
    """The points of a sweep, without repetitions.

    Raises:
      InputError: there is nothing to vary.
    """
    if options.points_file is not None:
        if options.grid or options.random is not None:
            raise InputError("points_file stands in place of grid and random")
        return read_points(pathlib.Path(options.points_file))
    values = parse_grid(options.grid)
    if options.random is None:
        if not values:
            raise InputError(
                "grid is empty: it must be NAME=VALUE,... or use --random or --points"
            )
        return [
            dict(zip(values, point, strict=True))
            for point in itertools.product(*values.values())
        ]
    if options.random < 1:
        raise InputError(f"random is {options.random}: it must be 1 or more")
    values = values or PAPER_RANGES
    every = list(itertools.product(*values.values()))
    count = min(options.random, len(every))
    chosen = np.random.default_rng(options.first_seed).choice(
        len(every), count, replace=False
    )
    return [dict(zip(values, every[i], strict=True)) for i in chosen]


def group(config: Config, points: Sequence[Point]) -> dict[Config, list[int]]:
    """Indices of points by the program that they share."""
    groups: dict[Config, list[int]] = {}
    for index, point in enumerate(points):
        shared = config.updated(
            {name: value for name, value in point.items() if name in _CONFIG}
        )
        groups.setdefault(shared, []).append(index)
    return groups


def sweep(
    options: Options, env: Any, points: Sequence[Point], folder: pathlib.Path
) -> Any:
    """Train all points, log and save; returns the summary.

    Raises:
      Interrupted: by a signal.
      OSError: the folder can't be written any more.
      ValueError: what is there to go on with does not fit.
    """
    from gasil_jax import batch, driver, logging
    from gasil_jax.interruption import Interruption
    from gasil_jax.progress import Progress

    run.write_config(options, folder, points=points)
    config, num_seeds = options.config, options.seeds
    seeds = list(range(options.first_seed, options.first_seed + num_seeds))
    steps_of = lambda points: (
        config.num_iterations * config.batch_steps * num_seeds * points
    )
    schedule = driver.Schedule(options.checkpoint_every, options.keep_checkpoints)
    curves: dict[int, dict[str, np.ndarray]] = {}
    title = f"{options.env} {config.agent} sweep"
    with (
        Interruption() as interruption,
        Progress(title, steps_of(len(points))) as progress,
    ):
        for number, (shared, indices) in enumerate(group(config, points).items()):
            hyperparameters = [
                config.updated(points[i]).hyperparameters for i in indices
            ]
            runs = batch.make_batch(
                env,
                shared,
                seeds * len(indices),
                [floats for floats in hyperparameters for _ in seeds],
            )
            labels = {
                "point": [index for index in indices for _ in seeds],
                "seed": seeds * len(indices),
            }
            place = folder / "programs" / str(number)
            place.mkdir(parents=True, exist_ok=True)
            driver.drive(
                runs,
                place,
                labels,
                schedule=schedule,
                progress=progress,
                interruption=interruption,
                steps_before=steps_of(len(curves)),
                trackers=trackers.make(
                    options.log, place, run_folder.flat(vars(options))
                ),
            )
            metrics = logging.read_metrics(
                place / "metrics.csv", tuple(labels), runs.num_members
            )
            for position, index in enumerate(indices):
                mine = slice(position * num_seeds, (position + 1) * num_seeds)
                curves[index] = {name: value[mine] for name, value in metrics.items()}

    final = {i: run.final_returns(curves[i]["episode_return"]) for i in curves}
    diverged = {i: (curves[i]["skipped_updates"] > 0).any(axis=1) for i in curves}
    names = sorted({name for point in points for name in point})
    with (folder / "results.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["point", "seed", *names, "final_return", "diverged"])
        for index, point in enumerate(points):
            for seed, value, bad in zip(seeds, final[index], diverged[index]):
                cell = "" if math.isnan(value) else f"{value:.7g}"
                row = [index, seed, *(point[name] for name in names), cell, int(bad)]
                writer.writerow(row)
    np.savez_compressed(
        folder / "curves.npz",
        **{
            name: np.stack([curves[i][name] for i in range(len(points))])
            for name in curves[0]
        },
    )
    fine = [i for i in final if not diverged[i].any() and np.isfinite(final[i]).all()]
    best = lambda score: max(fine, key=score) if fine else None
    summary = {
        "points": [
            {
                **point,
                "mean": _finite(final[i].mean()),
                "worst_seed": _finite(final[i].min()),
                "diverged_seeds": int(diverged[i].sum()),
            }
            for i, point in enumerate(points)
        ],
        "best_by_mean": best(lambda i: final[i].mean()),
        "best_by_worst_seed": best(lambda i: final[i].min()),
        "versions": logging.versions(),
    }
    logging.write_json(folder / "summary.json", summary)
    _plot(folder / "sweep.png", points, final)
    return summary


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _label(point: Point) -> str:
    return ", ".join(f"{name}={value:g}" for name, value in point.items())


def _plot(
    path: pathlib.Path, points: Sequence[Point], final: Mapping[int, np.ndarray]
) -> None:
    """Every seed's final return and their mean, a row for each point."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    size = (8.0, 1.0 + 0.35 * len(points))
    figure, axes = plt.subplots(figsize=size, layout="constrained")
    for row in range(len(points)):
        axes.plot(final[row], [row] * len(final[row]), "o", color="0.7", markersize=4)
        axes.plot(final[row].mean(), row, "|", color="#0072B2", markersize=14)
    axes.set_yticks(range(len(points)), [_label(point) for point in points])
    axes.set(xlabel="final return (each seed; the bar is their mean)")
    axes.invert_yaxis()
    figure.savefig(path, dpi=150)
    plt.close(figure)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    return run.exit_status(lambda: _main(arguments))


def _main(arguments: Sequence[str] | None) -> None:
    options = run.parse(Options, arguments, "gasil_jax.sweep")
    run.check(options)
    points = make_points(options)
    for point in points:
        config = options.config.updated(point)
        run.check(dataclasses.replace(options, config=config))
    run.use_devices(options, len(points) * options.seeds)
    env = run.make_env(options)
    for shared, indices in group(options.config, points).items():
        run.check_resources(options, env, shared, len(indices) * options.seeds)
    with run.open_folder(options, "gasil_jax.sweep") as folder:
        summary = sweep(options, env, points, folder)
    for title in ("best_by_mean", "best_by_worst_seed"):
        best = summary[title]
        if best is None:
            print(f"{title}: none, every point has a seed that diverged or never ended")
            continue
        scores = summary["points"][best]
        print(
            f"{title}: {_label(points[best])} (mean {scores['mean']:.1f}, "
            f"worst seed {scores['worst_seed']:.1f})"
        )
    print(f"in {folder}")


if __name__ == "__main__":
    sys.exit(main())

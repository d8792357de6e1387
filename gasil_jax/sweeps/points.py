"""Read or draw the points of a sweep. A point holds changed settings, by name."""

import contextlib
import itertools
import json
import math
import pathlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from gasil_jax import algorithms
from gasil_jax.algorithms import Algorithm
from gasil_jax.config import names, ranges
from gasil_jax.errors import InputError, did_you_mean
from gasil_jax.host.command_line import whole_number
from gasil_jax.imitation import agents_with
from gasil_jax.rewards import REWARD_MODELS

Point = Mapping[str, Any]

_FIXED = ("total_steps", "num_envs")
#: The ranges of the paper's appendix, from which `--random` draws.
PAPER_RANGES: Mapping[str, tuple[Any, ...]] = {
    "learning_rate": (3e-4, 1e-4, 5e-5, 3e-5),
    "discriminator_updates": (1, 5, 10, 20),
    "discriminator_learning_rate": (3e-4, 1e-4, 2e-5, 1e-5),
    "buffer_steps": (1000, 10000),
    "alpha": (0.02, 0.1, 0.2, 1.0),
}


def kinds(algorithm: Algorithm) -> Mapping[str, type]:
    """Return the names that a sweep may vary, with the type of their values."""
    return {
        name: int if allowed.whole else float
        for part in algorithm.parts
        for name, allowed in ranges(part).items()
        if name not in _FIXED
    }


def parse_grid(grid: Sequence[str], algorithm: Algorithm) -> dict[str, tuple[Any, ...]]:
    """Return the values by name from entries NAME=VALUE,VALUE,... for an algorithm.

    Raises:
      InputError: if a name is unknown or given twice, or if a value is not a number.
    """
    values, allowed = {}, kinds(algorithm)
    for entry in grid:
        name, _, listed = entry.partition("=")
        name = name.replace("-", "_")
        if name not in allowed:
            raise InputError(f"grid: {_why_not(name, algorithm)}")
        if name in values:
            raise InputError(f"grid has {name} twice: give all its values in one entry")
        try:
            read = float if allowed[name] is float else whole_number
            numbers = [read(value) for value in listed.split(",")]
            values[name] = tuple(dict.fromkeys(numbers))
        except ValueError:
            kind, example = (
                ("numbers", "0.1,0.2")
                if allowed[name] is float
                else ("whole numbers", "10,20")
            )
            raise InputError(
                f"grid has {entry!r}: it must be {kind}, like {name}={example}"
            ) from None
    return values


def read_points(path: pathlib.Path, algorithm: Algorithm) -> list[dict[str, Any]]:
    """Return the points that a JSON file lists, for an algorithm.

    Raises:
      InputError: if the file can't be read or is not a list of points.
    """
    try:
        points = json.loads(path.read_text())
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(
            f"points_file is {path}, which can't be read: {error}"
        ) from None
    if not isinstance(points, list) or not points:
        raise InputError(
            f"points_file is {path}: it must hold a list of points, one or more"
        )
    for point in points:
        if not isinstance(point, dict):
            raise InputError(f"points_file is {path}: {point!r} is not a point")
        with _errors_name(f"points_file is {path}"):
            check_point(point, algorithm)
    allowed = kinds(algorithm)
    with _errors_name(f"points_file is {path}"):
        read = [
            {name: allowed[name](value) for name, value in point.items()}
            for point in points
        ]
    for index, point in enumerate(read):
        if point in read[:index]:
            raise InputError(f"points_file is {path}: it has {point} twice")
    return read


@contextlib.contextmanager
def _errors_name(source: str) -> Iterator[None]:
    """Turn an error in a point into an `InputError` that names the source."""
    try:
        yield
    # A whole number that is too large for a float is an OverflowError.
    except (ValueError, OverflowError) as error:
        raise InputError(f"{source}: {error}") from None


def check_point(point: Point, algorithm: Algorithm) -> None:
    """Raise `InputError` if a name can't vary or a value is not of its type."""
    allowed = kinds(algorithm)
    for name, value in point.items():
        if name not in allowed:
            raise InputError(_why_not(name, algorithm))
        whole = allowed[name] is int
        if isinstance(value, bool) or not isinstance(
            value, int if whole else int | float
        ):
            kind = "a whole number" if whole else "a number"
            raise InputError(f"{name} is {value!r}, not {kind}")


def check_saved(
    points: Sequence[Point], algorithm: Algorithm, path: pathlib.Path
) -> None:
    """Raise `InputError` if the points in a config.json do not fit its algorithm."""
    with _errors_name(f"{path} is damaged, or another program wrote it: points"):
        for point in points:
            check_point(point, algorithm)
            algorithms.check(algorithm.replace(**point))


def _why_not(name: str, algorithm: Algorithm) -> str:
    """Return why a sweep of an algorithm can't vary a name, and what it can vary."""
    allowed = tuple(kinds(algorithm))
    of_models = {x for model in REWARD_MODELS for x in names(model)}
    if name not in algorithm.settings and (name in of_models or agents_with(name)):
        return f"{algorithm.why_not(name)}. What can vary: {', '.join(allowed)}"
    return f"{name!r} can't vary: {did_you_mean(name, allowed)}"


def make_points(
    grid: Sequence[str],
    random: int | None,
    points_file: str | None,
    *,
    seed: int,
    algorithm: Algorithm,
) -> list[dict[str, Any]]:
    """Return the points of a sweep, without repetitions.

    Args:
      grid: NAME=VALUE,VALUE,... for each name that varies.
      random: number of points to draw from the grid or, without a grid, from
        `PAPER_RANGES`; None takes the whole grid.
      points_file: a file that lists the points, instead of grid and random.
      seed: seed of the draws.
      algorithm: what the points change. Names that it does not have are left out of
        `PAPER_RANGES`.

    Raises:
      InputError: if nothing varies, or if a name or value is not allowed.
    """
    if points_file is not None:
        if grid or random is not None:
            raise InputError("points_file can't be combined with grid or random")
        return read_points(pathlib.Path(points_file), algorithm)
    values: Mapping[str, tuple[Any, ...]] = parse_grid(grid, algorithm)
    if random is None:
        if not values:
            raise InputError(
                "grid is empty: it must be NAME=VALUE,..., or use --random or "
                "--points-file"
            )
        return [
            dict(zip(values, point, strict=True))
            for point in itertools.product(*values.values())
        ]
    if random < 1:
        raise InputError(f"random is {random}: it must be 1 or more")
    values = values or {
        name: PAPER_RANGES[name] for name in PAPER_RANGES if name in kinds(algorithm)
    }
    sizes = [len(listed) for listed in values.values()]
    count = math.prod(sizes)
    if count >= 2**63:
        raise InputError(f"random is {random}: the grid must have under 2**63 points")
    if random > count:
        raise InputError(
            f"random is {random}: it must be at most {count}, the number of points"
        )
    chosen = np.random.default_rng(seed).choice(count, random, replace=False)
    return [
        {
            name: listed[i]
            for (name, listed), i in zip(values.items(), indices, strict=True)
        }
        for indices in zip(*np.unravel_index(chosen, sizes), strict=True)
    ]

"""Read, make or draw the points of a sweep.

A point holds changed settings, by name; of a sweep over agents its "agent", too.
"""

import itertools
import math
import pathlib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from gasil_jax.agents import agents_with
from gasil_jax.algorithms import Algorithm
from gasil_jax.algorithms import check as check_algorithm
from gasil_jax.config import names, ranges
from gasil_jax.errors import InputError, did_you_mean, unknown
from gasil_jax.host import json_files
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


def whole_number(text: str) -> int:
    """Return the whole number in a text, which may be written as 1e6."""
    try:
        return int(text)
    except ValueError:
        if (number := float(text)).is_integer():
            return int(number)
        raise


def _kinds(algorithm: Algorithm) -> Mapping[str, type]:
    """Return the names that a sweep may vary, with the type of their values."""
    return {
        name: int if allowed.whole else float
        for part in algorithm.parts
        for name, allowed in ranges(part).items()
        if name not in _FIXED
    }


def in_words(point: Point) -> str:
    """Return the values of a point as text."""
    return ", ".join(
        str(value) if name == "agent" else f"{name}={value:g}"
        for name, value in point.items()
    )


def algorithm_of(
    point: Point, algorithms: Sequence[Algorithm]
) -> tuple[Algorithm, dict[str, Any]]:
    """Return a point's algorithm, by default the first, and the values it changes."""
    values, by_name = dict(point), {x.agent.name: x for x in algorithms}
    agent = values.pop("agent", algorithms[0].agent.name)
    if agent not in by_name:
        raise InputError(unknown("agent", agent, [*by_name]))
    return by_name[agent], values


def completed(every: Iterable[Point], *algorithms: Algorithm) -> tuple[Point, ...]:
    """Return points that all have the same names, without repetitions."""
    listed = list(every)
    varied = list(dict.fromkeys(name for point in listed for name in point))
    whole = []
    for point in listed:
        algorithm, _ = algorithm_of(point, algorithms)
        # A point that lacks a name has its algorithm's own value.
        values = {"agent": algorithm.agent.name, **algorithm.settings, **point}
        kinds = {"agent": str, **_kinds(algorithm)}
        whole.append({x: kinds[x](values[x]) for x in varied})
    return tuple(x for i, x in enumerate(whole) if x not in whole[:i])


def _grid(
    grid: Sequence[str], algorithms: Sequence[Algorithm]
) -> dict[str, tuple[Any, ...]]:
    """Return the values by name from entries NAME=VALUE,VALUE,..."""
    values: dict[str, tuple[Any, ...]] = {}
    kinds = _kinds(algorithms[0])
    for entry in grid:
        name, _, listed = entry.partition("=")
        name = name.replace("-", "_")
        if name in values:
            raise InputError(f"grid has {name} twice: give all its values in one entry")
        for algorithm in algorithms:
            if name not in _kinds(algorithm):
                raise InputError(f"grid: {_why_not(name, algorithm)}")
        number = whole_number if kinds[name] is int else float
        try:
            values[name] = tuple(dict.fromkeys(map(number, listed.split(","))))
        except ValueError:
            whole = kinds[name] is int
            like = (
                f"whole numbers, like {name}=10"
                if whole
                else f"numbers, like {name}=0.1"
            )
            raise InputError(
                f"grid has {entry!r}: it must be {like},{20 if whole else 0.2}"
            ) from None
    return values


def check(every: Iterable[Point], *algorithms: Algorithm, source: str = "") -> None:
    """Check that points change what can vary, to values that are allowed."""
    try:
        for point in every:
            algorithm, values = algorithm_of(point, algorithms)
            allowed, unused = _kinds(algorithm), without_effect(algorithm)
            for name in values:
                if name not in allowed:
                    raise InputError(_why_not(name, algorithm))
                if name in unused:
                    raise InputError(f"{name} can't vary: {unused[name]}")
            check_algorithm(algorithm.replace(**values))
    except ValueError as error:
        raise InputError(f"{source}{error}") from None


def without_effect(algorithm: Algorithm) -> dict[str, str]:
    """Return the names of settings that have no effect, each with the reason."""
    if algorithm.agent.uses_reward:
        return {}
    reason = f"agent {algorithm.agent.name!r} does not use the environment's reward"
    every = [x for model in REWARD_MODELS for x in (model.switch, *names(model))]
    return dict.fromkeys(every, reason)


def _why_not(name: str, algorithm: Algorithm) -> str:
    """Return why a sweep of an algorithm can't vary a name, and what it can vary."""
    if name == "agent":
        return "'agent' can't vary here: name several agents as --agent A,B"
    allowed = tuple(_kinds(algorithm))
    of_models = {x for model in REWARD_MODELS for x in names(model)}
    if name not in algorithm.settings and (name in of_models or agents_with(name)):
        return f"{algorithm.why_not(name)}. What can vary: {', '.join(allowed)}"
    return f"{name!r} can't vary: {did_you_mean(name, allowed)}"


def read(path: pathlib.Path) -> list[Point]:
    """Return the points that a JSON file lists."""
    try:
        every: Sequence[Point] = json_files.read(
            path, tuple[dict[str, float | str], ...]
        )
    except OSError as error:
        raise InputError(
            f"points_file is {path}, which can't be read: {error}"
        ) from None
    if not every:
        raise InputError(f"points_file is {path}: it must list a point or more")
    return list(every)


def make_points(
    grid: Sequence[str],
    random: int | None,
    *,
    seed: int,
    algorithms: Sequence[Algorithm],
) -> list[Point]:
    """Return the points of a sweep, of all its agents."""
    values: Mapping[str, tuple[Any, ...]] = _grid(grid, algorithms)
    if random is None:
        every = itertools.product(*values.values())
        return [dict(zip(values, point, strict=True)) for point in every]
    shared = set.intersection(*({*_kinds(algorithm)} for algorithm in algorithms))
    values = values or {name: x for name, x in PAPER_RANGES.items() if name in shared}
    sizes = [len(listed) for listed in values.values()]
    count = math.prod(sizes)
    if not 1 <= random <= min(count, 10_000):
        raise InputError(
            f"random is {random}: it must be from 1 to {min(count, 10_000):,}, of "
            f"{count:,} points"
        )
    generator, drawn = np.random.default_rng(seed), dict[tuple[int, ...], None]()
    while len(drawn) < random:
        drawn[tuple(int(generator.integers(size)) for size in sizes)] = None
    return [
        {name: x[i] for (name, x), i in zip(values.items(), at, strict=True)}
        for at in drawn
    ]

"""Finds and loads the training states that a run or a sweep has saved."""

import dataclasses
import json
import pathlib
import sys
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gasil_jax import train
from gasil_jax.config import Config, validate
from gasil_jax.errors import InputError
from gasil_jax.host import checkpoint, command_line, environments, run_folder
from gasil_jax.imitation import AGENTS
from gasil_jax.sweeps import shards
from gasil_jax.sweeps.points import Point
from gasil_jax.sweeps.shards import Program
from gasil_jax.sweeps.tables import Trained


class Saved(NamedTuple):
    """The members of a run, or of one point.

    Attributes:
      root: folder of the checkpoints that they are in.
      program: what was trained and is saved there together.
      places: of the members in it.
    """

    root: pathlib.Path
    program: Program
    places: Sequence[int]

    @property
    def seeds(self) -> list[int]:
        """The members' seed numbers."""
        return [self.program.members[i][1] for i in self.places]


def find(
    folder: pathlib.Path, described: Mapping[str, Any], point: int | None
) -> Saved:
    """Where the states are.

    Args:
      folder: of the run, sweep or shard.
      described: its config.json, of `run_folder.read`.
      point: of a sweep; default the best by mean.

    Raises:
      InputError: there is no such point in the folder.
    """
    if "points" in described:
        return _of_sweep(folder, described, _checked(folder, described, point))
    if point is not None:
        raise InputError(f"point is {point}: {folder} is of a run, which has none")
    config, first = described["config"], described["first_seed"]
    seeds = range(first, first + described["seeds"])
    # A run is a sweep of one point, in one program.
    (program,) = shards.programs(config, [{}], seeds)
    return Saved(folder / "checkpoints", program, range(len(seeds)))


def _checked(
    folder: pathlib.Path, described: Mapping[str, Any], point: int | None
) -> int:
    """The point that is asked for, or the best."""
    points: Sequence[Point] = described["points"]
    if point is None:
        try:
            summary = json.loads((folder / "summary.json").read_text())
        except (OSError, ValueError):
            summary = {}
        point = summary.get("best_by_mean")
        if point is None:
            raise InputError(
                f"run is {folder}, a sweep without a best point: name one, --point 0 "
                f"to {len(points) - 1}"
            )
    if not 0 <= point < len(points):
        raise InputError(
            f"point is {point}: {folder} has points 0 to {len(points) - 1}"
        )
    return point


def _of_sweep(folder: pathlib.Path, described: Mapping[str, Any], point: int) -> Saved:
    """All points of a program are trained together."""
    if shards.root(folder).is_dir():
        raise InputError(
            f"run is {folder}, whose members are in its shards: name one of "
            f"{shards.root(folder)}"
        )
    program, places = _with_point(folder, described, point)
    return Saved(program.folder(folder) / "checkpoints", program, places)


def _with_point(
    folder: pathlib.Path, described: Mapping[str, Any], point: int
) -> tuple[Program, list[int]]:
    """The program that trains a point, and the places of its members in it."""
    for program in Trained.described(folder, described).programs:
        places = [i for i, (index, _) in enumerate(program.members) if index == point]
        if places:
            return program, places
    raise InputError(f"point is {point}: it is not in {folder}, a shard of its sweep")


def load(
    folder: pathlib.Path,
    which: str = "last",
    point: int | None = None,
    seed: int | None = None,
) -> tuple[Any, Config, list[int], Any]:
    """Environment, config, seed numbers and states (seed, ...) of a run or point.

    Args:
      folder: of the run or sweep, finished or not.
      which: of its checkpoints, "last" or "best", the one with the best evaluation
        on the way or, where there was none, the highest returns in training.
      point: of a sweep; default the best by mean.
      seed: its number; default all.

    Raises:
      InputError: it is not the folder of a run, or has no such checkpoint or seed, or
        the best is asked for of a point that shares its checkpoints with others.
    """
    described = run_folder.read(folder)
    saved = find(folder, described, point)
    found, damages = checkpoint.latest(saved.root)
    for damage in damages:
        print(f"warning: {damage}", file=sys.stderr)
    config, count = saved.program.config, len(saved.program.members)
    if which == "best":
        if len(saved.places) < count:
            raise InputError(
                "checkpoint is 'best': this point was trained with others, and "
                "checkpoints are scored over all of them: it must be 'last'"
            )
        found = checkpoint.best(saved.root)
    if found is None:
        scored = " with a score" if which == "best" else ""
        raise InputError(f"run is {folder}: it has no whole checkpoint{scored}")
    settings = dataclasses.asdict(described["settings"])
    with command_line.input_checked():
        validate(config, tuple(AGENTS))
        env = environments.make_env(described["env"], **settings)
        # All members have leaves of the same names.
        init = lambda seed: train.init(
            env, config, jax.random.key(seed), saved.program.hyperparameters[0]
        )
        like = jax.eval_shape(jax.vmap(init), jnp.arange(count, dtype=jnp.uint32))
        states = found.restore(like)
    seeds, places = saved.seeds, np.array(saved.places)
    if seed is not None:
        if seed not in seeds:
            raise InputError(f"seed is {seed}: the run has {seeds[0]} to {seeds[-1]}")
        seeds, places = [seed], places[[seeds.index(seed)]]
    if len(places) < count:
        states = jax.tree.map(lambda x: x[places], states)
    return env, config, seeds, states

"""Where the training states are that a run, a sweep or a halving has saved."""

import json
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from gasil_jax import shards
from gasil_jax.command_line import InputError
from gasil_jax.points import Point
from gasil_jax.shards import Program
from gasil_jax.sweep_tables import Trained


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
      folder: of the run, sweep, shard or halving.
      described: its config.json, of `run_folder.read`.
      point: of a sweep or halving; default the best by mean.

    Raises:
      InputError: there is no such point in the folder.
    """
    if "points" in described:
        where = _of_halving if "reduction" in described else _of_sweep
        return where(folder, described, _checked(folder, described, point))
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
        # Of a sweep and of a halving.
        point = summary.get("best_by_mean", summary.get("best"))
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


def _of_halving(
    folder: pathlib.Path, described: Mapping[str, Any], point: int
) -> Saved:
    """Each point is trained in a folder of its own."""
    program, places = _with_point(folder, {**described, "shard": None}, point)
    own = program.part(places[0], places[-1] + 1)
    root = folder / "points" / str(point) / "checkpoints"
    return Saved(root, own, range(len(places)))


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

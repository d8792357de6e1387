"""Divide a sweep into programs, each compiled once, and shards, each run separately.

A member is a point with a seed. The members of a program differ in hyperparameters, the
numbers that are traced, alone: points that differ in a count have separate programs. A
shard is one of n nearly equal parts of all members. It takes members program by
program, so that it compiles few programs.
"""

import dataclasses
import pathlib
import re
from collections.abc import Mapping, Sequence
from typing import Any

from gasil_jax.algorithms import Algorithm
from gasil_jax.errors import InputError
from gasil_jax.host import run_folder
from gasil_jax.sweeps.points import Point


@dataclasses.dataclass(frozen=True)
class Program:
    """The members that one compiled program trains.

    Attributes:
      number: number of the program in the whole sweep, and name of its folder.
      algorithm: the algorithm that its members share.
      members: (index of the point, absolute seed number) of each member.
      hyperparameters: the numbers of each member, by name.
    """

    number: int
    algorithm: Algorithm
    members: tuple[tuple[int, int], ...]
    hyperparameters: tuple[Mapping[str, Any], ...]

    def part(self, begin: int, end: int) -> "Program":
        """Return the program with only the members from index `begin` to `end`."""
        return dataclasses.replace(
            self,
            members=self.members[begin:end],
            hyperparameters=self.hyperparameters[begin:end],
        )

    def folder(self, sweep: pathlib.Path) -> pathlib.Path:
        """Return the program's folder inside the folder of a sweep or shard."""
        return sweep / "programs" / str(self.number)


def programs(
    algorithm: Algorithm, points: Sequence[Point], seeds: Sequence[int]
) -> list[Program]:
    """Return the programs that train all points with all seeds.

    Args:
      algorithm: the algorithm that the points change.
      points: changed settings, by name.
      seeds: absolute seed numbers.
    """
    changed = [algorithm.replace(**point) for point in points]
    groups: dict[Algorithm, list[int]] = {}
    for index, own in enumerate(changed):
        shared = own.replace(**algorithm.hyperparameters)
        groups.setdefault(shared, []).append(index)
    return [
        Program(
            number,
            shared,
            tuple((i, seed) for i in indices for seed in seeds),
            tuple(changed[i].hyperparameters for i in indices for _ in seeds),
        )
        for number, (shared, indices) in enumerate(groups.items())
    ]


@dataclasses.dataclass(frozen=True)
class Shard:
    """One of several parts of a sweep.

    Attributes:
      number: number of the part, from 1 on.
      count: number of parts.
    """

    number: int
    count: int

    def __str__(self) -> str:
        return f"{self.number}/{self.count}"

    def folder(self, sweep: pathlib.Path) -> pathlib.Path:
        """Return the shard's folder inside the folder of its sweep."""
        return root(sweep) / f"{self.number}-of-{self.count}"


def root(sweep: pathlib.Path) -> pathlib.Path:
    """Return the folder that holds the shards of a sweep."""
    return sweep / "shards"


def name(folder: pathlib.Path, shard: Shard | None) -> str:
    """Return the name of a sweep or shard in trackers: SWEEP, or SWEEP-3-of-8.

    Args:
      folder: folder of the sweep or the shard.
      shard: the shard; None for a whole sweep.
    """
    folder = folder.absolute()
    sweep = folder.parent.parent
    # A shard's folder may have been copied out of the folder of its sweep.
    inside = shard is not None and folder == shard.folder(sweep)
    return f"{sweep.name}-{folder.name}" if inside else folder.name


def refuse_unsharded(out: pathlib.Path) -> None:
    """Raise `InputError` if the folder holds a run or sweep without shards."""
    if run_folder.has_run(out) and not root(out).is_dir():
        raise InputError(
            f"out is {out}, which holds a run that is not in shards: name another "
            "folder"
        )


def refuse_other_count(out: pathlib.Path, shard: Shard) -> None:
    """Raise `InputError` if the folder holds a sweep with another number of shards."""
    counts = {path.name.split("-of-")[-1] for path in root(out).glob("*-of-*")}
    others = counts - {str(shard.count)}
    if others:
        raise InputError(
            f"shard is {shard}: {out} holds a sweep that is cut into {min(others)} "
            "shards"
        )


def refuse_sharded(out: pathlib.Path) -> None:
    """Raise `InputError` if the folder holds shards of a sweep, or their tables."""
    merged = (out / "results.csv").exists() and not (out / "programs").is_dir()
    if merged and not root(out).is_dir():
        raise InputError(
            f"out is {out}, which holds the tables of shards in other folders: "
            "continue each of them with --resume, then run python -m gasil_jax.merge"
        )
    if root(out).is_dir():
        raise InputError(
            f"out is {out}, which holds shards: continue each of them with --shard and "
            "--resume, then run python -m gasil_jax.merge"
        )


def refuse_used(out: pathlib.Path, resume: bool) -> None:
    """Raise `InputError` unless the folder is empty or holds shards to resume."""
    if root(out).is_dir():
        if not resume:
            raise InputError(
                f"out is {out}, where shards have begun: name a new or an empty "
                "folder, or continue them with --resume"
            )
    elif out.is_dir():
        run_folder.refuse_used(out)


def parse(text: str) -> Shard:
    """Return the shard with a name such as "3/8".

    Args:
      text: NUMBER/COUNT.

    Raises:
      InputError: if the text has another form.
    """
    match = re.fullmatch(r"([1-9][0-9]*)/([1-9][0-9]*)", text, re.ASCII)
    shard = Shard(*map(int, match.groups())) if match else None
    if shard is None or shard.number > shard.count:
        raise InputError(
            f"shard is {text!r}: it must be NUMBER/COUNT, such as 1/8 up to 8/8"
        )
    return shard


def cut_evenly(whole: Sequence[Program], shard: Shard) -> list[Program]:
    """Return the programs that a shard trains, each with the shard's members only.

    The sizes of shards differ by one member at most. Each member is in one shard.

    Raises:
      InputError: if there are more shards than members.
    """
    total = sum(len(program.members) for program in whole)
    if shard.count > total:
        raise InputError(
            f"shard is {shard}: {total} members (points x seeds) make {total} shards "
            "at most"
        )
    first = (shard.number - 1) * total // shard.count
    last = shard.number * total // shard.count
    shares, before = [], 0
    for program in whole:
        size = len(program.members)
        part = program.part(max(0, first - before), max(0, last - before))
        if part.members:
            shares.append(part)
        before += size
    return shares

"""How a sweep is cut: into programs that compile once, and into shards that run apart.

A member is a point with a seed. The members of a program differ in `Hyperparameters`
alone; two counts are among these, which divide the points unless it is asked that they
share a program. A shard is one of n near-equal parts of all members, which
are taken program by program, so that a shard compiles as few programs as may be.
"""

import dataclasses
import pathlib
import re
from collections.abc import Sequence

from gasil_jax.config import Config, Hyperparameters, ranges
from gasil_jax.errors import InputError
from gasil_jax.host import run_folder
from gasil_jax.sweeps.points import Point

#: Hyperparameters that decide shapes: of a program its configuration has the largest.
COUNTS = tuple(x for x, allowed in ranges(Hyperparameters).items() if allowed.whole)


@dataclasses.dataclass(frozen=True)
class Program:
    """What one compiled program trains.

    Attributes:
      number: among the programs of the whole sweep; names its folder.
      config: that its members share.
      members: (index of the point, absolute seed number) of each.
      hyperparameters: of each.
    """

    number: int
    config: Config
    members: tuple[tuple[int, int], ...]
    hyperparameters: tuple[Hyperparameters, ...]

    def part(self, begin: int, end: int) -> "Program":
        """The same program with some of its members, from place to place."""
        return dataclasses.replace(
            self,
            members=self.members[begin:end],
            hyperparameters=self.hyperparameters[begin:end],
        )

    def folder(self, sweep: pathlib.Path) -> pathlib.Path:
        """Where it is in the folder of a sweep or shard."""
        return sweep / "programs" / str(self.number)


def programs(
    config: Config,
    points: Sequence[Point],
    seeds: Sequence[int],
    share_counts: bool = False,
) -> list[Program]:
    """The programs of a sweep, all points with all seeds.

    Args:
      config: what the points are changes of.
      points: hyperparameters and fields of `Config` by name.
      seeds: absolute seed numbers.
      share_counts: whether points that differ in the buffer's steps or the
        discriminator's updates share a program, that of the largest.
    """
    configs = [config.replace(**point) for point in points]
    counts = [
        {name: getattr(own.hyperparameters, name) for name in COUNTS} for own in configs
    ]
    if share_counts:
        largest = {name: max(own[name] for own in counts) for name in COUNTS}
        counts = [largest] * len(configs)
    groups: dict[Config, list[int]] = {}
    for index, own in enumerate(configs):
        shared = config.hyperparameters.replace(**counts[index])
        groups.setdefault(own.replace(hyperparameters=shared), []).append(index)
    return [
        Program(
            number,
            shared,
            tuple((i, seed) for i in indices for seed in seeds),
            tuple(configs[i].hyperparameters for i in indices for _ in seeds),
        )
        for number, (shared, indices) in enumerate(groups.items())
    ]


@dataclasses.dataclass(frozen=True)
class Shard:
    """One of several parts of a sweep.

    Attributes:
      number: which, from 1 on.
      count: how many there are.
    """

    number: int
    count: int

    def __str__(self) -> str:
        return f"{self.number}/{self.count}"

    def folder(self, sweep: pathlib.Path) -> pathlib.Path:
        """Where it is in the folder of its sweep: the same on every host."""
        return root(sweep) / f"{self.number}-of-{self.count}"


def root(sweep: pathlib.Path) -> pathlib.Path:
    """The folder that holds the shards of a sweep."""
    return sweep / "shards"


def refuse_whole(out: pathlib.Path) -> None:
    """Raise `InputError` if a run or sweep that is not in shards is in the folder."""
    if run_folder.is_described(out) and not root(out).is_dir():
        raise InputError(
            f"out is {out}, which holds a run that is not in shards: name another "
            "folder"
        )


def refuse_recut(out: pathlib.Path, shard: Shard) -> None:
    """Raise `InputError` if the folder holds shards of another number."""
    inside = root(out)
    cuts = {path.name.split("-of-")[-1] for path in inside.glob("*-of-*")}
    others = cuts - {str(shard.count)}
    if others:
        raise InputError(
            f"shard is {shard}: {out} holds a sweep that is cut into {min(others)}"
        )


def refuse_sharded(out: pathlib.Path) -> None:
    """Raise `InputError` if a sweep in shards is in the folder."""
    if root(out).is_dir():
        raise InputError(
            f"out is {out}, which holds shards: go on with each of them with --shard, "
            "and then python -m gasil_jax.merge"
        )


def parse(text: str, name: str = "shard") -> Shard:
    """From "3/8".

    Args:
      text: that.
      name: what a refusal calls it.

    Raises:
      InputError: it is no such thing.
    """
    found = re.fullmatch(r"([1-9][0-9]*)/([1-9][0-9]*)", text, re.ASCII)
    shard = Shard(*map(int, found.groups())) if found else None
    if shard is None or shard.number > shard.count:
        raise InputError(
            f"{name} is {text!r}: it must be NUMBER/COUNT, such as 1/8 up to 8/8"
        )
    return shard


def share(whole: Sequence[Program], shard: Shard) -> list[Program]:
    """The part of the programs that a shard trains, in order.

    Shards differ by one member at most, and together hold each member once.

    Raises:
      InputError: there are more shards than members.
    """
    total = sum(len(program.members) for program in whole)
    if shard.count > total:
        raise InputError(
            f"shard is {shard}: {total} members (points x seeds) make {total} shards "
            "at most"
        )
    first = (shard.number - 1) * total // shard.count
    last = shard.number * total // shard.count
    mine, before = [], 0
    for program in whole:
        size = len(program.members)
        part = program.part(max(0, first - before), max(0, last - before))
        if part.members:
            mine.append(part)
        before += size
    return mine

"""Shards: nearly equal parts of a sweep's runs, for a process each."""

import dataclasses
import re
from collections.abc import Sequence

from gasil_jax.errors import InputError
from gasil_jax.sweeps import programs
from gasil_jax.sweeps.runs import Run


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


def cut_evenly(runs: Sequence[Run], shard: Shard) -> list[Run]:
    """Return the runs of a shard, which does not depend on what is trained already.

    The sizes of shards differ by one run at most, and the runs of a program are divided
    as little as possible.

    Raises:
      InputError: if there are more shards than runs.
    """
    ordered = [run for program in programs.group(runs) for run in program.runs]
    total = len(ordered)
    if shard.count > total:
        raise InputError(
            f"shard is {shard}: {total} members (points x seeds) make {total} shards "
            "at most"
        )
    first = (shard.number - 1) * total // shard.count
    return ordered[first : shard.number * total // shard.count]

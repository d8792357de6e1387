"""Shards: parts of runs, for a process each."""

import dataclasses
import re

from gasil_jax.errors import InputError


@dataclasses.dataclass(frozen=True)
class Shard:
    """One of several parts.

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

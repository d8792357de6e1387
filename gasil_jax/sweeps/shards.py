"""Shards: parts of runs, for a process each."""

import re

from gasil_jax.errors import InputError


def parse(text: str) -> tuple[int, int]:
    """Return the number of a shard, from 1 on, and their count, from text like "3/8".

    Raises:
      InputError: if the text has another form.
    """
    match = re.fullmatch(r"([1-9][0-9]*)/([1-9][0-9]*)", text, re.ASCII)
    number, count = map(int, match.groups()) if match else (0, 0)
    if not 1 <= number <= count:
        raise InputError(
            f"shard is {text!r}: it must be NUMBER/COUNT, such as 1/8 up to 8/8"
        )
    return number, count

"""Errors of bad input, and the words that they share. Every layer may import this."""

import difflib
from collections.abc import Sequence


class InputError(ValueError):
    """Bad input, in one line that names the value and what is allowed."""


def nearest(name: str, allowed: Sequence[str]) -> str:
    """The allowed name that is most like `name`."""
    return difflib.get_close_matches(name, allowed, n=1, cutoff=0.0)[0]


def unknown(kind: str, name: str, allowed: Sequence[str]) -> str:
    """The error message for a name that is none of the allowed ones."""
    return (
        f"{kind} {name!r} is unknown: did you mean {nearest(name, allowed)!r}? "
        f"(one of {', '.join(allowed)})"
    )

"""The error for bad input, and its wording. Every layer may import this module."""

import difflib
from collections.abc import Sequence


class InputError(ValueError):
    """Bad input; the message is one line with the value and what is allowed."""


class NotImportable(InputError):
    """A MODULE:NAME that can't be imported here."""


def nearest(name: str, allowed: Sequence[str]) -> str:
    """Return the allowed name that is most similar to `name`."""
    return difflib.get_close_matches(name, allowed, n=1, cutoff=0.0)[0]


def unknown(kind: str, name: str, allowed: Sequence[str]) -> str:
    """Return the error message for a name that is not among the allowed ones."""
    return (
        f"{kind} {name!r} is unknown: did you mean {nearest(name, allowed)!r}? "
        f"(one of {', '.join(allowed)})"
    )

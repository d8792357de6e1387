"""The error for bad input, and its wording. Every layer may import this module."""

import difflib
import shlex
from collections.abc import Sequence


class InputError(ValueError):
    """Bad input; the message is one line with the value and what is allowed."""


class NotImportable(InputError):
    """A MODULE:NAME that can't be imported here."""


def nearest(name: str, allowed: Sequence[str]) -> str | None:
    """Return the allowed name that is most similar to `name`, or None if none is.

    Capital letters and small ones count as the same.
    """
    lowered = {x.lower(): x for x in allowed}
    close = difflib.get_close_matches(name.lower(), lowered, n=1, cutoff=0.7)
    return lowered[close[0]] if close else None


def unknown(
    kind: str, name: str, allowed: Sequence[str], *, forms: Sequence[str] = ()
) -> str:
    """Return the error message for a name that is not among the allowed ones.

    Args:
      kind: the kind of thing that is named, such as "agent".
      name: the unknown name.
      allowed: the names that exist.
      forms: the forms of other allowed names, such as MODULE:NAME.
    """
    return f"{kind} {name!r} is unknown: {did_you_mean(name, allowed, forms)}"


def did_you_mean(name: str, allowed: Sequence[str], forms: Sequence[str] = ()) -> str:
    """Return the end of an error message: the most similar allowed name, and all names.

    Names with spaces are quoted, as on a command line.
    """
    listed = ", ".join(shlex.quote(x) for x in (*allowed, *forms))
    close = nearest(name, allowed)
    if close is None:
        return f"it must be one of {listed}"
    return f"did you mean {close!r}? (one of {listed})"

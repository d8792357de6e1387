"""The error for bad input, and its wording. Neither JAX nor MuJoCo is needed here."""

import difflib
import numbers
import shlex
from collections.abc import Iterable, Sequence
from typing import Any


class InputError(ValueError):
    """Bad input; the message is one line with the value and what is allowed."""


class NotImportable(InputError):
    """A MODULE:NAME that can't be imported here."""


def refusal(name: str, value: Any, allowed: object) -> InputError:
    """Return the error for a value that is not allowed."""
    return InputError(f"{name} is {shown(value)}: it must be {allowed}")


def shown(value: Any) -> str:
    """Return a value in one line that is not long, whatever it is."""
    try:
        # The repr of NumPy's numbers also names their type.
        show = str if isinstance(value, numbers.Number) else repr
        text = " ".join(show(value).split())
    except Exception:  # It may be an object of the user's, or a number of 5,000 digits.
        text = f"of type {type(value).__name__}"
    return text if len(text) < 300 else f"{text[:300]}..."


def nearest(name: str, allowed: Iterable[str]) -> str | None:
    """Return the allowed name that is most similar to `name`, or None if none is.

    Capital letters and small ones count as the same. A prefix, as in "gymnax:Catch",
    does not make names similar. A name that is a part of another is near it, as "lr" is
    to "learning_rate".
    """
    bare = {x.rpartition(":")[2].lower(): x for x in allowed}
    given = name[:300].rpartition(":")[2].lower()
    close = difflib.get_close_matches(given, bare, n=1, cutoff=0.7)
    if not close:
        initials = {x: "".join(word[:1] for word in x.split("_")) for x in bare}
        longer = len(given) > 2
        close = [x for x in bare if given == initials[x] or (longer and given in x)]
    return bare[close[0]] if close else None


def unknown(
    kind: str, name: Any, allowed: Sequence[str], *, forms: Sequence[str] = ()
) -> str:
    """Return the error message for a name that is not among the allowed ones.

    `kind` is what is named, such as "agent"; `forms` are those of other allowed names,
    such as MODULE:NAME.
    """
    text = name if isinstance(name, str) else shown(name)
    return f"{kind} {shown(text)} is unknown: {did_you_mean(text, allowed, forms)}"


def did_you_mean(name: str, allowed: Sequence[str], forms: Sequence[str] = ()) -> str:
    """Return the end of an error message: the most similar allowed name, and all names.

    Names with spaces are quoted, as on a command line.
    """
    listed = ", ".join(shlex.quote(x) for x in (*allowed, *forms))
    close = nearest(name, allowed)
    if close is None:
        return f"it must be one of {listed}"
    return f"did you mean {close!r}? (one of {listed})"

"""Import what a user gives as MODULE:NAME, and tell of errors in it in one line."""

import importlib
import pathlib
import traceback
from typing import Any

import jax


def find(kind: str, name: str) -> Any:
    """Return the object that MODULE:NAME names.

    Args:
      kind: what the object is, for the error message, such as "env".
      name: MODULE:NAME.

    Raises:
      ValueError: if it can't be imported.
    """
    module, attribute = name.split(":", 1)
    try:
        return getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError, ValueError) as error:
        why = str(error)
    # A script without `if __name__ == "__main__"` may exit.
    except (Exception, SystemExit) as error:
        why = in_a_line(error)
    raise ValueError(f"{kind} {name!r} can't be imported: {why}")


def in_a_line(error: BaseException, but: pathlib.Path | None = None) -> str:
    """Return the message of an error in the user's code, and where it was raised.

    Args:
      error: the error.
      but: a folder whose code is not the user's, besides JAX and this package.
    """
    message = f"{type(error).__name__}: {error}".partition("\n")[0]
    if isinstance(error, SyntaxError):
        return message  # It names file and line already.
    frames = reversed(traceback.extract_tb(error.__traceback__))
    others = _NOT_THE_USERS if but is None else (*_NOT_THE_USERS, str(but))
    user_frames = (x for x in frames if not x.filename.startswith(others))
    frame = next(user_frames, None)
    if frame is None:
        return message
    return f"{message} ({frame.filename}, line {frame.lineno})"


_NOT_THE_USERS = tuple(str(pathlib.Path(x).parent) for x in (jax.__file__, __file__))

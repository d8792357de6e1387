"""Import an object that a user names as MODULE:NAME; report errors in one line."""

import contextlib
import importlib
import pathlib
import sysconfig
import traceback
from collections.abc import Iterator
from typing import Any

import jax


def find(kind: str, name: str) -> Any:
    """Return the object that MODULE:NAME names; `kind` is what it is, such as "env"."""
    module, attribute = name.split(":", 1)
    with refused(f"{kind} {name!r} can't be imported"):
        return getattr(importlib.import_module(module), attribute)


@contextlib.contextmanager
def refused(
    what: str, *packages: pathlib.Path, passing: type[Exception] | tuple[()] = ()
) -> Iterator[None]:
    """Turn all that a user's code raises in the `with` block into a `ValueError`.

    That includes `SystemExit`, as of a script that ends with `sys.exit()`: the user's
    code does not decide how this process ends. Only Ctrl-C does. `what` begins the
    message, such as "agent 'a:B' can't be traced", and errors of the type `passing` are
    raised as they are.
    """
    try:
        yield
    except passing:
        raise
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        why = in_a_line(error, *packages)
        raise ValueError(f"{what}: {why}") from None


def in_a_line(error: BaseException, *packages: pathlib.Path) -> str:
    """Return an error as one line: its message, with type and place if they help.

    The place is the innermost line of the user's own code, if the error passed any:
    that of other `packages`, which are folders, is not. The type is left out of an
    error that explains itself without it.
    """
    message = str(error).partition("\n")[0]
    typed = ": ".join(filter(None, (type(error).__name__, message)))
    if isinstance(error, SyntaxError):
        return typed  # It names file and line already.
    others = (*_NOT_THE_USERS, *packages)
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        path = pathlib.Path(frame.filename)
        if not any(path.is_relative_to(x) for x in others) and path.is_file():
            return f"{typed} ({path}, line {frame.lineno})"
    plain = isinstance(error, ImportError | AttributeError | ValueError)
    return message if plain else typed


def first_change(before: Any, after: Any) -> tuple[str, str, str] | None:
    """Return the first leaf of two pytrees of arrays whose dtype or shape differs.

    It is a path and what is there in each, such as float32[3] or "missing"; or None.
    """
    described = [
        {
            jax.tree_util.keystr(path): f"{leaf.dtype}{list(leaf.shape)}"
            for path, leaf in jax.tree_util.tree_leaves_with_path(tree)
        }
        for tree in (before, after)
    ]
    for path in described[0] | described[1]:
        first, then = (leaves.get(path, "missing") for leaves in described)
        if first != then:
            return path, first, then
    return None


_NOT_THE_USERS = (
    *(pathlib.Path(sysconfig.get_path(x)) for x in ("stdlib", "purelib", "platlib")),
    pathlib.Path(jax.__file__).parent,
    pathlib.Path(__file__).parent,
)

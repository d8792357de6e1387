"""Files that are refused beforehand, or written whole."""

import contextlib
import pathlib
import tempfile
import uuid
from collections.abc import Iterator, Sequence

from gasil_jax.errors import InputError


def unwritable(path: pathlib.Path, error: OSError) -> str:
    """What is said of a folder or file that can't be written."""
    # Libraries raise it without a number, some in several lines.
    why = error.strerror or str(error).partition("\n")[0]
    return f"out is {path}, which can't be written: {why}"


def check(path: pathlib.Path, endings: Sequence[str]) -> None:
    """Raise `InputError` unless it can be a new file with one of these endings."""
    if path.suffix not in endings:
        raise InputError(f"out is {path}: it must end in {', '.join(endings)}")
    if path.exists():
        raise InputError(f"out is {path}, which exists: name a new file")


def make_parent(path: pathlib.Path) -> None:
    """Make the folder that it goes in.

    Raises:
      InputError: that can't be, or it can't be written in.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise InputError(unwritable(path, error)) from None


@contextlib.contextmanager
def whole(path: pathlib.Path) -> Iterator[pathlib.Path]:
    """Gives a path beside it to write to, which becomes it in the end, or nothing.

    So no reader sees half a file, and processes may write the same one side by side.

    Raises:
      OSError: it can't be written, in one line that names it.
    """
    # No number of a process: those of several hosts may be the same.
    partial = path.with_name(f".{path.stem}.{uuid.uuid4().hex}{path.suffix}")
    try:
        yield partial
        partial.rename(path)
    except OSError as error:
        raise OSError(unwritable(path, error)) from error
    finally:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)

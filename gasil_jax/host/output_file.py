"""Check the paths of output files, and write files atomically."""

import contextlib
import errno
import os
import pathlib
import sys
import uuid
from collections.abc import Iterator, Sequence

from gasil_jax.errors import InputError

#: Errors of calls that a file system does not have, such as those for locks.
MISSING_CALL = (errno.ENOSYS, errno.EINVAL, errno.EOPNOTSUPP)
#: Errors of a disk, or a user's share of it, that is full.
_FULL = (errno.ENOSPC, errno.EDQUOT)


class WriteError(OSError):
    """A file or folder could not be written; the message is one line with its path."""


def note(text: str) -> None:
    """Print a line to stderr about something that is allowed but may be a mistake."""
    print(f"note: {text}", file=sys.stderr)


@contextlib.contextmanager
def refused(path: pathlib.Path, option: str = "out") -> Iterator[None]:
    """Turn an `OSError` from the `with` block into the refusal of an option's path."""
    try:
        yield
    except OSError as error:
        why = f"which can't be written: {_reason(error)}"
        raise InputError(f"{option} is {path}, {why}") from None


def unwritten(path: pathlib.Path, error: Exception) -> str:
    """Return the error message for a file or folder that could not be written."""
    return f"{path} can't be written: {_reason(error)}"


def _reason(error: Exception) -> str:
    # A library's error may have no `strerror`, and a message of several lines or none.
    strerror = getattr(error, "strerror", None)
    if getattr(error, "errno", None) in _FULL:
        return f"{strerror}: make room there"
    return strerror or str(error).partition("\n")[0] or type(error).__name__


@contextlib.contextmanager
def errors_named(path: pathlib.Path) -> Iterator[None]:
    """Turn an `OSError` raised inside the `with` block into a `WriteError`."""
    try:
        yield
    except OSError as error:
        raise WriteError(unwritten(path, error)) from error


def flush(descriptor: int) -> None:
    """Make the operating system write an open file or folder to the disk, if it can."""
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in MISSING_CALL:
            raise


def check(path: pathlib.Path, endings: Sequence[str]) -> None:
    """Raise `InputError` unless the path is free and has one of these endings."""
    if path.suffix not in endings:
        raise InputError(f"out is {path}: it must end in {', '.join(endings)}")
    if path.exists():
        raise InputError(f"out is {path}, which exists: name a new file")


def make_parent(path: pathlib.Path) -> None:
    """Create the folder of a file, and check that a file can be written in it."""
    with refused(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        probe = _partial(path)
        probe.touch()
        probe.unlink()


def _partial(path: pathlib.Path) -> pathlib.Path:
    # A process number is not unique: processes on several hosts may share the folder.
    return path.with_name(f".{path.stem}.{uuid.uuid4().hex}{path.suffix}")


@contextlib.contextmanager
def atomic(path: pathlib.Path) -> Iterator[pathlib.Path]:
    """Yield a temporary path beside the file, which is renamed to it at the end."""
    partial = _partial(path)
    try:
        with errors_named(path):
            yield partial
            partial.rename(path)
    finally:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)

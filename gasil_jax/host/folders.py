"""Create, lock and check the folders that training writes to."""

import contextlib
import errno
import fcntl
import functools
import os
import pathlib
import socket
import tempfile
import time
from collections.abc import Iterator

from gasil_jax.errors import InputError
from gasil_jax.host import output_file
from gasil_jax.host.output_file import note, unwritable

_LOCK = ".lock"
_PROBE = ".writable-"
CONFIG = "config.json"
#: Errors of locking where there are no locks.
_NO_LOCKS = (*output_file.MISSING_CALL, errno.ENOLCK)


def create(folder: pathlib.Path, *, option: str = "out") -> pathlib.Path:
    """Create a folder if it is missing, and return it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=_PROBE, dir=folder):
            pass
    except OSError as error:
        raise InputError(unwritable(folder, error, option)) from None
    return folder


def create_new(name: str) -> pathlib.Path:
    """Create a folder under runs/, with a number after its name if that is taken."""
    runs, number = create(pathlib.Path("runs")), 1
    while True:
        folder = runs / (name if number == 1 else f"{name}-{number}")
        try:
            folder.mkdir()
            return folder
        except FileExistsError:
            number += 1
        except OSError as error:
            raise InputError(unwritable(folder, error)) from None


def check_writable(folder: pathlib.Path) -> None:
    """Raise `InputError` if a folder, or where it would be made, is read-only."""
    existing = folder
    while not existing.exists():
        existing = existing.parent
    try:
        with tempfile.TemporaryDirectory(prefix=_PROBE, dir=existing):
            pass
    except OSError as error:
        raise InputError(unwritable(folder, error)) from None


@functools.cache
def _note_missing_locks(folder: pathlib.Path, why: str) -> None:
    note(
        f"{folder} can't be locked ({why}): make sure that no other process writes "
        "to it"
    )


@contextlib.contextmanager
def lock(
    folder: pathlib.Path, *, option: str = "out", seconds: float = 0.0
) -> Iterator[None]:
    """Lock the folder against other processes inside the `with` block.

    The operating system frees the lock when the process ends, however it ends. Where
    the file system has no locks, a note says so, and nothing is locked.
    """
    deadline = time.monotonic() + seconds
    with (folder / _LOCK).open("a+") as file:
        while True:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.monotonic() < deadline:
                    time.sleep(0.1)
                    continue
                file.seek(0)
                raise InputError(
                    f"{option} is {folder}, which "
                    f"{file.read() or 'another process'} is writing to: name another "
                    "folder or wait"
                ) from None
            except OSError as error:
                if error.errno not in _NO_LOCKS:
                    raise
                _note_missing_locks(folder, str(error.strerror))
                break
        with output_file.errors_named(folder / _LOCK):
            file.truncate(0)
            file.write(f"process {os.getpid()} on {socket.gethostname()}")
            file.flush()
        yield


def refuse_used(folder: pathlib.Path, *, option: str = "out") -> None:
    """Raise `InputError` unless the folder is empty or missing.

    What killed processes may leave does not count: the lock, half written files and the
    folder by which `create` tests whether it can write.
    """
    if not folder.exists():
        return
    used = any(
        path.name != _LOCK
        and not path.name.startswith(_PROBE)
        and not output_file.is_temporary(path)
        for path in folder.iterdir()
    )
    if used:
        resume = "--resume" if option == "out" else "resume=True"
        more = f", or continue what is in it with {resume}"
        raise InputError(
            f"{option} is {folder}, which is not empty: name a new or an empty folder"
            f"{more if has_config(folder) else ''}"
        )


def has_config(folder: pathlib.Path) -> bool:
    """Return whether a run or a sweep has begun in the folder."""
    return (folder / CONFIG).is_file()

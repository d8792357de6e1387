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
from gasil_jax.host.output_file import note, refused

_LOCK = ".lock"
CONFIG = "config.json"
#: Errors of locking where there are no locks.
_NO_LOCKS = (*output_file.MISSING_CALL, errno.ENOLCK)


def create(folder: pathlib.Path, *, option: str = "out") -> pathlib.Path:
    """Create a folder if it is missing, and return it."""
    with refused(folder, option):
        folder.mkdir(parents=True, exist_ok=True)
    check_writable(folder, option=option)
    return folder


def create_new(name: str) -> pathlib.Path:
    """Create a folder under runs/, with a number after its name if that is taken."""
    folder, number = create(pathlib.Path("runs")) / name, 1
    while True:
        with refused(folder), contextlib.suppress(FileExistsError):
            folder.mkdir()
            return folder
        number += 1
        folder = folder.with_name(f"{name}-{number}")


def check_writable(folder: pathlib.Path, *, option: str = "out") -> None:
    """Raise `InputError` if a folder, or where it would be made, is read-only."""
    existing = folder
    with refused(folder, option):
        while not existing.exists():
            existing = existing.parent
        with tempfile.TemporaryDirectory(prefix=".writable-", dir=existing):
            pass


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

    Hidden files do not count: the lock, and what killed processes may leave.
    """
    if folder.exists() and not all(x.name.startswith(".") for x in folder.iterdir()):
        resume = "--resume" if option == "out" else "resume=True"
        more = f", or continue what is in it with {resume}"
        raise InputError(
            f"{option} is {folder}, which is not empty: name a new or an empty folder"
            f"{more if has_config(folder) else ''}"
        )


def has_config(folder: pathlib.Path) -> bool:
    """Return whether a run or a sweep has begun in the folder."""
    return (folder / CONFIG).is_file()

"""A run's folder: made, locked, described in config.json, and read again."""

import contextlib
import dataclasses
import fcntl
import json
import os
import pathlib
import socket
import tempfile
import time
from collections.abc import Iterator, Mapping
from typing import Any

from gasil_jax.config import Config, Hyperparameters
from gasil_jax.errors import InputError
from gasil_jax.host.environments import Settings
from gasil_jax.host.output_file import unwritable

_LOCK = ".lock"
_PROBE = ".writable-"
_CONFIG = "config.json"


def check(out: pathlib.Path, resume: bool) -> None:
    """Refuse a folder before a run is built for it; nothing new is left but a lock.

    Raises:
      InputError: it can't be written, is in use, or, unless `resume`, is used.
    """
    if out.is_dir():
        with lock(create(out, "")):
            if not (resume and is_described(out)):
                refuse_used(out)
        return
    place = out
    while not place.exists():
        place = place.parent
    try:
        with tempfile.TemporaryDirectory(prefix=_PROBE, dir=place):
            pass
    except OSError as error:
        raise InputError(unwritable(out, error)) from None


def create(out: pathlib.Path | None, name: str) -> pathlib.Path:
    """Make the folder `out`, or else a new one of that name under runs/.

    Raises:
      InputError: it can't be written.
    """
    try:
        if out is not None:
            out.mkdir(parents=True, exist_ok=True)
            probe = out / f"{_PROBE}{os.getpid()}"
            probe.touch()
            probe.unlink()
            return out
        number = 1
        while True:
            folder = pathlib.Path("runs", name if number == 1 else f"{name}-{number}")
            with contextlib.suppress(FileExistsError):
                folder.mkdir(parents=True)
                return folder
            number += 1
    except OSError as error:
        where = folder if out is None else out
        raise InputError(unwritable(where, error)) from None


@contextlib.contextmanager
def lock(folder: pathlib.Path) -> Iterator[None]:
    """Keep every other process from writing into the folder.

    The operating system takes the lock away from a process that ends, however it ends.

    Raises:
      InputError: another process has it.
    """
    with (folder / _LOCK).open("a+") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.seek(0)
            raise InputError(
                f"out is {folder}, which {file.read() or 'another process'} is "
                "writing to: name another folder or wait"
            ) from None
        file.truncate(0)
        file.write(f"process {os.getpid()} on {socket.gethostname()}")
        file.flush()
        yield


@contextlib.contextmanager
def wait_for_lock(folder: pathlib.Path, seconds: float = 60.0) -> Iterator[None]:
    """`lock`, after whoever has it for a moment.

    Raises:
      InputError: another process had it all the time.
    """
    deadline = time.monotonic() + seconds
    with contextlib.ExitStack() as stack:
        while True:
            try:
                stack.enter_context(lock(folder))
                break
            except InputError:
                if time.monotonic() > deadline:
                    raise
                time.sleep(0.1)
        yield


def refuse_used(folder: pathlib.Path) -> None:
    """Raise `InputError` if there is anything in the folder but what `create` leaves.

    That is a lock, and for a moment what another process tries whether it can write.
    """
    names = (path.name for path in folder.iterdir())
    if any(name != _LOCK and not name.startswith(_PROBE) for name in names):
        raise InputError(
            f"out is {folder}, which is not empty: name a new or an empty folder, or "
            "go on with what is there with --resume"
        )


def is_described(folder: pathlib.Path) -> bool:
    """Whether a run has begun in the folder."""
    return (folder / _CONFIG).is_file()


def describe(folder: pathlib.Path, content: Mapping[str, Any]) -> None:
    """Write config.json."""
    from gasil_jax.host import metrics_files

    metrics_files.write_json(folder / _CONFIG, content)


def read(folder: pathlib.Path) -> dict[str, Any]:
    """What config.json holds, "config" and "settings" as the dataclasses they are.

    Raises:
      InputError: there is none, or it is not of a run.
    """
    path = folder / _CONFIG
    try:
        content = json.loads(path.read_text())
        fields = _tuples_in(content["config"])
        fields["hyperparameters"] = Hyperparameters(**fields["hyperparameters"])
        described = _tuples_in(content)
        described["config"] = Config(**fields)
        described["settings"] = Settings(**content["settings"])
        if "points" in described:  # Of a sweep, which may be older than the option.
            described.setdefault("share_counts", False)
        for name, kind in (("env", str), ("seeds", int), ("first_seed", int)):
            if type(described[name]) is not kind:
                raise TypeError(f"{name} is {described[name]!r}")
    except OSError:
        raise InputError(f"run is {folder}: it must be the folder of a run") from None
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path} is damaged or of another program: {error}") from None
    return described


def _tuples_in(fields: Mapping[str, Any]) -> dict[str, Any]:
    return {name: _as_tuples(value) for name, value in fields.items()}


def _as_tuples(value: Any) -> Any:
    # JSON has no tuples, and a configuration is hashable.
    return tuple(map(_as_tuples, value)) if isinstance(value, list) else value


#: What may differ between a run and its continuation.
_FREE = (
    *("out", "resume", "checkpoint_every", "keep_checkpoints", "devices"),
    # What a file lists is compared itself.
    *("log", "points_file"),
)


def differences(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Fields that may not change between a run and its continuation, and do.

    Args:
      before: of `read`.
      now: the same of what is asked for. "total_steps" may have grown.

    Returns:
      "NAME was A, is B" for each.
    """
    found, asked = [], flat(now)
    for name, old in flat(before).items():
        new = asked.get(name)
        grown = name == "total_steps" and new is not None and new >= old
        if old != new and not grown and name not in _FREE:
            found.append(f"{name} was {old}, is {new}")
    return found


def flat(described: Mapping[str, Any]) -> dict[str, Any]:
    """Every field by its own name, those in dataclasses too."""
    fields: dict[str, Any] = {}
    for name, value in described.items():
        if dataclasses.is_dataclass(value):
            own = {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
            fields |= flat(own)
        else:
            fields[name] = value
    return fields

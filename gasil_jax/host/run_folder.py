"""Create, lock, write and read the folder of a run, and its config.json."""

import contextlib
import dataclasses
import errno
import fcntl
import functools
import hashlib
import os
import pathlib
import socket
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Required, TypedDict

import jax

from gasil_jax import algorithms
from gasil_jax.algorithms import Algorithm
from gasil_jax.errors import InputError, refusal
from gasil_jax.host import (
    command_line,
    descriptions,
    json_reader,
    metrics_files,
    output_file,
)
from gasil_jax.host.environments import Settings
from gasil_jax.host.output_file import unwritable

_LOCK = ".lock"
_PROBE = ".writable-"
CONFIG = "config.json"
#: What `gasil_jax.fit` writes instead, if no command can train the same.
FIT = "fit.json"
#: Files that only the process that has locked the folder writes.
_LOCKED = (
    *(CONFIG, FIT, "summary.json", "policy.npz", "learning_curve.png"),
    *("results.csv", "curves.npz", "sweep.png", "hyperparameters.png"),
)
#: Errors of locking where there are no locks.
_NO_LOCKS = (*output_file.MISSING_CALL, errno.ENOLCK)


def check(out: pathlib.Path, resume: bool) -> None:
    """Check that a run can use the folder. Writes nothing but a lock file.

    Raises:
      InputError: if it can't be written, if another process uses it, if it is not
        empty and `resume` is false, or if its training has ended and can't continue.
    """
    if out.is_dir():
        with lock(create(out)):
            if resume and has_run(out):
                refuse_without_checkpoints(out)
            else:
                refuse_used(out)
        return
    existing = out
    while not existing.exists():
        existing = existing.parent
    try:
        with tempfile.TemporaryDirectory(prefix=_PROBE, dir=existing):
            pass
    except OSError as error:
        raise InputError(unwritable(out, error)) from None


def refuse_without_checkpoints(folder: pathlib.Path) -> None:
    """Raise `InputError` if training has ended and its checkpoints are gone.

    Args:
      folder: folder of a run, or of a program of a sweep.
    """
    # A sweep has results too, but its checkpoints are in the folders of its programs.
    trained = (folder / "metrics.csv").exists() and has_results(folder)
    if trained and not any((folder / "checkpoints").glob("*")):
        raise InputError(
            f"out is {folder}: training in it has ended and its checkpoints are gone, "
            "so that it can't continue: name another folder"
        )


def has_results(folder: pathlib.Path) -> bool:
    """Return whether the training of the run or program in the folder has ended."""
    names = ("summary.json", "training.json", "policy.npz")
    return any((folder / name).exists() for name in names)


def create(out: pathlib.Path, *, option: str = "out") -> pathlib.Path:
    """Create a folder if it is missing, and return it.

    Args:
      out: the folder.
      option: what the error message calls the folder.

    Raises:
      InputError: if it can't be written.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=_PROBE, dir=out):
            pass
    except OSError as error:
        raise InputError(unwritable(out, error, option)) from None
    return out


def create_new(name: str) -> pathlib.Path:
    """Create a folder under runs/, with a number after its name if that is taken.

    Raises:
      InputError: if it can't be written.
    """
    runs = create(pathlib.Path("runs"))
    number = 1
    while True:
        folder = runs / (name if number == 1 else f"{name}-{number}")
        try:
            folder.mkdir()
        except FileExistsError:
            number += 1
        except OSError as error:
            raise InputError(unwritable(folder, error, "out")) from None
        else:
            return folder


@functools.cache
def _note_missing_locks(folder: pathlib.Path, why: str) -> None:
    """Print a note that a folder can't be locked, once for each folder."""
    command_line.note(
        f"{folder} can't be locked ({why}): make sure that no other process writes "
        "to it"
    )


@contextlib.contextmanager
def lock(folder: pathlib.Path, *, option: str = "out") -> Iterator[None]:
    """Lock the folder against other processes inside the `with` block.

    What a killed process had half written is deleted.

    The operating system frees the lock when the process ends, however it ends. Where
    the file system has no locks, a note says so, and nothing is locked.

    Raises:
      InputError: if another process holds the lock.
    """
    with (folder / _LOCK).open("a+") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.seek(0)
            raise InputError(
                f"{option} is {folder}, which {file.read() or 'another process'} is "
                "writing to: name another folder or wait"
            ) from None
        except OSError as error:
            if error.errno not in _NO_LOCKS:
                raise
            _note_missing_locks(folder, str(error.strerror))
        else:
            for name in _LOCKED:
                output_file.delete_temporary(folder / name)
        with output_file.errors_named(folder / _LOCK):
            file.truncate(0)
            file.write(f"process {os.getpid()} on {socket.gethostname()}")
            file.flush()
        yield


@contextlib.contextmanager
def wait_for_lock(folder: pathlib.Path, seconds: float = 60.0) -> Iterator[None]:
    """Lock the folder like `lock`, but wait if another process holds the lock.

    Raises:
      InputError: if another process still holds it after `seconds`.
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


def content(folder: pathlib.Path) -> set[str]:
    """Return the names in a folder, but for those that may be left by killed processes.

    These are the lock file, half written files, and the folder that `create` makes for
    a moment to test whether it can write.
    """
    return {
        path.name
        for path in folder.iterdir()
        if path.name != _LOCK
        and not path.name.startswith(_PROBE)
        and not output_file.is_temporary(path)
    }


def refuse_used(folder: pathlib.Path, *, option: str = "out") -> None:
    """Raise `InputError` unless the folder is empty, as `content` sees it."""
    if content(folder):
        message = (
            f"{option} is {folder}, which is not empty: name a new or an empty folder"
        )
        if has_run(folder) and option == "out":
            message += ", or continue the run in it with --resume"
        raise InputError(message)


def has_run(folder: pathlib.Path) -> bool:
    """Return whether the folder holds a run, sweep or shard, finished or not."""
    return (folder / CONFIG).is_file()


def write_description(
    folder: pathlib.Path, description: Mapping[str, Any], name: str = CONFIG
) -> None:
    """Write config.json, the description of a run or a sweep, or fit.json."""
    content = {**description}
    if name == CONFIG:
        algorithm = descriptions.describe(description["algorithm"])
        content |= {"out": str(folder), "algorithm": algorithm}
    metrics_files.write_json(folder / name, content)


class _Description(TypedDict, total=False):
    """The content of config.json, of a run or a sweep."""

    env: Required[str]
    seeds: Required[int]
    first_seed: Required[int]
    settings: Required[Settings]
    algorithm: Required[dict[str, Any]]
    out: str | None
    resume: bool
    checkpoint_every: int | None
    keep_checkpoints: int
    evaluate_every: int | None
    evaluate_episodes: int | None
    log: tuple[str, ...]
    preset: str
    devices: int | None
    grid: tuple[str, ...]
    random: int | None
    points_file: str | None
    points: tuple[dict[str, float], ...]
    shard: str | None
    launcher: str | None
    shards: int | None


class Fit(TypedDict):
    """The fields of fit.json that are read; the settings are beside them."""

    why_no_run: str
    env: str
    agent: str
    seeds: tuple[int, ...]


def read_fit(folder: pathlib.Path) -> Fit:
    """Return the content of fit.json.

    Raises:
      InputError: if it is damaged.
      OSError: if there is no such file.
    """
    return json_reader.read(folder / FIT, Fit)


def _why_no_run(folder: pathlib.Path) -> str:
    """Return why a folder has no config.json, for an error message."""
    if not folder.exists():
        return ", which does not exist: it must be the folder of a run"
    if (folder / FIT).is_file():
        return (
            f", a folder of gasil_jax.fit that the options of a run can't describe "
            f"({read_fit(folder)['why_no_run']}): use it with gasil_jax.plot, "
            "gasil_jax.load_policy or gasil_jax.fit"
        )
    return f", which has no {CONFIG}: it must be the folder of a run"


def read(folder: pathlib.Path) -> dict[str, Any]:
    """Return the content of config.json, "algorithm" and "settings" as objects.

    "out" is the folder, which may have been moved since it was written.

    Raises:
      InputError: if there is no such file, if it does not describe a run, or if its
        agent can't be imported here.
    """
    path = folder / CONFIG
    try:
        description = json_reader.read(path, _Description)
    except (FileNotFoundError, NotADirectoryError):
        raise InputError(f"run is {folder}{_why_no_run(folder)}") from None
    with json_reader.blamed(path):
        algorithm = descriptions.read(description["algorithm"])
        algorithms.check(algorithm)
        check_seeds(description["seeds"], description["first_seed"])
    return {**description, "algorithm": algorithm, "out": folder}


#: The largest number of seeds. Their absolute numbers are below 2**32.
_MOST_SEEDS = 2**20


def check_seeds(seeds: int, first_seed: int) -> None:
    """Raise `InputError` if the number of seeds or the first seed is out of range."""
    if not 1 <= seeds <= _MOST_SEEDS:
        raise refusal("seeds", seeds, f"from 1 to {_MOST_SEEDS:,}")
    last = 2**32 - seeds
    if not 0 <= first_seed <= last:
        raise refusal("first_seed", first_seed, f"from 0 to {last}")


def seeds_of(description: Mapping[str, Any]) -> range:
    """Return the absolute numbers of the seeds, from config.json or options by name."""
    return range(
        description["first_seed"], description["first_seed"] + description["seeds"]
    )


#: The field of config.json and fit.json that holds what `expert_hash` returns.
EXPERT_HASH = "expert_sha256"
#: Options that may differ between a run and its continuation.
_MAY_DIFFER = (
    "out",
    "resume",
    "checkpoint_every",
    "keep_checkpoints",
    "devices",
    "log",
    # A sweep may be divided in another way, and points may be added to it.
    *("shard", "shards", "launcher", "grid", "random", "points_file", "points"),
    # `refuse_other_expert` compares its content, which may have moved.
    "expert",
    EXPERT_HASH,
)


def differences(
    before: Mapping[str, Any],
    now: Mapping[str, Any],
    grows: Sequence[str] = ("total_steps",),
) -> list[str]:
    """Return the fields in which a run must not differ from its continuation, but does.

    Args:
      before: description of the run, from `read`.
      now: description of its continuation.
      grows: the fields that may be larger now.

    Returns:
      "NAME was A, is B" for each of these fields, or for the agent alone, whose
      settings another agent does not have.
    """
    changes, earlier, requested = [], flat(before), flat(now)
    if earlier.get("agent") != requested.get("agent"):
        earlier = {"agent": earlier.get("agent")}
    for name, old in earlier.items():
        new = requested.get(name)
        grown = name in grows and new is not None and new >= old
        if old != new and not grown and name not in _MAY_DIFFER:
            changes.append(f"{name} was {old}, is {new}")
    return changes


def expert_hash(algorithm: Algorithm) -> dict[str, str]:
    """Return the hash of the expert's trajectories as a field, or {} without an expert.

    Raises:
      ValueError: if the expert can't be read.
    """
    if getattr(algorithm.agent, "expert", None) is None:
        return {}
    digest = hashlib.sha256()
    for values in jax.tree.leaves(algorithm.agent.data()):
        digest.update(values.tobytes())
    return {EXPERT_HASH: digest.hexdigest()}


def refuse_other_expert(
    before: Mapping[str, Any], now: Mapping[str, Any], folder: pathlib.Path
) -> None:
    """Raise `InputError` if the expert's trajectories are not those of a run.

    Args:
      before: content of the run's config.json or fit.json. It has no hash if an older
        version wrote it.
      now: the setting "expert" of the run to continue, and its `expert_hash`.
      folder: folder of the run.
    """
    if EXPERT_HASH in before and before[EXPERT_HASH] != now.get(EXPERT_HASH):
        raise InputError(
            f"expert is {now['expert']!r}, whose trajectories are not those with which "
            f"the run in {folder} began: give the same ones, or begin a new run"
        )


def flat(description: Mapping[str, Any]) -> dict[str, Any]:
    """Return every field by its own name, including those of nested objects."""
    fields: dict[str, Any] = {}
    for name, value in description.items():
        if isinstance(value, Algorithm):
            fields |= descriptions.describe(value)
        elif dataclasses.is_dataclass(value):
            own = {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
            fields |= flat(own)
        else:
            fields[name] = value
    return fields

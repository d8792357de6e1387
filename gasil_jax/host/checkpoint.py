"""Save and load training states with Orbax.

`save` and `restore` are of one state. `write`, `latest`, `best` and `prune` keep a
folder of checkpoints, each a folder named by its iteration:

    00000490/state/          the state, written by Orbax
    00000490/manifest.json   SHA-256 of every file of it, and a record

A checkpoint is written under another name and renamed when it is whole and on the
disk, so a process that is killed at any moment leaves the ones before it as they were.
One that was damaged later is told by its hashes, and set aside as 00000490.damaged when
training goes on from the one before.
"""

import contextlib
import hashlib
import json
import math
import os
import pathlib
import shutil
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp

_STATE, _MANIFEST, _PARTIAL = "state", "manifest.json", ".partial"
_DAMAGED = ".damaged"


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _as_arrays(state: Any) -> dict[str, Any]:
    """Leaves by their path in the state; typed keys as what they hold."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(state)
    return {
        jax.tree_util.keystr(path): jax.random.key_data(x) if _is_key(x) else x
        for path, x in leaves
    }


def save(folder: pathlib.Path, state: Any) -> None:
    """Write `state`, a pytree of arrays, to `folder`, which must not exist."""
    arrays = jax.tree.map(np.asarray, _as_arrays(state))
    with ocp.StandardCheckpointer() as checkpointer:
        checkpointer.save(folder.absolute(), arrays)


def restore(folder: pathlib.Path, like: Any) -> Any:
    """Read what `save` wrote.

    Args:
      folder: where it is.
      like: a state of the same structure, shapes and dtypes; its leaves may be
        `jax.ShapeDtypeStruct`.

    Raises:
      ValueError: it is a state of another structure, shape or dtype.
    """
    with ocp.StandardCheckpointer() as checkpointer:
        arrays = checkpointer.restore(folder.absolute())
    wanted = jax.eval_shape(_as_arrays, like)
    # Orbax may restore a part of a tree that does not match, without a word.
    shape = lambda tree: {name: (x.shape, str(x.dtype)) for name, x in tree.items()}
    if shape(arrays) != shape(wanted):
        names = set(arrays) ^ set(wanted) or {
            name for name in wanted if shape(arrays)[name] != shape(wanted)[name]
        }
        raise ValueError(f"{folder} holds another state: {min(names)} differs")
    leaves, structure = jax.tree_util.tree_flatten_with_path(like)
    values = [
        jax.random.wrap_key_data(arrays[jax.tree_util.keystr(path)])
        if _is_key(x)
        else jnp.asarray(arrays[jax.tree_util.keystr(path)])
        for path, x in leaves
    ]
    return jax.tree.unflatten(structure, values)


class Checkpoint(NamedTuple):
    """One that is whole.

    Attributes:
      folder: where it is.
      iteration: after which it was written.
      record: what `write` was given.
    """

    folder: pathlib.Path
    iteration: int
    record: Mapping[str, Any]

    def restore(self, like: Any) -> Any:
        """Its state; see `restore`."""
        return restore(self.folder / _STATE, like)


class WriteError(OSError):
    """A checkpoint could not be written; those before it are as they were."""


def write(
    root: pathlib.Path, iteration: int, state: Any, record: Mapping[str, Any]
) -> None:
    """Add a checkpoint to the folder `root`, if a whole one is not there already.

    Args:
      root: made where it is missing.
      iteration: its number.
      state: a pytree of arrays.
      record: what is to be known of it without reading the state; goes into JSON.

    Raises:
      WriteError: the disk is full, or the folder can't be written.
    """
    whole = root / f"{iteration:08d}"
    partial = root / f"{iteration:08d}{_PARTIAL}"
    with contextlib.suppress(ValueError):
        read(whole)
        return
    try:
        root.mkdir(parents=True, exist_ok=True)
        # What a process left that was killed here.
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir()
        save(partial / _STATE, state)
        manifest = {"files": _hashes(partial), "record": record}
        (partial / _MANIFEST).write_text(json.dumps(manifest, allow_nan=False))
        for path in [*partial.rglob("*"), partial]:
            _to_disk(path)
        shutil.rmtree(whole, ignore_errors=True)  # damaged
        partial.rename(whole)
        _to_disk(root)
    # Orbax reports a full disk as an error of several types.
    except Exception as error:
        shutil.rmtree(partial, ignore_errors=True)
        reason = str(error).splitlines()[0][:300] if str(error) else repr(error)
        raise WriteError(f"{root} can't be written: {reason}") from error


def _hashes(folder: pathlib.Path) -> dict[str, str]:
    found = {}
    for path in sorted(folder.rglob("*")):
        if path.is_file() and path.name != _MANIFEST:
            with path.open("rb") as file:
                digest = hashlib.file_digest(file, "sha256").hexdigest()
            found[path.relative_to(folder).as_posix()] = digest
    return found


def _to_disk(path: pathlib.Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _folders(root: pathlib.Path) -> list[pathlib.Path]:
    """Every finished checkpoint's folder, oldest first, whole or damaged."""
    if not root.is_dir():
        return []
    return sorted(
        path for path in root.iterdir() if path.name.isdecimal() and path.is_dir()
    )


def read(folder: pathlib.Path) -> Checkpoint:
    """The checkpoint in `folder`, its hashes compared.

    Raises:
      ValueError: it is damaged.
    """
    try:
        manifest = json.loads((folder / _MANIFEST).read_text())
        files, record = manifest["files"], dict(manifest["record"])
    except (OSError, ValueError, KeyError, TypeError):
        raise ValueError(f"{folder} is damaged: its manifest can't be read") from None
    found = _hashes(folder)
    if found != files:
        name = min(
            name for name in {*found, *files} if found.get(name) != files.get(name)
        )
        raise ValueError(f"{folder} is damaged: {name} is not what was written")
    return Checkpoint(folder, int(folder.name), record)


def latest(root: pathlib.Path) -> tuple[Checkpoint | None, list[str]]:
    """The newest checkpoint that is whole, and what is wrong with newer ones."""
    damages: list[str] = []
    for folder in reversed(_folders(root)):
        try:
            return read(folder), damages
        except ValueError as error:
            damages.append(str(error))
    return None, damages


def best(root: pathlib.Path) -> Checkpoint | None:
    """The whole checkpoint with the highest "score" in its record, if one has any."""
    scores = _scores(_folders(root))
    for folder in sorted(scores, key=scores.__getitem__, reverse=True):
        with contextlib.suppress(ValueError):
            return read(folder)
    return None


def best_score(root: pathlib.Path) -> float:
    """The highest "score" in a record, minus infinity where none has any."""
    return max(_scores(_folders(root)).values(), default=-math.inf)


def _scores(folders: list[pathlib.Path]) -> dict[pathlib.Path, float]:
    """The scores of those that have one."""
    found = {}
    for folder in folders:
        with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
            score = json.loads((folder / _MANIFEST).read_text())["record"]["score"]
            if score is not None:
                found[folder] = score
    return found


def set_aside(root: pathlib.Path, newer_than: int) -> None:
    """Rename checkpoints after an iteration, so that they no longer count as one.

    What is newer than the newest whole one is damaged: training that goes on from that
    writes them again, and `prune` would keep them for the newest.
    """
    for folder in _folders(root):
        if int(folder.name) > newer_than:
            other, number = folder.with_name(f"{folder.name}{_DAMAGED}"), 1
            while other.exists():
                number += 1
                other = folder.with_name(f"{folder.name}{_DAMAGED}.{number}")
            folder.rename(other)


def prune(root: pathlib.Path, keep: int) -> None:
    """Delete all but the newest `keep` and the best one."""
    folders = _folders(root)
    scores = _scores(folders)
    kept = {
        *folders[-keep:],
        *([max(scores, key=scores.__getitem__)] if scores else []),
    }
    for folder in folders:
        if folder not in kept:
            shutil.rmtree(folder)

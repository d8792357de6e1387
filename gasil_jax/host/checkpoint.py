"""Save and load training states with Orbax.

`save` and `restore` handle a single state. `write`, `latest`, `best` and `prune` manage
a folder of checkpoints. Each checkpoint is a folder named by its iteration:

    00000490/state/          the state, written by Orbax
    00000490/manifest.json   SHA-256 of each of its files, and a record

A checkpoint is written to 00000490.partial, which is renamed once it has been read
again and flushed to the disk, so that killing the process never damages a checkpoint.
The hashes reveal later damage. A damaged checkpoint is renamed to 00000490.damaged when
training continues from an older one.
"""

import contextlib
import functools
import hashlib
import json
import logging
import math
import os
import pathlib
import re
import shutil
import sys
import tempfile
from collections.abc import Iterator
from typing import Any, NamedTuple, TypedDict

import jax
import jax.numpy as jnp
import numpy as np

from gasil_jax.host import json_files, output_file

_STATE, _MANIFEST = "state", "manifest.json"
#: The name of the only array of a state that has none.
_NOTHING = "nothing"
_PARTIAL, _DAMAGED = ".partial", ".damaged"
#: Errors of reading a damaged checkpoint. Other errors, such as those of a network file
#: system, do not mean that it is damaged.
_DAMAGE_ERRORS = (FileNotFoundError, NotADirectoryError, IsADirectoryError, ValueError)


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _as_arrays(state: Any) -> dict[str, Any]:
    """Return the state's leaves by their path, with typed keys as plain arrays."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(state)
    return {
        jax.tree_util.keystr(path): jax.random.key_data(x) if _is_key(x) else x
        for path, x in leaves
    }


@functools.cache
def _quiet_orbax() -> Any:
    """Import Orbax, whose threads no longer print an error that it also raises."""
    # Commands that read no checkpoint, such as --help, start sooner without it.
    import orbax.checkpoint as ocp

    def is_news(record: logging.LogRecord) -> bool:
        return "os_error_code" not in f"{record.getMessage()} {record.exc_info}"

    for name in ("absl", "asyncio"):
        logging.getLogger(name).addFilter(is_news)
    # TensorStore reports each array to Orbax's loop, which ends with the first.
    late, before = "Event loop is closed", sys.unraisablehook
    sys.unraisablehook = lambda x: late in str(x.exc_value) or before(x)
    return ocp


@contextlib.contextmanager
def _orbax(folder: pathlib.Path) -> Iterator[tuple[Any, pathlib.Path]]:
    """Yield Orbax's checkpointer, and another path to a folder that it understands.

    Orbax takes a path with brackets or stars for a pattern, so no character of the
    other path means anything.
    """
    ocp = _quiet_orbax()
    try:
        with tempfile.TemporaryDirectory() as directory:
            link = pathlib.Path(directory, "checkpoints")
            link.symlink_to(folder.absolute().parent, target_is_directory=True)
            with ocp.StandardCheckpointer() as checkpointer:
                yield checkpointer, link / folder.name
    except (ValueError, OSError) as error:
        # TensorStore's message is long, and names the other path.
        if codes := re.findall(r"os_error_code='(\d+)'", "".join(_chain(error))):
            raise OSError(int(codes[0]), os.strerror(int(codes[0]))) from None
        raise


def _chain(error: BaseException | None) -> list[str]:
    """Return the messages of an error and of those that led to it, the first before."""
    if error is None:
        return []
    return [*_chain(error.__cause__ or error.__context__), str(error)]


def save(folder: pathlib.Path, state: Any) -> None:
    """Write `state`, a pytree of arrays, to a new folder, and read it again.

    Arrays of no size, which Orbax refuses, are left out; `restore` makes them anew.
    """
    arrays: dict[str, Any] = jax.tree.map(np.asarray, _as_arrays(state))
    arrays = {name: x for name, x in arrays.items() if x.size}
    with _orbax(folder) as (checkpointer, path):
        checkpointer.save(path, arrays or {_NOTHING: np.zeros(1, bool)})
    again = _read_arrays(folder)
    for name, array in arrays.items():
        if not np.array_equal(_bytes(again[name]), _bytes(array)):
            raise OSError(f"{name or 'its array'} is not what was written")


def _bytes(array: np.ndarray) -> np.ndarray:
    # Not-a-numbers are equal, and so are types that NumPy does not know.
    return np.ascontiguousarray(array).ravel().view(np.uint8)


def _read_arrays(folder: pathlib.Path) -> dict[str, Any]:
    """Return the arrays in a folder that `save` wrote, by their path in the state."""
    with _orbax(folder) as (checkpointer, path):
        arrays = checkpointer.restore(path)
    arrays.pop(_NOTHING, None)
    return arrays


def restore(folder: pathlib.Path, like: Any) -> Any:
    """Read a state that `save` wrote, as NumPy arrays and random keys.

    They are not put on a device, which may be too small for all members together.
    """
    expected = jax.eval_shape(_as_arrays, like)
    arrays = _read_arrays(folder)
    missing = {x: y for x, y in expected.items() if x not in arrays and not y.size}
    arrays |= {name: np.zeros(x.shape, x.dtype) for name, x in missing.items()}

    # Orbax may silently restore only a part of a tree that does not match.
    def shape(tree: Any) -> dict[str, Any]:
        return {name: (x.shape, str(x.dtype)) for name, x in tree.items()}

    if shape(arrays) != shape(expected):
        names = set(arrays) ^ set(expected) or {
            name for name in expected if shape(arrays)[name] != shape(expected)[name]
        }
        raise ValueError(f"{folder} holds another state: {min(names)} differs")
    leaves, structure = jax.tree_util.tree_flatten_with_path(like)
    values = [
        jax.random.wrap_key_data(arrays[jax.tree_util.keystr(path)], impl=_key_impl(x))
        if _is_key(x)
        else np.asarray(arrays[jax.tree_util.keystr(path)])
        for path, x in leaves
    ]
    return jax.tree.unflatten(structure, values)


def _key_impl(key: Any) -> Any:
    """Return the implementation of random keys, which may be `ShapeDtypeStruct`."""
    implementations = []
    jax.eval_shape(lambda x: implementations.append(jax.random.key_impl(x)), key)
    return implementations[0]


class Record(TypedDict):
    """Facts about a checkpoint that can be read without its state."""

    metrics_rows: int  # number of rows of metrics.csv when it was written
    evaluations_rows: int  # number of rows of evaluations.csv
    # Mean score of the policies or, without evaluations, mean of the returns since the
    # checkpoint before; None if neither is known.
    score: float | None


class _Manifest(TypedDict):
    """The content of manifest.json."""

    files: dict[str, str]
    record: Record


class Checkpoint(NamedTuple):
    """A complete, undamaged checkpoint."""

    folder: pathlib.Path  # its folder
    iteration: int  # number of iterations before it was written
    record: Record  # the record that `write` was given

    def restore(self, like: Any) -> Any:
        """Return the saved state; see the function `restore`."""
        return restore(self.folder / _STATE, like)

    def digest(self) -> str:
        """Return a hash of its files."""
        files = json.dumps(_manifest(self.folder)["files"], sort_keys=True)
        return hashlib.sha256(files.encode()).hexdigest()


class WriteError(output_file.WriteError):
    """A checkpoint could not be written; older ones are unharmed."""


def write(root: pathlib.Path, iteration: int, state: Any, record: Record) -> None:
    """Write a checkpoint into the folder `root`, unless an undamaged one is there."""
    folder = root / f"{iteration:08d}"
    partial = root / f"{iteration:08d}{_PARTIAL}"
    try:
        with contextlib.suppress(ValueError):
            read(folder)
            return
        root.mkdir(parents=True, exist_ok=True)
        # A killed process may have left it.
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir()
        save(partial / _STATE, state)
        manifest = {"files": _hashes(partial), "record": record}
        json_files.write(partial / _MANIFEST, manifest)
        for path in [*partial.rglob("*"), partial]:
            _flush(path)
        shutil.rmtree(folder, ignore_errors=True)  # A damaged checkpoint.
        partial.rename(folder)
        _flush(root)
    except (OSError, EOFError, ValueError) as error:
        shutil.rmtree(partial, ignore_errors=True)
        raise WriteError(output_file.unwritten(root, error)) from error


def check_writable(root: pathlib.Path) -> None:
    """Write a tiny checkpoint below the folder `root`, and delete it."""
    # `delete_partial` deletes it if the process is killed.
    tiny = root / f"check{_PARTIAL}"
    try:
        record = Record(metrics_rows=0, evaluations_rows=0, score=None)
        write(tiny, 0, {"x": np.zeros(1, np.float32)}, record)
    finally:
        shutil.rmtree(tiny, ignore_errors=True)


def _hashes(folder: pathlib.Path) -> dict[str, str]:
    """Return the SHA-256 of each file in a folder, by its relative path."""
    hashes = {}
    for path in sorted(folder.rglob("*")):
        if path.is_file() and path.name != _MANIFEST:
            with path.open("rb") as file:
                digest = hashlib.file_digest(file, "sha256").hexdigest()
            hashes[path.relative_to(folder).as_posix()] = digest
    return hashes


def _flush(path: pathlib.Path) -> None:
    """Make the operating system write a file or a folder's entries to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        output_file.flush(descriptor)
    finally:
        os.close(descriptor)


def _folders(root: pathlib.Path) -> list[pathlib.Path]:
    """Return the folders of all checkpoints, oldest first, including damaged ones."""
    if not root.is_dir():
        return []
    return sorted(
        path for path in root.iterdir() if path.name.isdecimal() and path.is_dir()
    )


def read(folder: pathlib.Path) -> Checkpoint:
    """Return the checkpoint in `folder` after checking its manifest and its hashes."""
    manifest, hashes = _manifest(folder), _hashes(folder)
    files, record = manifest["files"], manifest["record"]
    if hashes != files:
        name = min(
            name for name in {*hashes, *files} if hashes.get(name) != files.get(name)
        )
        raise ValueError(f"{folder} is damaged: {name} is not what was written")
    return Checkpoint(folder, int(folder.name), record)


def _manifest(folder: pathlib.Path) -> _Manifest:
    try:
        manifest: _Manifest = json_files.read(folder / _MANIFEST, _Manifest)
        return manifest
    except _DAMAGE_ERRORS as error:
        raise ValueError(f"{folder} is damaged: {error}") from None


def latest(root: pathlib.Path) -> tuple[Checkpoint | None, list[str]]:
    """Return the newest undamaged checkpoint, and the errors of damaged newer ones."""
    errors: list[str] = []
    for folder in reversed(_folders(root)):
        try:
            return read(folder), errors
        except (ValueError, FileNotFoundError) as error:
            if folder.exists():  # Training may delete it meanwhile.
                errors.append(str(error))
    return None, errors


def best(root: pathlib.Path) -> Checkpoint | None:
    """Return the checkpoint with the highest score, None if none has one."""
    folders = _folders(root)
    for folder in folders:
        _manifest(folder)
    scores = _scores(folders)
    return read(max(scores, key=scores.__getitem__)) if scores else None


def best_score(root: pathlib.Path) -> float:
    """Return the highest recorded score, or minus infinity if there is none."""
    return max(_scores(_folders(root)).values(), default=-math.inf)


def _scores(folders: list[pathlib.Path]) -> dict[pathlib.Path, float]:
    """Return the scores of the checkpoints that have one and can be read."""
    scores = {}
    for folder in folders:
        with contextlib.suppress(ValueError):
            if (score := _manifest(folder)["record"]["score"]) is not None:
                scores[folder] = score
    return scores


def set_aside(root: pathlib.Path, newer_than: int) -> None:
    """Rename damaged checkpoints, so that `prune` does not keep them for others."""
    for folder in _folders(root):
        if int(folder.name) > newer_than:
            renamed, number = folder.with_name(f"{folder.name}{_DAMAGED}"), 1
            while renamed.exists():
                number += 1
                renamed = folder.with_name(f"{folder.name}{_DAMAGED}.{number}")
            folder.rename(renamed)


def delete_partial(root: pathlib.Path) -> None:
    """Delete the partial checkpoints of killed processes; none may be writing now."""
    for folder in root.glob(f"*{_PARTIAL}"):
        shutil.rmtree(folder, ignore_errors=True)


def prune(root: pathlib.Path, keep: int) -> None:
    """Delete all checkpoints but the newest `keep` and the best one, where possible."""
    try:
        folders = _folders(root)
        scores = _scores(folders)
    except OSError:
        return
    kept = set(folders[-keep:])
    if scores:
        kept.add(max(scores, key=scores.__getitem__))
    for folder in set(folders) - kept:
        # Renamed first, so that a half deleted checkpoint does not count as damaged.
        partial = folder.with_name(f"{folder.name}{_PARTIAL}")
        shutil.rmtree(partial, ignore_errors=True)
        with contextlib.suppress(OSError):
            folder.rename(partial)
            shutil.rmtree(partial, ignore_errors=True)

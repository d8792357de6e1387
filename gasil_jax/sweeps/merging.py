"""Merge the shards of a sweep: read the shards and write the tables of the sweep."""

import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

from gasil_jax.errors import InputError
from gasil_jax.host import run_folder
from gasil_jax.host.run_folder import StoredRun
from gasil_jax.sweeps import shards, tables
from gasil_jax.sweeps.trained_programs import TrainedPrograms


def _shard_folders(folder: pathlib.Path) -> list[pathlib.Path]:
    """Return the folders of the shards in a folder, or the folder if it is a shard."""
    inside = shards.root(folder)
    paths = sorted(inside.iterdir()) if inside.is_dir() else [folder]
    shard_folders = [path for path in paths if run_folder.has_run(path)]
    if not shard_folders:
        raise InputError(f"folder is {folder}: it must hold shards or be one")
    return shard_folders


def _comparable(description: Mapping[str, Any]) -> dict[str, Any]:
    return {name: x for name, x in description.items() if name != "shard"}


def refuse_different(first: StoredRun, other: StoredRun) -> None:
    """Raise `InputError` if two shards are of different sweeps or experts."""
    before, now = _comparable(first.description), _comparable(other.description)
    # total_steps may not grow here.
    changed = run_folder.differences(before, now)
    changed = changed or run_folder.differences(now, before)
    if changed:
        raise InputError(
            f"{other.folder} is of another sweep than {first.folder}: "
            f"{'; '.join(changed)}"
        )
    fields = run_folder.flat(other.description)
    run_folder.refuse_other_expert(first.description, fields, first.folder)


def _read(folder: pathlib.Path) -> StoredRun:
    description = run_folder.read(folder)
    if not isinstance(description.get("shard"), str) or "points" not in description:
        raise InputError(f"folder is {folder}: it must be of a sweep's shard")
    return StoredRun(folder, description)


def stored_shards(inside: pathlib.Path) -> list[StoredRun]:
    """Return the shards of a sweep that exist, which may be unfinished.

    Args:
      inside: the folder that holds the shards, which may be missing.

    Raises:
      InputError: if one of them is damaged.
    """
    paths = sorted(inside.glob("*-of-*"))
    return [_read(path) for path in paths if run_folder.has_run(path)]


def _read_all(folders: Sequence[pathlib.Path]) -> list[StoredRun]:
    """Return the shards in order, after checking that they are all of one sweep."""
    paths = [path for folder in folders for path in _shard_folders(folder)]
    first, *others = every = [_read(path) for path in dict.fromkeys(paths)]
    for other in others:
        refuse_different(first, other)
    stored: dict[shards.Shard, StoredRun] = {}
    for each in every:
        shard = shards.parse(each.description["shard"])
        if shard in stored:
            raise InputError(
                f"shard {shard} is given twice: {stored[shard].folder}, {each.folder}"
            )
        stored[shard] = each
    counts = {shard.count for shard in stored}
    if len(counts) > 1:
        raise InputError(
            f"there are shards of {' and of '.join(map(str, sorted(counts)))}: name "
            "the folders of those that belong together"
        )
    count = counts.pop()
    expected = [shards.Shard(number, count) for number in range(1, count + 1)]
    missing = [str(shard) for shard in expected if shard not in stored]
    if missing:
        raise InputError(f"missing: shards {', '.join(missing)}, which have not begun")
    return [stored[shard] for shard in expected]


def _refuse_used(out: pathlib.Path, shard: StoredRun) -> None:
    """Raise `InputError` if `out` holds more than earlier tables of the same shards."""
    if run_folder.has_run(out):
        earlier, now = run_folder.read(out), shard.description
        # The shards may have been continued to more total_steps since.
        if run_folder.differences(_comparable(earlier), _comparable(now)):
            refuse_different(StoredRun(out, earlier), shard)
        # A single run has no points, and a sweep that was not merged has programs.
        used = "points" not in earlier or (out / "programs").is_dir()
    else:
        used = bool(run_folder.content(out) - {"shards"})
    if used:
        raise InputError(f"out is {out}, which holds other files: name another folder")


def merge(folders: Sequence[pathlib.Path], out: pathlib.Path) -> dict[str, Any]:
    """Write the tables of a sweep that was trained in shards; return the summary.

    Args:
      folders: the folder of the sweep, or the folders of all its shards.
      out: folder of the tables, created if it is missing.

    Raises:
      InputError: if a shard is missing, unfinished, damaged or of another sweep, or if
        `out` holds other files. Nothing has been written then.
    """
    every = _read_all(folders)
    description = every[0].description
    points = description["points"]
    seeds = run_folder.seeds_of(description)
    parts = [TrainedPrograms.from_description(*shard) for shard in every]
    unfinished = [
        shard.description["shard"]
        for part, shard in zip(parts, every, strict=True)
        if part.unfinished()
    ]
    if unfinished:
        raise InputError(
            f"not finished: shards {', '.join(unfinished)}; continue them with --resume"
        )
    results = tables.read(points, seeds, parts)
    run_folder.create(out)
    with run_folder.lock(out):
        _refuse_used(out, every[0])
        own = {"shard": None, "resume": False, "out": str(out)}
        run_folder.write_description(out, {**description, **own})
        return tables.write(out, results)

"""Unite sweeps: copy the programs of several folders into one, and write its tables."""

import pathlib
import shutil
from collections.abc import Sequence
from typing import Any

from gasil_jax.errors import InputError
from gasil_jax.host import run_folder
from gasil_jax.host.run_folder import StoredRun
from gasil_jax.sweeps import tables
from gasil_jax.sweeps.plan import Plan, programs_of, stored_plan

_ADDED = ("points", "seeds", "first_seed")


def merge(folders: Sequence[pathlib.Path], out: pathlib.Path) -> tuple[Plan, Any]:
    """Write the tables of all runs of some sweeps; return their plan and the summary.

    The points are those of all sweeps, and so are the seeds. Programs that `out` does
    not hold are copied to it.

    Args:
      folders: folders of sweeps, each of which may be trained in part.
      out: folder of the united sweep, created if it is missing; it may be one of them.

    Raises:
      InputError: if the sweeps differ in more than points and seeds, if a run is
        missing or has two different results, if a folder is damaged, or if `out` holds
        other files. Nothing has been written then.
    """
    every = list(dict.fromkeys(folders))
    if run_folder.has_run(out):
        every = list(dict.fromkeys([out, *every]))
    description = _united([StoredRun(folder, _read(folder)) for folder in every])
    plan = stored_plan(every[0], description)
    trained = [each for folder in every for each in plan.trained(folder)]
    results = tables.read(plan, trained)
    run_folder.create(out)
    with run_folder.lock(out):
        if not run_folder.has_run(out):
            run_folder.refuse_used(out)
        for each in trained:
            _copy(each.path, programs_of(out))
        run_folder.write_description(out, {**description, "out": str(out)})
        return plan, tables.write(out, results)


def _read(folder: pathlib.Path) -> dict[str, Any]:
    description = run_folder.read(folder)
    if "points" not in description:
        raise InputError(f"folder is {folder}, a run: it must be of a sweep")
    return description


def _united(every: Sequence[StoredRun]) -> dict[str, Any]:
    """Return the description of a sweep with the points and seeds of all.

    Raises:
      InputError: if they differ in something else.
    """
    (first, united), *others = every
    settings = {name: x for name, x in united.items() if name not in _ADDED}
    for folder, description in others:
        own = {name: x for name, x in description.items() if name not in _ADDED}
        changed = run_folder.differences(settings, own, grows=())
        changed = changed or run_folder.differences(own, settings, grows=())
        if changed:
            raise InputError(
                f"{folder} is of another sweep than {first}: {'; '.join(changed)}"
            )
        fields = run_folder.flat(description)
        run_folder.refuse_other_expert(united, fields, first)
    points = [point for _, x in every for point in x["points"]]
    seeds = [run_folder.seeds_of(x) for _, x in every]
    low, high = min(x.start for x in seeds), max(x.stop for x in seeds)
    distinct = [x for i, x in enumerate(points) if x not in points[:i]]
    return {**united, "points": distinct, "first_seed": low, "seeds": high - low}


def _copy(program: pathlib.Path, parent: pathlib.Path) -> None:
    """Copy a program's folder, whole or not at all, unless it is there."""
    target, partial = parent / program.name, parent / f".{program.name}"
    if not target.exists():
        shutil.rmtree(partial, ignore_errors=True)
        shutil.copytree(program, partial, ignore=shutil.ignore_patterns(".lock"))
        partial.rename(target)

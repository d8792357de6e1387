"""Unite sweeps, or parts of one: ``python -m gasil_jax.merge A B --out OUT``.

Parts of a sweep that were trained in different folders, sweeps of other points, and
sweeps of other seeds become one: its folder holds all programs and the tables, and it
can be continued. The folders are only read.
"""

import dataclasses
import pathlib
import shutil
import sys
from collections.abc import Sequence
from typing import Annotated, Any

import tyro

from gasil_jax.errors import InputError
from gasil_jax.host import command_line, run_folder
from gasil_jax.sweeps import tables
from gasil_jax.sweeps.plan import programs_of, stored_plan


@dataclasses.dataclass(frozen=True)
class Options:
    """Unite sweeps that differ in points and seeds alone, and write their tables.

    Attributes:
      folders: the folders of the sweeps, which may be trained in part each.
      out: folder of the united sweep, created if it is missing; default the one folder
        that is named, whose tables are written anew.
    """

    folders: Annotated[tuple[pathlib.Path, ...], tyro.conf.Positional]
    out: pathlib.Path | None = None


@command_line.reports_errors
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status."""
    options = command_line.parse(Options, arguments, "gasil_jax.merge")
    if not options.folders:
        raise InputError("folders is empty: name those of the sweeps")
    if options.out is None and len(options.folders) > 1:
        raise InputError("out is missing: several folders need --out")
    out = options.out or options.folders[0]
    present = [out] if run_folder.has_run(out) else []
    every = list(dict.fromkeys([*present, *options.folders]))
    united = _united(every)
    plan = stored_plan(united)
    trained = [each for folder in every for each in plan.trained(folder)]
    # Nothing has been written if a run is missing or has two different results.
    results = tables.read(plan, trained)
    run_folder.create(out)
    with run_folder.lock(out):
        if not run_folder.has_run(out):
            run_folder.refuse_used(out)
        for each in trained:
            _copy(each.path, programs_of(out))
        run_folder.write_description(out, united)
    tables.finish(out, results)
    return 0


def _united(folders: Sequence[pathlib.Path]) -> dict[str, Any]:
    """Return the description of a sweep with the points and seeds of all.

    Raises:
      InputError: if they differ in something else, or if one is a run.
    """
    first, *_ = every = [run_folder.read(folder) for folder in folders]
    for other in every:
        if "points" not in other:
            raise InputError(f"folder is {other['out']}, a run: it must be of a sweep")
        same = {**other, "seeds": first["seeds"], "first_seed": first["first_seed"]}
        changed = run_folder.differences(first, same, grows=())
        changed = changed or run_folder.differences(same, first, grows=())
        if changed:
            raise InputError(
                f"{other['out']} is of another sweep than {first['out']}: "
                f"{'; '.join(changed)}"
            )
        run_folder.refuse_other_expert(first, run_folder.flat(other), first["out"])
    points = [point for description in every for point in description["points"]]
    seeds = [run_folder.seeds_of(description) for description in every]
    low, high = min(x.start for x in seeds), max(x.stop for x in seeds)
    distinct = [x for i, x in enumerate(points) if x not in points[:i]]
    united = {"points": distinct, "first_seed": low, "seeds": high - low}
    return {**first, **united}


def _copy(program: pathlib.Path, parent: pathlib.Path) -> None:
    """Copy a program's folder, whole or not at all, unless it is there."""
    target, partial = parent / program.name, parent / f".{program.name}"
    if not target.exists():
        shutil.rmtree(partial, ignore_errors=True)
        shutil.copytree(program, partial, ignore=shutil.ignore_patterns(".lock"))
        partial.rename(target)


if __name__ == "__main__":
    sys.exit(main())

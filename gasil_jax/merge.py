"""Unite sweeps, or parts of one: ``python -m gasil_jax.merge A B --out OUT``.

Parts of a sweep that were trained in different folders, sweeps of other points, and
sweeps of other seeds become one: its folder holds all programs and the tables, and it
can be continued. The folders are only read.
"""

import dataclasses
import pathlib
import sys
from collections.abc import Sequence
from typing import Annotated

import tyro

from gasil_jax.errors import InputError
from gasil_jax.host import command_line
from gasil_jax.sweeps import merging, tables


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
    out = options.out
    if out is None:
        if len(options.folders) > 1:
            raise InputError("out is missing: several folders need --out")
        out = options.folders[0]
    plan, summary = merging.merge(options.folders, out)
    print(*tables.report(plan.points, summary), f"in {out}", sep="\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())

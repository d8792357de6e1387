"""Merge the shards of a sweep: ``python -m gasil_jax.merge OUT``.

Writes the same files as a sweep without shards: config.json, results.csv, curves.npz,
summary.json and the plots. The shards are only read.
"""

import dataclasses
import pathlib
import sys
from collections.abc import Sequence
from typing import Annotated

import tyro

from gasil_jax.errors import InputError
from gasil_jax.host import command_line, run_folder
from gasil_jax.sweeps import merging, shards, tables


@dataclasses.dataclass(frozen=True)
class Options:
    """Merge the shards of a sweep.

    Attributes:
      folders: the folder of the sweep, which holds shards/; or the folders of all its
        shards, which may have been copied elsewhere.
      out: folder to write the tables to; default the folder of the sweep.
    """

    folders: Annotated[tuple[pathlib.Path, ...], tyro.conf.Positional]
    out: pathlib.Path | None = None


@command_line.reports_errors
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status."""
    options = command_line.parse(Options, arguments, "gasil_jax.merge")
    if not options.folders:
        raise InputError(
            "folders is empty: name the sweep's folder, or those of all its shards"
        )
    out = options.out
    if out is None:
        if len(options.folders) > 1:
            raise InputError("out is missing: several folders need --out")
        out = options.folders[0]
        if not shards.root(out).is_dir():
            raise InputError(
                f"folder is {out}, which holds no shards: name the sweep's folder, or "
                "the folders of all its shards and --out"
            )
    summary = merging.merge(options.folders, out)
    points = run_folder.read(out)["points"]
    print(*tables.report(points, summary), f"in {out}", sep="\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())

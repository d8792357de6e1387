"""Train an agent: ``python -m gasil_jax.run --env walker2d --seeds 10``."""

import dataclasses
import pathlib
import shlex
import sys
from collections.abc import Sequence
from typing import Any

import numpy as np

from gasil_jax import statistics
from gasil_jax.host import command_line, environments, run_folder
from gasil_jax.host.progress import announced
from gasil_jax.host.run_options import (
    Options,
    check,
    check_out,
    open_folder,
    parse,
    resumed_run,
    write_config,
)
from gasil_jax.sweeps import assembly, programs, run_results
from gasil_jax.sweeps.programs import Program


def train(options: Options, env: Any, job: Program) -> dict[str, Any]:
    """Train, log and save a run; return the summary.

    Raises:
      Interrupted: if a signal was received.
      OSError: if the folder can no longer be written.
      ValueError: if the run to continue does not fit the options.
    """
    folder = job.path

    def write() -> None:
        write_config(options, folder)

    # A run that is continued keeps its config.json until its checkpoint is restored.
    if not run_folder.has_run(folder):
        write()
    title = f"{options.env} {options.agent}"
    members, outcome = assembly.train(
        options, env, [job], title=title, own_folder=True, on_restored=write
    )
    # Only now, when the progress display has ended.
    with announced(title, "writing the curve, the policies and the summary"):
        return run_results.finish(folder, options.env, members, outcome)[1]


def _print_next(env: Any, folder: pathlib.Path) -> None:
    """Print the commands that are of use for a new run, as a line for the shell."""
    quoted = shlex.quote(str(folder))
    commands = [f"evaluate {quoted}", f"plot {quoted}"]
    if environments.can_be_drawn(env):
        commands.append(f"render {quoted} --out episode.gif")
    print("next:", "; ".join(f"python -m gasil_jax.{x}" for x in commands))


@command_line.reports_errors
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status."""
    options = parse(Options, arguments, "gasil_jax.run", resumed_run(arguments))
    check(options)
    check_out(options)
    job = programs.of_run(vars(options), options.algorithm)
    env = assembly.prepare(options, [job])
    with open_folder(options, "gasil_jax.run") as folder:
        summary = train(options, env, dataclasses.replace(job, path=folder))
    scores = {
        name.replace("_", " "): np.array(list(summary[name].values()), float)
        for name in ("final_return", "final_evaluation")
        if name in summary
    }
    print(
        f"{statistics.in_words(scores)}, {run_results.speed_in_words(summary)}, "
        f"in {folder}"
    )
    _print_next(env, folder)
    if summary["unhealthy_seeds"]:
        print(
            f"warning: numbers that were not finite in seeds "
            f"{summary['unhealthy_seeds']}: see faulty_steps (simulation) and "
            f"skipped_updates (learning) in {folder / 'summary.json'}",
            file=sys.stderr,
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())

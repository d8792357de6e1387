"""Train an agent: ``python -m gasil_jax.run --env walker2d --seeds 10``."""

import pathlib
import shlex
import sys
from collections.abc import Sequence
from typing import Any

import numpy as np

from gasil_jax import statistics
from gasil_jax.host import command_line, driver, environments, run_folder
from gasil_jax.host.members import Members
from gasil_jax.host.progress import announced
from gasil_jax.host.run_options import (
    Options,
    check,
    check_out,
    open_folder,
    parse,
    resumed_run,
    seeds_of,
    write_config,
)
from gasil_jax.sweeps import assembly, run_results
from gasil_jax.sweeps.programs import Program, ProgramFolder
from gasil_jax.sweeps.runs import Run


def train(
    options: Options, env: Any, program: Program, folder: pathlib.Path
) -> dict[str, Any]:
    """Train, log and save a run; return the summary.

    Raises:
      Interrupted: if a signal was received.
      OSError: if the folder can no longer be written.
      ValueError: if the run to continue does not fit the options.
    """

    def write() -> None:
        write_config(options, folder)

    # A run that is continued keeps its config.json until its checkpoint is restored.
    if not run_folder.has_run(folder):
        write()
    title = f"{options.env} {options.agent}"
    labels = {"seed": seeds_of(options)}
    stored = ProgramFolder(program, folder, labels)
    job = assembly.Job(stored, folder.absolute().name)
    finished: list[tuple[Members, driver.Outcome]] = []
    assembly.train(
        options,
        env,
        [job],
        title=title,
        on_finished=lambda job, members, outcome: finished.append((members, outcome)),
        on_restored=write,
    )
    # Only now, when the progress display has ended.
    with announced(title, "writing the curve, the policies and the summary"):
        members, outcome = finished[0]
        tables = run_results.read(folder, options.seeds)
        summary = run_results.write(
            folder, options.env, members=members, outcome=outcome, tables=tables
        )
    if outcome.unsaved is not None:
        raise outcome.unsaved
    return summary


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
    # A run of many seeds is one program.
    program = Program(
        tuple(
            Run(options.env, options.algorithm, seed, options.settings)
            for seed in seeds_of(options)
        )
    )
    env = assembly.prepare(options, [program], [options.out] if options.out else [])
    with open_folder(options, "gasil_jax.run") as folder:
        summary = train(options, env, program, folder)
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

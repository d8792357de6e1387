"""The command line that the experiments share."""

import dataclasses
import pathlib
from collections.abc import Callable, Sequence
from typing import Any

from experiments import processes, report, trials
from experiments.report import Figure
from experiments.trials import Trial
from gasil_jax import command_line, shards
from gasil_jax.command_line import InputError


@dataclasses.dataclass(frozen=True)
class Options:
    """Train what has not been trained yet, then write tables, figure and page.

    Attributes:
      only: trials to train, PANEL or PANEL/CURVE; default all.
      quick: a small version for two CPU cores, below runs/quick, in minutes.
      seeds: of each trial; default the experiment's.
      total_steps: of each seed; default the experiment's.
      part: I/N: train only the I-th of N parts of each trial, to share it between
        machines; once all are there, --report puts them together.
      processes: so many runs at a time, on the CPU, each a process on cores of its own
        that trains one seed of one point: best with physics mujoco on many cores.
      report: train nothing, write tables and figure of what is there.
      list: print the trials and whether they are complete, and do nothing else.
      physics: of locomotion: mjx or mujoco.
      devices: host devices that members are sharded over; default the cores.
      share_counts: points that differ in buffer size or discriminator updates share a
        program, as in gasil_jax.sweep: best on a GPU.
      runs: where training writes.
      results: where tables, figure and page go; the hyperparameters stay those that
        the search in the checkout has found.
    """

    only: tuple[str, ...] = ()
    quick: bool = False
    seeds: int | None = None
    total_steps: int | None = None
    part: str = "1/1"
    processes: int | None = None
    report: bool = False
    list: bool = False
    physics: str = "mjx"
    devices: int | None = None
    share_counts: bool = False
    runs: pathlib.Path = pathlib.Path("runs")
    results: pathlib.Path = trials.RESULTS


#: Seeds and steps of the quick version.
_QUICK: dict[str, Any] = {"seeds": 3, "total_steps": 100_000, "rows": 20}


def main(
    figure: Figure,
    make: Callable[[], Sequence[Trial]],
    quick: Callable[[Sequence[Trial]], Sequence[Trial]],
    arguments: Sequence[str] | None,
    write: Callable[[Figure, Sequence[Trial], pathlib.Path], None] = report.write,
) -> int:
    """Run an experiment's command line; returns the exit status.

    Args:
      figure: what it shows.
      make: its trials.
      quick: those of them that the quick version has.
      arguments: default what the program was started with.
      write: figure and page.
    """
    program = f"experiments.{figure.name}"
    return command_line.exit_status(
        lambda: _run(
            command_line.parse(Options, arguments, program), figure, make, quick, write
        )
    )


def _run(
    options: Options,
    figure: Figure,
    make: Callable[[], Sequence[Trial]],
    quick: Callable[[Sequence[Trial]], Sequence[Trial]],
    write: Callable[[Figure, Sequence[Trial], pathlib.Path], None],
) -> int:
    part = shards.parse(options.part, "part")
    wanted = list(make())
    runs, results = options.runs / figure.name, options.results
    if options.report and part.count > 1:
        raise InputError(f"part is {options.part}: --report is of all parts")
    if options.quick:
        if results != trials.RESULTS:
            raise InputError(f"results is {results}: --quick writes below --runs")
        wanted = [dataclasses.replace(trial, **_QUICK) for trial in quick(wanted)]
        runs = options.runs / "quick" / figure.name
        results = options.runs / "quick" / "results"
    changes = {
        name: getattr(options, name)
        for name in ("seeds", "total_steps")
        if getattr(options, name) is not None
    }
    command_line.check_least(options, seeds=1, total_steps=1, processes=1)
    if options.processes is not None:
        if part.count > 1 or options.devices is not None or options.share_counts:
            raise InputError(
                f"processes is {options.processes}: --part, --devices and "
                "--share-counts don't go with it"
            )
    wanted = [dataclasses.replace(trial, **changes) for trial in wanted]
    chosen = _choose(wanted, options.only)
    folder = results / figure.name
    if options.list:
        for trial in chosen:
            known = trials.read(trial, folder)
            done = 0 if known is None else len(known.seeds)
            print(f"{trial.name}: {done} of {trial.seeds} seeds")
        return 0
    flags = ["--physics", options.physics]
    if options.devices is not None:
        flags += ["--devices", str(options.devices)]
    if options.share_counts:
        flags.append("--share-counts")
    for trial in chosen:
        trials.check(trial, folder)
    for trial in chosen:
        trials.adopt(trial, folder)
    todo = [trial for trial in chosen if trials.read_whole(trial, folder) is None]
    if done := len(chosen) - len(todo):
        print(f"{done} of {len(chosen)} trials are in {folder} already")
    if options.report:
        for trial in todo:
            trials.collect(trial, runs, folder)
    elif options.processes is not None:
        each = [(trial, trials.known(trial, folder)) for trial in todo]
        for trial in processes.train(each, runs, options.processes, flags):
            trials.collect(trial, runs, folder)
    else:
        for trial in todo:
            print(f"{figure.name}: {trial.name}", flush=True)
            if status := trials.train(trial, runs, part.number, part.count, flags):
                return status
            # Parts may run side by side; one process puts their results together.
            if part.count == 1:
                trials.collect(trial, runs, folder)
    if part.count == 1:
        write(figure, wanted, results)
        page = results / f"{figure.name}.md"
        print(f"in {page}" if page.exists() else f"{results} has nothing to show yet")
    return 0


def _choose(wanted: Sequence[Trial], only: Sequence[str]) -> list[Trial]:
    fits = lambda trial, name: name in (trial.name, trial.name.split("/")[0])
    for name in only:
        if not any(fits(trial, name) for trial in wanted):
            panels = dict.fromkeys(trial.name.split("/")[0] for trial in wanted)
            raise InputError(
                f"only is {name!r}: it must be PANEL or PANEL/CURVE, of the panels "
                f"{', '.join(panels)}"
            )
    return [t for t in wanted if not only or any(fits(t, name) for name in only)]

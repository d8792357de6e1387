"""``python -m experiments FIGURE``: train what a figure lacks, write its page.

Without a name it lists the figures and what else there is.
"""

import dataclasses
import importlib
import pathlib
import sys
from collections.abc import Sequence
from typing import Annotated

import tyro

from experiments import engine, store
from experiments.figures import FIGURES, Figure
from experiments.report import Page
from experiments.store import RESULTS, Run, Store
from experiments.summary import Summary
from gasil_jax.errors import InputError, unknown
from gasil_jax.host import command_line
from gasil_jax.sweeps import shards

_QUICK_STEPS = 100_000
_OTHERS = {
    "report": "all pages and plots, and the README's tables, from the stored runs",
    "merge": "FOLDER: add the runs of another machine's results",
}
#: Modules with a command line of their own.
_MODULES = {
    "benchmark": "speed and fidelity",
    "point_mass_layouts": "the search for the point mass' layout",
    "point_mass_moments": "policies, buffers, discriminator (paper, figures 3 and 4)",
}


@dataclasses.dataclass(frozen=True)
class Options:
    """Train the runs that a figure lacks, then write its page.

    Attributes:
      quick: train three seeds of a few panels, 100,000 steps each, below RUNS/quick.
      list: only print the missing runs.
      report: do not train; write the page from the stored runs.
      only: panels (or searches) to train; default all.
      part: I/N: train every N-th run, from the I-th on. Other machines train the
        others, and `merge` adds their results.
      processes: number of runs to train at a time, on the CPU, each in a process with
        its own cores; best with physics mujoco on many cores. By default runs that can
        share a program are trained together, which is best on a GPU.
      physics: physics engine of locomotion: mjx or mujoco.
      devices: number of host devices to shard members over; default one per core.
      evaluate: episodes of the evaluation after training; 0 for no evaluation.
      commit: commit of the code, if there is no repository.
      runs: folder of the training in progress; stopped training continues from there.
      results: folder of the pages and, below runs/, of the store.
    """

    quick: bool = False
    list: bool = False
    report: bool = False
    only: tuple[str, ...] = ()
    part: str = "1/1"
    processes: int | None = None
    physics: str = "mjx"
    devices: int | None = None
    evaluate: int = 0
    commit: str | None = None
    runs: pathlib.Path = pathlib.Path("runs", "experiments")
    results: pathlib.Path = RESULTS


def _selected(figure: Figure, only: Sequence[str]) -> Figure:
    """Return a figure with only the named panels and searches, or all for no names.

    Raises:
      InputError: if the figure has no panel or search of that name.
    """
    names = (*figure.panels, *figure.searches)
    for name in only:
        if name not in names:
            raise InputError(unknown("only", name, names))
    select = lambda values: {k: x for k, x in values.items() if not only or k in only}
    panels, searches = select(figure.panels), select(figure.searches)
    return dataclasses.replace(figure, panels=panels, searches=searches)


def _quick(figure: Figure) -> Figure:
    """Return a figure with three seeds of each curve and fewer steps."""
    small = lambda curve: dataclasses.replace(curve, seeds=3, total_steps=_QUICK_STEPS)
    panels = {
        panel: {label: small(curve) for label, curve in curves.items()}
        for panel, curves in figure.panels.items()
    }
    return dataclasses.replace(figure, panels=panels)


def _quick_runs(figure: Figure, searched: Store) -> list[Run]:
    """Return its curves' runs, and the searches' first points, one seed each."""
    curves = dataclasses.replace(figure, searches={})
    runs = curves.requested(searched, searched)
    for search in figure.searches.values():
        for stage in search.stages(searched)[:1]:
            for run, *_ in search.runs(stage)[:4]:
                config = run.config.replace(total_steps=_QUICK_STEPS)
                runs.append(dataclasses.replace(run, config=config))
    return runs


def _figure(name: str, options: Options) -> None:
    part = shards.parse(options.part, "part")
    command_line.check_least(options, processes=1, devices=1, evaluate=0)
    figure, results, work = FIGURES[name], options.results, options.runs
    if options.processes is not None and options.devices is not None:
        raise InputError(f"devices is {options.devices}: with processes each has one")
    if options.quick:
        if results != RESULTS:
            raise InputError(f"results is {results}: --quick writes below --runs")
        work, results = options.runs / "quick", options.runs / "quick" / "results"
    chosen = _selected(figure, options.only or (figure.quick if options.quick else ()))
    chosen = _quick(chosen) if options.quick else chosen
    runs_of, checked_in = Store(results / "runs"), Store(RESULTS / "runs")
    # Figures without searches of their own use the checked-in searches.
    searched = runs_of if figure.searches and not options.quick else checked_in

    def missing_runs() -> list[Run]:
        runs = chosen.requested(runs_of, searched)
        runs = _quick_runs(chosen, checked_in) if options.quick else runs
        return runs_of.missing(engine.part_of(runs, part))

    missing = missing_runs()
    print(f"{name}: {len(missing)} runs are missing", flush=True)
    if options.list:
        for program in engine.programs(missing, options.physics):
            print(f"  {program}")
        return
    setup = engine.Setup(
        work,
        options.physics,
        options.devices,
        options.evaluate,
        source=engine.source(options.commit),
    )
    while missing and not options.report:
        engine.train_missing(missing, runs_of, setup, options.processes)
        # When a stage of a search has ended, the points of the next one are known.
        missing = missing_runs()
    Page(name, runs_of, searched, chosen if options.quick else None).write(results)
    print(f"in {results / name}.md")
    if results == RESULTS:
        Summary(runs_of).write()


@dataclasses.dataclass(frozen=True)
class MergeOptions:
    """Add the runs of another machine to the store.

    Attributes:
      folder: folder of the other machine's results.
      results: folder of the results to add them to.
    """

    folder: Annotated[pathlib.Path, tyro.conf.Positional]
    results: pathlib.Path = RESULTS


def _merge(options: MergeOptions) -> None:
    new, total = store.merge(options.folder, Store(options.results / "runs"))
    print(f"{new} of {total} runs are new, in {options.results / 'runs'}")


@dataclasses.dataclass(frozen=True)
class ReportOptions:
    """Write all pages and plots from the stored runs."""


def _report() -> None:
    stored = Store(RESULTS / "runs")
    for name in FIGURES:
        Page(name, stored).write(RESULTS)
    Summary(stored).write()
    print(f"in {RESULTS}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status."""
    return command_line.exit_status(lambda: _main(arguments))


def _main(arguments: Sequence[str] | None) -> int | None:
    name, *rest = list(sys.argv[1:] if arguments is None else arguments) or ["--help"]
    if name in ("-h", "--help"):
        print("python -m experiments NAME (--help for its options)\n")
        titles = {x: figure.title for x, figure in FIGURES.items()}
        for listed, title in (titles | _OTHERS | _MODULES).items():
            print(f"  {listed:20} {title}")
    elif name in FIGURES:
        _figure(name, command_line.parse(Options, rest, f"experiments {name}"))
    elif name == "merge":
        _merge(command_line.parse(MergeOptions, rest, "experiments merge"))
    elif name == "report":
        command_line.parse(ReportOptions, rest, "experiments report")
        _report()
    elif name in _MODULES:
        return int(importlib.import_module(f"experiments.{name}").main(rest))
    else:
        raise InputError(unknown("experiment", name, (*FIGURES, *_OTHERS, *_MODULES)))
    return None


if __name__ == "__main__":
    sys.exit(main())

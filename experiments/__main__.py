"""``python -m experiments NAME``: train a figure's missing runs and write its page.

Without a name it lists the figures and the other commands.
"""

import dataclasses
import pathlib
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any

import tyro

from experiments import (
    benchmark,
    doing_nothing,
    engine,
    point_mass_layouts,
    point_mass_moments,
    profile,
    roofline,
    store,
    two_doors,
    zoo,
)
from experiments.curves import Curve, Figure
from experiments.figures import FIGURES
from experiments.report import Page
from experiments.search import PaperSearch
from experiments.store import RESULTS, ResultsFolder, Store
from experiments.summary import Summary
from gasil_jax.errors import InputError, unknown
from gasil_jax.host import command_line
from gasil_jax.sweeps import shards
from gasil_jax.sweeps.runs import Run


@dataclasses.dataclass(frozen=True)
class Options:
    """Train the runs that a figure lacks, then write its page.

    In the default folder all else that is made from stored runs is written too: the
    other pages, the README's tables and the tuned presets.

    Attributes:
      quick: train a small version below the folder `runs`: three seeds of the first
        panel, or of those that `only` names, for 100,000 steps each.
      list: only print the missing runs.
      only: panels and searches to train; default all. A panel without its searches
        trains only what complete searches chose.
      shard: train only this part of the runs, NUMBER/COUNT with numbers from 1 on.
        Other processes or machines train the others, and `merge` adds another
        machine's results.
      results: folder of the pages and, below runs/, of the stored runs. Runs that are
        stored there are not trained again.
      setup: how runs are trained.
    """

    quick: bool = False
    list: bool = False
    only: tuple[str, ...] = ()
    shard: str = "1/1"
    results: ResultsFolder = RESULTS
    setup: Annotated[engine.Setup, tyro.conf.arg(name="")] = dataclasses.field(
        default_factory=engine.Setup
    )


def _selected(figure: Figure, names: Sequence[str]) -> Figure:
    """Return a figure with only the named panels and searches, or all for no names.

    Raises:
      InputError: if the figure has no panel or search of that name.
    """
    allowed = (*figure.panels, *figure.searches)
    for name in names:
        if name not in allowed:
            raise InputError(unknown("only", name, allowed))

    def select(values: Mapping[str, Any]) -> dict[str, Any]:
        return {k: x for k, x in values.items() if not names or k in names}

    panels, searches = select(figure.panels), select(figure.searches)
    return dataclasses.replace(figure, panels=panels, searches=searches)


def _small(figure: Figure, names: Sequence[str]) -> Figure:
    """Return the small version of a figure, of the named panels or the first one.

    Instead of what searches choose, which may not be known yet, it uses the presets
    "tuned", "scaled" and "paper".

    Raises:
      InputError: if a name is no panel or search of the figure, or if only searches are
        named.
    """
    selected = _selected(figure, names or [*figure.panels][:1])
    if not selected.panels:
        raise InputError(
            f"only is {' '.join(names)}: --quick trains panels, which are "
            f"{', '.join(figure.panels)}"
        )

    def small(curve: Curve) -> Curve:
        base = curve.base
        if search := curve.search:
            base = "scaled" if search.decompose_rewards else "tuned"
            base = "paper" if isinstance(search, PaperSearch) else base
        return dataclasses.replace(curve, base=base, seeds=3, total_steps=100_000)

    panels = {
        panel: {name: small(curve) for name, curve in curves.items()}
        for panel, curves in selected.panels.items()
    }
    return dataclasses.replace(figure, panels=panels, searches={})


def _train(name: str, options: Options) -> None:
    """Train the runs that a figure lacks, then write its page."""
    setup, results, figure = options.setup, options.results, FIGURES[name]
    shard = shards.parse(options.shard)
    command_line.check_minimum(
        setup, devices=1, evaluate_episodes=0, processes=1, members=1
    )
    published = results.resolve() == RESULTS.resolve()
    if options.quick and not published:
        raise InputError(
            f"results is {results}: --quick writes below --runs instead, leave it out"
        )
    if options.quick:
        setup = dataclasses.replace(setup, runs=setup.runs / "quick")
        results, figure = setup.runs / "results", _small(figure, options.only)
    chosen = figure if options.quick else _selected(figure, options.only)

    def stores() -> tuple[Store, Store]:
        """Return the stores of the figure's runs and of the searches' runs."""
        # They are read again each time, because other processes may have added runs. A
        # figure without searches uses the choices of other figures' stored searches.
        searched = results if figure.searches else RESULTS
        return Store(results / "runs"), Store(searched / "runs")

    def lacking() -> tuple[Store, list[Run]]:
        """Return the store of the figure's runs, and the runs that it lacks."""
        stored, searched = stores()
        requested = chosen.requested(searched)
        return stored, stored.missing(engine.select_by_key(requested, *shard))

    while True:
        stored, missing = lacking()
        print(f"{name}: {len(missing)} runs are missing", flush=True)
        if options.list or not missing:
            break
        # When a stage of a search has ended, the points of the next one are known.
        if setup.processes > 1:
            engine.train_in_processes(lambda: lacking()[1], stored, setup)
        else:
            engine.train_missing(missing, stored, setup)
    if options.list:
        for each in engine.unfinished(missing, setup):
            print(f"  {engine.title(each)}")
        return
    if published and not options.quick:
        # Other pages may have some of the same runs.
        _write_all_pages()
    else:
        Page(name, *stores(), figure if options.quick else None).write(results)
    print(f"in {results / name}.md")


@dataclasses.dataclass(frozen=True)
class MergeOptions:
    """Add the runs of another machine's results to the stored ones.

    Attributes:
      folder: folder of the other machine's results.
      results: folder of the results to add them to.
    """

    folder: Annotated[pathlib.Path, tyro.conf.Positional]
    results: ResultsFolder = RESULTS


def _merge(options: MergeOptions) -> None:
    new, total = store.merge(options.folder, Store(options.results / "runs"))
    print(f"{new} of {total} runs are new, in {options.results / 'runs'}")


@dataclasses.dataclass(frozen=True)
class CoverageOptions:
    """Print how much of the plan of all agents and tasks is stored.

    Points beyond the grid and the further seeds of the best points are only planned
    once they are known, and an incomplete search has no final runs yet. The exit status
    is 1 while runs are missing.

    Attributes:
      results: folder of the results that are counted.
    """

    results: ResultsFolder = RESULTS


def _coverage(options: CoverageOptions) -> int:
    store, complete = Store(options.results / "runs"), True
    for name in ("matrix", "paper_protocol"):
        print(f"{name:22} agent                   search    seeds")
        for panel, label, curve in FIGURES[name].curves():
            cells = []
            requested = curve.search.requested(store) if curve.search else []
            for runs, planned in (
                (requested, len(requested)),
                (curve.runs(store), curve.seeds),
            ):
                stored = sum(run in store for run in runs)
                complete &= stored == planned
                cells.append(f"{stored} of {planned}")
            print(f"{panel:22} {label:20} {cells[0]:>9} {cells[1]:>8}")
    return int(not complete)


@dataclasses.dataclass(frozen=True)
class ReportOptions:
    """Write all pages, plots and presets, and the README's tables, from stored runs."""


def _write_all_pages() -> None:
    summary = Summary(Store(RESULTS / "runs"))
    for page in summary.pages.values():
        page.write(RESULTS)
    summary.write()


def _report(options: ReportOptions) -> None:
    _write_all_pages()
    print(f"in {RESULTS}")


#: Commands other than figures, by name: the class of their options, and a function.
COMMANDS: Mapping[str, tuple[Any, Callable[[Any], int | None]]] = {
    "report": (ReportOptions, _report),
    "coverage": (CoverageOptions, _coverage),
    "merge": (MergeOptions, _merge),
    "benchmark": (benchmark.Options, benchmark.run),
    "profile": (profile.Options, profile.run),
    "roofline": (roofline.Options, roofline.run),
    "zoo": (zoo.Options, zoo.run),
    "doing_nothing": (doing_nothing.Options, doing_nothing.run),
    "point_mass_layouts": (point_mass_layouts.Options, point_mass_layouts.run),
    "point_mass_moments": (point_mass_moments.Options, point_mass_moments.run),
    "two_doors": (two_doors.Options, two_doors.run),
}


@command_line.reports_errors
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status."""
    name, *rest = list(sys.argv[1:] if arguments is None else arguments) or ["--help"]
    if name in ("-h", "--help"):
        print("python -m experiments NAME (--help for its options)\n")
        titles = {listed: figure.title for listed, figure in FIGURES.items()}
        for command, (options, _) in COMMANDS.items():
            titles[command] = options.__doc__.splitlines()[0].removesuffix(".")
        for listed, title in titles.items():
            print(f"  {listed:20} {title}")
    elif name in FIGURES:
        _train(name, command_line.parse(Options, rest, f"experiments {name}"))
    elif name in COMMANDS:
        options, function = COMMANDS[name]
        return function(command_line.parse(options, rest, f"experiments {name}")) or 0
    else:
        raise InputError(unknown("experiment", name, (*FIGURES, *COMMANDS)))
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""``python -m experiments NAME``: train a figure's missing runs and draw them.

Without a name it lists the figures and the other commands.
"""

import dataclasses
import pathlib
import sys
from collections.abc import Mapping, Sequence
from types import ModuleType
from typing import Any

from experiments import (
    benchmark,
    engine,
    profile,
    report,
    zoo,
)
from experiments.curves import Curve, Figure
from experiments.engine import Setup
from experiments.figure_results import Results
from experiments.figures import FIGURES
from experiments.search import PaperSearch
from experiments.store import RESULTS, Store
from gasil_jax.cli.parsing import check_minimum, read
from gasil_jax.cli.reporting import reports_errors
from gasil_jax.errors import InputError, unknown
from gasil_jax.host.runs import Run
from gasil_jax.host.sweep import parse_shard

#: Commands other than figures: each module has `Options` and a `run` that takes them.
COMMANDS: Mapping[str, ModuleType] = {
    "report": report,
    "benchmark": benchmark,
    "profile": profile,
    "zoo": zoo,
}
#: Environment steps of each run of `--quick`.
_QUICK_STEPS = 100_000


@dataclasses.dataclass(frozen=True)
class Options(Setup):
    """Train the runs that a figure lacks, then draw them.

    Attributes:
      quick: train a small version below the folder of --runs: three seeds of the first
        panel, or of those of --only, for 100,000 steps each.
      list: only print the missing runs.
      only: panels and searches to train, instead of all. A panel without its searches
        trains only what complete searches chose.
      shard: train only this part of the runs, as NUMBER/COUNT.
      results: folder of the stored runs, in runs/, and of a page.
    """

    quick: bool = False
    list: bool = False
    only: tuple[str, ...] = ()
    shard: str = "1/1"
    results: pathlib.Path = RESULTS


def _selected(figure: Figure, names: Sequence[str]) -> Figure:
    """Return a figure with only the named panels and searches, or all for no names."""
    allowed = (*figure.panels, *figure.searches)
    for name in names:
        if name not in allowed:
            raise InputError(unknown("only", name, allowed))

    def select(values: Mapping[str, Any]) -> dict[str, Any]:
        return {k: x for k, x in values.items() if not names or k in names}

    panels, searches = select(figure.panels), select(figure.searches)
    return dataclasses.replace(figure, panels=panels, searches=searches)


def _small(figure: Figure, names: Sequence[str]) -> Figure:
    """Return the small version of a figure, of the named panels or the first one."""
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
        return dataclasses.replace(curve, base=base, seeds=3, total_steps=_QUICK_STEPS)

    panels = {
        panel: {name: small(curve) for name, curve in curves.items()}
        for panel, curves in selected.panels.items()
    }
    return dataclasses.replace(figure, panels=panels, searches={})


def _train(name: str, options: Options) -> None:
    """Train the runs that a figure lacks, then draw them."""
    check_minimum(options, devices=1, evaluate_episodes=0, processes=1, members=1)
    setup, results, figure = options, options.results, FIGURES[name]
    shard = parse_shard(options.shard)
    if options.quick:
        if results.resolve() != RESULTS.resolve():
            raise InputError(
                f"results is {results}: --quick writes below --runs instead, leave it "
                "out"
            )
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
    if results.resolve() == RESULTS.resolve():
        pages = report.all_results(stores()[0])
        for page in report.showing(name):
            report.write(pages, page, report.PAGES)
            print(f"in {report.PAGES / page}.md")
        return
    text = f"# {figure.title}\n\n{{{{{name} curves}}}}\n\n{{{{{name} forest}}}}\n"
    shown = {name: Results(name, figure, *stores())}
    report.write(shown, name, results, text)
    print(f"in {results / name}.md")


@reports_errors
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status."""
    name, *rest = list(sys.argv[1:] if arguments is None else arguments) or ["--help"]
    if name in ("-h", "--help"):
        print("python -m experiments NAME (--help for its options)\n")
        docs = {x: one.Options.__doc__ or "" for x, one in COMMANDS.items()}
        about = {x: words.partition("\n")[0] for x, words in docs.items()}
        for listed, title in ({x: y.title for x, y in FIGURES.items()} | about).items():
            print(f"  {listed:20} {title.removesuffix('.')}")
    elif name in FIGURES:
        _train(name, read(Options, rest, f"experiments {name}"))
    elif name in COMMANDS:
        module = COMMANDS[name]
        module.run(read(module.Options, rest, f"experiments {name}"))
    else:
        raise InputError(unknown("experiment", name, (*FIGURES, *COMMANDS)))
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""``python -m experiments report``: pages, pictures, tables and presets of all runs.

A page is the text of ``notes/NAME.md`` with its slots filled in: {{claims}}, or
{{FIGURE SLOT ARGUMENTS}} with a slot of `tables.SLOTS`.
"""

import csv
import dataclasses
import functools
import json
import pathlib
import re
import shlex
from collections.abc import Callable, Iterable

import numpy as np

from experiments import claims, plots, tables
from experiments.agents import OWN
from experiments.claims import Pages
from experiments.figure_results import Results, families
from experiments.figures import FIGURES
from experiments.search import ADAPTIVE, PAIR, PaperSearch, SparseSearch
from experiments.store import RESULTS, Store
from gasil_jax import presets
from gasil_jax.errors import InputError
from gasil_jax.host import output_file
from gasil_jax.statistics import bootstrap_interval, interquartile_mean

NOTES = pathlib.Path(__file__).parent / "notes"
README = pathlib.Path(__file__).parent.parent / "README.md"
#: The documents with blocks that are filled in: README has "readme", the other a table.
DOCUMENTS = (README, README.parent / "docs" / "reproducing.md")
#: The folder of the pages, and their names. The note "front" is a part of the README.
PAGES = README.parent / "docs" / "results"
NAMES = sorted(path.stem for path in NOTES.glob("*.md") if path.stem != "front")
_SLOT = re.compile(r"{{(.+?)}}")


def note(name: str) -> str:
    """Return the text of a page, with its slots."""
    return (NOTES / f"{name}.md").read_text()


def fill(text: str, value: Callable[..., str]) -> str:
    """Fill the slots of a text with the results of `value`."""
    return _SLOT.sub(lambda x: value(*shlex.split(x[1])), text)


def fill_blocks(text: str, value: Callable[..., str]) -> str:
    """Replace the text between ``<!-- begin SLOT -->`` and ``<!-- end -->``."""
    block = re.compile(r"(<!-- begin (.+?) -->\n).*?(<!-- end -->)", re.DOTALL)
    return block.sub(lambda x: f"{x[1]}\n{value(*shlex.split(x[2]))}\n\n{x[3]}", text)


def value(pages: Pages, name: str, *arguments: str) -> str:
    """Return the text of a slot."""
    if name == "claims":
        return claims.table(pages)
    if name == "readme":
        # The README is two folders above the pictures.
        text = page(pages, note("front")).rstrip()
        return re.sub(r"\]\((\w+\.png)\)", r"](docs/results/\1)", text)
    if name == "families":
        return tables.families([pages[x] for x in arguments])
    slot, *rest = arguments or ("",)
    if name not in pages or slot not in tables.SLOTS:
        raise InputError(
            f"slot is {shlex.join([name, *arguments])}: it must be claims, or a figure "
            f"and one of {', '.join(tables.SLOTS)}"
        )
    return tables.SLOTS[slot](pages[name], *rest) or "not measured"


def page(pages: Pages, text: str) -> str:
    """Return the text of a note with its slots filled in."""
    return fill(text, functools.partial(value, pages))


def pictures(pages: Pages, text: str) -> dict[str, Callable[[], plots.Picture]]:
    """Return what draws each picture of a note, by the name of its file."""
    drawn: dict[str, Callable[[], plots.Picture]] = {}
    for words in _SLOT.findall(text):
        name, slot, *kind = [*shlex.split(words), ""][:3]
        if name == "families":
            joined = [pages[x] for x in shlex.split(words)[1:]]
            if families(joined):
                path = tables.picture(slot, name)
                drawn[path] = functools.partial(plots.families, joined)
            continue
        draw = {"curves": plots.curves, "forest": plots.forest}.get(slot)
        if draw and tables.is_drawn(pages[name], slot, *kind):
            path = tables.picture(name, slot, *kind)
            drawn[path] = functools.partial(draw, pages[name], *kind)
    return drawn


def write(pages: Pages, name: str, folder: pathlib.Path, text: str = "") -> None:
    """Write a page and its pictures; `text` is by default its note."""
    text = text or note(name)
    for path, draw in pictures(pages, text).items():
        plots.save_png(draw(), folder / path)
    folder.mkdir(parents=True, exist_ok=True)
    with output_file.atomic(folder / f"{name}.md") as partial:
        partial.write_text(page(pages, text))


def showing(figure: str) -> list[str]:
    """Return the pages that name a figure."""
    return [name for name in NAMES if f"{{{{{figure} " in note(name)]


def all_results(store: Store) -> dict[str, Results]:
    """Return the results of all figures."""
    return {name: Results(name, figure, store) for name, figure in FIGURES.items()}


def curves_table(pages: Pages) -> Iterable[list[str]]:
    """Yield the rows of curves.csv: every number and setting of each curve."""
    yield [
        *("figure", "task", "agent", "seeds", "final_return", "low", "high"),
        *("evaluated", "solved", "settings", "trained_with"),
    ]
    for name, results in pages.items():
        for (panel, label), one in results.curves.items():
            low, high = map(float, bootstrap_interval(one.final))
            final = [float(interquartile_mean(one.final)), low, high]
            evaluated = ""
            if len(one.evaluated):
                evaluated = f"{interquartile_mean(one.evaluated):.1f}"
            solved = ""
            if (panel, label) in results.sooner:
                solved = f"{results.scores[panel, label].mean():.2f}"
            settings = tables.settings(results, panel, label)
            seeds, by = f"{len(one.records)}", one.provenance()
            words = [f"{x:.5g}" for x in final] + [evaluated, solved, settings, by]
            yield [name, panel, label, seeds, *words]


def comparisons_table(pages: Pages) -> Iterable[list[str]]:
    """Yield the rows of comparisons.csv: every verdict on a single panel."""
    yield [
        *("figure", "task", "ours", "other", "less", "difference", "low", "high"),
        *("p", "visible_from", "verdict"),
    ]
    for name, results in pages.items():
        for key, one in results.comparisons.items():
            every = (one.middle, one.low, one.high, one.p, one.visible)
            words = [f"{x:.4g}" for x in every]
            yield [name, *[*key, ""][:4], *words, one.verdict]


def tuned(pages: Pages) -> str:
    """Return the tuned presets as JSON, updated by what complete searches chose."""
    rows = json.loads(presets.TUNED.read_text())
    final = {
        one.curve.search: float(interquartile_mean(one.final))
        for name in ("matrix", "ppo_values")
        for one in pages[name].curves.values()
        if one.complete
    }
    for results in pages.values():
        for search in results.figure.searches.values():
            # The preset "paper" has normalized rewards and the paper's bonus, "scaled"
            # decomposed rewards.
            other = search.decompose_rewards or getattr(search, "bonus", None)
            other = other or not getattr(search, "normalize_rewards", True)
            # On the sparse tasks each agent has one setting for all, and so has
            # adaptive imitation where that returns about as much as its searches. The
            # experiments' own agents have no presets.
            kind = "delayed" if search.reward_delay > 1 else "dense"
            is_own = kind == "delayed" and search.env in ("ant", "humanoid")
            single = search.agent == ADAPTIVE and not is_own
            single |= isinstance(search, SparseSearch) or search.agent in OWN
            # The best of its own values and of those that PPO's and PPO+GASIL's
            # searches chose, by the final returns on the pages.
            others = [dataclasses.replace(search, chooser=x) for x in PAIR]
            best = max([search, *others], key=lambda x: final.get(x, -np.inf))
            point = best.chosen(results.searched)
            if point is None or single or other:
                continue
            kind = f"paper {kind}" if isinstance(search, PaperSearch) else kind
            of_task = rows.setdefault(kind, {}).setdefault(search.env, {})
            settings = tables.changed(search.algorithm(point))
            of_task[search.agent] = dict(sorted(settings.items()))
    return json.dumps(rows, indent=1, sort_keys=True) + "\n"


@dataclasses.dataclass(frozen=True)
class Options:
    """Write all pages, plots and presets, and the README's text on results."""


def run(options: Options) -> None:
    """Write all that is made from stored runs."""
    pages = all_results(Store(RESULTS / "runs"))
    for name in NAMES:
        write(pages, name, PAGES)
    for path, draw in pictures(pages, note("front")).items():
        plots.save_png(draw(), PAGES / path)
    for name, rows in (
        ("curves", curves_table(pages)),
        ("comparisons", comparisons_table(pages)),
    ):
        with (
            output_file.atomic(PAGES / f"{name}.csv") as partial,
            partial.open("w", newline="") as file,
        ):
            csv.writer(file, lineterminator="\n").writerows(rows)
    of = functools.partial(value, pages)
    documents = {path: fill_blocks(path.read_text(), of) for path in DOCUMENTS}
    for written, content in (*documents.items(), (presets.TUNED, tuned(pages))):
        with output_file.atomic(written) as partial:
            partial.write_text(content)
    print(f"in {PAGES}")

"""Statistics, tables, plots and pages: every number and verdict is of stored runs.

A page is notes/NAME.md with its slots, {{NAME ARGUMENTS}}, filled in. Verdicts are
corrected for the number of comparisons of their page by Holm's method.
"""

import dataclasses
import functools
import io
import itertools
import math
import pathlib
import re
import shlex
import zlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from experiments import search
from experiments.figures import (
    AGES,
    FIGURES,
    GEOMETRY_NUM_ENVS,
    Comparisons,
    Curve,
    Figure,
    geometry_curve,
)
from experiments.search import AGENTS, PAIR
from experiments.store import Record, Run, Store
from gasil_jax.errors import InputError
from gasil_jax.figures import plotting
from gasil_jax.figures.statistics import bootstrap_interval, interquartile_mean
from gasil_jax.host import output_file

NOTES = pathlib.Path(__file__).parent / "notes"
#: Probability that any verdict of a page is wrong, at most.
LEVEL = 0.05
_DRAWS = 10_000
#: Of fewer seeds an interval covers far less than it says, and nothing is clear.
_FEWEST_SEEDS = 5
#: Scores, (seeds,), by panel and curve.
Scores = Mapping[tuple[str, str], np.ndarray]

IN_STEP = (
    "These runs are of environments that were reset together and stayed in step; see "
    "[batch geometry](batch_geometry.md)."
)
_READING = """## How to read this

A final return is the interquartile mean over seeds of the mean return over the last
tenth of training, of the episodes that the acting policy ended; in brackets a 95%
interval, the percentile bootstrap's over seeds, which is a little too narrow for ten.
Better, worse and not clear are verdicts on differences, corrected by Holm's method for
the {} comparisons of this page: the chance that any of them is wrong is 5%. A list of
added seeds, which are also among all, is corrected by itself. A percentage over several
tasks is the geometric mean of the ratios, less one."""


@dataclasses.dataclass(frozen=True)
class Comparison:
    """A difference, its 95% interval, and its p-value, corrected by Holm's method."""

    middle: float
    low: float
    high: float
    p: float

    @property
    def verdict(self) -> str:
        """Better, worse or not clear."""
        if not self.p <= LEVEL:
            return "not clear"
        return "better" if self.middle > 0 else "worse"

    def __str__(self) -> str:
        return in_words(self.middle, self.low, self.high)


@functools.cache
def _draws(name: str, scores: tuple[float, ...]) -> np.ndarray:
    """Interquartile means of bootstrap samples: (draws,)."""
    rng = np.random.default_rng(zlib.crc32(name.encode()))
    rows = rng.integers(len(scores), size=(_DRAWS, len(scores)))
    return interquartile_mean(np.array(scores)[rows], axis=1)


def draws(scores: Scores, panel: str, curve: str) -> np.ndarray:
    """Interquartile means of bootstrap samples of a curve's seeds: (draws,)."""
    return _draws(f"{panel}/{curve}", tuple(scores[panel, curve].tolist()))


def compare(scores: Scores, family: Comparisons) -> dict[tuple[str, ...], Comparison]:
    """Differences of interquartile means, of those whose curves all have scores.

    The p-value is the percentile bootstrap's: the share of draws on the other side of
    0, times two. Holm: the smallest is multiplied by the number of comparisons, the
    next by one less, and none is smaller than the one before.
    """
    raw = {}
    for key, terms in family.items():
        if not all((panel, curve) in scores for _, panel, curve in terms):
            continue
        drawn = np.sum([w * draws(scores, *curve) for w, *curve in terms], axis=0)
        middle = sum(w * float(interquartile_mean(scores[p, c])) for w, p, c in terms)
        low, high = map(float, np.percentile(drawn, [2.5, 97.5]))
        beyond = min(int((drawn <= 0).sum()), int((drawn >= 0).sum()))
        sides = [scores[p, c] for _, p, c in terms]
        enough = all(len(x) >= _FEWEST_SEEDS and np.isfinite(x).all() for x in sides)
        p_value = min(1.0, 2 * (1 + beyond) / (1 + _DRAWS)) if enough else 1.0
        raw[key] = Comparison(middle, low, high, p_value)
    corrected, least = {}, 0.0
    for i, key in enumerate(sorted(raw, key=lambda key: raw[key].p)):
        least = max(least, min(1.0, raw[key].p * (len(raw) - i)))
        corrected[key] = dataclasses.replace(raw[key], p=least)
    return corrected


def together(scores: Scores, panels: Sequence[str], ours: str, other: str) -> str:
    """Return by what share one curve exceeds the other over all panels, in words."""
    drawn = [np.log(draws(scores, p, ours) / draws(scores, p, other)) for p in panels]
    mean = lambda panel, curve: interquartile_mean(scores[panel, curve])
    middle = np.mean([np.log(mean(p, ours) / mean(p, other)) for p in panels])
    low, high = np.percentile(np.mean(drawn, axis=0), [2.5, 97.5])
    shares = [100 * math.expm1(float(x)) for x in (middle, low, high)]
    return "{:+.0f}% [{:.0f}, {:.0f}]".format(*shares)


def number(value: float) -> str:
    """Return a score as text, without decimals from 100 on."""
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.1f}"


def in_words(middle: float, low: float, high: float) -> str:
    """Return a number and its interval as text."""
    return f"{number(middle)} [{number(low)}, {number(high)}]"


def interval(scores: np.ndarray) -> str:
    """Interquartile mean and 95% interval of (seeds,); of few seeds the mean alone."""
    middle = float(interquartile_mean(scores))
    if len(scores) < _FEWEST_SEEDS:
        return number(middle)
    return in_words(middle, *map(float, bootstrap_interval(scores)))


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


@dataclasses.dataclass(frozen=True)
class Results:
    """The stored runs of a curve, of all or only a part of its seeds."""

    curve: Curve
    point: Mapping[str, Any]
    runs: tuple[Run, ...]
    records: tuple[Record, ...]

    @property
    def complete(self) -> bool:
        """Whether the runs of all seeds are stored."""
        return len(self.runs) == self.curve.seeds

    @property
    def seeds(self) -> str:
        """How many, in words."""
        return f"{len(self.runs)}" + (
            "" if self.complete else f" of {self.curve.seeds}"
        )

    def part(self, begin: float, end: float) -> np.ndarray:
        """Mean return over a part of training, (seeds,)."""
        return np.array([record.part(begin, end) for record in self.records])

    @property
    def final(self) -> np.ndarray:
        """Final return, (seeds,)."""
        return np.array([record.final for record in self.records])

    def provenance(self) -> str:
        """Return physics, versions, devices and commits of the seeds, in words."""
        seeds_of: dict[str, list[int]] = {}
        for run, record in zip(self.runs, self.records, strict=True):
            by = record.provenance
            jax = (by["versions"] or {}).get("jax")
            source = f"collected at {by.get('collected_at') or '?'}"
            if by["commit"]:
                changed = ", changed" if by["clean"] is False else ""
                source = f"commit {by['commit']}{changed}"
            words = [by["physics"], jax and f"jax {jax}", by["device"], source]
            seeds_of.setdefault(", ".join(filter(None, words)), []).append(run.seed)
        if len(seeds_of) == 1:
            return next(iter(seeds_of))
        return "; ".join(
            f"seeds {_ranges(x)}: {words}" for words, x in seeds_of.items()
        )


def _ranges(numbers: Sequence[int]) -> str:
    """Increasing numbers in words: 0 to 4, 7."""
    steps = [i for i in range(1, len(numbers)) if numbers[i] > numbers[i - 1] + 1]
    runs = [numbers[i:j] for i, j in itertools.pairwise([0, *steps, len(numbers)])]
    return ", ".join(f"{x[0]} to {x[-1]}" if len(x) > 1 else f"{x[0]}" for x in runs)


class Page:
    """What there is of a figure, and the slots of its page.

    Args:
      name: of the figure.
      store: of its runs.
      searched: of the searches' runs; default the same.
      figure: a figure to use instead; default the one of that name, which has a note.
    """

    def __init__(
        self,
        name: str,
        store: Store,
        searched: Store | None = None,
        figure: Figure | None = None,
    ):
        self.name, self.store, self.figure = name, store, figure or FIGURES[name]
        self.note = "{{table}}" if figure else (NOTES / f"{name}.md").read_text()
        self.results: dict[str, dict[str, Results]] = {}
        self.missing = 0
        for panel, curves in self.figure.panels.items():
            for label, curve in curves.items():
                runs = [run for run in curve.runs(searched or store) if run in store]
                self.missing += curve.seeds - len(runs)
                if runs:
                    point = curve.point(searched or store) or {}
                    records = tuple(store[run] for run in runs)
                    results = Results(curve, point, tuple(runs), records)
                    self.results.setdefault(panel, {})[label] = results
        self.scores: dict[tuple[str, str], np.ndarray] = {}
        for panel, label, results in self._complete():
            self.scores[panel, label] = results.final
            if self.figure.early is not None:
                share = self.figure.early / results.curve.total_steps
                self.scores[panel, f"{label} early"] = results.part(0.0, share)
        self.comparisons = compare(self.scores, self.figure.compared())

    def _complete(self) -> list[tuple[str, str, Results]]:
        return [
            (panel, label, results)
            for panel, curves in self.results.items()
            for label, results in curves.items()
            if results.complete
        ]

    def table(self) -> str:
        """Final returns: a row for each panel and curve."""
        favourite = self.figure.favourite if self.figure.over is None else None
        head = ["task", "agent", "seeds", "final return"]
        head += [f"{favourite} ahead by", f"{favourite} is"] if favourite else []
        rows = []
        for panel, curves in self.results.items():
            for label, results in curves.items():
                cells = [panel, label, results.seeds, interval(results.final)]
                if favourite:
                    against = self.comparisons.get((panel, favourite, label))
                    cells += [str(against), against.verdict] if against else ["", ""]
                rows.append(cells)
        return markdown_table(head, rows)

    def final(self, panel: str, curve: str) -> str:
        """Return the final return of a curve as text."""
        return interval(self.scores[panel, curve])

    def compared(self, *key: str) -> str:
        """Return a comparison in words."""
        panel, ours, other, comparison = *key[:3], self.comparisons[key]
        words = {"not clear": "is not clearly different from"}
        phrase = words.get(comparison.verdict, f"is {comparison.verdict} than")
        return f"{ours} {phrase} {other} on {panel} ({comparison})"

    def comparisons_list(self) -> str:
        """Return every comparison of the page, in a line each."""
        lines = []
        for key in self.figure.compared():
            if comparison := self.comparisons.get(key):
                panel, ours, other, *less = key
                more = f", less that of {less[0]}" if less else ""
                words = f"{panel}, {ours} - {other}{more}"
                lines.append(f"- {words}: {comparison}, {comparison.verdict}.")
        return "\n".join(lines)

    def tally(self, *panels: str, scores: Scores | None = None) -> str:
        """On how many panels the favourite is better than each other, and by how much.

        Args:
          *panels: which; default all.
          scores: to compare, as a family of their own; default the page's.
        """
        favourite, panels = (
            str(self.figure.favourite),
            panels or tuple(self.figure.panels),
        )
        comparisons = self.comparisons
        if scores is not None:
            comparisons = compare(scores, self.figure.compared())
        scores = scores or self.scores
        lines = []
        for other in dict.fromkeys(x for p in panels for x in self.figure.panels[p]):
            complete = [p for p in panels if (p, favourite, other) in comparisons]
            verdicts = [
                comparisons[panel, favourite, other].verdict for panel in complete
            ]
            if not verdicts:
                continue
            words = [x for x in ("better", "not clear", "worse") if x in verdicts]
            counts = ", ".join(f"{word} on {verdicts.count(word)}" for word in words)
            line = f"- {favourite} against {other}: {counts} of {len(complete)}"
            # A ratio has no meaning where a seed learned nothing or lost.
            both = lambda panel: (scores[panel, favourite], scores[panel, other])  # noqa: B023
            positive = [
                p for p in complete if all((side > 0).all() for side in both(p))
            ]
            if len(positive) > 1:
                which = f"the {len(positive)} where every seed's return is above 0"
                which = "all of them" if len(positive) == len(complete) else which
                line += f"; over {which} {together(scores, positive, favourite, other)}"
            lines.append(f"{line}.")
        return "\n".join(lines)

    def added(self, *panels: str) -> str:
        """Return the tally of only the seeds after the tenth."""
        curves = [x for x in self._complete() if x[0] in panels and len(x[2].runs) > 10]
        later = {(panel, label): results.final[10:] for panel, label, results in curves}
        return self.tally(*panels, scores=later)

    def best_value(self, panel: str) -> str:
        """Return the curve of a panel with the highest interquartile mean."""
        mean = lambda label: float(interquartile_mean(self.scores[panel, label]))
        return max(self.figure.panels[panel], key=mean)

    def verdict(self, panel: str, ours: str, other: str) -> str:
        """Return the comparison of two curves of a panel, in either order."""
        if comparison := self.comparisons.get((panel, ours, other)):
            return comparison.verdict
        verdict = self.comparisons[panel, other, ours].verdict
        return {"better": "worse", "worse": "better"}.get(verdict, verdict)

    def best(self) -> str:
        """The best value of each panel, and whether it is better than each other."""
        lines = []
        for panel, curves in self.figure.panels.items():
            if all((panel, label) in self.scores for label in curves):
                best, labels = self.best_value(panel), list(curves)
                where = (
                    "at an end" if best in (labels[0], labels[-1]) else "in the middle"
                )
                verdicts = ", ".join(
                    f"{label} ({self.verdict(panel, best, label)})"
                    for label in curves
                    if label != best
                )
                lines.append(
                    f"- {panel}: {best} has most, {where}; against {verdicts}."
                )
        return "\n".join(lines)

    def settings(self) -> str:
        """What each curve was trained with, beyond the appendix's values."""
        rows = []
        for panel, curves in self.results.items():
            for label, results in curves.items():
                point = search.point_in_words(results.point)
                if results.runs[0].config.normalize_rewards:
                    point += ", rewards normalized"
                rows.append([panel, label, point, results.provenance()])
        return markdown_table(
            ["task", "agent", "hyperparameters", "trained with"], rows
        )

    def geometry(self) -> str:
        """Starting ages drawn and not, for each agent and number of environments."""
        rows = [
            [
                panel,
                agent,
                str(count),
                *(self.final(panel, name) for name in names),
                str(comparison),
                comparison.verdict,
            ]
            for panel in self.results
            for agent in PAIR
            for count in GEOMETRY_NUM_ENVS
            for names in [[geometry_curve(agent, drawn, count) for drawn in AGES]]
            if (comparison := self.comparisons.get((panel, *names)))
        ]
        head = ["task", "agent", "environments", "ages drawn", "not drawn"]
        head += ["difference", "drawn is"]
        return markdown_table(head, rows) if rows else "No cell is complete yet."

    def geometry_tally(self) -> str:
        """For each number of environments, on how many cells drawn ages are better."""
        lines = []
        for count in GEOMETRY_NUM_ENVS:
            pairs = {
                agent: [geometry_curve(agent, drawn, count) for drawn in AGES]
                for agent in PAIR
            }
            cells = [
                self.comparisons[panel, drawn, not_drawn].verdict
                for panel in self.results
                for drawn, not_drawn in pairs.values()
                if (panel, drawn, not_drawn) in self.comparisons
            ]
            words = [x for x in ("better", "not clear", "worse") if x in cells]
            counts = ", ".join(f"{word} on {cells.count(word)}" for word in words)
            over_all = [
                f"{agent} {together(self.scores, panels, *pair)}"
                for agent, pair in pairs.items()
                for panels in [
                    [
                        panel
                        for panel in self.results
                        if all((self.scores[panel, x] > 0).all() for x in pair)
                    ]
                ]
            ]
            many = "environment" if count == 1 else "environments"
            lines.append(
                f"- {count} {many}: drawn is {counts} of {len(cells)} cells; over the "
                f"tasks where every seed's return is above 0, {', '.join(over_all)}."
            )
        return "\n".join(lines)

    def value(self, slot: str, *arguments: str) -> str:
        """What stands in a slot.

        Raises:
          InputError: there is no such slot, or nothing to stand in it.
        """
        slots: dict[str, Callable[..., str]] = {
            "table": self.table,
            "final": self.final,
            "compared": self.compared,
            "comparisons": self.comparisons_list,
            "tally": self.tally,
            "added": self.added,
            "best": self.best,
            "geometry": self.geometry,
            "geometry_tally": self.geometry_tally,
            "searches": lambda: search.table(self.figure.searches, self.store),
            "effects": lambda: search.effects(self.figure.searches, self.store),
        }
        try:
            return slots[slot](*arguments)
        except (KeyError, TypeError):
            raise InputError(
                f"slot is {shlex.join([slot, *arguments])} in {self.name}: it must be "
                f"one of {', '.join(slots)}, of complete curves"
            ) from None

    @property
    def in_step(self) -> bool:
        """Whether environments of locomotion were reset together in some runs."""
        runs = [x.runs[0] for curves in self.results.values() for x in curves.values()]
        for each in self.figure.searches.values():
            runs += [
                x[0] for stage in each.stages(self.store)[:1] for x in each.runs(stage)
            ]
        return any(
            run.env != "point_mass" and not run.config.stagger_episodes for run in runs
        )

    def text(self) -> str:
        """Return the page as Markdown."""
        parts = [f"# {self.figure.title}"]
        if self.in_step and self.figure.over is None:
            parts.append(IN_STEP)
        if self.figure.claim:
            parts.append(f"**The paper's claim.** {self.figure.claim}")
        note = [fill(self.note, self.value).strip()]
        picture = [f"![{self.name}]({self.name}.png)"] if self.results else []
        parts += [*picture, *note] if self.figure.claim else [*note, *picture]
        if self.missing:
            curves = [
                x for panel in self.figure.panels.values() for x in panel.values()
            ]
            total = sum(curve.seeds for curve in curves)
            parts.append(f"Not trained yet: {self.missing} of {total} runs.")
        if self.results:
            parts += [_READING.format(len(self.comparisons)), "## Settings"]
            parts.append(self.settings())
        return "\n\n".join(parts) + "\n"

    def write(self, results: pathlib.Path) -> None:
        """Write the page and its plot."""
        results.mkdir(parents=True, exist_ok=True)
        if self.results:
            save_png(_draw(self), results / f"{self.name}.png")
        with output_file.whole(results / f"{self.name}.md") as partial:
            partial.write_text(self.text())


def fill(note: str, value: Callable[..., str]) -> str:
    """Fill the slots of a note, {{NAME ARGUMENTS}}, with what `value` returns."""
    return re.sub(r"{{(.+?)}}", lambda x: value(*shlex.split(x[1])), note)


def _colors(curves: Sequence[str]) -> dict[str, Any]:
    """Return a color for each label: fixed for agents, dark to light for values."""
    import matplotlib

    if set(curves) & set(AGENTS):
        return dict(
            zip(dict.fromkeys([*AGENTS, *curves]), plotting.COLORS, strict=False)
        )
    shades = matplotlib.colormaps["viridis"](np.linspace(0.0, 0.9, len(curves)))
    return dict(zip(curves, shades, strict=True))


def _draw(page: Page) -> Any:
    """Return a matplotlib figure with axes for each panel."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    count = len(page.results)
    # Four in a square: no panel is alone in its row.
    columns = min({4: 2}.get(count, 4 if count > 6 else 3), count)
    rows = math.ceil(count / columns)
    size = (3.6 * columns, 2.8 * rows)
    figure, grid = plt.subplots(
        rows, columns, figsize=size, layout="constrained", squeeze=False
    )
    for axes in grid.flat[count:]:
        axes.set_visible(False)
    for axes, panel in zip(grid.flat, page.results, strict=False):
        (_draw_over if page.figure.over else _draw_curves)(page, panel, axes)
        axes.set_title(panel)
        if axes.get_lines():
            axes.legend(frameon=False, fontsize=7)
    for row in grid:
        row[0].set_ylabel("episode return")
    return figure


def _draw_curves(page: Page, panel: str, axes: Any) -> None:
    """Learning curves: interquartile mean and 95% interval over seeds."""
    color_of = _colors(list(page.figure.panels[panel]))
    for label, results in page.results[panel].items():
        # As coarse as the coarsest record.
        steps = min((record.env_steps for record in results.records), key=len)
        returns = np.array(
            [np.interp(steps, x.env_steps, x.episode_return) for x in results.records]
        )
        finite = np.isfinite(returns).all(axis=0)
        if finite.any():
            color = color_of[label]
            steps, returns = steps[finite] / 1e6, returns[:, finite]
            low, high = bootstrap_interval(returns, resamples=500)
            axes.fill_between(steps, low, high, color=color, alpha=0.2, linewidth=0)
            axes.plot(steps, interquartile_mean(returns, 0), color=color, label=label)
    axes.set_xlabel("million steps")


def _draw_over(page: Page, panel: str, axes: Any) -> None:
    """Final returns over the number of environments: a line for each agent and ages."""
    lines = [(agent, drawn) for agent in PAIR for drawn in AGES]
    for i, (agent, drawn) in enumerate(lines):
        names = {n: geometry_curve(agent, drawn, n) for n in GEOMETRY_NUM_ENVS}
        complete = [n for n in names if (panel, names[n]) in page.scores]
        if not complete:
            continue
        scores = [page.scores[panel, names[n]] for n in complete]
        middle = np.array([interquartile_mean(x) for x in scores])
        low, high = np.array([bootstrap_interval(x) for x in scores]).T
        # Shifted sideways, so that no interval hides another.
        steps = np.array(complete) * 1.06 ** (i - 1.5)
        axes.errorbar(
            steps,
            middle,
            [middle - low, high - middle],
            color=plotting.COLORS[PAIR.index(agent)],
            linestyle="-" if drawn else "--",
            **{"marker": "o", "markersize": 3, "capsize": 2},
            label=f"{agent}, ages {AGES[drawn].replace('-', ' ')}",
        )
    axes.set(xlabel="environments", xscale="log", xlim=(0.7, 180.0))
    axes.set_xticks(GEOMETRY_NUM_ENVS, [str(n) for n in GEOMETRY_NUM_ENVS])
    axes.minorticks_off()


def save_png(figure: Any, path: pathlib.Path, dpi: int = 80) -> None:
    """Write a small PNG, of 256 colors, and close the figure."""
    import matplotlib.pyplot as plt
    from PIL import Image

    with io.BytesIO() as buffer:
        figure.savefig(buffer, format="png", dpi=dpi)
        plt.close(figure)
        image = Image.open(buffer).convert("RGB").quantize(256)
    path.parent.mkdir(parents=True, exist_ok=True)
    with output_file.whole(path) as partial:
        image.save(partial, optimize=True)

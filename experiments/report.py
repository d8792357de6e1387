"""Statistics, tables, plots and pages, all made from the stored runs.

A page is ``notes/NAME.md`` with its slots, {{NAME ARGUMENTS}}, filled in. Verdicts are
corrected for the number of comparisons of their page by Holm's method.
"""

import contextlib
import csv
import dataclasses
import functools
import io
import itertools
import math
import pathlib
import re
import shlex
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import matplotlib
import matplotlib.figure
import numpy as np
from PIL import Image

from experiments.figures import FIGURES, Comparisons, Curve, Figure, name_of
from experiments.search import AGENTS, DELAY, TASKS, importance
from experiments.store import Record, Run, Store
from gasil_jax.config import Config
from gasil_jax.errors import InputError
from gasil_jax.figures import plotting
from gasil_jax.figures.statistics import bootstrap_interval, interquartile_mean
from gasil_jax.host import output_file

NOTES = pathlib.Path(__file__).parent / "notes"
#: Others' mean returns after about 1M steps, each with the file that it stands in.
PUBLISHED = pathlib.Path(__file__).parent / "published.csv"
#: The probability that any verdict of a page is wrong, at most.
LEVEL = 0.05
_DRAWS = 10_000
#: Fewer seeds have no interval, because it would be far too narrow, and no verdict.
_FEWEST_SEEDS = 5
_VERDICTS = ("better", "not clear", "worse")
#: Scores, (seeds,), by panel and curve.
Scores = Mapping[tuple[str, str], np.ndarray]

_READING = """## How to read this

A final return is the interquartile mean over seeds of the mean return over the last
tenth of training, of the episodes that the acting policy ended; in brackets a 95%
interval, the percentile bootstrap's over seeds, which is a little too narrow for ten.
Better, worse and not clear are verdicts on differences, corrected by Holm's method for
the {} comparisons of this page: the chance that any of them is wrong is 5%. The
probability of improvement is that of a seed of one curve having more than a seed of the
other, averaged over the tasks."""


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
    rng = np.random.default_rng(zlib.crc32(name.encode()))
    rows = rng.integers(len(scores), size=(_DRAWS, len(scores)))
    return interquartile_mean(np.array(scores)[rows], axis=1)


def draws(scores: Scores, panel: str, curve: str) -> np.ndarray:
    """Return interquartile means of bootstrap samples of a curve's seeds: (draws,)."""
    return _draws(f"{panel}/{curve}", tuple(scores[panel, curve].tolist()))


def compare(scores: Scores, family: Comparisons) -> dict[tuple[str, ...], Comparison]:
    """Return the differences of interquartile means whose curves all have scores.

    The p-value is the percentile bootstrap's: the share of draws on the other side of
    0, times two. In Holm's method the smallest is multiplied by the number of
    comparisons, the next by one less, and none is smaller than the one before.
    """
    raw = {}
    for key, terms in family.items():
        if not all((panel, curve) in scores for _, panel, curve in terms):
            continue
        sides = [scores[panel, curve] for _, panel, curve in terms]
        drawn = np.sum([w * draws(scores, *curve) for w, *curve in terms], axis=0)
        middle = sum(w * float(interquartile_mean(scores[p, c])) for w, p, c in terms)
        low, high = map(float, np.percentile(drawn, [2.5, 97.5]))
        beyond = min(int((drawn <= 0).sum()), int((drawn >= 0).sum()))
        enough = all(len(x) >= _FEWEST_SEEDS and np.isfinite(x).all() for x in sides)
        p_value = min(1.0, 2 * (1 + beyond) / (1 + _DRAWS)) if enough else 1.0
        raw[key] = Comparison(middle, low, high, p_value)
    corrected, least = {}, 0.0
    for i, key in enumerate(sorted(raw, key=lambda key: raw[key].p)):
        least = max(least, min(1.0, raw[key].p * (len(raw) - i)))
        corrected[key] = dataclasses.replace(raw[key], p=least)
    return {key: corrected[key] for key in raw}


def improvement(scores: Scores, panels: Sequence[str], ours: str, other: str) -> str:
    """Return the probability of improvement over the panels, in words.

    It is the probability that a seed of `ours` has more than one of `other`, in the
    mean over the panels, with the 95% percentile bootstrap interval over seeds, drawn
    within each panel (Agarwal et al. 2021).
    """
    rng = np.random.default_rng(zlib.crc32(f"{ours}/{other}".encode()))

    def probability(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        more, same = (
            a[..., :, None] > b[..., None, :],
            a[..., :, None] == b[..., None, :],
        )
        return (more + 0.5 * same).mean(axis=(-1, -2))

    def resampled(values: np.ndarray) -> np.ndarray:
        return values[rng.integers(len(values), size=(_DRAWS // 10, len(values)))]

    pairs = [(scores[panel, ours], scores[panel, other]) for panel in panels]
    middle = np.mean([probability(*pair) for pair in pairs])
    drawn = [probability(*map(resampled, pair)) for pair in pairs]
    low, high = np.percentile(np.mean(drawn, axis=0), [2.5, 97.5])
    return f"{middle:.2f} [{low:.2f}, {high:.2f}]"


def counted(verdicts: Sequence[str]) -> str:
    """Return how often there is each verdict, in words."""
    words = [word for word in _VERDICTS if word in verdicts]
    return ", ".join(f"{word} on {verdicts.count(word)}" for word in words)


def number(value: float) -> str:
    """Return a score as text, without decimals from 100 on."""
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.1f}"


def in_words(middle: float, low: float, high: float) -> str:
    """Return a number and its interval as text."""
    return f"{number(middle)} [{number(low)}, {number(high)}]"


def interval(scores: np.ndarray) -> str:
    """Return interquartile mean and 95% interval of (seeds,); of few seeds the mean."""
    middle = float(interquartile_mean(scores))
    if len(scores) < _FEWEST_SEEDS:
        return number(middle)
    return in_words(middle, *map(float, bootstrap_interval(scores)))


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table in Markdown; without rows nothing."""
    lines = [head, ["---"] * len(head), *rows]
    if len(lines) == 2:
        return ""
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def point_in_words(point: Mapping[str, Any]) -> str:
    """Return changed settings as "name value, name value"."""
    words = lambda value: f"{value:g}" if type(value) in (int, float) else f"{value}"
    return ", ".join(f"{name} {words(value)}" for name, value in point.items())


def changed(config: Config) -> dict[str, Any]:
    """Return the settings of a config that are not the defaults."""
    default = Config(agent=config.agent)
    values = lambda config: {**vars(config), **vars(config.hyperparameters)}
    mine, defaults = values(config), values(default)
    names = [name for name in mine if name not in ("hyperparameters", "total_steps")]
    return {name: mine[name] for name in names if mine[name] != defaults[name]}


@dataclasses.dataclass(frozen=True)
class Results:
    """The stored runs of a curve, of all or only a part of its seeds."""

    curve: Curve
    point: Mapping[str, Any]
    records: Mapping[Run, Record]

    @property
    def complete(self) -> bool:
        """Whether the runs of all seeds are stored."""
        return len(self.records) == self.curve.seeds

    @property
    def seeds(self) -> str:
        """How many seeds there are, in words."""
        of = "" if self.complete else f" of {self.curve.seeds}"
        return f"{len(self.records)}{of}"

    @property
    def final(self) -> np.ndarray:
        """The final returns, (seeds,)."""
        return np.array([record.final for record in self.records.values()])

    def provenance(self) -> str:
        """Return physics, versions, devices and commits of the seeds, in words."""
        seeds_of: dict[str, list[int]] = {}
        for run, record in self.records.items():
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
    """Return increasing numbers in words: 0 to 4, 7."""
    steps = [i for i in range(1, len(numbers)) if numbers[i] > numbers[i - 1] + 1]
    runs = [numbers[i:j] for i, j in itertools.pairwise([0, *steps, len(numbers)])]
    return ", ".join(f"{x[0]} to {x[-1]}" if len(x) > 1 else f"{x[0]}" for x in runs)


class Page:
    """The page of a figure; `SLOTS` names the methods that slots of its note may name.

    Args:
      name: name of the figure.
      store: store of its runs.
      searched: store of the searches' runs; default the same.
      figure: a figure without a note to use instead of the one of that name.
    """

    SLOTS = (
        *("table", "differences", "tally", "aggregate"),
        *("searches", "importance", "published"),
    )

    def __init__(
        self,
        name: str,
        store: Store,
        searched: Store | None = None,
        figure: Figure | None = None,
    ):
        self.name, self.figure = name, figure or FIGURES[name]
        self.searched = searched or store
        self.note = "{{table}}" if figure else (NOTES / f"{name}.md").read_text()
        self.results: dict[tuple[str, str], Results] = {}
        self.scores: dict[tuple[str, str], np.ndarray] = {}
        for panel, label, curve in self.figure.curves():
            runs = [run for run in curve.runs(self.searched) if run in store]
            if not runs:
                continue
            point = curve.point(self.searched) or {}
            results = Results(curve, point, {run: store[run] for run in runs})
            self.results[panel, label] = results
            if results.complete:
                self.scores[panel, label] = results.final
                if self.figure.early is not None:
                    share = self.figure.early / curve.total_steps
                    early = [x.part(0.0, share) for x in results.records.values()]
                    self.scores[panel, f"{label} early"] = np.array(early)
        self.comparisons = compare(self.scores, self.figure.compared())

    def table(self) -> str:
        """Return the final returns: a row for each panel and curve."""
        favourite = self.figure.favourite
        head = ["task", "agent", "seeds", "final return"]
        head += [f"{favourite} ahead by", f"{favourite} is"] if favourite else []
        rows = []
        for (panel, label), results in self.results.items():
            cells = [panel, label, results.seeds, interval(results.final)]
            if favourite:
                rival = str(self.figure.rival(panel, label))
                against = self.comparisons.get((panel, rival, label))
                cells += [str(against), against.verdict] if against else ["", ""]
            rows.append(cells)
        return markdown_table(head, rows)

    def differences(self) -> str:
        """Return every comparison of the page, each in a line."""
        lines = []
        for (panel, ours, other, *less), comparison in self.comparisons.items():
            more = f", less that of {less[0]}" if less else ""
            difference = f"{comparison}, {comparison.verdict}"
            lines.append(f"- {panel}, {ours} - {other}{more}: {difference}.")
        return "\n".join(lines)

    def tally(self, *panels: str) -> str:
        """Return on how many panels the favourite is better than each other curve.

        Args:
          *panels: the panels; default all.
        """
        lines, panels = [], panels or tuple(self.figure.panels)
        for other in dict.fromkeys(x for p in panels for x in self.figure.panels[p]):
            with_other = [p for p in panels if other in self.figure.panels[p]]
            ours = str(self.figure.rival(with_other[0], other))
            complete = [p for p in with_other if (p, ours, other) in self.comparisons]
            if complete:
                verdicts = [self.comparisons[p, ours, other].verdict for p in complete]
                probability = improvement(self.scores, complete, ours, other)
                lines.append(
                    f"- {ours} against {other}: {counted(verdicts)} of "
                    f"{len(complete)}; probability of improvement {probability}."
                )
        return "\n".join(lines)

    def aggregate(self, unit: str = "ppo") -> str:
        """Return each curve's return over all tasks, in units of one dense curve's.

        A seed's return is divided by the interquartile mean of the curve `unit` in the
        panel of the same task with dense rewards. Then every task counts alike in the
        interquartile mean over all seeds of all tasks; its 95% interval is the
        percentile bootstrap's over seeds, drawn within each task. The curves must have
        scores on all of these tasks, dense or delayed.
        """
        dense: dict[str, list[str]] = {}
        for panel, curves in self.figure.panels.items():
            curve = next(iter(curves.values()))
            if (name_of(curve.env), unit) in self.scores:
                delayed = "delayed" if curve.reward_delay > 1 else "dense"
                dense.setdefault(delayed, []).append(panel)
        rows = []
        for kind, panels in dense.items():
            names = list(
                dict.fromkeys(x for p in panels for x in self.figure.panels[p])
            )
            for name in names:
                having = [panel for panel in panels if (panel, name) in self.scores]
                if having == panels:
                    rows.append(
                        [kind, name, f"{len(panels)}", self._over(panels, name, unit)]
                    )
        head = ["rewards", "agent", "tasks", f"return in units of dense {unit}'s"]
        return markdown_table(head, rows)

    def _over(self, panels: Sequence[str], name: str, unit: str) -> str:
        """Return the interquartile mean over panels, as `aggregate` says, in words."""
        of_panel = []
        for panel in panels:
            env = next(iter(self.figure.panels[panel].values())).env
            one = float(interquartile_mean(self.scores[name_of(env), unit]))
            of_panel.append(self.scores[panel, name] / one)
        most = math.lcm(*map(len, of_panel))
        rng = np.random.default_rng(zlib.crc32(name.encode()))
        drawn = []
        for _ in range(_DRAWS // 10):
            parts = [rng.choice(x, len(x)).repeat(most // len(x)) for x in of_panel]
            drawn.append(interquartile_mean(np.concatenate(parts)))
        low, high = np.percentile(drawn, [2.5, 97.5])
        every = np.concatenate([x.repeat(most // len(x)) for x in of_panel])
        return f"{float(interquartile_mean(every)):.2f} [{low:.2f}, {high:.2f}]"

    def searches(self) -> str:
        """Return the results of the figure's searches."""
        head = ["task", "points", "best point", "its mean", "median", "worst"]
        rows = []
        for name, search in self.figure.searches.items():
            points = search.points(self.searched)
            scores = search.scores(points, self.searched)
            best = search.best(self.searched)
            cells = ["not complete", "", "", ""]
            if scores is not None and best is not None:
                means = scores.mean(axis=1)
                values = (best[1].mean(), np.median(means), means.min())
                cells = [point_in_words(best[0]), *(f"{x:.0f}" for x in values)]
            rows.append([name, f"{len(points)}", *cells])
        return markdown_table(head, rows)

    def importance(self) -> str:
        """Return how much each hyperparameter matters to each agent."""
        shares = {x: importance(x, self.searched) for x in AGENTS}
        names = list(dict.fromkeys(name for x in shares.values() for name in x))
        rows = [
            [agent, *(f"{x[name]:.0%}" if name in x else "" for name in names)]
            for agent, x in shares.items()
            if x
        ]
        return markdown_table(["agent", *names], rows)

    def published(self, rewards: str, *names: str) -> str:
        """Return others' published returns beside those of some of our curves.

        Args:
          rewards: "dense" or "delayed".
          *names: our curves.
        """
        with PUBLISHED.open(newline="") as file:
            others = [row for row in csv.DictReader(file) if row["rewards"] == rewards]
        delay = DELAY if rewards == "delayed" else 1
        rows = []
        for name in names:
            ours = [self.scores.get((name_of(env, delay), name)) for env in TASKS]
            counts = sorted({len(x) for x in ours if x is not None})
            cells = ["" if x is None else interval(x) for x in ours]
            if counts:
                seeds = " or ".join(map(str, counts))
                rows.append([f"ours, {name}", "v5", seeds, *cells])
        columns = ("source", "tasks", "seeds", *TASKS)
        rows += [[row[column] for column in columns] for row in others]
        return markdown_table(columns, rows)

    def settings(self) -> str:
        """Return what each curve was trained with, beyond the appendix's values."""
        rows = []
        for names, results in self.results.items():
            config = next(iter(results.records)).config
            if isinstance(results.curve.base, str):
                words = point_in_words(changed(config))
            else:
                words = point_in_words(results.point)
                words += ", rewards normalized" if config.normalize_rewards else ""
            rows.append([*names, words, results.provenance()])
        head = ["task", "agent", "hyperparameters", "trained with"]
        return markdown_table(head, rows)

    def value(self, slot: str, *arguments: str) -> str:
        """Return what stands in a slot.

        Raises:
          InputError: if there is no such slot, or nothing to stand in it.
        """
        if slot in self.SLOTS:
            # Curves that are not complete, or wrong arguments, are reported below.
            with contextlib.suppress(KeyError, TypeError):
                return getattr(self, slot)(*arguments) or "Nothing is complete yet."
        raise InputError(
            f"slot is {shlex.join([slot, *arguments])} in {self.name}: it must be "
            f"one of {', '.join(self.SLOTS)}, of complete curves"
        )

    def text(self) -> str:
        """Return the page as Markdown."""
        parts = [f"# {self.figure.title}"]
        if self.figure.claim:
            parts.append(f"**The paper's claim.** {self.figure.claim}")
        note = [fill(self.note, self.value).strip()]
        picture = [f"![{self.name}]({self.name}.png)"] if self.results else []
        parts += [*picture, *note] if self.figure.claim else [*note, *picture]
        total = sum(curve.seeds for _, _, curve in self.figure.curves())
        stored = [len(results.records) for results in self.results.values()]
        if missing := total - sum(stored):
            parts.append(f"Not trained yet: {missing} of {total} runs.")
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


def fill_blocks(text: str, value: Callable[..., str]) -> str:
    """Replace what is between ``<!-- begin SLOT -->`` and ``<!-- end -->``."""
    block = re.compile(r"(<!-- begin (.+?) -->\n).*?(<!-- end -->)", re.DOTALL)
    return block.sub(lambda x: f"{x[1]}\n{value(*shlex.split(x[2]))}\n\n{x[3]}", text)


def _draw(page: Page) -> matplotlib.figure.Figure:
    """Return a plot with axes for each panel."""
    panels = list(dict.fromkeys(panel for panel, _ in page.results))
    count = len(panels)
    # Four panels are drawn in a square, so that none is alone in its row.
    columns = min({4: 2}.get(count, 4 if count > 6 else 3), count)
    rows = math.ceil(count / columns)
    size = (3.6 * columns, 2.8 * rows)
    figure = matplotlib.figure.Figure(figsize=size, layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False)
    for axes in grid.flat[count:]:
        axes.set_visible(False)
    for axes, panel in zip(grid.flat, panels, strict=False):
        (_draw_over if page.figure.over else _draw_curves)(page, panel, axes)
        axes.set_title(panel)
    shown = [axes.get_legend_handles_labels() for axes in grid.flat[:count]]
    handle_of = {
        name: x
        for handles, names in shown
        for x, name in zip(handles, names, strict=True)
    }
    if count > 1 and len(handle_of) > 4:
        # So many names would hide the curves.
        below: Any = {"loc": "outside lower center", "ncols": 4, "fontsize": 8}
        figure.legend([*handle_of.values()], [*handle_of], frameon=False, **below)
    else:
        for axes, (_, names) in zip(grid.flat, shown, strict=False):
            if names:
                axes.legend(frameon=False, fontsize=7)
    for row in grid:
        row[0].set_ylabel("episode return")
    return figure


def _colors(figure: Figure) -> dict[str, Any]:
    """Return the color of each curve's name, the same in all panels.

    An agent has the same in all figures. Values, and more names than there are colors,
    are dark to light.
    """
    names = list(dict.fromkeys(x for curves in figure.panels.values() for x in curves))
    if len(names) > len(plotting.COLORS) or all(map(str.isdecimal, names)):
        shades = matplotlib.colormaps["viridis"](np.linspace(0.0, 0.9, len(names)))
        return dict(zip(names, shades, strict=True))
    of_agent = dict(zip(AGENTS, plotting.COLORS, strict=False))
    color_of = {name: of_agent[name] for name in names if name in of_agent}
    free = (x for x in plotting.COLORS if x not in color_of.values())
    return {name: color_of.get(name) or next(free) for name in names}


def _draw_curves(page: Page, panel: str, axes: Any) -> None:
    """Draw learning curves: interquartile mean and 95% interval over seeds."""
    color_of = _colors(page.figure)
    for label in page.figure.panels[panel]:
        if (panel, label) not in page.results:
            continue
        records = list(page.results[panel, label].records.values())
        # Returns are compared at the steps of the record with the fewest rows.
        steps = min((record.env_steps for record in records), key=len)
        returns = np.array(
            [np.interp(steps, x.env_steps, x.episode_return) for x in records]
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
    """Draw final returns over a setting: a line for the curves that differ in it."""
    curves = page.figure.panels[panel]
    lines: dict[str, dict[Any, str]] = {}
    for name in curves:
        line, value = page.figure.point_of(panel, name)
        lines.setdefault(line, {})[value] = name
    values = sorted({value for points in lines.values() for value in points})
    agents = list(dict.fromkeys(curve.agent for curve in curves.values()))
    drawn: list[str] = []
    for i, (line, points) in enumerate(lines.items()):
        complete = [x for x in points if (panel, points[x]) in page.scores]
        agent = next(curves[name].agent for name in points.values())
        style = ("-", "--", ":", "-.")[drawn.count(agent) % 4]
        drawn.append(agent)
        if not complete:
            continue
        scores = [page.scores[panel, points[x]] for x in complete]
        middle = np.array([interquartile_mean(x) for x in scores])
        low, high = np.array([bootstrap_interval(x) for x in scores]).T
        axes.errorbar(
            # Shifted sideways, so that no interval hides another.
            np.array(complete) * 1.06 ** (i - (len(lines) - 1) / 2),
            middle,
            [middle - low, high - middle],
            color=plotting.COLORS[agents.index(agent) % len(plotting.COLORS)],
            linestyle=style,
            **{"marker": "o", "markersize": 3, "capsize": 2},
            label=line,
        )
    _, label = page.figure.over or ("", "")
    limits = (0.7 * values[0], 1.4 * values[-1])
    axes.set(xlabel=label, xscale="log", xlim=limits)
    axes.set_xticks(values, list(map(str, values)))
    axes.minorticks_off()


def save_png(
    figure: matplotlib.figure.Figure, path: pathlib.Path, dpi: int = 80
) -> None:
    """Write a small PNG, of 256 colors."""
    with io.BytesIO() as buffer:
        figure.savefig(buffer, format="png", dpi=dpi)
        image = Image.open(buffer).convert("RGB").quantize(256)
    path.parent.mkdir(parents=True, exist_ok=True)
    with output_file.whole(path) as partial:
        image.save(partial, optimize=True)

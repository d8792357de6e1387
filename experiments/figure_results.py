"""The stored runs of a figure, what they return, and how they compare."""

import dataclasses
import functools
import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from experiments import comparisons, doing_nothing
from experiments.comparisons import Comparison, Scores, Sides
from experiments.curves import Comparisons, Curve, Figure
from experiments.store import Record, Store
from gasil_jax.host.runs import Run
from gasil_jax.statistics import interquartile_mean


@dataclasses.dataclass(frozen=True)
class CurveResults:
    """The stored runs of a curve, which may be only some of its seeds."""

    curve: Curve
    records: Mapping[Run, Record]

    @property
    def complete(self) -> bool:
        """Whether the runs of all seeds are stored."""
        return len(self.records) == self.curve.seeds

    @property
    def final(self) -> np.ndarray:
        """The final returns, (seeds,)."""
        return np.array([record.final for record in self.records.values()])

    @property
    def evaluated(self) -> np.ndarray:
        """The mean returns of the last policies' mean actions, (evaluated seeds,)."""
        evaluations = [record.evaluation_return for record in self.records.values()]
        return np.array([returns[-1] for returns in evaluations if len(returns)])

    def steps_until(self, success: float) -> np.ndarray:
        """Return `steps_until_solved` of each seed, (seeds,)."""
        return np.array([steps_until_solved(x, success) for x in self.records.values()])

    def provenance(self) -> str:
        """Return physics, versions, devices and commits of the seeds as text."""
        seeds_of: dict[str, list[int]] = {}
        for run, record in self.records.items():
            by = record.provenance
            jax = (by["versions"] or {}).get("jax")
            source = f"collected at {by.get('collected_at') or '?'}"
            if by["commit"]:
                checked = {True: "", False: ", changed", None: ", not compared"}
                source = f"commit {by['commit']}{checked[by['clean']]}"
            words = [by["physics"], jax and f"jax {jax}", by["device"], source]
            seeds_of.setdefault(", ".join(filter(None, words)), []).append(run.seed)
        if len(seeds_of) == 1:
            return next(iter(seeds_of))
        return "; ".join(
            f"seeds {_ranges(x)}: {words}" for words, x in seeds_of.items()
        )


def _ranges(numbers: Sequence[int]) -> str:
    """Return increasing numbers as text, such as "0 to 4, 7"."""
    steps = [i for i in range(1, len(numbers)) if numbers[i] > numbers[i - 1] + 1]
    runs = [numbers[i:j] for i, j in itertools.pairwise([0, *steps, len(numbers)])]
    return ", ".join(f"{x[0]} to {x[-1]}" if len(x) > 1 else f"{x[0]}" for x in runs)


def steps_until_solved(record: Record, success: float) -> float:
    """Return the steps until half of a success's return; infinite if it ends below."""
    if not record.final >= success / 2:
        return math.inf
    return float(record.env_steps[(record.episode_return >= success / 2).argmax()])


class Row(NamedTuple):
    """A line of a forest plot: what is compared, and the verdicts on single panels."""

    name: str
    compared: Comparison
    verdicts: Mapping[str, str]


#: A mean over tasks and the ends of its interval, by curve.
Whole = dict[str, tuple[float, float, float]]


#: The families of tasks that are aggregated: their kinds, by title.
FAMILIES: Mapping[str, str] = {
    "dense": "dense",
    "delayed by 20 steps": "delayed",
    "delayed by 100 steps": "delayed 100",
    "gymnax and point mass": "others",
    "sparse mazes, grids, car": "",
    "noisy mazes and grids": "noisy",
    "sparse robots": "robots",
    "noisy sparse robots": "robots noisy",
    "DoorKey": "navix",
}


class Results:
    """The stored runs of a figure; `searched` is the store of the searches' runs.

    Attributes:
      name: name of the figure.
      curves: the curves of which runs are stored, by panel and name.
      scores: the final returns of the complete ones, and what they return early; where
        tasks are either solved or not, whether each seed solves it.
      sooner: where tasks are either solved or not, minus the steps until then.
      comparisons: the figure's comparisons of these scores.
    """

    def __init__(
        self, name: str, figure: Figure, store: Store, searched: Store | None = None
    ):
        self.name, self.figure, self.searched = name, figure, searched or store
        self.curves: dict[tuple[str, str], CurveResults] = {}
        self.scores: dict[tuple[str, str], np.ndarray] = {}
        self.sooner: dict[tuple[str, str], np.ndarray] = {}
        # Pages draw them, list them and name single ones.
        self._forests: dict[tuple[str, bool], list[Row]] = {}
        self._wholes: dict[str, Whole] = {}
        for panel, label, curve in figure.curves():
            runs = [run for run in curve.runs(self.searched) if run in store]
            if not runs:
                continue
            results = CurveResults(curve, {run: store[run] for run in runs})
            self.curves[panel, label] = results
            if results.complete:
                self._add_scores(panel, label, results)

    def _add_scores(self, panel: str, label: str, one: CurveResults) -> None:
        figure = self.figure
        self.scores[panel, label] = one.final
        if figure.solved_from is not None:
            steps = one.steps_until(figure.solved_from(one.curve.env))
            self.scores[panel, label] = np.isfinite(steps)
            self.sooner[panel, label] = -steps
        if figure.early is not None:
            share = figure.early / one.curve.total_steps
            early = [x.part(0.0, share) for x in one.records.values()]
            self.scores[panel, f"{label} early"] = np.array(early)

    @functools.cached_property
    def comparisons(self) -> dict[tuple[str, ...], Comparison]:
        """The figure's comparisons, corrected family by family."""
        dropped = self.figure.dropped_pairs * len(self.figure.panels)
        compared: dict[tuple[str, ...], Comparison] = {}
        for family in self.figure.families():
            if self.figure.solved_from is None:
                compared |= comparisons.compare(self.scores, family, dropped)
                continue
            sides = {key: self._sides(self.scores, key) for key in family}
            effects = {key: comparisons.lead("", [x]) for key, x in sides.items() if x}
            compared |= comparisons.judged(effects, dropped)
        terms = self._terms
        return {
            key: dataclasses.replace(
                one, below=all(self._is_below(*x) for _, *x in terms[key])
            )
            for key, one in compared.items()
        }

    @functools.cached_property
    def _terms(self) -> Comparisons:
        return self.figure.compared()

    def _sides(self, scores: Scores, key: tuple[str, ...]) -> Sides | None:
        """Return the scores of a comparison's two curves, or None if any lack."""
        found = [scores.get((panel, name)) for _, panel, name in self._terms[key]]
        ours, other = found
        return None if ours is None or other is None else (ours, other)

    def _is_below(self, panel: str, label: str) -> bool:
        """Return whether a curve is known to return less than doing nothing."""
        floor = doing_nothing.of(self.figure, panel)
        if floor is None:
            return False
        return float(interquartile_mean(self.scores[panel, label])) < floor.mean

    def scale(self, env: str) -> tuple[float, float]:
        """Return the returns that count as 0, at the start, and as 1, of the best."""
        own = [x for x in self.curves.values() if x.complete and x.curve.env == env]
        first = np.array([y.first for x in own for y in x.records.values()])
        start = float(interquartile_mean(first[np.isfinite(first)]))
        return start, max(float(interquartile_mean(x.final)) for x in own)

    def whole(self, kind: str = "") -> Whole:
        """Return each curve's mean over `measured` panels, if it is complete on these.

        Where tasks are either solved or not, it is the share of seeds, else the
        interquartile mean of scores, which are returns on `scale`. There is no mean of
        panels that share a task, and none of two curves alone.
        """
        if kind not in self._wholes:
            whole = self._whole(self.measured(kind))
            self._wholes[kind] = whole if len(whole) > 2 else {}
        return self._wholes[kind]

    def measured(self, kind: str = "") -> list[str]:
        """Return the panels where all is complete that is shown in panels of a kind."""
        figure, panels = self.figure, self.figure.of_kind(kind)
        own = {figure.favourite, *figure.shown}
        own = own.intersection(*(figure.panels[panel] for panel in panels))
        return [p for p in panels if own and all((p, x) in self.scores for x in own)]

    def _whole(self, panels: Sequence[str]) -> Whole:
        figure, scores, whole = self.figure, self.scores, Whole()
        envs = [next(iter(figure.panels[x].values())).env for x in panels]
        if figure.over or len(set(envs)) < len(envs):
            return whole
        names = [
            name
            for name in figure.names(panels)
            if all((p, name) in scores for p in panels)
        ]
        if figure.solved_from is not None:
            return {
                x: comparisons.mean_share([scores[p, x] for p in panels]) for x in names
            }
        scales = [self.scale(env) for env in envs] if names else []
        for name in names:
            # Where nothing is learned, there is nothing to be compared.
            relative = [
                (scores[panel, name] - start)
                / (best - start if best > start else np.inf)
                for panel, (start, best) in zip(panels, scales, strict=True)
            ]
            whole[name] = comparisons.over_tasks(name, relative)
        return whole

    def pairs(self, kind: str = "") -> dict[tuple[str, str], list[str]]:
        """Return the pairs that are compared on panels of a kind, each with these."""
        on: dict[tuple[str, str], list[str]] = {}
        panels = self.figure.of_kind(kind)
        for panel, ours, other, *_ in self.comparisons:
            if panel in panels:
                on.setdefault((ours, other), []).append(panel)
        return on

    @property
    def is_of_one_task(self) -> bool:
        """Whether all panels are of one task, so that returns have one unit."""
        return len({curve.env for *_, curve in self.figure.curves()}) == 1

    def forest(self, kind: str = "", sooner: bool = False) -> list[Row]:
        """Return what is compared on panels of a kind, a row for each pair of curves.

        On one task it is the difference of final returns. Over several tasks it is the
        probability of improvement, less one half, or the difference of the shares of
        seeds that solve a task; with `sooner` how often ours solves it sooner, less one
        half. These rows are a family of tests. Panels where both curves return less
        than doing nothing do not count.
        """
        if (kind, sooner) not in self._forests:
            self._forests[kind, sooner] = self._forest(kind, sooner)
        return self._forests[kind, sooner]

    def _forest(self, kind: str, sooner: bool) -> list[Row]:
        if self.is_of_one_task:
            return [
                Row(row_name(*key), one, {}) for key, one in self.comparisons.items()
            ]
        test: Any = comparisons.improvement
        if self.figure.solved_from is not None and not sooner:
            test = comparisons.lead
        scores = self.sooner if sooner else self.scores
        pairs, effects = self.pairs(kind), {}
        for pair, panels in pairs.items():
            keys = [(panel, *pair) for panel in panels]
            keys = [key for key in keys if not self.comparisons[key].below]
            if sides := [x for x in (self._sides(scores, key) for key in keys) if x]:
                effects[pair] = test("/".join(pair), sides)
        every = comparisons.judged(effects, self.figure.dropped_pairs)
        return [
            Row(
                row_name("", *pair),
                one,
                {x: self.comparisons[x, *pair].verdict for x in pairs[pair]},
            )
            for pair, one in every.items()
        ]

    def measure(self, sooner: bool = False) -> tuple[str, float]:
        """Return what `forest` measures in words, and the value of no difference."""
        if self.is_of_one_task:
            return "difference of final returns", 0.0
        if self.sooner and not sooner:
            return "difference of shares that solve a task", 0.0
        return (
            f"probability that the first {'is sooner' if sooner else 'returns more'}",
            0.5,
        )

    def ahead(self, kind: str = "") -> dict[str, Comparison]:
        """Return how likely the favourite returns more, or is sooner, by curve."""
        rows = self.forest(kind, sooner=bool(self.sooner))
        by_name, ours = {x.name: x.compared for x in rows}, self.figure.favourite
        others = {x: row_name("", ours, x) for x in self.figure.names()}
        return {x: by_name[name] for x, name in others.items() if name in by_name}


def families(pages: Sequence[Results]) -> dict[str, tuple[Results, str]]:
    """Return the families of figures' tasks of which runs are stored, by title."""
    shown = {}
    for results in pages:
        for title, kind in FAMILIES.items():
            if (kind or results.figure.solved_from) and results.whole(kind):
                own, every = results.measured(kind), results.figure.of_kind(kind)
                some = f", {len(own)} of {len(every)} tasks" * (own != every)
                shown[title + some] = results, kind
    return shown


def arms(pages: Sequence[Results]) -> list[str]:
    """Return the names of figures' curves, each once, those first that are shown."""
    names = [(*one.figure.shown, *one.figure.names()) for one in pages]
    return list(dict.fromkeys(itertools.chain(*names)))


def row_name(panel: str, ours: str, other: str, less: str = "") -> str:
    """Return what a comparison compares."""
    before = f"{panel}: " if panel else ""
    return f"{before}{ours} − {other}" + (f", less {less}'s" if less else "")

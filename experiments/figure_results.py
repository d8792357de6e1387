"""The stored runs of a figure, what they return, and how they compare."""

import dataclasses
import functools
import itertools
from collections.abc import Mapping, Sequence

import numpy as np

from experiments import doing_nothing, shares
from experiments.comparisons import Comparison, Scores, compare
from experiments.curves import Curve, Figure
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


class Results:
    """The stored runs of a figure; `searched` is the store of the searches' runs.

    Attributes:
      curves: the curves of which runs are stored, by panel and name.
      scores: the final returns of the complete ones, and what they return early.
      comparisons: the figure's comparisons of these scores.
    """

    def __init__(self, figure: Figure, store: Store, searched: Store | None = None):
        self.figure, self.searched = figure, searched or store
        self.curves: dict[tuple[str, str], CurveResults] = {}
        self.scores: dict[tuple[str, str], np.ndarray] = {}
        for panel, label, curve in figure.curves():
            runs = [run for run in curve.runs(self.searched) if run in store]
            if not runs:
                continue
            results = CurveResults(curve, {run: store[run] for run in runs})
            self.curves[panel, label] = results
            if results.complete:
                self.scores[panel, label] = results.final
                if figure.early is not None:
                    share = figure.early / curve.total_steps
                    early = [x.part(0.0, share) for x in results.records.values()]
                    self.scores[panel, f"{label} early"] = np.array(early)
        self.comparisons = self.compare(self.scores)

    def compare(self, scores: Scores) -> dict[tuple[str, ...], Comparison]:
        """Return the figure's comparisons of scores, corrected family by family."""
        dropped = self.figure.dropped_pairs * len(self.figure.panels)
        compared: dict[tuple[str, ...], Comparison] = {}
        for family in self.figure.families():
            compared |= compare(scores, family, dropped)
        if not self.figure.floor:
            return compared
        terms = self.figure.compared()
        return {
            key: dataclasses.replace(
                one, below=all(self._is_below(scores, *x) for _, *x in terms[key])
            )
            for key, one in compared.items()
        }

    def _is_below(self, scores: Scores, panel: str, label: str) -> bool:
        """Return whether a curve returns less than doing nothing on its task."""
        floor = doing_nothing.stored()[self.figure.panels[panel][label].env].mean
        return float(interquartile_mean(scores[panel, label])) < floor

    @functools.cached_property
    def steps(self) -> shares.Steps:
        """The steps until seeds solve their tasks, of complete curves."""
        from_ = self.figure.solved_from
        assert from_ is not None
        return {
            key: np.array(
                [
                    shares.steps_until_solved(record, from_(results.curve.env))
                    for record in results.records.values()
                ]
            )
            for key, results in self.curves.items()
            if results.complete
        }

    @functools.cached_property
    def solved(self) -> shares.Solved:
        """Which seeds solve their task, of complete curves."""
        return {key: np.isfinite(steps) for key, steps in self.steps.items()}

"""The pages of figures with their tables and plots, made from the stored runs.

A page is the text of ``notes/NAME.md`` with its slots, {{NAME ARGUMENTS}}, filled in.
"""

import csv
import dataclasses
import functools
import inspect
import itertools
import pathlib
import re
import shlex
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from experiments import doing_nothing, plots, point_mass_layouts, shares
from experiments.comparisons import (
    BELOW,
    FEWEST_SEEDS,
    Comparison,
    Scores,
    compare,
    counted,
    improvement,
    in_words,
    interval,
    judged,
    number,
    over_tasks,
)
from experiments.curves import Curve, Figure, name_of
from experiments.figures import FIGURES
from experiments.search import (
    AGENTS,
    BEYOND,
    CELLS,
    DELAY,
    PROTOCOL,
    SEEDS,
    SPACES,
    SPARSE,
    SPARSE_GRIDS,
    SPARSE_PROTOCOL,
    SPARSE_ROBOTS,
    TASKS,
    importance,
    mean_ranks,
)
from experiments.store import Record, Store
from gasil_jax.algorithms import Algorithm
from gasil_jax.errors import InputError
from gasil_jax.host import output_file
from gasil_jax.statistics import interquartile_mean
from gasil_jax.sweeps.runs import Run

NOTES = pathlib.Path(__file__).parent / "notes"
#: Mean returns that others have published, after about 1M steps, with their sources.
PUBLISHED = pathlib.Path(__file__).parent / "published.csv"

_READING = """## How to read this

- **Final return:** the mean, over the iterations of the last tenth of training, of the
  mean return of the episodes that end in an iteration, with the acting policy. The
  interquartile mean over seeds is shown and, in brackets, its 95% interval, by the
  percentile bootstrap over seeds, which covers a little less than 95% with ten seeds.
- **Evaluated:** the interquartile mean of the last policy's returns with its mean
  actions, without noise. A number in brackets says how many seeds were evaluated, where
  not all were.
- **Better, worse:** verdicts on differences, by a permutation test and the bootstrap
  together (differences of differences: by the bootstrap alone), corrected by Holm's
  method within a family of comparisons (here of {}). Dense and delayed rewards,
  normalized and raw ones, and comparisons among the paper's agents and others are
  separate families. If no two curves of a family differed, the chance of even one
  "better" or "worse" would be at most 5% (about 5% for differences of differences).
  Verdicts on evaluated returns are corrected on their own.
  All verdicts are about these settings: the intervals leave out that another search
  might have chosen others.
- **Not clear:** neither; it does not mean that two are equal.
- **Probability of improvement:** the probability that a random seed of the first curve
  has a higher return than a random seed of the second, where equal ones count half,
  averaged over the tasks."""

_SHARES = """## How to read this

- **A seed solves a task** if its final return is at least half of what makes an episode
  a success: half of 1, of 10 with a treasure, of 0.9 in deep sea, of 80 for the car, of
  500 for a robot, which is paid 1 a step. The final return is the mean, over the
  iterations of the last tenth of training, of the mean return of the episodes that end
  in an iteration, with the acting policy.
- **In brackets** are the thousands of steps until the mean return is that high, the
  median over the seeds that solve the task.
- **Sooner:** the probability that a random seed of the first curve solves its task in
  fewer steps than a random seed of the second, where equal ones count half and a seed
  that does not solve it comes last, averaged over tasks. Its verdict is that of a
  permutation of seeds within each task.
- **Better, worse:** on a task by Fisher's exact test, and on the mean over tasks by a
  permutation of seeds within each task, both corrected by Holm's method, the tasks and
  the means each as one family. The change that noise makes is judged by the bootstrap
  alone. Intervals are the bootstrap's over seeds, without correction.
- **Not clear:** neither; it does not mean that two are equal. A difference from the
  number in brackets on would have been found with a probability of four fifths."""


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table in Markdown, or an empty text if there are no rows."""
    lines = [head, ["---"] * len(head), *rows]
    if len(lines) == 2:
        return ""
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def point_in_words(point: Mapping[str, Any]) -> str:
    """Return changed settings as "name value, name value"."""

    def words(value: Any) -> Any:
        return f"{value:g}" if type(value) in (int, float) else f"{value}"

    return ", ".join(f"{name} {words(value)}" for name, value in point.items())


def changed(algorithm: Algorithm) -> dict[str, Any]:
    """Return the settings of an algorithm that differ from the defaults."""
    models = tuple(type(model)() for model in algorithm.rewards)
    defaults = Algorithm(type(algorithm.agent)(), models).settings
    # Without models of rewards, which are no default.
    defaults |= {model.switch: False for model in models}
    return {
        name: value
        for name, value in algorithm.settings.items()
        if name != "total_steps" and value != defaults[name]
    }


@dataclasses.dataclass(frozen=True)
class Results:
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


def _verdicts(
    comparisons: Mapping[tuple[str, ...], Comparison],
    panels: Sequence[str],
    pair: tuple[str, str],
) -> dict[str, str]:
    """Return the verdicts on a pair of curves by panel, where there are any."""
    compared = {panel: comparisons.get((panel, *pair)) for panel in panels}
    return {panel: x.verdict for panel, x in compared.items() if x}


class Page:
    """The page of a figure; `SLOTS` are the methods that slots in its text may name.

    Args:
      name: name of the figure.
      store: store of the figure's runs.
      searched: store of the searches' runs; default `store`.
      figure: a figure to use instead of the one with that name; its page is one table.
    """

    SLOTS = (
        *("table", "returns", "differences", "tally", "evaluated", "aggregate"),
        *("protocol", "grids", "searches", "importance", "ranks", "published"),
        *("passing", "shares", "lead", "sooner", "noise", "means", "better", "chosen"),
        *("points", "layouts", "apart", "final", "foretold"),
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
            results = Results(curve, {run: store[run] for run in runs})
            self.results[panel, label] = results
            if results.complete:
                self.scores[panel, label] = results.final
                if self.figure.early is not None:
                    share = self.figure.early / curve.total_steps
                    early = [x.part(0.0, share) for x in results.records.values()]
                    self.scores[panel, f"{label} early"] = np.array(early)
        self.comparisons = self._compared(self.scores)

    def _compared(self, scores: Scores) -> dict[tuple[str, ...], Comparison]:
        """Return the figure's comparisons of scores, corrected family by family."""
        families = self.figure.families()
        every = {k: x for one in families for k, x in compare(scores, one).items()}
        if not self.figure.floor:
            return every
        terms = self.figure.compared()
        return {
            key: dataclasses.replace(
                one, below=all(self._is_below(scores, *x) for _, *x in terms[key])
            )
            for key, one in every.items()
        }

    def _is_below(self, scores: Scores, panel: str, label: str) -> bool:
        """Return whether a curve returns less than doing nothing on its task."""
        floor = doing_nothing.stored()[self.figure.panels[panel][label].env].mean
        return float(interquartile_mean(scores[panel, label])) < floor

    def table(self) -> str:
        """Return the final returns: a row for each panel and curve."""
        favourite = self.figure.favourite
        head = ["task", "agent", "seeds", "final return", "evaluated"]
        head += [f"{favourite} ahead by", f"{favourite} is"] if favourite else []
        rows = []
        for (panel, label), results in self.results.items():
            count, evaluated = len(results.records), results.evaluated
            seeds = f"{count}" + f" of {results.curve.seeds}" * (not results.complete)
            cells = [panel, label, seeds, interval(results.final), ""]
            if len(evaluated):
                of = f" ({len(evaluated)})" * (len(evaluated) < count)
                cells[-1] = f"{number(float(interquartile_mean(evaluated)))}{of}"
            if favourite:
                rival = str(self.figure.rival(panel, label))
                against = self.comparisons.get((panel, rival, label))
                cells += [f"{against}", against.verdict] if against else ["", ""]
            rows.append(cells)
        if self.figure.floor:
            rows = [
                row
                for panel, own in itertools.groupby(rows, lambda row: row[0])
                for row in (*own, self._floor_row(panel, len(head)))
            ]
        return markdown_table(head, rows)

    def _floor_row(self, panel: str, columns: int) -> list[str]:
        """Return the row of a table about what doing nothing returns."""
        env = next(iter(self.figure.panels[panel].values())).env
        cells = [panel, "doing nothing", "", in_words(*doing_nothing.stored()[env])]
        return [*cells, *[""] * (columns - len(cells))]

    def returns(self, *panels: str) -> str:
        """Return final returns without intervals: a row per curve, a column per panel.

        Args:
          *panels: the panels.
        """
        if not panels or not set(panels) <= set(self.figure.panels):
            raise self._no_slot("returns", *panels)
        means = {
            key: number(float(interquartile_mean(scores)))
            for key, scores in self.scores.items()
        }
        rows = [
            [name, *(means.get((panel, name), "") for panel in panels)]
            for name in self.figure.names(panels)
        ]
        return markdown_table(["agent", *panels], rows)

    def differences(self) -> str:
        """Return all comparisons of the page, one per line."""
        lines = []
        for (panel, ours, other, *less), comparison in self.comparisons.items():
            more = f", less that of {less[0]}" if less else ""
            difference = f"{comparison}, {comparison.verdict}"
            lines.append(f"- {panel}, {ours} - {other}{more}: {difference}.")
        return "\n".join(lines)

    def tally(self, *panels: str) -> str:
        """Return on how many panels the favourite is better than each other curve.

        Args:
          *panels: the panels; or "delayed" or "dense", and "raw" for rewards that are
            not normalized; default all.
        """
        panels = self._chosen(*panels)
        if not panels:
            return ""
        return self._tally(self.scores, self.comparisons, panels)

    def _chosen(self, *panels: str) -> tuple[str, ...]:
        """Return the panels that `tally`'s arguments name."""
        if panels and panels[0] in ("delayed", "dense"):
            family = (panels[0] == "delayed", panels[1:] == ("raw",))
            return tuple(
                panel
                for panel, curves in self.figure.panels.items()
                if next(iter(curves.values())).family[:2] == family
            )
        if not set(panels) <= set(self.figure.panels):
            raise self._no_slot("tally", *panels)
        return panels or tuple(self.figure.panels)

    def better(self, rewards: str, ours: str, *others: str) -> str:
        """Return where a curve is better, and worse, than others, as half a sentence.

        Args:
          rewards: "delayed" or "dense"; empty for all panels.
          ours: the curve.
          *others: the curves it is compared with.
        """
        if rewards not in ("", "delayed", "dense"):
            raise self._no_slot("better", rewards, ours, *others)
        panels = self._chosen(*filter(None, [rewards]))
        names: dict[str, list[str]] = {}
        for other in others:
            on = [panel for panel in panels if other in self.figure.panels[panel]]
            verdicts = _verdicts(self.comparisons, on, (ours, other))
            measured = "" if len(verdicts) == len(on) else " measured"
            count = [*verdicts.values()].count
            less = [f"{x} on {count(x)}" for x in ("worse", BELOW) if count(x)]
            extra = f" ({', '.join(less)})" if less else ""
            tasks = f"{count('better')}{extra}"
            tasks += f" of {len(verdicts)}{measured} tasks"
            names.setdefault(tasks, []).append(other.upper())
        parts = [
            f"than {', '.join(x[:-1])} and {x[-1]} on {tasks} each"
            if len(x) > 1
            else f"than {x[0]} on {tasks}"
            for tasks, x in names.items()
        ]
        return f"better {', '.join(parts)}"

    def evaluated(self) -> str:
        """Return the tally of evaluated returns, which are a separate family of tests.

        They are the returns of the last policies' mean actions, over the seeds that
        were evaluated, if these are enough.
        """
        scores = {
            key: results.evaluated
            for key, results in self.results.items()
            if results.complete and len(results.evaluated) >= FEWEST_SEEDS
        }
        comparisons = self._compared(scores)
        return self._tally(scores, comparisons, lacking="without enough evaluations")

    def _tally(
        self,
        scores: Scores,
        comparisons: Mapping[tuple[str, ...], Comparison],
        panels: Sequence[str] = (),
        *,
        lacking: str = "not measured yet",
    ) -> str:
        lines, panels = [], panels or self._chosen()
        for other in self.figure.names(panels):
            on = [panel for panel in panels if other in self.figure.panels[panel]]
            ours = str(self.figure.rival(on[0], other))
            verdicts = _verdicts(comparisons, on, (ours, other))
            if verdicts:
                probability = improvement(scores, [*verdicts], ours, other=other)
                words = counted([*verdicts.values()])
                others = len(on) - len(verdicts)
                more = f", {others} {lacking}" if others else ""
                lines.append(
                    f"- {ours} against {other}: {words} of {len(verdicts)}"
                    f"{more}; probability of improvement {probability}."
                )
        return "\n".join(lines)

    def aggregate(self, unit: str = "ppo") -> str:
        """Return each curve's return over all tasks, relative to one dense curve's.

        A seed's return is divided by the interquartile mean of the curve `unit` in the
        panel of the same task with dense rewards. All tasks have the same weight in the
        interquartile mean over all seeds of all tasks. Its 95% interval is the
        percentile bootstrap's over seeds, drawn within each task; the unit is not
        resampled. A curve without scores on all of the tasks is left out.
        """
        panels_of: dict[str, list[str]] = {}
        unit_of, rows = {}, []
        for panel, curves in self.figure.panels.items():
            curve = next(iter(curves.values()))
            if (dense := (name_of(curve.env), unit)) in self.scores:
                kind = "delayed" if curve.reward_delay > 1 else "dense"
                panels_of.setdefault(kind, []).append(panel)
                unit_of[panel] = float(interquartile_mean(self.scores[dense]))
        for kind, panels in panels_of.items():
            for name in self.figure.names(panels):
                if all((panel, name) in self.scores for panel in panels):
                    relative = [self.scores[x, name] / unit_of[x] for x in panels]
                    words = over_tasks(name, relative)
                    rows.append([kind, name, f"{len(panels)}", words])
        head = ["rewards", "agent", "tasks", f"return in units of dense {unit}'s"]
        return markdown_table(head, rows)

    def grids(self) -> str:
        """Return a table of the searches' grids and the values beyond them."""
        rows = []
        for name, beyond in BEYOND.items():
            agents = [agent for agent in AGENTS if name in SPACES[agent]]

            def words(values: Any) -> Any:
                return ", ".join(f"{x:g}" for x in values if x is not None)

            grid = words(SPACES[agents[0]][name])
            who = "all" if len(agents) == len(AGENTS) else ", ".join(agents)
            rows.append([name, grid, words(beyond), who])
        return markdown_table(["hyperparameter", "grid", "beyond", "agents"], rows)

    def protocol(self) -> str:
        """Return the text that says how a search chooses its point."""
        return SPARSE_PROTOCOL if self.figure.solved_from else PROTOCOL

    def searches(self) -> str:
        """Return a table of the results of the figure's searches."""
        few = len(SEEDS)
        head = ["task", "points", "best point", "its mean (seeds)"]
        head += [f"all points' median of {few} seeds", "worst"]
        rows = []
        for name, search in self.figure.searches.items():
            points = search.points(self.searched)
            scores = search.scores(points, self.searched)
            best = search.best(self.searched)
            cells = ["not complete", "", "", ""]
            if scores is not None and best is not None:
                means = scores.mean(axis=1)
                mean = f"{best[1].mean():.0f} ({len(best[1])})"
                cells = [point_in_words(best[0]), mean]
                cells += [f"{x:.0f}" for x in (np.median(means), means.min())]
            rows.append([name, f"{len(points)}", *cells])
        return markdown_table(head, rows)

    def points(self, panel: str, name: str, seeds: str = "final") -> str:
        """Return the final returns of each point of a search, where all are stored.

        A row is a learning rate.

        Args:
          panel: the panel.
          name: the curve, whose search has a learning rate and an alpha.
          seeds: "final" for the curve's seeds, "search" for those of its search.
        """
        curve = self.figure.panels.get(panel, {}).get(name)
        search = curve and curve.search
        if curve is None or not search or seeds not in ("final", "search"):
            raise self._no_slot("points", panel, name, seeds)
        own = SEEDS if seeds == "search" else range(curve.seeds)
        rows: dict[str, list[str]] = {}
        points = search.points(self.searched)
        for point, runs in zip(points, search.runs(points, own)):
            if not all(run in self.searched for run in runs):
                return ""
            finals = np.array([self.searched[run].final for run in runs])
            row = rows.setdefault(f"{point['learning_rate']:g}", [])
            row.append(interval(finals))
        alphas = dict.fromkeys(f"alpha {point['alpha']:g}" for point in points)
        cells = [[rate, *row] for rate, row in rows.items()]
        head = f"{panel}, {len(own)} seeds; learning rate"
        return markdown_table([head, *alphas], cells)

    def apart(self, panel: str, ours: str, other: str) -> str:
        """Return a comparison of the page, or an empty text if curves are missing."""
        compared = self.comparisons.get((panel, ours, other))
        return f"{compared}, {compared.verdict}" if compared else ""

    def final(self, panel: str, name: str, seeds: str = "final") -> str:
        """Return a curve's final return.

        Args:
          panel: the panel.
          name: the curve.
          seeds: "final" for the curve's, "search" for what its search's seeds returned.
        """
        curve = self.figure.panels.get(panel, {}).get(name)
        if curve is None or seeds not in ("final", "search"):
            raise self._no_slot("final", panel, name, seeds)
        if seeds == "search":
            best = curve.search and curve.search.best(self.searched)
            return number(best[1].mean()) if best else ""
        scores = self.scores.get((panel, name))
        return "" if scores is None else interval(scores)

    def foretold(self, *words: str) -> str:
        """Return whether predicted verdicts came true, or that they are not measured.

        Args:
          *words: panel, curve, other curve and the predicted verdict, again and again.
        """
        true = []
        for panel, ours, other, verdict in zip(*[iter(words)] * 4, strict=True):
            if (panel, ours, other) not in self.figure.compared():
                raise self._no_slot("foretold", *words)
            if (compared := self.comparisons.get((panel, ours, other))) is None:
                return "not measured"
            true.append(compared.verdict == verdict)
        return "yes" if all(true) else f"{true.count(True)} of {len(true)}"

    def layouts(self) -> str:
        """Return in how many of the point mass' random layouts PPO+GASIL is ahead.

        It is ahead where the mean return of its best point is higher than PPO's.
        """
        leads = [lead for lead, _ in point_mass_layouts.leads()]
        ahead = sum(lead > 0 for lead in leads)
        return f"{ahead} of {len(leads)} ({ahead / len(leads):.1%})"

    def importance(self) -> str:
        """Return a table of how much each hyperparameter matters to each agent."""
        shares = {x: importance(x, self.searched) for x in AGENTS}
        names = list(dict.fromkeys(name for x in shares.values() for name in x))
        rows = [
            [agent, *(f"{x[name]:.0%}" if name in x else "" for name in names)]
            for agent, x in shares.items()
            if x
        ]
        return markdown_table(["agent", *names], rows)

    def ranks(self, name: str) -> str:
        """Return a table of the mean rank of a hyperparameter's values on each task.

        Args:
          name: the hyperparameter.
        """
        tasks = {
            name_of(*task): mean_ranks(name, *task, store=self.searched)
            for task in CELLS
        }
        values = sorted({value for of_task in tasks.values() for value in of_task})
        rows = [
            [task, *(f"{of_task[value]:.2f}" for value in values)]
            for task, of_task in tasks.items()
            if of_task
        ]
        return markdown_table([f"{name}:", *(f"{value:g}" for value in values)], rows)

    def published(self, rewards: str, *names: str) -> str:
        """Return a table of returns that others have published, and of our curves'.

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

    def passing(self, panel: str, threshold: str) -> str:
        """Return which share of each curve's seeds returns more than a threshold.

        Where some seeds learn a task and others don't, this says more than a mean.

        Args:
          panel: the panel.
          threshold: the return.
        """
        rows = []
        for name in self.figure.panels.get(panel, ()):
            if (panel, name) in self.scores:
                finals = self.scores[panel, name]
                count = int(np.sum(finals > float(threshold)))
                share = f"{count} of {len(finals)}"
                rows.append([name, f"{count / len(finals):.0%} ({share})"])
                rows[-1] += [interval(finals)]
        head = [panel, f"seeds above {threshold}", "interquartile mean"]
        return markdown_table(head, rows)

    @functools.cached_property
    def _steps(self) -> shares.Steps:
        """The steps until seeds solve their tasks, of complete curves."""
        from_ = self.figure.solved_from
        if from_ is None:
            raise self._no_slot("shares")
        return {
            key: np.array(
                [
                    shares.steps_until_solved(record, from_(results.curve.env))
                    for record in results.records.values()
                ]
            )
            for key, results in self.results.items()
            if results.complete
        }

    @functools.cached_property
    def _solved(self) -> shares.Solved:
        """Which seeds solve their task, of the curves that are complete."""
        return {key: np.isfinite(steps) for key, steps in self._steps.items()}

    def _sparse(self, kind: str) -> list[str]:
        """Return the panels of a kind of tasks.

        Args:
          kind: words: "noisy" for tasks with noise, "robots" or "navix" for those that
            are trained longer; default those without any of it.
        """

        def words(panel: str) -> set[str]:
            task = panel.removesuffix("_noisy")
            of = {
                "noisy": task != panel,
                "robots": task in SPARSE_ROBOTS,
                "navix": task in SPARSE_GRIDS,
            }
            return {word for word, holds in of.items() if holds}

        return [x for x in self.figure.panels if words(x) == set(kind.split())]

    def _compared_on(self, ours: str, kind: str) -> dict[tuple[str, str], list[str]]:
        """Return the panels on which two complete curves are compared, by these curves.

        Args:
          ours: the curve that is compared with each other one; empty for the figure's
            own comparisons.
          kind: the kind of tasks, see `_sparse`.
        """
        panels = self._sparse(kind)
        pairs = [key for key in self.figure.compared() if key[0] in panels]
        if ours:
            pairs = [(p, ours, x) for p in panels for x in self.figure.panels[p]]
        having: dict[tuple[str, str], list[str]] = {}
        for panel, first, second in pairs:
            both = {(panel, first), (panel, second)}
            if len(both) == 2 and both <= self._solved.keys():
                having.setdefault((first, second), []).append(panel)
        return having

    def shares(self, kind: str = "") -> str:
        """Return the share of seeds that solve each task: a column for each curve.

        In brackets are the thousands of steps until then, the median over those seeds.

        Args:
          kind: the kind of tasks, see `_sparse`.
        """
        steps, panels = self._steps, self._sparse(kind)
        names = self.figure.names(panels)

        def cell(panel: str, name: str) -> str:
            if (panel, name) not in steps:
                return ""
            until = steps[panel, name]
            solved = until[np.isfinite(until)]
            median = f" ({np.median(solved) / 1000:.0f})" if len(solved) else ""
            return f"{len(solved) / len(until):.2f}{median}"

        rows = [
            [panel.removeprefix("sparse:"), *(cell(panel, name) for name in names)]
            for panel in panels
            if any((panel, name) in steps for name in names)
        ]
        mean = self.mean_shares(kind)
        means = ["mean", *(f"{mean[x]:.2f}" if x in mean else "" for x in names)]
        return markdown_table(["task", *names], [*rows, means] if rows else [])

    def mean_shares(self, kind: str = "") -> dict[str, float]:
        """Return the mean over tasks of the shares of solving seeds, by curve.

        Only of curves that are complete on all tasks.

        Args:
          kind: the kind of tasks, see `_sparse`.
        """
        solved, panels = self._solved, self._sparse(kind)
        return {
            name: float(np.mean([solved[p, name].mean() for p in panels]))
            for name in self.figure.names(panels)
            if all((p, name) in solved for p in panels)
        }

    def means(self, kind: str, *names: str) -> str:
        """Return `mean_shares` of some curves as text, those that are complete.

        What stands in brackets in a curve's name, but for a number, is for the text
        around it to say.

        Args:
          kind: the kind of tasks, see `_sparse`.
          *names: the curves.
        """
        mean = self.mean_shares(kind)
        plain = {x: re.sub(r" \(\D.*", "", x).upper() for x in names if x in mean}
        return ", ".join(f"{words} {mean[x]:.2f}" for x, words in plain.items())

    def lead(self, ours: str = "", kind: str = "", *others: str) -> str:
        """Return how a curve's shares of solving seeds compare with other curves'.

        The verdicts on tasks are one family, and those on the means another.

        Args:
          ours: the curve, which is compared with each other one; default the figure's
            own comparisons.
          kind: the kind of tasks, see `_sparse`.
          *others: the curves to list the comparisons with; default all.
        """
        solved, having = self._solved, self._compared_on(ours, kind)
        one = shares.compare(solved, [(p, *x) for x, ps in having.items() for p in ps])
        mean = judged({x: shares.overall(solved, on, x) for x, on in having.items()})
        lines = []
        for (first, second), lead in mean.items():
            on = having[first, second]
            verdicts = [one[panel, first, second].verdict for panel in on]
            if second in (others or [second]):
                lines.append(
                    f"- {first} against {second}: mean share {lead:+z.2f}, "
                    f"{lead.verdict_in_words('.2f')}; {counted(verdicts)} of {len(on)} "
                    "tasks."
                )
        return "\n".join(lines)

    def sooner(self, ours: str = "", kind: str = "", *others: str) -> str:
        """Return whether a curve's seeds solve their tasks sooner than other curves'.

        The verdicts are one family.

        Args:
          ours: the curve, as for `lead`.
          kind: the kind of tasks, see `_sparse`.
          *others: the curves to list the comparisons with; default all.
        """
        having = self._compared_on(ours, kind)
        every = {x: shares.sooner(self._steps, on, x) for x, on in having.items()}
        lines = []
        for (first, second), lead in judged(every).items():
            if second in (others or [second]):
                ends = lead.middle, lead.low, lead.high
                share = "{:.2f} [{:.2f}, {:.2f}]".format(*(0.5 + x for x in ends))
                lines.append(
                    f"- {first} sooner than {second}: with probability {share}, "
                    f"{lead.verdict_in_words('.2f')}, on {len(having[first, second])} "
                    "tasks."
                )
        return "\n".join(lines)

    def noise(self, ours: str, *others: str) -> str:
        """Return how noise changes the lead of other curves over one.

        The tasks are those that have a version with noise. The verdicts are one family.

        Args:
          ours: the curve.
          *others: the curves whose leads are listed.
        """
        solved = self._solved
        tasks: dict[str, list[str]] = {}
        for other in others:
            for panel in self._sparse(""):
                both = (panel, f"{panel}_noisy")
                if {(p, x) for p in both for x in (ours, other)} <= solved.keys():
                    tasks.setdefault(other, []).append(panel)
        changes = {
            other: shares.change(
                solved, on, [f"{panel}_noisy" for panel in on], pair=(other, ours)
            )
            for other, on in tasks.items()
        }
        return "\n".join(
            f"- {other}'s lead over {ours}: {change:+z.2f} with noise, "
            f"{change.verdict_in_words('.2f')}, on {len(tasks[other])} tasks."
            for other, change in judged(changes).items()
        )

    def chosen(self) -> str:
        """Return a table of what each agent's search chose for all sparse tasks."""
        first = {x.agent: x for x in self.figure.searches.values()}
        rows = []
        for agent, search in first.items():
            best = search.best(self.searched)
            cells = ["not complete", ""]
            if best is not None:
                cells = [point_in_words(best[0]), f"{best[1].mean():.2f}"]
            rows.append([agent, f"{len(search.points(self.searched))}", *cells])
        return markdown_table(["agent", "points", "chosen", "its progress"], rows)

    def settings(self) -> str:
        """Return a table of each curve's settings that are not the defaults."""
        rows = []
        for names, results in self.results.items():
            algorithm = next(iter(results.records)).algorithm
            if isinstance(results.curve.base, str):
                words = point_in_words(changed(algorithm))
            else:
                words = point_in_words(results.curve.point(self.searched) or {})
                is_normalized = algorithm.settings["normalize_rewards"]
                words += ", rewards normalized" if is_normalized else ""
            rows.append([*names, words, results.provenance()])
        head = ["task", "agent", "hyperparameters", "trained with"]
        return markdown_table(head, rows)

    @functools.cache  # noqa: B019  # The summaries have many of a page's slots too.
    def value(self, slot: str, *arguments: str) -> str:
        """Return the text of a slot.

        Raises:
          InputError: if there is no such slot, or it does not take these arguments.
        """
        if slot not in self.SLOTS:
            raise self._no_slot(slot, *arguments)
        method = getattr(self, slot)
        try:
            inspect.signature(method).bind(*arguments)
        except TypeError:
            raise self._no_slot(slot, *arguments) from None
        return method(*arguments) or "Nothing is complete yet."

    def _no_slot(self, *words: str) -> InputError:
        return InputError(
            f"slot is {shlex.join(words)} in {self.name}: it must be one of "
            f"{', '.join(self.SLOTS)}, with its arguments"
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
            words = f"Not trained yet: {missing} of {total} runs"
            searches = self.figure.searches.values()
            runs = [run for x in searches for run in x.requested(self.searched)]
            if searched := len(self.searched.missing(runs)):
                words += f", and at least {searched} of the searches"
            parts.append(f"{words}.")
        if self.results:
            sizes = [f"{len(family)}" for family in self.figure.families()]
            reading = _READING.format(" and ".join(sizes))
            parts += [_SHARES if self.figure.solved_from else reading, "## Settings"]
            parts.append(self.settings())
        return "\n\n".join(parts) + "\n"

    def picture(self) -> plots.Picture:
        """Return the page's plot."""
        records = {k: list(x.records.values()) for k, x in self.results.items()}
        return plots.draw(self.figure, records, self.scores)

    def write(self, results: pathlib.Path) -> None:
        """Write the page and its plot."""
        results.mkdir(parents=True, exist_ok=True)
        if self.results:
            plots.save_png(self.picture(), results / f"{self.name}.png")
        if self.name == "sparse":
            plots.save_png(plots.draw_starts(SPARSE), results / "sparse_tasks.png")
        with output_file.atomic(results / f"{self.name}.md") as partial:
            partial.write_text(self.text())


def fill(note: str, value: Callable[..., str]) -> str:
    """Fill the slots of a text, {{NAME ARGUMENTS}}, with the results of `value`."""
    return re.sub(r"{{(.+?)}}", lambda x: value(*shlex.split(x[1])), note)


def fill_blocks(text: str, value: Callable[..., str]) -> str:
    """Replace the text between ``<!-- begin SLOT -->`` and ``<!-- end -->``."""
    block = re.compile(r"(<!-- begin (.+?) -->\n).*?(<!-- end -->)", re.DOTALL)
    return block.sub(lambda x: f"{x[1]}\n{value(*shlex.split(x[2]))}\n\n{x[3]}", text)

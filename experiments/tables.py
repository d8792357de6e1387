"""Tables and sentences of numbers from a figure's results, for the slots of its page.

`SLOTS` has those that a page may name, as {{NAME ARGUMENTS}}. Some take a kind of
panels: "delayed" or "dense", and "delayed raw" or "dense raw" for rewards that are not
normalized; of sparse tasks "noisy" for those with noise, "robots" or "navix" for those
that are trained longer. By default they are all panels, or the sparse tasks that are
none of these.
"""

import csv
import itertools
import pathlib
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from experiments import doing_nothing
from experiments import shares as statistics
from experiments.comparisons import (
    BELOW,
    FEWEST_SEEDS,
    Comparison,
    Effect,
    Scores,
    counted,
    improvement,
    in_words,
    interval,
    judged,
    number,
    over_tasks,
)
from experiments.curves import Curve, Figure, name_of
from experiments.figure_results import Results
from experiments.search import (
    AGENTS,
    BEYOND,
    CELLS,
    DELAY,
    SEEDS,
    SPACES,
    SPARSE_GRIDS,
    SPARSE_ROBOTS,
    TASKS,
    mean_ranks,
)
from gasil_jax.algorithms import Algorithm
from gasil_jax.errors import InputError, unknown
from gasil_jax.statistics import interquartile_mean

#: Mean returns that others have published, after about 1M steps, with their sources.
PUBLISHED = pathlib.Path(__file__).parent / "published.csv"


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


def panels_of(figure: Figure, kind: str) -> list[str]:
    """Return the panels of a kind."""

    def words(panel: str) -> set[str]:
        if figure.solved_from is None:
            delayed, raw, _ = next(iter(figure.panels[panel].values())).family
            return {"delayed" if delayed else "dense", *["raw"] * raw}
        task = panel.removesuffix("_noisy")
        kinds = {"robots": task in SPARSE_ROBOTS, "navix": task in SPARSE_GRIDS}
        return {x for x, holds in {"noisy": task != panel, **kinds}.items() if holds}

    of_all = not kind and figure.solved_from is None
    return [x for x in figure.panels if of_all or words(x) == set(kind.split())]


def table(results: Results) -> str:
    """Return the final returns: a row for each panel and curve."""
    favourite = results.figure.favourite
    head = ["task", "agent", "seeds", "final return", "evaluated"]
    head += [f"{favourite} ahead by", f"{favourite} is"] if favourite else []
    rows = []
    for (panel, label), one in results.curves.items():
        count, evaluated = len(one.records), one.evaluated
        seeds = f"{count}" + f" of {one.curve.seeds}" * (not one.complete)
        cells = [panel, label, seeds, interval(one.final), ""]
        if len(evaluated):
            of = f" ({len(evaluated)})" * (len(evaluated) < count)
            cells[-1] = f"{number(float(interquartile_mean(evaluated)))}{of}"
        if favourite:
            rival = str(results.figure.rival(panel, label))
            against = results.comparisons.get((panel, rival, label))
            cells += [f"{against}", against.verdict] if against else ["", ""]
        rows.append(cells)
    if results.figure.floor:
        rows = [
            row
            for panel, own in itertools.groupby(rows, lambda row: row[0])
            for row in (*own, _floor(results.figure, panel, len(head)))
        ]
    return markdown_table(head, rows)


def _floor(figure: Figure, panel: str, columns: int) -> list[str]:
    """Return the row of a table about what doing nothing returns."""
    env = next(iter(figure.panels[panel].values())).env
    cells = [panel, "doing nothing", "", in_words(*doing_nothing.stored()[env])]
    return [*cells, *[""] * (columns - len(cells))]


def returns(results: Results, *panels: str) -> str:
    """Return final returns without intervals: a row per curve, a column per panel."""
    means = {k: number(float(interquartile_mean(x))) for k, x in results.scores.items()}
    rows = [
        [name, *(means.get((panel, name), "") for panel in panels)]
        for name in results.figure.names(panels)
    ]
    return markdown_table(["agent", *panels], rows)


def differences(results: Results) -> str:
    """Return all comparisons of the page, one per line."""
    lines = []
    for (panel, ours, other, *less), comparison in results.comparisons.items():
        more = f", less that of {less[0]}" if less else ""
        difference = f"{comparison}, {comparison.verdict}"
        lines.append(f"- {panel}, {ours} - {other}{more}: {difference}.")
    return "\n".join(lines)


def _verdicts(
    comparisons: Mapping[tuple[str, ...], Comparison],
    panels: Iterable[str],
    pair: tuple[str, str],
) -> dict[str, str]:
    """Return the verdicts on a pair of curves by panel, where there are any."""
    compared = {panel: comparisons.get((panel, *pair)) for panel in panels}
    return {panel: x.verdict for panel, x in compared.items() if x}


def _tally(
    results: Results,
    scores: Scores,
    comparisons: Mapping[tuple[str, ...], Comparison],
    *,
    panels: Sequence[str],
    lacking: str,
) -> str:
    figure, lines = results.figure, []
    for other in figure.names(panels):
        on = [panel for panel in panels if other in figure.panels[panel]]
        ours = str(figure.rival(on[0], other))
        if verdicts := _verdicts(comparisons, on, (ours, other)):
            probability = improvement(scores, [*verdicts], ours, other=other)
            words = counted([*verdicts.values()])
            others = len(on) - len(verdicts)
            more = f", {others} {lacking}" if others else ""
            lines.append(
                f"- {ours} against {other}: {words} of {len(verdicts)}"
                f"{more}; probability of improvement {probability}."
            )
    return "\n".join(lines)


def tally(results: Results, kind: str = "") -> str:
    """Return on how many panels the favourite is better than each other curve."""
    return _tally(
        results,
        results.scores,
        results.comparisons,
        panels=panels_of(results.figure, kind),
        lacking="not measured yet",
    )


def evaluated(results: Results) -> str:
    """Return the tally of the last policies' mean actions, a family of its own.

    It is over the seeds that were evaluated, if these are enough.
    """
    scores = {
        key: one.evaluated
        for key, one in results.curves.items()
        if one.complete and len(one.evaluated) >= FEWEST_SEEDS
    }
    return _tally(
        results,
        scores,
        results.compare(scores),
        panels=panels_of(results.figure, ""),
        lacking="without enough evaluations",
    )


def better(results: Results, kind: str, ours: str, *others: str) -> str:
    """Return where a curve is better, and worse, than others, as half a sentence."""
    names: dict[str, list[str]] = {}
    for other in others:
        panels = panels_of(results.figure, kind)
        on = [panel for panel in panels if other in results.figure.panels[panel]]
        verdicts = _verdicts(results.comparisons, on, (ours, other))
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


def aggregate(results: Results, unit: str = "ppo") -> str:
    """Return each curve's return over all tasks, relative to one dense curve's.

    A seed's return is divided by the interquartile mean of the curve `unit` in the
    panel of the same task with dense rewards. All tasks have the same weight in the
    interquartile mean over all seeds of all tasks. Its 95% interval is the percentile
    bootstrap's over seeds, drawn within each task; the unit is not resampled. A curve
    without scores on all of the tasks is left out.
    """
    panels_by: dict[str, list[str]] = {}
    scores, unit_of, rows = results.scores, {}, []
    for panel, curves in results.figure.panels.items():
        curve = next(iter(curves.values()))
        if (dense := (name_of(curve.env), unit)) in scores:
            kind = "delayed" if curve.reward_delay > 1 else "dense"
            panels_by.setdefault(kind, []).append(panel)
            unit_of[panel] = float(interquartile_mean(scores[dense]))
    for kind, panels in panels_by.items():
        for name in results.figure.names(panels):
            if all((panel, name) in scores for panel in panels):
                relative = [scores[x, name] / unit_of[x] for x in panels]
                rows.append([kind, name, f"{len(panels)}", over_tasks(name, relative)])
    head = ["rewards", "agent", "tasks", f"return in units of dense {unit}'s"]
    return markdown_table(head, rows)


def passing(results: Results, panel: str, threshold: str) -> str:
    """Return which share of each curve's seeds returns more than a threshold.

    Where some seeds learn a task and others don't, this says more than a mean.
    """
    rows = []
    for name in results.figure.panels[panel]:
        if (panel, name) in results.scores:
            finals = results.scores[panel, name]
            count = int(np.sum(finals > float(threshold)))
            share = f"{count / len(finals):.0%} ({count} of {len(finals)})"
            rows.append([name, share, interval(finals)])
    head = [panel, f"seeds above {threshold}", "interquartile mean"]
    return markdown_table(head, rows)


def published(results: Results, rewards: str, *names: str) -> str:
    """Return returns that others have published, "dense" or "delayed", beside ours."""
    with PUBLISHED.open(newline="") as file:
        others = [row for row in csv.DictReader(file) if row["rewards"] == rewards]
    delay, rows = DELAY if rewards == "delayed" else 1, []
    for name in names:
        ours = [results.scores.get((name_of(env, delay), name)) for env in TASKS]
        if counts := sorted({len(x) for x in ours if x is not None}):
            cells = ["" if x is None else interval(x) for x in ours]
            seeds = " or ".join(map(str, counts))
            rows.append([f"ours, {name}", "v5", seeds, *cells])
    columns = ("source", "tasks", "seeds", *TASKS)
    rows += [[row[column] for column in columns] for row in others]
    return markdown_table(columns, rows)


def grids(results: Results) -> str:
    """Return a table of the searches' grids and the values beyond them."""
    rows = []
    for name, beyond in BEYOND.items():
        agents = [agent for agent in AGENTS if name in SPACES[agent]]
        grid, further = (
            ", ".join(f"{x:g}" for x in values if x is not None)
            for values in (SPACES[agents[0]][name], beyond)
        )
        who = "all" if len(agents) == len(AGENTS) else ", ".join(agents)
        rows.append([name, grid, further, who])
    return markdown_table(["hyperparameter", "grid", "beyond", "agents"], rows)


def searches(results: Results) -> str:
    """Return what the figure's searches found; of sparse tasks a row for each agent."""
    store, sparse = results.searched, results.figure.solved_from is not None
    few = len(SEEDS)
    head = ["task", "points", "best point", "its mean (seeds)"]
    head += [f"all points' median of {few} seeds", "worst"]
    head = ["agent", "points", "chosen", "its progress"] if sparse else head
    named = results.figure.searches
    if sparse:
        named = {search.agent: search for search in named.values()}
    rows = []
    for name, search in named.items():
        points, best = search.points(store), search.best(store)
        cells = ["not complete"] + [""] * (len(head) - 3)
        if best is not None and sparse:
            cells = [point_in_words(best[0]), f"{best[1].mean():.2f}"]
        elif best is not None:
            scores = search.scores(points, store)
            assert scores is not None
            means = scores.mean(axis=1)
            mean = f"{best[1].mean():.0f} ({len(best[1])})"
            cells = [point_in_words(best[0]), mean]
            cells += [f"{x:.0f}" for x in (np.median(means), means.min())]
        rows.append([name, f"{len(points)}", *cells])
    return markdown_table(head, rows)


def _curve(results: Results, panel: str, name: str) -> Curve:
    """Return a curve; raise `InputError` if the figure has none of the name."""
    if name not in (curves := results.figure.panels.get(panel, {})):
        raise InputError(unknown("curve", name, [*curves]))
    return curves[name]


def points(results: Results, panel: str, name: str, seeds: str = "final") -> str:
    """Return the final returns of each point of a search, where all are stored.

    A row is a learning rate. They are of the curve's seeds, or with "search" of those
    of the search, whose points have a learning rate and an alpha.
    """
    curve, rows = _curve(results, panel, name), dict[str, list[str]]()
    own = SEEDS if seeds == "search" else range(curve.seeds)
    search, store = curve.search, results.searched
    assert search is not None
    every = search.points(store)
    for point, runs in zip(every, search.runs(every, own)):
        if not all(run in store for run in runs):
            return ""
        row = rows.setdefault(f"{point['learning_rate']:g}", [])
        row.append(interval(np.array([store[run].final for run in runs])))
    alphas = dict.fromkeys(f"alpha {point['alpha']:g}" for point in every)
    head = f"{panel}, {len(own)} seeds; learning rate"
    return markdown_table([head, *alphas], [[rate, *row] for rate, row in rows.items()])


def apart(results: Results, panel: str, ours: str, other: str) -> str:
    """Return a comparison of the page, or an empty text if curves are missing."""
    compared = results.comparisons.get((panel, ours, other))
    return f"{compared}, {compared.verdict}" if compared else ""


def final(results: Results, panel: str, name: str, seeds: str = "final") -> str:
    """Return a curve's final return; with "search" that of its search's best point."""
    curve = _curve(results, panel, name)
    if seeds == "search":
        best = curve.search.best(results.searched) if curve.search else None
        return number(best[1].mean()) if best else ""
    scores = results.scores.get((panel, name))
    return "" if scores is None else interval(scores)


def foretold(results: Results, *words: str) -> str:
    """Return whether predicted verdicts came true, or that they are not measured.

    The words are panel, curve, other curve and the predicted verdict, again and again.
    """
    true = []
    for panel, ours, other, verdict in zip(*[iter(words)] * 4, strict=True):
        if (panel, ours, other) not in results.figure.compared():
            raise InputError(f"foretold has {panel}, {ours}, {other}: not compared")
        if (compared := results.comparisons.get((panel, ours, other))) is None:
            return "not measured"
        true.append(compared.verdict == verdict)
    return "yes" if all(true) else f"{true.count(True)} of {len(true)}"


def ranks(results: Results, name: str) -> str:
    """Return the mean rank of a hyperparameter's values on each task."""
    tasks = {
        name_of(*task): mean_ranks(name, *task, store=results.searched)
        for task in CELLS
    }
    values = sorted({value for of_task in tasks.values() for value in of_task})
    rows = [
        [task, *(f"{of_task[value]:.2f}" for value in values)]
        for task, of_task in tasks.items()
        if of_task
    ]
    return markdown_table([f"{name}:", *(f"{value:g}" for value in values)], rows)


def settings(results: Results) -> str:
    """Return each curve's settings that are not the defaults, and its provenance."""
    rows = []
    for names, one in results.curves.items():
        algorithm = next(iter(one.records)).algorithm
        if isinstance(one.curve.base, str):
            words = point_in_words(changed(algorithm))
        else:
            words = point_in_words(one.curve.point(results.searched) or {})
            is_normalized = algorithm.settings["normalize_rewards"]
            words += ", rewards normalized" if is_normalized else ""
        rows.append([*names, words, one.provenance()])
    return markdown_table(["task", "agent", "hyperparameters", "trained with"], rows)


def shares(results: Results, kind: str = "") -> str:
    """Return the share of seeds that solve each task: a column for each curve.

    In brackets are the thousands of steps until then, the median over those seeds.
    """
    steps, panels = results.steps, panels_of(results.figure, kind)
    names = results.figure.names(panels)

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
    mean = mean_shares(results, kind)
    means = ["mean", *(f"{mean[x]:.2f}" if x in mean else "" for x in names)]
    return markdown_table(["task", *names], [*rows, means] if rows else [])


def mean_shares(results: Results, kind: str = "") -> dict[str, float]:
    """Return the mean share of solving seeds, of curves that are complete on all."""
    solved, panels = results.solved, panels_of(results.figure, kind)
    return {
        name: float(np.mean([solved[p, name].mean() for p in panels]))
        for name in results.figure.names(panels)
        if all((p, name) in solved for p in panels)
    }


def means(results: Results, kind: str, *names: str) -> str:
    """Return `mean_shares` of some curves as text, those that are complete.

    What stands in brackets in a curve's name, but for a number, is for the text around
    it to say.
    """
    mean = mean_shares(results, kind)
    plain = {x: re.sub(r" \(\D.*", "", x).upper() for x in names if x in mean}
    return ", ".join(f"{words} {mean[x]:.2f}" for x, words in plain.items())


def _panels_by_pair(
    results: Results, ours: str, kind: str
) -> dict[tuple[str, str], list[str]]:
    """Return the panels on which two complete curves are compared, by these curves.

    `ours` is compared with each other one; if it is empty, the comparisons are the
    figure's own.
    """
    panels = panels_of(results.figure, kind)
    pairs = [key for key in results.figure.compared() if key[0] in panels]
    if ours:
        pairs = [(p, ours, x) for p in panels for x in results.figure.panels[p]]
    having: dict[tuple[str, str], list[str]] = {}
    for panel, first, second in pairs:
        both = {(panel, first), (panel, second)}
        if len(both) == 2 and both <= results.solved.keys():
            having.setdefault((first, second), []).append(panel)
    return having


def lead(results: Results, ours: str = "", kind: str = "", *others: str) -> str:
    """Return how a curve's shares of solving seeds compare with other curves'.

    The verdicts on tasks are one family, and those on the means another. `others` are
    those that are listed, by default all.
    """
    solved, having = results.solved, _panels_by_pair(results, ours, kind)
    pairs = [(panel, *x) for x, panels in having.items() for panel in panels]
    dropped, panels = results.figure.dropped_pairs, panels_of(results.figure, kind)
    verdict_of = statistics.verdicts(solved, pairs, dropped * len(panels))
    every = {x: statistics.overall(solved, on, x) for x, on in having.items()}
    mean = judged(every, dropped)
    return "\n".join(
        f"- {first} against {second}: mean share {one:+z.2f}, "
        f"{one.verdict_in_words('.2f')}; "
        f"{counted([verdict_of[panel, first, second] for panel in on])} of {len(on)} "
        "tasks."
        for (first, second), one in mean.items()
        for on in [having[first, second]]
        if second in (others or [second])
    )


def sooner(results: Results, ours: str = "", kind: str = "", *others: str) -> str:
    """Return whether a curve's seeds solve their tasks sooner; otherwise as `lead`."""
    having, lines = _panels_by_pair(results, ours, kind), []
    every = {x: statistics.sooner(results.steps, on, x) for x, on in having.items()}
    for (first, second), one in judged(every, results.figure.dropped_pairs).items():
        if second in (others or [second]):
            ends = (0.5 + x for x in (one.middle, one.low, one.high))
            lines.append(
                f"- {first} sooner than {second}: with probability "
                f"{'{:.2f} [{:.2f}, {:.2f}]'.format(*ends)}, "
                f"{one.verdict_in_words('.2f')}, on {len(having[first, second])} tasks."
            )
    return "\n".join(lines)


def noise(results: Results, ours: str, *others: str) -> str:
    """Return how noise changes the lead of other curves over one: a family of tests.

    The tasks are those that have a version with noise.
    """
    solved, count, changes = results.solved, dict[str, int](), dict[str, Effect]()
    for other in others:
        on = [
            panel
            for panel in panels_of(results.figure, "")
            if {(f"{panel}{x}", y) for x in ("", "_noisy") for y in (ours, other)}
            <= solved.keys()
        ]
        if on:
            noisy, count[other] = [f"{panel}_noisy" for panel in on], len(on)
            changes[other] = statistics.change(solved, on, noisy, pair=(other, ours))
    return "\n".join(
        f"- {other}'s lead over {ours}: {change:+z.2f} with noise, "
        f"{change.verdict_in_words('.2f')}, on {count[other]} tasks."
        for other, change in judged(changes).items()
    )


#: The functions that slots of a page may name.
SLOTS: Mapping[str, Callable[..., str]] = {
    function.__name__: function
    for function in (
        *(table, returns, differences, tally, evaluated, better, aggregate, passing),
        *(published, grids, searches, ranks, points, apart, final, foretold),
        *(shares, means, lead, sooner, noise),
    )
}

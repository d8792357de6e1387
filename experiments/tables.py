"""The slots of a page: numbers, tables and pictures from a figure's results.

`SLOTS` has those that a page may name, as {{FIGURE NAME ARGUMENTS}}. A kind of panels
is one of `Figure.of_kind`.
"""

import csv
import pathlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import fields
from typing import Any

import numpy as np

from experiments import doing_nothing, figure_results
from experiments.comparisons import BELOW, Comparison, in_words, number
from experiments.curves import Curve, name_of
from experiments.figure_results import Results, Row, row_name
from experiments.search import AGENTS, BEYOND, DELAY, SPACES, TASKS
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


def folded(title: str, *parts: str) -> str:
    """Return Markdown that is shown when its title is clicked."""
    text = "\n\n".join(filter(None, parts))
    return f'<details markdown="1"><summary>{title}</summary>\n\n{text}\n\n</details>'


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


def settings(results: Results, panel: str, name: str) -> str:
    """Return a curve's settings: what was chosen, or what is not the default."""
    one = results.curves[panel, name]
    algorithm = next(iter(one.records)).algorithm
    if isinstance(one.curve.base, str):
        return point_in_words(changed(algorithm))
    words = point_in_words(one.curve.point(results.searched) or {})
    return words + ", rewards normalized" * algorithm.settings["normalize_rewards"]


def picture(name: str, slot: str, kind: str = "") -> str:
    """Return the name of a picture's file."""
    words = [name, *[slot] * (slot != "curves"), *kind.split()]
    return f"{'_'.join(words)}.png"


def claim(results: Results) -> str:
    """Return what the paper claims."""
    return f"**The paper's claim.** {results.figure.claim}"


def curves(results: Results, kind: str = "") -> str:
    """Return the picture of learning curves, or of final returns over a setting."""
    if not is_drawn(results, "curves"):
        return "Not trained yet."
    words = "returns of each agent on each task"
    return f"![{words}]({picture(results.name, 'curves', kind)})"


def forest(results: Results, kind: str = "") -> str:
    """Return the picture of what is compared, with the numbers folded."""
    if not is_drawn(results, "forest", kind):
        return numbers(results, kind)
    words = "differences with their intervals, and the verdict on each task"
    drawn = f"![{words}]({picture(results.name, 'forest', kind)})"
    return f"{drawn}\n\n{numbers(results, kind)}"


def is_drawn(results: Results, slot: str, kind: str = "") -> bool:
    """Return whether there are runs for a picture."""
    return bool(results.forest(kind) if slot == "forest" else results.curves)


def numbers(results: Results, kind: str = "") -> str:
    """Return the final returns and the rows of the forest plot, folded.

    A column is a panel. Where tasks are either solved or not, a cell is the share of
    seeds that solve it, and in brackets the thousands of steps until then, the median
    over these seeds.
    """
    panels = [x for x in results.figure.of_kind(kind) if _measured(results, x)]
    rows = [
        [name, *(_cell(results, panel, name) for panel in panels)]
        for name in results.figure.names(panels)
        if any((panel, name) in results.scores for panel in panels)
    ]
    floors = [doing_nothing.of(results.figure, x) for x in panels]
    if any(floors):
        rows.append(["doing nothing", *(number(x.mean) if x else "" for x in floors)])
    head = ["", *(x.removeprefix("sparse:") for x in panels)]
    parts = [_untrained(results, kind), markdown_table(head, rows)]
    for sooner in (False, True) if results.sooner else (False,):
        parts.append(_compared(results.forest(kind, sooner), results, sooner))
    return folded("Numbers", *parts)


def lacking(results: Results, kind: str = "") -> str:
    """Return what is not trained yet of a kind, or that all is."""
    return _untrained(results, kind) or "All runs are trained."


def _untrained(results: Results, kind: str) -> str:
    """Return how many runs of a kind are not trained yet, and of which panels."""
    asked, total, left = results.figure.of_kind(kind), 0, dict[str, int]()
    for panel, name, curve in results.figure.curves():
        one = results.curves.get((panel, name))
        missing = curve.seeds - (len(one.records) if one else 0)
        if panel in asked:
            total += curve.seeds
            left |= {panel: left.get(panel, 0) + missing} if missing else {}
    if not left:
        return ""
    runs = f"{sum(left.values())} of {total} runs"
    return f"Not trained yet: {runs}. They are of {', '.join(left)}."


def _measured(results: Results, panel: str) -> bool:
    return any((panel, name) in results.scores for name in results.figure.panels[panel])


def _cell(results: Results, panel: str, name: str) -> str:
    if (panel, name) not in results.scores:
        return ""
    if (panel, name) not in results.sooner:
        return number(float(interquartile_mean(results.scores[panel, name])))
    until = -results.sooner[panel, name]
    solved = until[np.isfinite(until)]
    median = f" ({np.median(solved) / 1000:.0f})" if len(solved) else ""
    return f"{len(solved) / len(until):.2f}{median}"


def _compared(rows: Sequence[Row], results: Results, sooner: bool) -> str:
    """Return the rows of a forest plot as a table."""
    what, null = results.measure(sooner)
    spec = "" if results.is_of_one_task else ".2f"
    lines = []
    for row in rows:
        one = row.compared
        words = [_beside(null, one, spec), number(one.visible, spec), one.verdict]
        lines.append([row.name, *words])
    return markdown_table(["", what, "visible from", "verdict"], lines)


def _beside(null: float, one: Comparison, spec: str) -> str:
    """Return an effect, measured from its null, and its interval as text."""
    return in_words(null + one.middle, null + one.low, null + one.high, spec)


def _find(results: Results, panel: str, name: str) -> Curve:
    """Return a curve; raise `InputError` if the figure has none of the name."""
    if name not in (curves := results.figure.panels.get(panel, {})):
        raise InputError(unknown("curve", name, [*curves]))
    return curves[name]


def final(results: Results, panel: str, name: str) -> str:
    """Return a curve's final return, the interquartile mean over seeds."""
    _find(results, panel, name)
    scores = results.scores.get((panel, name))
    return "" if scores is None else number(float(interquartile_mean(scores)))


def search(results: Results, panel: str, name: str) -> str:
    """Return what the best point of a curve's search returned with its own seeds."""
    one = _find(results, panel, name).search
    best = one.best(results.searched) if one else None
    return number(best[1].mean()) if best else ""


def apart(results: Results, panel: str, ours: str, other: str) -> str:
    """Return a comparison of the figure, or an empty text if curves are missing."""
    compared = results.comparisons.get((panel, ours, other))
    return f"{compared}, {compared.verdict}" if compared else ""


def count(results: Results, verdict: str, kind: str, ours: str, *others: str) -> str:
    """Return on how many tasks a curve has one verdict against all others."""
    on = [
        [x for x in map(results.comparisons.get, [(p, ours, x) for x in others]) if x]
        for p in results.figure.of_kind(kind)
    ]
    measured = [x for x in on if len(x) == len(others)]
    holds = [x for x in measured if all(one.verdict == verdict for one in x)]
    return f"{len(holds)} of {len(measured)}"


def likely(
    results: Results, ours: str, other: str, kind: str = "", asked: str = ""
) -> str:
    """Return a row of the forest plot in words, and its verdict."""
    if not any(key[1:] == (ours, other) for key in results.figure.compared()):
        raise InputError(f"likely has {ours}, {other}: not compared")
    compared = {row.name: row.compared for row in results.forest(kind)}
    if (one := compared.get(row_name("", ours, other))) is None:
        return ""
    _, null = results.measure()
    reached = _reached(null + one.middle, asked)
    return f"{_beside(null, one, '.2f')}, {one.verdict}{reached}"


def _reached(value: float, asked: str) -> str:
    """Return in words whether a number is what was asked, if something was."""
    if not asked:
        return ""
    return ", reached" if value >= float(asked) else ", **not reached**"


def below(results: Results, kind: str = "") -> str:
    """Return the tasks on which some curves both return less than doing nothing."""
    panels = results.figure.of_kind(kind)
    every = {
        x: [one for k, one in results.comparisons.items() if k[0] == x] for x in panels
    }
    return ", ".join(
        results.figure.panels[x][next(iter(results.figure.panels[x]))].env
        for x, own in every.items()
        if own and all(one.verdict == BELOW for one in own)
    )


def tasks(results: Results, verdict: str, kind: str, ours: str, other: str) -> str:
    """Return the tasks on which a curve has a verdict against another one."""
    compared = [
        (x, results.comparisons.get((x, ours, other)))
        for x in results.figure.of_kind(kind)
    ]
    named = [x for x, one in compared if one and one.verdict == verdict]
    measured = any(one for _, one in compared)
    return ", ".join(named) or "none" * measured


def foretold(results: Results, *words: str) -> str:
    """Return whether verdicts, after panel and both curves, came true."""
    true = []
    for panel, ours, other, verdict in zip(*[iter(words)] * 4, strict=True):
        if (panel, ours, other) not in results.figure.compared():
            raise InputError(f"foretold has {panel}, {ours}, {other}: not compared")
        if (compared := results.comparisons.get((panel, ours, other))) is None:
            return "not measured"
        true.append(compared.verdict == verdict)
    return "yes" if all(true) else f"{true.count(True)} of {len(true)}"


def passing(results: Results, threshold: str, *panels: str) -> str:
    """Return which share of each curve's seeds returns more than a threshold."""
    rows = []
    for name in results.figure.names(panels):
        finals = [results.scores.get((panel, name)) for panel in panels]
        cells = [
            "" if x is None else f"{np.mean(x > float(threshold)):.0%} of {len(x)}"
            for x in finals
        ]
        rows.append([name, *cells])
    return markdown_table([f"seeds above {threshold}", *panels], rows)


def published(results: Results, rewards: str, *names: str) -> str:
    """Return returns that others have published, "dense" or "delayed", beside ours."""
    with PUBLISHED.open(newline="") as file:
        others = [row for row in csv.DictReader(file) if row["rewards"] == rewards]
    delay, rows = DELAY if rewards == "delayed" else 1, []
    for name in names:
        ours = [results.scores.get((name_of(env, delay), name)) for env in TASKS]
        if counts := sorted({len(x) for x in ours if x is not None}):
            middles = [None if x is None else interquartile_mean(x) for x in ours]
            cells = ["" if x is None else f"{x:.0f}" for x in middles]
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


def share(results: Results, kind: str, name: str, asked: str = "") -> str:
    """Return the mean share of seeds that solve tasks of a kind, as a percentage."""
    panels = results.figure.of_kind(kind)
    if not panels:
        raise InputError(f"share has {kind}: no panels")
    if not all((panel, name) in results.scores for panel in panels):
        return ""
    mean = float(np.mean([results.scores[panel, name].mean() for panel in panels]))
    return f"{mean:.0%}{_reached(mean, asked)}"


def rule(results: Results, name: str, kind: str) -> str:
    """Return a table of a curve's settings beside the defaults, and of its agent's."""
    rows: dict[str, list[str]] = {}
    for panel in results.figure.of_kind(kind):
        algorithm = _find(results, panel, name).runs(results.searched)[0].algorithm
        rows.setdefault(point_in_words(changed(algorithm)), []).append(panel)
    own = {x.name: getattr(algorithm.agent, x.name) for x in fields(algorithm.agent)}
    rows[point_in_words(own)] = ["the agent's own"]
    words = [[", ".join(x), words] for words, x in rows.items()]
    return markdown_table(["tasks", "settings"], words)


def families(pages: Sequence[Results]) -> str:
    """Return the picture of means over families of tasks, with the numbers folded."""
    shown = figure_results.families(pages)
    if not shown:
        return "Not trained yet."
    names = figure_results.arms(pages)
    favourite = pages[0].figure.favourite
    means, ahead = [], []
    for name in names:
        whole = [one.whole(kind).get(name) for one, kind in shown.values()]
        means.append([name, *(in_words(*x, ".2f") if x else "" for x in whole)])
        against = [one.ahead(kind).get(name) for one, kind in shown.values()]
        cells = [f"{_beside(0.5, x, '.2f')}, {x.verdict}" if x else "" for x in against]
        ahead.append([name, *cells])
    title = f"How likely {favourite} returns more, or solves a sparse task sooner:"
    parts = [markdown_table(["", *shown], x) for x in (means, ahead)]
    words = "means over families of tasks, and how likely one agent returns more"
    drawn = f"![{words}]({picture(pages[0].name, 'families')})"
    return f"{drawn}\n\n{folded('Numbers', parts[0], title, parts[1])}"


#: The functions that slots of a page may name.
SLOTS: Mapping[str, Callable[..., str]] = {
    function.__name__: function
    for function in (
        *(claim, curves, forest, numbers, final, search, apart, count, likely, below),
        *(foretold, passing, published, grids, share, tasks, rule, lacking),
    )
}

"""Pictures of figures: learning curves, returns over a setting, and forest plots."""

import io
import itertools
import math
import pathlib
from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure as Picture
from matplotlib.patches import Rectangle
from PIL import Image

from experiments import doing_nothing, figure_results
from experiments.comparisons import BELOW, Comparison
from experiments.curves import Figure
from experiments.figure_results import CurveResults, Results, Row, Whole
from experiments.search import AGENTS
from gasil_jax.host import output_file, plotting
from gasil_jax.statistics import bootstrap_interval, interquartile_mean

#: The color of each agent, the same in all pictures.
_COLOR_OF = dict(zip(AGENTS, plotting.COLORS, strict=False))
#: The color of each verdict. The last two have the same intervals and other squares.
_VERDICTS = {"better": "#0072B2", "not clear": "0.72", "worse": "#D55E00", BELOW: "1.0"}
#: Largest numbers of lines in a panel and of panels in a row.
MOST_LINES, _MOST_COLUMNS = 5, 4


def curves(results: Results, kind: str = "") -> Picture:
    """Return learning curves, or returns over a setting, and the mean over tasks."""
    figure = results.figure
    panels = [x for x in figure.of_kind(kind) if any(k[0] == x for k in results.curves)]
    lines, whole = _lines(figure), results.whole(kind) if len(panels) > 2 else {}
    count = len(panels) + bool(whole)
    columns = 3 if count in (5, 6, 12) else min(_MOST_COLUMNS, count)
    rows = math.ceil(count / columns)
    picture = Picture(figsize=(3.1 * columns, 2.5 * rows + 0.4), layout="constrained")
    grid = picture.subplots(rows, columns, squeeze=False)
    for axes, panel in zip(grid.flat, panels, strict=False):
        draw = _draw_over if figure.over else _draw_curves
        draw(results, panel, axes, lines)
        _draw_floor(figure, panel, axes)
        axes.set_title(_short(panel), fontsize=9)
        axes.tick_params(labelsize=7)
    if whole:
        axes = grid.flat[len(panels)]
        at = {"transform": axes.get_yaxis_transform(), "fontsize": 6.5, "va": "bottom"}
        for row, name in enumerate(whole):
            axes.text(0.02, row - 0.08, name, **at)
        _draw_whole(axes, whole, [*whole], lines, figure)
        axes.set(ylim=(len(whole) - 0.5, -0.8), yticks=[])
        axes.set_title("mean over these tasks", fontsize=9)
    for axes in grid.flat[count:]:
        axes.set_visible(False)
    shares = figure.solved_from is not None
    for row in grid:
        row[0].set_ylabel("share of seeds" if shares else "episode return", fontsize=8)
    _draw_legend(picture, [*grid.flat[: len(panels)]], lines)
    return picture


def _draw_legend(picture: Picture, panels: Sequence[Any], lines: Any) -> None:
    """Draw one legend below all panels."""
    handle_of: dict[str, Any] = {}
    for axes in panels:
        handles, names = axes.get_legend_handles_labels()
        handle_of |= dict(zip(names, handles, strict=True))
    handle_of = {name: handle_of[name] for name in lines if name in handle_of}
    # At this font size a letter is about 0.07 inches wide.
    width = 0.6 + 0.07 * max(map(len, handle_of), default=0)
    fitting = max(1, min(len(handle_of), int(picture.get_figwidth() / width)))
    below: Any = {"loc": "outside lower center", "ncols": fitting, "fontsize": 8}
    picture.legend([*handle_of.values()], [*handle_of], frameon=False, **below)


def _lines(figure: Figure) -> dict[str, dict[str, Any]]:
    """Return color and width of each shown line, the same in all panels."""
    named: dict[str, str] = {}
    first: set[str] = set()
    for panel, curves in figure.panels.items():
        own = {figure.point_of(panel, x)[0]: curve.agent for x, curve in curves.items()}
        first |= {*sorted(own, key=lambda x: x != figure.favourite)[:MOST_LINES]}
        named = {**own, **named}
    shown = [x for x in named if x in (figure.shown or first)]
    color_of = _with_free_colors(shown, named)
    return {
        name: {
            "color": color_of[name],
            "linewidth": 2.6 if name == figure.favourite else 1.2,
            "zorder": 3 if name == figure.favourite else 2,
        }
        for name in shown
    }


def _with_free_colors(names: Collection[str], agents: Any) -> dict[str, Any]:
    """Return each agent's own color, where it is free, and else one that is left."""
    color_of: dict[str, Any] = {}
    for name in sorted(names, key=lambda x: x != agents[x]):
        own = _COLOR_OF.get(agents[name])
        free = [own, *plotting.COLORS, "gray"]
        color_of[name] = next(x for x in free if x and x not in color_of.values())
    return color_of


def _draw_curves(results: Results, panel: str, axes: Any, lines: Any) -> None:
    """Draw the interquartile mean over seeds and its 95% interval."""
    figure = results.figure
    for name, style in lines.items():
        if (panel, name) not in results.curves:
            continue
        steps, returns = _returns(results.curves[panel, name])
        if figure.solved_from is not None:
            half = figure.solved_from(figure.panels[panel][name].env) / 2
            share = np.mean(returns >= half, axis=0)
            axes.plot(steps / 1e6, share, label=name, **style)
            continue
        finite = np.isfinite(returns).all(axis=0)
        if not finite.any():
            continue
        steps, returns = steps[finite] / 1e6, returns[:, finite]
        low, high = bootstrap_interval(returns, resamples=500)
        band = {"color": style["color"], "alpha": 0.18, "linewidth": 0}
        axes.fill_between(steps, low, high, **band)
        axes.plot(steps, interquartile_mean(returns, 0), label=name, **style)
    if figure.solved_from is not None:
        axes.set_ylim(-0.03, 1.03)
    axes.set_xlabel("million steps", fontsize=8)


def _draw_floor(figure: Figure, panel: str, axes: Any) -> None:
    """Draw what doing nothing returns, where that is shown."""
    if floor := doing_nothing.of(figure, panel):
        dotted = {"color": "0.4", "linestyle": (0, (1, 1)), "linewidth": 1.0}
        axes.axhline(floor.mean, **dotted)
        at = {"transform": axes.get_yaxis_transform(), "va": "bottom", "ha": "right"}
        axes.text(0.98, floor.mean, "doing nothing", color="0.4", fontsize=6, **at)


def _returns(one: CurveResults) -> tuple[np.ndarray, np.ndarray]:
    """Return the steps of the record with the fewest rows, and returns at these."""
    seeds = [*one.records.values()]
    steps = min((record.env_steps for record in seeds), key=len)
    every = [np.interp(steps, x.env_steps, x.episode_return) for x in seeds]
    return steps, np.array(every)


def _draw_over(results: Results, panel: str, axes: Any, lines: Any) -> None:
    """Draw final returns over a setting; a line joins curves that differ only in it."""
    figure = results.figure
    assert figure.over is not None
    points: dict[str, dict[Any, np.ndarray]] = {}
    for name in figure.panels[panel]:
        if (panel, name) in results.scores:
            line, value = figure.point_of(panel, name)
            points.setdefault(line, {})[value] = results.scores[panel, name]
    values = sorted({value for x in points.values() for value in x})
    for i, (line, style) in enumerate(lines.items()):
        if not (finals := points.get(line)):
            continue
        middle = np.array([interquartile_mean(x) for x in finals.values()])
        low, high = np.array([bootstrap_interval(x) for x in finals.values()]).T
        # Each line is shifted sideways, so that no interval hides another.
        places = np.array([*finals]) * 1.06 ** (i - (len(lines) - 1) / 2)
        ends = [middle - low, high - middle]
        marks = {"marker": "o", "markersize": 3, "capsize": 2}
        axes.errorbar(places, middle, ends, label=line, **marks, **style)
    limits = (0.7 * values[0], 1.4 * values[-1])
    axes.set(xscale="log", xlim=limits)
    axes.set_xlabel(figure.over[1], fontsize=8)
    axes.set_xticks(values, list(map(str, values)))
    axes.minorticks_off()


def _draw_whole(
    axes: Any, whole: Whole, names: Sequence[str], lines: Any, figure: Figure
) -> None:
    """Draw the means over all tasks, a row for each curve, shown as a line or not."""
    for name, (middle, low, high) in whole.items():
        color = lines[name]["color"] if name in lines else "0.6"
        width = 4.0 if name == figure.favourite else 2.0
        row = names.index(name)
        axes.plot([low, high], [row, row], color=color, linewidth=width)
        axes.plot(middle, row, "o", color=color, markersize=4)
    axes.tick_params(axis="x", labelsize=7)
    unit = "share of seeds" if figure.solved_from else "score, 1: the best agent's"
    axes.set_xlabel(unit, fontsize=8)


def families(pages: Sequence[Results]) -> Picture:
    """Return means over families of tasks, and probabilities of improvement.

    A family has a row for each curve: on the left its mean over the tasks, on the right
    how likely a seed of the favourite returns more than one of this curve, or solves a
    sparse task sooner. The color is the corrected verdict on the favourite.
    """
    shown, columns = figure_results.families(pages), 3
    names = figure_results.arms(pages)
    rows = math.ceil(len(shown) / columns)
    height = 0.5 + rows * (0.7 + 0.15 * len(names))
    picture = Picture(figsize=(12.6, height), layout="constrained")
    grid = picture.subplots(rows, 2 * columns, squeeze=False).reshape(-1, 2)
    for axes in grid[len(shown) :].flat:
        axes.set_visible(False)
    for i, (title, (results, kind)) in enumerate(shown.items()):
        scores, ahead = grid[i]
        whole = results.whole(kind)
        _draw_whole(scores, whole, names, _lines(results.figure), results.figure)
        against = results.ahead(kind)
        _draw_rows(ahead, [*against.values()], 0.5, [names.index(x) for x in against])
        scores.set_title(title, fontsize=9, loc="left")
        sooner = results.figure.solved_from is not None
        words = "is sooner" if sooner else "returns more"
        ahead.set_xlabel(f"{results.figure.favourite} {words}", fontsize=7)
        for axes in (scores, ahead):
            axes.set(xlim=(-0.03, 1.03), yticks=range(len(names)))
            axes.set_ylim(len(names) - 0.5, -0.5)
            axes.set_yticklabels([] if i % columns or axes is ahead else names)
            axes.tick_params(axis="y", labelsize=7)
            axes.grid(axis="x", color="0.92")
    return picture


def forest(results: Results, kind: str = "") -> Picture:
    """Return a forest plot of what is compared: a line for each pair of curves.

    A line is the difference with its 95% interval; its color is the corrected verdict.
    Small ticks are the smallest differences that would have been found. Squares are
    the verdicts on single tasks.
    """
    kinds = [False, True] if results.sooner else [False]
    parts = [results.forest(kind, sooner) for sooner in kinds]
    rows = parts[0]
    panels = list(dict.fromkeys(x for row in rows for x in row.verdicts))
    label = 0.075 * max((len(row.name) for row in rows), default=1)
    width, height = 3.4 * len(parts) + label, 0.9 + 0.24 * max(len(rows), 2)
    ratios = [3.4] * len(parts)
    if panels:
        ratios.append(0.24 * len(panels))
        width += ratios[-1]
        height += 0.065 * max(len(_short(x)) for x in panels)
    picture = Picture(figsize=(width, height), layout="constrained")
    (grid,) = picture.subplots(1, len(ratios), width_ratios=ratios, squeeze=False)
    for i, part in enumerate(parts):
        text, null = results.measure(kinds[i])
        _draw_rows(grid[i], [row.compared for row in part], null, range(len(part)))
        grid[i].set_ylim(max(len(part), 2) - 0.5, -0.5)
        grid[i].set_xlabel(text, fontsize=8)
        names = [row.name for row in part] if i == 0 else [""] * len(part)
        grid[i].set_yticks(range(len(part)), names, fontsize=8)
    if panels:
        _draw_squares(grid[-1], rows, panels)
    words = (
        "first curve: blue better, orange worse, grey not clear; ticks: visible from"
    )
    picture.suptitle(words, fontsize=7.5, color="0.3")
    return picture


def _draw_rows(
    axes: Any, rows: Sequence[Comparison], null: float, heights: Sequence[int]
) -> None:
    axes.axvline(null, color="0.3", linewidth=0.8)
    for y, one in zip(heights, rows, strict=True):
        color = _VERDICTS["not clear" if one.below else one.verdict]
        axes.plot([null + one.low, null + one.high], [y, y], color=color, linewidth=3)
        axes.plot(null + one.middle, y, "o", color=color, markersize=5)
        for end in (null - one.visible, null + one.visible):
            if null != 0.5 or 0.0 < end < 1.0:
                axes.plot(end, y, "|", color="0.3", markersize=6, markeredgewidth=0.8)
    if null == 0.5:
        axes.set_xlim(-0.03, 1.03)
    axes.tick_params(axis="x", labelsize=7)
    axes.grid(axis="x", color="0.92")
    axes.set_axisbelow(True)


def _short(panel: str) -> str:
    """Return a panel's name without the package of its task."""
    return panel.split(":")[-1].removeprefix("Navix-")


def _draw_squares(axes: Any, rows: Sequence[Row], panels: Sequence[str]) -> None:
    """Draw the verdict on each single panel."""
    for (y, row), (x, panel) in itertools.product(enumerate(rows), enumerate(panels)):
        if verdict := row.verdicts.get(panel):
            face: Any = {
                "facecolor": _VERDICTS[verdict],
                "edgecolor": "0.72",
                "lw": 0.6,
            }
            axes.add_patch(Rectangle((x - 0.36, y - 0.36), 0.72, 0.72, **face))
    axes.set_xticks(range(len(panels)), [*map(_short, panels)], fontsize=7, rotation=90)
    axes.set_yticks([])
    axes.set(xlim=(-0.6, len(panels) - 0.4), ylim=(max(len(rows), 2) - 0.5, -0.5))
    axes.spines[:].set_visible(False)
    axes.tick_params(length=0)


def save_png(picture: Picture, path: pathlib.Path, dpi: int = 100) -> None:
    """Write a small PNG, of 256 colors."""
    with io.BytesIO() as buffer:
        picture.savefig(buffer, format="png", dpi=dpi)
        image = Image.open(buffer).convert("RGB").quantize(256)
    path.parent.mkdir(parents=True, exist_ok=True)
    with output_file.atomic(path) as partial:
        image.save(partial, optimize=True)

"""Plots of figures: learning curves, or final returns over a setting."""

import io
import itertools
import math
import pathlib
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure as Picture
from PIL import Image

from experiments import doing_nothing
from experiments.comparisons import Scores
from experiments.curves import Figure
from experiments.search import AGENTS
from experiments.store import Record
from gasil_jax.host import output_file, plotting
from gasil_jax.statistics import bootstrap_interval, interquartile_mean

#: The color of each agent, the same in all figures.
_COLOR_OF = dict(zip(AGENTS, plotting.COLORS, strict=False))
#: The stored runs of each curve, by panel and curve.
Records = Mapping[tuple[str, str], Sequence[Record]]


def draw(figure: Figure, records: Records, scores: Scores) -> Picture:
    """Return a plot with axes for each panel.

    Args:
      figure: what it is a plot of.
      records: the stored runs of each curve.
      scores: the final returns of the complete curves.
    """
    panels = list(dict.fromkeys(panel for panel, _ in records))
    count = len(panels)
    # Four panels are drawn in a square, so that none is alone in its row.
    columns = min({4: 2}.get(count, 4 if count > 6 else 3), count)
    rows = math.ceil(count / columns)
    width = 3.6 + (0.055 * max(map(len, figure.names())))
    size = ((width if _has_direct_labels(figure) else 3.6) * columns, 2.8 * rows)
    picture = Picture(figsize=size, layout="constrained")
    grid = picture.subplots(rows, columns, squeeze=False)
    for axes in grid.flat[count:]:
        axes.set_visible(False)
    for axes, panel in zip(grid.flat, panels, strict=False):
        if figure.over:
            _draw_over(figure, panel, scores, axes=axes)
        else:
            _draw_curves(figure, panel, records, axes=axes)
        axes.set_title(panel)
    if not _has_direct_labels(figure):
        _draw_legends(figure, picture, list(grid.flat[:count]))
    for row in grid:
        is_share = figure.solved_from is not None
        row[0].set_ylabel("share of seeds" if is_share else "episode return")
    return picture


def _draw_legends(figure: Figure, picture: Picture, panels: Sequence[Any]) -> None:
    """Draw a legend in each panel, or below all panels if there are many names."""
    shown = [axes.get_legend_handles_labels() for axes in panels]
    handle_of = {
        name: x
        for handles, names in shown
        for x, name in zip(handles, names, strict=True)
    }
    if len(panels) > 1 and len(handle_of) > 3:
        # So many names would hide the curves, so the legend is below the panels. At
        # this font size a letter is about 0.07 inches wide.
        width = 0.5 + 0.07 * max(map(len, handle_of))
        size = picture.get_size_inches()
        fitting = max(1, min(4, int(size[0] / width)))
        if figure.solved_from is not None:
            # Else the legend of many names takes the panels' room.
            lines = math.ceil(len(handle_of) / fitting)
            picture.set_size_inches(size[0], size[1] + 0.17 * lines)
        below: Any = {"loc": "outside lower center", "ncols": fitting, "fontsize": 8}
        picture.legend([*handle_of.values()], [*handle_of], frameon=False, **below)
    else:
        for axes, (_, names) in zip(panels, shown, strict=True):
            if names:
                axes.legend(frameon=False, fontsize=7)


#: The styles of lines that have the same color.
_STYLES = ("-", "--", ":", "-.")


def _lines(figure: Figure) -> dict[str, dict[str, Any]]:
    """Return color, style and width of each curve's line, the same in all panels.

    If there are more names than colors, curves of one agent share its color. If the
    styles are too few for that, or if the names are numbers, colors go from dark to
    light. The figure's subject is thick.
    """
    names = figure.names()
    agent_of = {name: curve.agent for _, name, curve in figure.curves()}
    alike = {
        name: [x for x in names if agent_of[x] == agent_of[name]] for name in names
    }
    many = len(names) > len(plotting.COLORS)
    few_styles = many and max(map(len, alike.values())) > len(_STYLES)
    style_of = dict.fromkeys(names, "-")
    if few_styles or all(map(str.isdecimal, names)):
        shades = matplotlib.colormaps["viridis"](np.linspace(0.0, 0.9, len(names)))
        color_of: dict[str, Any] = dict(zip(names, shades, strict=True))
    elif many:
        agents = _with_free_colors(dict.fromkeys(agent_of.values()))
        color_of = {name: agents[agent_of[name]] for name in names}
        style_of = {name: _STYLES[alike[name].index(name)] for name in names}
    else:
        color_of = _with_free_colors(names)
    return {
        name: {
            "color": color_of[name],
            "linestyle": style_of[name],
            "linewidth": 2.4 if name == figure.favourite else 1.2,
        }
        for name in names
    }


def _with_free_colors(names: Collection[str]) -> dict[str, Any]:
    """Return each agent's own color, and for other names the colors that are left."""
    color_of = {name: _COLOR_OF[name] for name in names if name in _COLOR_OF}
    free = itertools.cycle(
        [x for x in plotting.COLORS if x not in color_of.values()] or ["gray"]
    )
    return {name: color_of.get(name) or next(free) for name in names}


#: Largest number of bands in a panel, and of lines that are labelled at their ends.
_MOST_BANDS, _MOST_LABELS = 5, 12


def _has_direct_labels(figure: Figure) -> bool:
    """Return whether lines are labelled at their ends, and not in a legend."""
    if figure.over or figure.solved_from is not None:
        return False
    return max(map(len, figure.panels.values())) <= _MOST_LABELS


def _draw_curves(figure: Figure, panel: str, records: Records, *, axes: Any) -> None:
    """Draw learning curves: the interquartile mean over seeds.

    The figure's subject is thick. It and the curves that end highest, at most five in
    all, have a band, their 95% interval. Where tasks are either solved or not, curves
    are the share of seeds that solve the task.
    """
    lines, drawn = _lines(figure), {}
    for label in figure.panels[panel]:
        if (panel, label) not in records:
            continue
        seeds = records[panel, label]
        # Returns are compared at the steps of the record with the fewest rows.
        steps = min((record.env_steps for record in seeds), key=len)
        returns = np.array(
            [np.interp(steps, x.env_steps, x.episode_return) for x in seeds]
        )
        if figure.solved_from is not None:
            half = figure.solved_from(figure.panels[panel][label].env) / 2
            share = np.mean(returns >= half, axis=0)
            axes.plot(steps / 1e6, share, label=label, **lines[label])
            axes.set_ylim(-0.03, 1.03)
            continue
        finite = np.isfinite(returns).all(axis=0)
        if finite.any():
            drawn[label] = steps[finite] / 1e6, returns[:, finite]
    middle_of = {x: interquartile_mean(returns, 0) for x, (_, returns) in drawn.items()}
    # The subject first, then the highest.
    ranked = sorted(middle_of, key=lambda x: -middle_of[x][-1])
    banded = sorted(ranked, key=lambda x: x != figure.favourite)[:_MOST_BANDS]
    for label, (steps, returns) in drawn.items():
        if label in banded:
            low, high = bootstrap_interval(returns, resamples=500)
            band = {"color": lines[label]["color"], "alpha": 0.2, "linewidth": 0}
            axes.fill_between(steps, low, high, **band)
        axes.plot(steps, middle_of[label], label=label, **lines[label])
    if figure.floor:
        # Before labels, whose places depend on the limits.
        env = next(iter(figure.panels[panel].values())).env
        floor = doing_nothing.stored()[env].mean
        axes.axhline(floor, color="gray", linestyle=(0, (1, 1)), linewidth=1.0)
        at = axes.get_yaxis_transform()
        words = {"color": "gray", "fontsize": 6, "va": "bottom", "transform": at}
        axes.text(0.01, floor, "doing nothing", **words)
    if _has_direct_labels(figure):
        ends = {label: float(middle_of[label][-1]) for label in ranked}
        color_of = {label: lines[label]["color"] for label in ends}
        plotting.label_ends(axes, ends, color_of)
    axes.set_xlabel("million steps")


def _draw_over(figure: Figure, panel: str, scores: Scores, *, axes: Any) -> None:
    """Draw final returns over a setting; a line joins curves that differ only in it."""
    curves = figure.panels[panel]
    color_of = _with_free_colors(dict.fromkeys(x.agent for *_, x in figure.curves()))
    lines: dict[str, dict[Any, str]] = {}
    for name in curves:
        line, value = figure.point_of(panel, name)
        lines.setdefault(line, {})[value] = name
    values = sorted({value for points in lines.values() for value in points})
    drawn: list[str] = []
    for i, (line, points) in enumerate(lines.items()):
        complete = [x for x in points if (panel, points[x]) in scores]
        agent = next(curves[name].agent for name in points.values())
        style = _STYLES[drawn.count(agent) % len(_STYLES)]
        drawn.append(agent)
        if not complete:
            continue
        finals = [scores[panel, points[x]] for x in complete]
        middle = np.array([interquartile_mean(x) for x in finals])
        low, high = np.array([bootstrap_interval(x) for x in finals]).T
        axes.errorbar(
            # Each line is shifted sideways, so that no interval hides another.
            np.array(complete) * 1.06 ** (i - (len(lines) - 1) / 2),
            middle,
            [middle - low, high - middle],
            color=color_of[agent],
            linestyle=style,
            **{"marker": "o", "markersize": 3, "capsize": 2},
            label=line,
        )
    _, label = figure.over or ("", "")
    limits = (0.7 * values[0], 1.4 * values[-1])
    axes.set(xlabel=label, xscale="log", xlim=limits)
    axes.set_xticks(values, list(map(str, values)))
    axes.minorticks_off()


def save_png(picture: Picture, path: pathlib.Path, dpi: int = 80) -> None:
    """Write a small PNG, of 256 colors."""
    with io.BytesIO() as buffer:
        picture.savefig(buffer, format="png", dpi=dpi)
        image = Image.open(buffer).convert("RGB").quantize(256)
    path.parent.mkdir(parents=True, exist_ok=True)
    with output_file.atomic(path) as partial:
        image.save(partial, optimize=True)

"""Draw learning curves, and the returns of a sweep over its hyperparameters."""

import pathlib
import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from gasil_jax.statistics import (
    FEWEST_SEEDS,
    bootstrap_interval,
    interquartile_mean,
)

#: The palette of Okabe and Ito, which colour-blind readers can distinguish. Its yellow
#: is too light for lines and is left out; grey and brown are added.
COLORS = (
    "#0072B2",
    "#D55E00",
    "#009E73",
    "#CC79A7",
    "#E69F00",
    "#56B4E9",
    "#000000",
    "#999999",
    "#8C510A",
)

_MOST_PARTS = 50


def binned_returns(
    env_steps: np.ndarray, returns: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean returns, (seeds, iterations), over 50 equal parts of training.

    Parts in which not every seed has ended an episode are left out. They are given by
    the steps at their ends, (parts,), and the means, (seeds, parts).
    """
    parts = np.array_split(np.arange(len(env_steps)), min(_MOST_PARTS, len(env_steps)))
    complete = [x for x in parts if np.isfinite(returns[:, x]).any(axis=1).all()]
    if not complete:
        return env_steps[:0], returns[:, :0]
    steps = np.array([env_steps[part[-1]] for part in complete])
    means = [np.nanmean(returns[:, part], axis=1) for part in complete]
    return steps, np.stack(means, axis=1)


def smoothed(returns: np.ndarray, window: int) -> np.ndarray:
    """Return the means over each point and those before it, `window` in all."""
    means = [
        returns[..., max(0, end - window) : end].mean(axis=-1)
        for end in range(1, returns.shape[-1] + 1)
    ]
    return np.stack(means, axis=-1)


def unit_of_steps(most: float) -> tuple[float, str]:
    """Return the unit in which steps up to `most` are drawn, and its name."""
    if most >= 500_000:
        return 1e6, "million steps of a seed"
    return (1e3, "thousand steps of a seed") if most >= 5_000 else (1.0, "steps")


def plain_ticks(axes: Any) -> None:
    """Let ticks of linear axes be whole numbers without an offset, and not too many."""
    for name, axis in (("x", axes.xaxis), ("y", axes.yaxis)):
        if axis.get_scale() == "linear":
            axes.ticklabel_format(axis=name, useOffset=False, style="plain")
            axes.locator_params(axis=name, nbins=6)


def draw_returns(
    axes: Any,
    env_steps: np.ndarray,
    returns: np.ndarray,
    *,
    evaluations: Mapping[str, np.ndarray] | None,
    color: str,
    label: str = "training",
    evaluated: str = "evaluations",
    style: str = "-",
    unit: float = 1e6,
) -> None:
    """Draw the interquartile mean of returns, (seeds, points), and its 95% interval.

    The interval is drawn from five seeds on. `evaluations` has "env_steps" and "mean",
    (seeds, evaluations) each, drawn dashed; `unit` is the number of steps that is 1.
    """
    if len(env_steps):
        steps, middle = env_steps / unit, interquartile_mean(returns, axis=0)
        if len(returns) >= FEWEST_SEEDS:
            low, high = bootstrap_interval(returns)
            axes.fill_between(steps, low, high, color=color, alpha=0.2, linewidth=0)
        axes.plot(steps, middle, style, color=color, label=label)
    if evaluations is not None:
        steps = evaluations["env_steps"][0] / unit
        middle = interquartile_mean(evaluations["mean"], axis=0)
        axes.plot(steps, middle, "--", color=color, linewidth=1, label=evaluated)


def write_caption(figure: Any, num_seeds: Sequence[int], more: str = "") -> None:
    """Write below a figure what its lines and intervals are."""
    *others, largest = sorted(set(num_seeds))
    seeds = f"{', '.join(map(str, others))}{' or ' if others else ''}{largest}"
    seeds += " seed" if largest == 1 else " seeds"
    shaded = ", shaded its 95% interval" if largest >= FEWEST_SEEDS else ""
    if shaded and min(num_seeds) < FEWEST_SEEDS:
        shaded += f" from {FEWEST_SEEDS} seeds on"
    text = f"interquartile mean over {seeds}{shaded}{more}"
    figure.supxlabel(text, fontsize="small", color="0.3")


def learning_curve(
    path: pathlib.Path,
    env_steps: np.ndarray,
    episode_return: np.ndarray,
    *,
    title: str,
    evaluations: Mapping[str, np.ndarray] | None = None,
) -> None:
    """Save the returns, (seeds, iterations), of all seeds, with mean and interval."""
    from matplotlib.figure import Figure

    steps, returns = binned_returns(env_steps, episode_return)
    figure = Figure(figsize=(6.4, 4.2), layout="constrained")
    axes = figure.subplots()
    unit, words = unit_of_steps(env_steps[-1] if len(env_steps) else 0)
    axes.plot(steps / unit, returns.T, color="0.75", linewidth=0.8)
    shown: dict[str, Any] = {"evaluations": evaluations, "color": COLORS[0]}
    draw_returns(axes, steps, returns, unit=unit, **shown)
    axes.set(xlabel=words, ylabel="episode return")
    plain_ticks(axes)
    if evaluations is not None:
        axes.legend(frameon=False)
    elif not len(steps):
        where: dict[str, Any] = {"ha": "center", "transform": axes.transAxes}
        axes.text(0.5, 0.5, "not every seed has ended an episode", **where)
    axes.set_title(title)
    write_caption(figure, [len(returns)], "; grey: each seed")
    figure.savefig(path, dpi=150)


#: The number of best points whose learning curves stand beside their final returns.
_MOST_CURVES = 5


def final_returns(
    path: pathlib.Path,
    labels: Sequence[str],
    returns: np.ndarray,
    *,
    title: str,
    env_steps: np.ndarray,
    curves: np.ndarray,
) -> None:
    """Save every seed's return, (points, seeds), in a row a point, the best mean first.

    Beside them are the best points' curves, (points, seeds, iterations).
    """
    from matplotlib.figure import Figure

    order = np.argsort(-np.nan_to_num(returns.mean(axis=1), nan=-np.inf), kind="stable")
    # A label is no wider than half of the rows. Its numbers have hyphens: 3e-05.
    wrapped = [
        textwrap.fill(f"{number}: {labels[number]}", 48, break_on_hyphens=False)
        for number in order
    ]
    lines = 1 + max(label.count("\n") for label in wrapped)
    # Matplotlib refuses pictures of more than 2**16 pixels.
    height = min(max(1.6 + (0.22 + 0.13 * lines) * len(labels), 3.6), 400.0)
    figure = Figure(figsize=(13.0, height), layout="constrained")
    axes, beside = figure.subplots(1, 2, width_ratios=(8, 5))
    unit, words = unit_of_steps(np.nanmax(env_steps))
    for row, point in enumerate(order):
        color = COLORS[row] if row < _MOST_CURVES else "0.4"
        axes.plot(returns[point], [row] * returns.shape[1], "o", color="0.7", ms=4)
        mean = {"color": color, "markersize": 14, "mew": 2}
        axes.plot(returns[point].mean(), row, "|", **mean)
        if row < _MOST_CURVES:
            whole = np.isfinite(env_steps[point])
            own = binned_returns(env_steps[point, whole], curves[point][:, whole])
            look: dict[str, Any] = {"evaluations": None, "color": color}
            draw_returns(beside, *own, label=f"{point}", unit=unit, **look)
    axes.set_yticks(range(len(order)), wrapped, fontsize=8)
    axes.get_yticklabels()[0].set(color=COLORS[0], weight="bold")
    axes.set(xlabel="final return of each seed; the bar is their mean")
    axes.invert_yaxis()
    beside.set(xlabel=words, ylabel="episode return", title="the best points")
    if beside.get_lines():
        beside.legend(frameon=False, title="point")
    axes.ticklabel_format(axis="x", useOffset=False, style="plain")
    plain_ticks(beside)
    figure.suptitle(title)
    figure.savefig(path, dpi=150)


def marginals(
    path: pathlib.Path,
    values: Mapping[str, Sequence[Any]],
    returns: np.ndarray,
    *,
    title: str,
    best: int | None,
    left_out: int,
) -> None:
    """Save a panel for each hyperparameter: the points' mean returns over its values.

    Returns are (points,), without the `left_out` points that have none; the `best` one
    is marked.
    """
    from matplotlib.figure import Figure

    columns = min(len(values), 3)
    rows = -(-len(values) // columns)
    size = (0.8 + 3.6 * columns, 1.4 + 2.8 * rows)
    figure = Figure(figsize=size, layout="constrained")
    grid = figure.subplots(rows, columns, sharey=True, squeeze=False)
    for axes, name in zip(grid.flat, values):
        _draw_marginal(axes, values[name], returns, best=best)
        axes.set(xlabel=name.replace("_", " "))
    for axes in grid.flat[len(values) :]:
        axes.remove()
    for axes in grid[:, 0]:
        axes.set_ylabel("final return")
        axes.ticklabel_format(axis="y", useOffset=False, style="plain")
    handles, labels = grid[0, 0].get_legend_handles_labels()
    above: dict[str, Any] = {"loc": "outside upper center", "ncols": len(labels)}
    named: dict[str, Any] = {"title": title, "title_fontsize": "large"}
    figure.legend(handles, labels, frameon=False, **named, **above)
    text = "point: mean over its seeds; mean: over the points of each value"
    if left_out:
        text += f"; {left_out} of {len(returns) + left_out} points are left out, "
        text += "because a seed has no return"
    text = textwrap.fill(text, 10 + 50 * columns)
    figure.supxlabel(text, fontsize="small", color="0.3")
    figure.savefig(path, dpi=150)


#: With more values than these, ticks are where Matplotlib puts them.
_MOST_TICKS = 10


def _mark_tried(axes: Any, values: np.ndarray) -> None:
    """Put a tick at each value, with its number where there is room for it."""
    places = axes.xaxis.get_transform().transform(values)
    names, free = [], -np.inf
    for value, place in zip(values, places, strict=True):
        name = f"{value:g}"
        half = 0.015 * len(name) * np.ptp(places)
        names.append(name if place - half >= free else "")
        free = place + half if names[-1] else free
    axes.set_xticks(values, names)
    axes.set_xticks([], minor=True)


def _draw_marginal(
    axes: Any, values: Sequence[Any], returns: np.ndarray, *, best: int | None
) -> None:
    """Draw the points' returns over one hyperparameter, and the mean of each value."""
    if not isinstance(values[0], str):
        places, style = np.array(values, float), "-D"
        positive = places[places > 0.0]
        # In floats 3e-4 / 3e-5 is less than 10.
        if positive.size and positive.max() > 9.99 * positive.min():
            # Values that are not positive lie on the linear part about 0.
            linear = {"linthresh": positive.min()} if places.min() <= 0.0 else {}
            axes.set_xscale("symlog" if linear else "log", **linear)
        if len(tried := np.unique(places)) <= _MOST_TICKS:
            _mark_tried(axes, tried)
    else:
        names = list(dict.fromkeys(values))
        places, style = np.array([names.index(x) for x in values]), "D"
        axes.set_xticks(range(len(names)), [str(name) for name in names])
    centres = np.unique(places)
    means = [returns[places == centre].mean() for centre in centres]
    axes.plot(centres, means, style, color=COLORS[0], markersize=6, label="mean")
    axes.plot(places, returns, "o", color="0.3", markersize=3, label="point")
    axes.margins(x=0.1)
    if best is not None:
        marked = {"color": COLORS[1], "markersize": 13, "label": "best point"}
        axes.plot(places[best], returns[best], "*", **marked)

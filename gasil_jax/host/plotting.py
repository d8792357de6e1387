"""Draw learning curves, and the returns of a sweep over its hyperparameters."""

import pathlib
import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from gasil_jax.statistics import (
    FEWEST_SEEDS,
    are_numbers,
    bootstrap_interval,
    groups,
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
    """Return the mean returns over equal parts of training, at most 50.

    Parts in which not every seed has ended an episode are left out.

    Args:
      env_steps: (iterations,).
      returns: (seeds, iterations), NaN where no episode ended.

    Returns:
      The steps at the end of each part, (parts,), and the means, (seeds, parts).
    """
    parts = np.array_split(np.arange(len(env_steps)), min(_MOST_PARTS, len(env_steps)))
    complete = [x for x in parts if np.isfinite(returns[:, x]).any(axis=1).all()]
    if not complete:
        return env_steps[:0], returns[:, :0]
    steps = np.array([env_steps[part[-1]] for part in complete])
    means = [np.nanmean(returns[:, part], axis=1) for part in complete]
    return steps, np.stack(means, axis=1)


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
) -> None:
    """Draw the interquartile mean over seeds and, from five seeds on, its 95% interval.

    Steps are (points,), and returns (seeds, points). "env_steps" and "mean" of the
    evaluations are (seeds, evaluations); their interquartile mean is dashed.
    """
    if len(env_steps):
        steps, middle = env_steps / 1e6, interquartile_mean(returns, axis=0)
        if len(returns) >= FEWEST_SEEDS:
            low, high = bootstrap_interval(returns)
            axes.fill_between(steps, low, high, color=color, alpha=0.2, linewidth=0)
        axes.plot(steps, middle, style, color=color, label=label)
    if evaluations is not None:
        steps = evaluations["env_steps"][0] / 1e6
        middle = interquartile_mean(evaluations["mean"], axis=0)
        axes.plot(steps, middle, "--", color=color, linewidth=1, label=evaluated)
    axes.set(xlabel="million steps of a seed", ylabel="episode return")


def label_ends(
    axes: Any, ends: Mapping[str, float], color_of: Mapping[str, Any]
) -> None:
    """Write names beside the ends of lines, apart from each other."""
    low, high = axes.get_ylim()
    gap = 0.06  # Of the height of the axes, for this font size.
    heights = [(y - low) / (high - low) for y in ends.values()]
    for i in range(1, len(heights)):
        heights[i] = min(heights[i], heights[i - 1] - gap)
    # What was moved below the axes is moved up again, and pushes the others.
    floor = 0.0
    for i in reversed(range(len(heights))):
        heights[i] = max(heights[i], floor)
        floor = heights[i] + gap
    for name, height in zip(ends, heights, strict=True):
        style = {"xycoords": "axes fraction", "va": "center", "fontsize": 7}
        axes.annotate(name, (1.02, height), color=color_of[name], **style)


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
    """Save the returns over environment steps as a PNG: all seeds, mean and interval.

    Steps are (iterations,), and returns (seeds, iterations), NaN where no episode
    ended; evaluations are as in `draw_returns`.
    """
    from matplotlib.figure import Figure

    steps, returns = binned_returns(env_steps, episode_return)
    figure = Figure(figsize=(6.4, 4.2), layout="constrained")
    axes = figure.subplots()
    axes.plot(steps / 1e6, returns.T, color="0.75", linewidth=0.8)
    draw_returns(axes, steps, returns, evaluations=evaluations, color=COLORS[0])
    if evaluations is not None:
        axes.legend(frameon=False)
    elif not len(steps):
        where: dict[str, Any] = {"ha": "center", "transform": axes.transAxes}
        axes.text(0.5, 0.5, "not every seed has ended an episode", **where)
    axes.set_title(title)
    write_caption(figure, [len(returns)], "; grey: each seed")
    figure.savefig(path, dpi=150)


def final_returns(
    path: pathlib.Path,
    labels: Sequence[str],
    returns: np.ndarray,
    *,
    best: int | None,
) -> None:
    """Save every seed's final return, (points, seeds), and their mean, row by row.

    The best point by mean is marked, if there is one.
    """
    from matplotlib.figure import Figure

    # A label is no wider than half of the figure. Its numbers have hyphens: 3e-05.
    wrapped = [
        textwrap.fill(f"{number}: {label}", 48, break_on_hyphens=False)
        for number, label in enumerate(labels)
    ]
    lines = 1 + max(label.count("\n") for label in wrapped)
    # Matplotlib refuses pictures of more than 2**16 pixels.
    size = (8.0, min(1.4 + (0.22 + 0.13 * lines) * len(labels), 400.0))
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots()
    for row, seeds in enumerate(returns):
        axes.plot(seeds, [row] * len(seeds), "o", color="0.7", markersize=4)
        color = COLORS[1] if row == best else COLORS[0]
        axes.plot(seeds.mean(), row, "|", color=color, markersize=14, mew=2)
    axes.set_yticks(range(len(labels)), wrapped, fontsize=8)
    if best is not None:
        axes.get_yticklabels()[best].set(color=COLORS[1], weight="bold")
    axes.set(xlabel="final return of each seed; the bar is their mean")
    axes.set_title("the best mean is orange" if best is not None else "", fontsize=9)
    axes.invert_yaxis()
    figure.savefig(path, dpi=150)


def marginals(
    path: pathlib.Path,
    values: Mapping[str, Sequence[Any]],
    returns: np.ndarray,
    *,
    best: int | None,
    left_out: int,
) -> None:
    """Save a panel for each hyperparameter: the points' returns over its values.

    Args:
      path: the image file.
      values: each point's value of every hyperparameter that varies, by name.
      returns: each point's mean final return, (points,), all finite.
      best: index of the point that is marked.
      left_out: number of points without a return, which are not among these.
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
    handles, labels = grid[0, 0].get_legend_handles_labels()
    above: dict[str, Any] = {"loc": "outside upper center", "ncols": len(labels)}
    figure.legend(handles, labels, frameon=False, **above)
    text = "point: mean over its seeds; mean: over the points of each value"
    if any(len(groups(x)) < len(set(x)) for x in values.values()):
        text += ", or of neighbouring values with fewer than two points each"
    if left_out:
        text += f"; {left_out} of {len(returns) + left_out} points are left out, "
        text += "because a seed has no return"
    text = textwrap.fill(text, 10 + 50 * columns)
    figure.supxlabel(text, fontsize="small", color="0.3")
    figure.savefig(path, dpi=150)


def _draw_marginal(
    axes: Any, values: Sequence[Any], returns: np.ndarray, *, best: int | None
) -> None:
    """Draw the points' returns over one hyperparameter, and the means of its groups."""
    parts = groups(values)
    if are_numbers(values):
        places, style = np.array(values, float), "-D"
        positive = places[places > 0.0]
        # In floats 3e-4 / 3e-5 is less than 10.
        if positive.size and positive.max() > 9.99 * positive.min():
            # Values that are not positive lie on the linear part about 0.
            linear = {"linthresh": positive.min()} if places.min() <= 0.0 else {}
            axes.set_xscale("symlog" if linear else "log", **linear)
        distinct = np.unique(places)
        shown = axes.xaxis.get_transform().transform(distinct)
        if np.diff(shown).min(initial=np.inf) > 0.15 * np.ptp(shown):
            axes.set_xticks(distinct, [f"{value:g}" for value in distinct])
            axes.set_xticks([], minor=True)
    else:
        names = list(dict.fromkeys(values))
        places, style = np.array([names.index(x) for x in values]), "D"
        axes.set_xticks(range(len(names)), [str(name) for name in names])
    centres = [np.median(places[part]) for part in parts]
    means = [returns[part].mean() for part in parts]
    axes.plot(centres, means, style, color=COLORS[0], markersize=6, label="mean")
    axes.plot(places, returns, "o", color="0.3", markersize=3, label="point")
    axes.margins(x=0.1)
    if best is not None:
        marked = {"color": COLORS[1], "markersize": 13, "label": "best point"}
        axes.plot(places[best], returns[best], "*", **marked)

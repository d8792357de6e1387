"""Draw learning curves."""

import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from gasil_envs.pictures import point_mass_layout as point_mass_layout
from gasil_jax.figures.statistics import bootstrap_interval, interquartile_mean

#: Okabe and Ito's colours, which colour-blind readers can distinguish.
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")


_POINTS = 50


def in_parts(
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
    parts = np.array_split(np.arange(len(env_steps)), min(_POINTS, len(env_steps)))
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
    evaluations: Mapping[str, np.ndarray] | None,
    *,
    color: str,
    label: str = "training",
    evaluated: str = "evaluations",
    style: str = "-",
) -> None:
    """Draw the interquartile mean over seeds with its 95% interval.

    Args:
      axes: where to draw; steps are in millions.
      env_steps: (points,).
      returns: (seeds, points).
      evaluations: "env_steps" and "mean" of the evaluations during training, (seeds,
        evaluations) each, whose interquartile mean is dashed; None if there are none.
      color: color of the line, the interval and the evaluations.
      label: label in the legend.
      evaluated: label of the evaluations.
      style: style of the line.
    """
    if len(env_steps):
        low, high = bootstrap_interval(returns)
        steps, middle = env_steps / 1e6, interquartile_mean(returns, axis=0)
        axes.fill_between(steps, low, high, color=color, alpha=0.2, linewidth=0)
        axes.plot(steps, middle, style, color=color, label=label)
    if evaluations is not None:
        steps = evaluations["env_steps"][0] / 1e6
        middle = interquartile_mean(evaluations["mean"], axis=0)
        axes.plot(steps, middle, "--", color=color, linewidth=1, label=evaluated)
    axes.set(xlabel="million steps of a seed", ylabel="episode return")


def write_caption(figure: Any, num_seeds: Sequence[int], more: str = "") -> None:
    """Write below a figure what its lines and intervals are.

    Args:
      figure: the figure.
      num_seeds: number of seeds of each line.
      more: what else there is to say.
    """
    *others, largest = sorted(set(num_seeds))
    seeds = f"{', '.join(map(str, others))}{' or ' if others else ''}{largest}"
    seeds += " seed" if largest == 1 else " seeds"
    text = f"interquartile mean over {seeds}, shaded its 95% interval{more}"
    figure.supxlabel(text, fontsize="small", color="0.3")


def save(figure: Any, path: pathlib.Path, dpi: int) -> None:
    """Write a figure in the format of the path's suffix and close the figure."""
    import matplotlib.pyplot as plt

    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=dpi)
    plt.close(figure)


def learning_curve(
    path: pathlib.Path,
    env_steps: np.ndarray,
    episode_return: np.ndarray,
    title: str,
    *,
    evaluations: Mapping[str, np.ndarray] | None = None,
) -> None:
    """Save the returns over environment steps as a PNG: all seeds, mean and interval.

    Args:
      path: the image file.
      env_steps: (iterations,).
      episode_return: (seeds, iterations); NaN where no episode ended.
      title: title of the plot.
      evaluations: "env_steps" and "mean" of the evaluations during training, (seeds,
        evaluations) each; None if there are none.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    steps, returns = in_parts(env_steps, episode_return)
    figure, axes = plt.subplots(figsize=(6.4, 4.2), layout="constrained")
    axes.plot(steps / 1e6, returns.T, color="0.75", linewidth=0.8)
    draw_returns(axes, steps, returns, evaluations, color=COLORS[0])
    if evaluations is not None:
        axes.legend(frameon=False)
    elif not len(steps):
        where: dict[str, Any] = {"ha": "center", "transform": axes.transAxes}
        axes.text(0.5, 0.5, "not every seed has ended an episode", **where)
    axes.set_title(title)
    write_caption(figure, [len(returns)], "; grey: each seed")
    save(figure, path, dpi=150)

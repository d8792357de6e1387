"""Draw learning curves."""

import pathlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from gasil_envs.pictures import point_mass_layout as point_mass_layout

#: Okabe and Ito's colours, which colour-blind readers can distinguish.
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")


def smooth(curve: np.ndarray, window: int) -> np.ndarray:
    """Return the running mean over the last `window` entries: (..., n) -> (..., n).

    NaN entries are left out; where all are NaN, so is the mean.
    """
    finite = np.isfinite(curve)
    pad = lambda x: np.concatenate([np.zeros((*x.shape[:-1], window)), x], axis=-1)
    total = np.cumsum(pad(np.where(finite, curve, 0.0)), axis=-1)
    count = np.cumsum(pad(finite.astype(float)), axis=-1)
    total = total[..., window:] - total[..., :-window]
    count = count[..., window:] - count[..., :-window]
    return np.where(count > 0, total / np.maximum(count, 1.0), np.nan)


def draw_band(
    axes: Any,
    steps: np.ndarray,
    mean: np.ndarray,
    spread: np.ndarray,
    color: str,
    label: str | None = None,
) -> None:
    """Draw a curve with `spread` shaded on both sides of it; all arrays are (n,)."""
    low, high = mean - spread, mean + spread
    axes.fill_between(steps, low, high, color=color, alpha=0.2, linewidth=0)
    axes.plot(steps, mean, color=color, label=label)


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
    """Save mean, spread and each seed's return over environment steps as a PNG.

    Each point is a mean over the preceding fiftieth of training. The mean of the
    evaluations is dashed.

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

    episode_return = smooth(episode_return, max(1, len(env_steps) // 50))
    figure, axes = plt.subplots(figsize=(6.4, 4.0), layout="constrained")
    for curve in episode_return:
        axes.plot(env_steps, curve, color="0.75", linewidth=0.8)
    has_return = np.isfinite(episode_return).any(axis=0)
    if has_return.any():
        seen, steps = episode_return[:, has_return], env_steps[has_return]
        mean, spread = np.nanmean(seen, axis=0), np.nanstd(seen, axis=0)
        draw_band(axes, steps, mean, spread, "#0072B2", "mean ± standard deviation")
    if evaluations is not None:
        steps, mean = evaluations["env_steps"][0], evaluations["mean"].mean(axis=0)
        axes.plot(steps, mean, "--", color="#D55E00", label="mean of the evaluations")
    if has_return.any() or evaluations is not None:
        axes.legend(frameon=False, loc="upper left")
    axes.set(xlabel="environment steps", ylabel="episode return", title=title)
    save(figure, path, dpi=150)

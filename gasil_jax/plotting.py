"""Learning curves from metrics."""

import pathlib

import numpy as np


def learning_curve(
    path: pathlib.Path, env_steps: np.ndarray, episode_return: np.ndarray, title: str
) -> None:
    """Save mean, spread and each seed's return over environment steps as a PNG.

    Args:
      path: where to.
      env_steps: (iterations,).
      episode_return: (seeds, iterations); NaN where no episode ended.
      title: of the plot.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(6.4, 4.0), layout="constrained")
    for curve in episode_return:
        axes.plot(env_steps, curve, color="0.75", linewidth=0.8)
    some = np.isfinite(episode_return).any(axis=0)
    if some.any():
        seen, steps = episode_return[:, some], env_steps[some]
        mean, spread = np.nanmean(seen, axis=0), np.nanstd(seen, axis=0)
        axes.fill_between(
            steps, mean - spread, mean + spread, color="#0072B2", alpha=0.2
        )
        axes.plot(steps, mean, color="#0072B2", label="mean ± standard deviation")
        axes.legend(frameon=False, loc="upper left")
    axes.set(xlabel="environment steps", ylabel="episode return", title=title)
    figure.savefig(path, dpi=150)
    plt.close(figure)

"""PPO's learning curves on three tasks: ``python -m experiments.ppo_mujoco``.

Five seeds of 1M steps each; about 25 minutes on two CPU cores.
"""

import pathlib
import sys

import matplotlib
import numpy as np

from gasil_jax import logging, plotting, run

FIGURE = pathlib.Path(__file__).parent / "figures" / "ppo.png"
ENVIRONMENTS = ("walker2d", "hopper", "halfcheetah")
SEEDS = 5


def plot(folders: dict[str, pathlib.Path], path: pathlib.Path) -> None:
    """A panel for each environment: every seed, their mean and spread."""
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    size = (10.0, 3.2)
    figure, panels = plt.subplots(1, len(folders), figsize=size, layout="constrained")
    for panel, (env, folder) in zip(panels, folders.items(), strict=True):
        metrics = logging.read_metrics(folder / "metrics.csv", ("seed",), SEEDS)
        steps = metrics["env_steps"][0]
        returns = plotting.smooth(metrics["episode_return"], len(steps) // 50)
        some = np.isfinite(returns).any(axis=0)
        steps, returns = steps[some] / 1e6, returns[:, some]
        for curve in returns:
            panel.plot(steps, curve, color="0.75", linewidth=0.8)
        mean, spread = np.nanmean(returns, axis=0), np.nanstd(returns, axis=0)
        plotting.draw_band(panel, steps, mean, spread, "#0072B2")
        panel.set(title=f"{env}, PPO", xlabel="million steps")
    panels[0].set_ylabel("episode return")
    plotting.save(figure, path, dpi=100)


def main() -> int:
    """Train what has not been trained yet, then plot."""
    folders = {env: pathlib.Path("runs", "ppo_mujoco", env) for env in ENVIRONMENTS}
    for env, folder in folders.items():
        arguments = ["--env", env, "--agent", "ppo", "--seeds", str(SEEDS)]
        if not (folder / "summary.json").exists() and (
            status := run.main([*arguments, "--out", str(folder)])
        ):
            return status
    plot(folders, FIGURE)
    print(FIGURE)
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""Delayed reward (paper, section 5.4): ``python -m experiments.delayed_mujoco``.

Hopper and Walker2d with the reward given every 20 steps, PPO (which is PPO+GASIL with
alpha 0) against PPO+GASIL at the appendix's values of alpha, ten seeds each. On one
H200 about 17 minutes for each task; on two CPU cores about a day.
"""

import json
import pathlib
import sys

import matplotlib
import numpy as np

from gasil_jax import plotting, sweep

FIGURE = pathlib.Path(__file__).parent / "figures" / "delayed_mujoco.png"
ENVIRONMENTS = ("hopper", "walker2d")
ALPHAS = (0.0, 0.02, 0.1, 0.2, 1.0)
STEPS = 1_000_000


def train(env: str, folder: pathlib.Path) -> int:
    """Run the sweep of one environment, or go on with it; returns the exit status."""
    return sweep.main(
        [
            *("--env", env, "--agent", "ppo+gasil", "--reward-delay", "20"),
            *("--seeds", "10", "--total-steps", str(STEPS), "--out", str(folder)),
            *("--resume", "--grid", "alpha=" + ",".join(map(str, ALPHAS))),
        ]
    )


def plot(folders: dict[str, pathlib.Path], path: pathlib.Path) -> None:
    """Learning curves of all alphas, a panel for each environment."""
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(1, 2, figsize=(9.0, 3.6), layout="constrained")
    colors = ("0.3", "#56B4E9", "#0072B2", "#E69F00", "#D55E00")
    for panel, (env, folder) in zip(panels, folders.items(), strict=True):
        points = json.loads((folder / "summary.json").read_text())["points"]
        curves = np.load(folder / "curves.npz")["episode_return"]
        steps = np.linspace(0, STEPS / 1e6, curves.shape[-1])
        for point, seeds, color in zip(points, curves, colors, strict=True):
            mean = np.nanmean(seeds, axis=0)
            error = np.nanstd(seeds, axis=0) / np.sqrt(len(seeds))
            alpha = point["alpha"]
            label = f"PPO+GASIL, alpha {alpha:g}" if alpha else "PPO"
            plotting.draw_band(panel, steps, mean, error, color, label)
        panel.set(title=f"{env}, reward every 20 steps", xlabel="million steps")
    panels[0].set_ylabel("episode return")
    panels[0].legend(frameon=False, fontsize=8)
    plotting.save(figure, path, dpi=110)


def main() -> int:
    """Train what has not been trained yet, then plot."""
    folders = {env: pathlib.Path("runs", "delayed_mujoco", env) for env in ENVIRONMENTS}
    for env, folder in folders.items():
        if not (folder / "summary.json").exists() and (status := train(env, folder)):
            return status
    plot(folders, FIGURE)
    print(FIGURE)
    return 0


if __name__ == "__main__":
    sys.exit(main())

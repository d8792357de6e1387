"""Draw the point mass' layout: ``python -m experiments.point_mass_layout``."""

import pathlib

import matplotlib
import numpy as np

from gasil_envs.point_mass import Layout
from gasil_jax import plotting

FIGURE = pathlib.Path(__file__).parent / "figures" / "point_mass_layout.png"


def draw(layout: Layout, path: pathlib.Path) -> None:
    """Save a drawing of the box, the objects with their reach, and the start."""
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(4.0, 4.0), layout="constrained")
    count = len(layout.blue + layout.green + layout.orange)
    plotting.point_mass_layout(axes, layout, np.zeros(count, bool))
    (x, y) = layout.start
    axes.text(x, y, "start", ha="center", va="center", fontsize=9)
    plotting.save(figure, path, dpi=100)


if __name__ == "__main__":
    draw(Layout(), FIGURE)
    print(FIGURE)

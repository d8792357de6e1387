"""Draw the point mass' layout: ``python -m experiments.point_mass_layout``."""

import pathlib

import matplotlib

from gasil_envs.point_mass import Layout

FIGURE = pathlib.Path(__file__).parent / "figures" / "point_mass_layout.png"


def draw(layout: Layout, path: pathlib.Path) -> None:
    """Save a drawing of the box, the objects with their reach, and the start."""
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(4.0, 4.0), layout="constrained")
    kinds = (
        (layout.blue, "#0072B2", layout.blue_reward),
        (layout.green, "#009E73", layout.green_reward),
        (layout.orange, "#E69F00", layout.orange_reward),
    )
    for places, color, reward in kinds:
        for x, y in places:
            axes.add_patch(plt.Circle((x, y), layout.radius, color=color, alpha=0.6))
            axes.text(x, y, f"{reward:+g}", ha="center", va="center", fontsize=9)
    (x, y), spread = layout.start, layout.start_spread
    axes.add_patch(
        plt.Rectangle((x - spread, y - spread), 2 * spread, 2 * spread, color="0.85")
    )
    axes.text(x, y, "start", ha="center", va="center", fontsize=9)
    axes.set(xlim=(-1, 1), ylim=(-1, 1), aspect="equal")
    path.parent.mkdir(exist_ok=True)
    figure.savefig(path, dpi=100)
    plt.close(figure)


if __name__ == "__main__":
    draw(Layout(), FIGURE)
    print(FIGURE)

"""Dense rewards (paper, figure 5): ``python -m experiments.mujoco``."""

import functools
import sys
from collections.abc import Sequence

from experiments import command, comparison
from experiments.report import Figure

FIGURE = Figure(
    name="mujoco",
    title="MuJoCo tasks (paper, figure 5)",
    claim="PPO+GASIL improves PPO on most of the tasks, and outperforms PPO+BC and "
    "PPO+SIL on most of them.",
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    make = functools.partial(comparison.make, 1)
    return command.main(FIGURE, make, comparison.quick, arguments)


if __name__ == "__main__":
    sys.exit(main())

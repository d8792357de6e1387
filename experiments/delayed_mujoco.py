"""Delayed rewards (paper, figure 7): ``python -m experiments.delayed_mujoco``."""

import functools
import sys
from collections.abc import Sequence

from experiments import command, comparison, random_search
from experiments.report import Figure

FIGURE = Figure(
    name="delayed_mujoco",
    title="MuJoCo tasks with delayed rewards (paper, figure 7)",
    claim="With the reward given every 20 steps, PPO+GASIL improves PPO, and "
    "outperforms PPO+BC and PPO+SIL, on all tasks by a large margin.",
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    make = functools.partial(comparison.make, random_search.DELAY)
    return command.main(FIGURE, make, comparison.quick, arguments)


if __name__ == "__main__":
    sys.exit(main())

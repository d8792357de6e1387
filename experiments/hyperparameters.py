"""GASIL's numbers (paper, figure 8): ``python -m experiments.hyperparameters``.

PPO+GASIL on Walker2d with what the search found best for it, but for one number. The
paper's figure is of the dense reward; the delayed one is here too, for there the search
chose an alpha with which the discriminator's reward is not small beside the task's. So
are both with normalized rewards, of whose searches the same is true of the delayed one.
"""

import sys
from collections.abc import Sequence

from experiments import command, normalized_rewards, random_search, report
from experiments.report import Figure
from experiments.trials import Trial

VALUES = {
    "buffer_steps": (500, 1000, 2000, 5000, 10000),
    "discriminator_updates": (1, 5, 10, 20),
}


def _panel(name: str, reward_delay: int, normalized: bool) -> str:
    return normalized_rewards.panel_of(
        random_search.panel(name, reward_delay), normalized
    )


_PANELS = {
    _panel(name, delay, normalized): [str(value) for value in values]
    for normalized in normalized_rewards.TUNED
    for delay in (1, random_search.DELAY)
    for name, values in VALUES.items()
}

FIGURE = Figure(
    name="hyperparameters",
    title="Effect of GASIL's hyperparameters (paper, figure 8)",
    claim="The agent performs poorly when the buffer is too small (500 steps) or too "
    "large (5000 steps), and with too few or too many discriminator updates.",
    favourite=None,
    more="""**What it says.** With the dense reward the search chose an alpha with
which the discriminator's reward has no weight ([figure 5](mujoco.md)), and with
normalized ones one with which it has little: there the curves show mostly how far ten
seeds differ by chance. In all four panels 20 updates have least, and in three the most
is in the middle, as the paper says; that 20 do worse than ten is clear with normalized
dense rewards alone, and that one is too few nowhere. (With normalized and delayed
rewards one has as much as any: the search chose it with the largest learning rate,
3e-4, the others were tuned with 2e-5 or less.) The buffer's size has no order in any of
the four, from 500 steps to 10,000: an episode of walker2d is at most 1,000 steps, and a
buffer of 500 holds the first half of the best one.""",
    conclude=lambda shown: report.optimum(shown, _PANELS),
)


def make() -> list[Trial]:
    """A panel for each hyperparameter, a curve for each of its values."""
    return [
        Trial(
            name=f"{_panel(name, delay, normalized)}/{value}",
            env="walker2d",
            agent="ppo+gasil",
            points=({**tuned, name: value},),
            reward_delay=delay,
            normalize_rewards=normalized,
        )
        for normalized, best in normalized_rewards.TUNED.items()
        for delay in (1, random_search.DELAY)
        if (tuned := best("walker2d", "ppo+gasil", delay)) is not None
        for name, values in VALUES.items()
        for value in values
    ]


def quick(wanted: Sequence[Trial]) -> list[Trial]:
    """The ends and one value in the middle."""
    values = [(name, x) for name, of in VALUES.items() for x in (of[0], of[1], of[-1])]
    names = [f"{name}/{value}" for name, value in values]
    return [trial for trial in wanted if trial.name in names]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    return command.main(FIGURE, make, quick, arguments)


if __name__ == "__main__":
    sys.exit(main())

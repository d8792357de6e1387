"""A bonus that knows nothing: ``python -m experiments.untrained_discriminator``.

The discriminator's reward is never negative, so where an episode ends with a fall it
also pays for staying up, whatever the discriminator has learned. Here PPO+GASIL has
what was found best for it on delayed tasks with normalized rewards, but a discriminator
that stays what it was at the start, about 1/2 everywhere: a bonus of about alpha log 2
for each step. What PPO+GASIL has more is what imitation adds.
"""

import dataclasses
import sys
from collections.abc import Sequence

from experiments import command, normalized_rewards, random_search
from experiments.report import Figure
from experiments.trials import PAIR, Trial

#: Where falls end episodes and PPO+GASIL is ahead.
TASKS = ("hopper", "walker2d")
UNTRAINED = "untrained discriminator"
# Steps of this size don't move it, and the least number of them.
_STILL = {"discriminator_learning_rate": 1e-12, "discriminator_updates": 1}

FIGURE = Figure(
    name="untrained_discriminator",
    title="Delayed rewards and a bonus that knows nothing",
    claim="PPO+GASIL is better than PPO because it imitates, which the paper takes for "
    "granted.",
)


def make() -> list[Trial]:
    """PPO, PPO+GASIL and the control: ten seeds of each."""
    delay = random_search.DELAY
    wanted = []
    for env in TASKS:
        plain, tuned = (
            Trial(
                name=f"{random_search.panel(env, delay)}/{agent}",
                env=env,
                agent=agent,
                points=(normalized_rewards.best(env, agent, delay) or {},),
                reward_delay=delay,
                normalize_rewards=True,
            )
            for agent in PAIR
        )
        panel = tuned.name.split("/")[0]
        (point,) = tuned.points
        control = dataclasses.replace(
            tuned, name=f"{panel}/{UNTRAINED}", points=({**point, **_STILL},)
        )
        wanted += [plain, control, tuned]
    return wanted


def quick(wanted: Sequence[Trial]) -> list[Trial]:
    """Hopper's."""
    return [trial for trial in wanted if trial.env == "hopper"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    return command.main(FIGURE, make, quick, arguments)


if __name__ == "__main__":
    sys.exit(main())

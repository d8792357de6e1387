"""A bonus that knows nothing: ``python -m experiments.constant_bonus``.

The discriminator's reward is never negative, so where an episode ends with a fall it
also pays for staying up, whatever the discriminator has learned. Here PPO+GASIL has
what was found best for it on delayed tasks with normalized rewards, but a discriminator
that an entropy bonus holds at 1/2 everywhere, which is alpha log 2 for each step. What
PPO+GASIL has more is what imitation adds. (A discriminator that is only left as it is
at the start is a reward too, a random one, and the policy learns to collect it.)
"""

import dataclasses
import sys
from collections.abc import Sequence

from experiments import command, normalized_rewards, random_search
from experiments.report import Figure
from experiments.trials import PAIR, Trial

#: Where falls end episodes and PPO+GASIL is ahead.
TASKS = ("hopper", "walker2d")
CONSTANT = "constant bonus"
# Against this weight what tells good from other moves a logit by 2 / 1000.
_HELD = {
    "discriminator_entropy_coefficient": 1e3,
    "discriminator_updates": 5,
    "discriminator_learning_rate": 3e-4,
}


FIGURE = Figure(
    name="constant_bonus",
    title="Delayed rewards and a bonus that knows nothing",
    claim="The discriminator's reward, learned from good trajectories, acts as a "
    "useful reward shaping that makes learning easier.",
    more="""**What it says.** A part is the bonus, more is imitation. On walker2d the
bonus alone more than doubles PPO's return; PPO+GASIL is clearly ahead of it. On hopper
six of its ten seeds stand still for the whole episode, which returns about 1000, and
three run. The bonus has PPO+GASIL's alpha and learning rate; it was not
tuned for itself.""",
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
            tuned, name=f"{panel}/{CONSTANT}", points=({**point, **_HELD},)
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

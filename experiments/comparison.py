"""The four agents on the six tasks, each with what the search found best for it."""

from experiments import random_search
from experiments.trials import AGENTS, TASKS, Trial
from gasil_jax import presets

#: Humanoid's length; the other tasks' is the trial's default.
_STEPS = {"humanoid": 3_000_000}


def make(reward_delay: int) -> list[Trial]:
    """Ten seeds of every agent on every task.

    Where a task has not been searched, its agents have the appendix's first values.
    """
    return [
        Trial(
            name=f"{env}/{agent}",
            env=env,
            agent=agent,
            points=(random_search.best(env, agent, reward_delay) or {},),
            reward_delay=reward_delay,
            total_steps=_STEPS.get(env, 1_000_000),
            # The paper's; where rewards are delayed alpha is fixed.
            alpha_schedule=presets.preset(
                env, agent, "paper", reward_delay
            ).alpha_schedule,
        )
        for env in TASKS
        for agent in AGENTS
    ]


def quick(wanted: list[Trial]) -> list[Trial]:
    """Hopper's."""
    return [trial for trial in wanted if trial.env == "hopper"]

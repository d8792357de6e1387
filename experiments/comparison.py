"""The four agents on the six tasks, each with what the search found best for it."""

from collections.abc import Mapping, Sequence

from experiments import random_search, report
from experiments.trials import AGENTS, TASKS, Results, Trial

#: Seeds of a task with delayed rewards, where they are not ten. One learns to run and
#: another does not, so that ten tell few agents apart.
DELAYED_SEEDS = {"hopper": 20, "walker2d": 20, "halfcheetah": 20}


def seeds(env: str, reward_delay: int) -> int:
    """How many of them each agent has on a task."""
    more = DELAYED_SEEDS if reward_delay > 1 else {}
    return more.get(env, Trial.seeds)


def make(reward_delay: int) -> list[Trial]:
    """Every agent on every task, ten seeds or `DELAYED_SEEDS` of each.

    None of an agent whose search on a task is not whole: it would be of other points.
    Humanoid has 1M steps as the others, and its alpha is fixed as theirs; the paper's
    3M and its schedule of alpha are in `experiments.humanoid`.
    """
    return [
        Trial(
            name=f"{env}/{agent}",
            env=env,
            agent=agent,
            points=(found,),
            reward_delay=reward_delay,
            seeds=seeds(env, reward_delay),
        )
        for env in TASKS
        for agent in AGENTS
        if (found := random_search.best(env, agent, reward_delay)) is not None
    ]


def said_of_added(shown: Mapping[str, Mapping[str, Results]]) -> str:
    """The tally of the seeds after the tenth alone, Markdown; empty without any.

    They were trained after a look at the first ten, with what had been chosen before.

    Args:
      shown: task -> curve -> results, with delayed rewards.
    """
    added = {
        env: {
            curve: known.after(Trial.seeds)
            for curve, known in curves.items()
            if len(known.seeds) > Trial.seeds
        }
        for env, curves in shown.items()
        if env in DELAYED_SEEDS
    }
    which = f"Of delayed {', '.join(added)}"
    name = f"{which} the seeds added after a look at the first ten, alone"
    return report.tallies({name: added}, AGENTS[-1])


def quick(wanted: Sequence[Trial]) -> list[Trial]:
    """Hopper's."""
    return [trial for trial in wanted if trial.env == "hopper"]

"""Rewards, normalized: ``python -m experiments.normalized_rewards``.

The paper's implementation is based on OpenAI baselines', whose ``ppo2`` normalizes
rewards on MuJoCo tasks and whose ``ppo1`` does not; the paper does not say which it
has, and the appendix's range of alpha means another thing with each. Figures 5 and 7
have rewards as they are. Here every agent trains with normalized rewards, tuned anew:
the same search over the appendix's ranges with the same number of runs
(random_search.md), then as many seeds of the best point as those figures have. The
command lists and trains a stage once the one before it is complete: start it three
times.
"""

import dataclasses
import pathlib
import sys
from collections.abc import Callable, Mapping, Sequence

from experiments import (
    command,
    comparison,
    delayed_mujoco,
    mujoco,
    random_search,
    report,
    trials,
    two_stage,
)
from experiments.report import Figure
from experiments.trials import AGENTS, PAIR, Results, Trial
from gasil_jax.points import Point

#: Ant and humanoid cost several times as much, and no agent has learned to walk there.
TASKS = ("hopper", "walker2d", "halfcheetah", "swimmer")
# With the figure that has the same rewards as they are.
_DELAYS = {random_search.DELAY: delayed_mujoco.FIGURE, 1: mujoco.FIGURE}


def _gather(
    wanted: Sequence[Trial], results: pathlib.Path
) -> dict[str, dict[str, Results]]:
    """What is there of the tuned agents."""
    tuned = [trial for trial in wanted if not two_stage.is_search(trial)]
    return report.panels(tuned, results / FIGURE.name)


def by_delay(
    shown: Mapping[str, Mapping[str, Results]],
) -> dict[int, dict[str, Mapping[str, Results]]]:
    """Of what is shown the tasks of each reward: delay -> task -> curve -> results."""
    found: dict[int, dict[str, Mapping[str, Results]]] = {}
    for delay in _DELAYS:
        for env in TASKS:
            if (name := random_search.panel(env, delay)) in shown:
                found.setdefault(delay, {})[env] = shown[name]
    return found


def _conclude(shown: Mapping[str, Mapping[str, Results]]) -> str:
    """The tallies of delayed and of dense rewards, and of the seeds added: Markdown."""
    of = by_delay(shown)
    groups = {
        f"{_DELAYS[delay].title}, rewards normalized": tasks
        for delay, tasks in of.items()
    }
    said = report.tallies(groups, AGENTS[-1])
    added = comparison.said_of_added(of.get(random_search.DELAY, {}))
    return "\n\n".join(part for part in (said, added) if part)


FIGURE = Figure(
    name="normalized_rewards",
    title="Normalized rewards (paper, figures 5 and 7)",
    claim=" ".join(figure.claim for figure in _DELAYS.values()),
    conclude=_conclude,
    more="""**What it says.** With delayed rewards, as the paper says, PPO+GASIL is
ahead by a large margin of all three on hopper and walker2d, where an episode ends with
a fall: it has more than twice PPO's return on one and more than three times on the
other, and 15 and 14 of the 16 points that were tried have more than PPO's best. With
ten seeds PPO+SIL on hopper was not clear, so these two and halfcheetah were given ten
more, and those alone, simulated by C MuJoCo, say the same of all three (above). The
points with alpha 0.2 and 1 have more than those with 0.02 (below); on hopper the
discriminator's learning rate matters as much. With [rewards as they
are](delayed_mujoco.md) the same alphas weigh far less beside a running robot's reward.
On halfcheetah, where nothing ends an episode early, the less alpha the better, down to
the least that the appendix has, and nothing tells PPO+GASIL and PPO apart; on swimmer
it is clearly behind PPO+BC and PPO+SIL. A reward that is never negative pays for
staying up, too: [a control](constant_bonus.md) tells how much of it is that. Not every
agent gains by the unit: PPO+SIL's return on delayed walker2d is little more than half
of what it is with rewards as they are.

With dense rewards nothing tells PPO+GASIL and PPO apart, and over the four tasks it is
behind PPO+SIL, by swimmer's doing alone. On all but hopper the search chose alpha 0.02
and five updates at 2e-5, with which the discriminator hardly moves from 1/2: PPO with a
small bonus. Hopper's returns are higher than with rewards as they are, of all agents
but PPO clearly.""",
    gather=_gather,
)


def search(
    env: str, agent: str, reward_delay: int = 1, obs_noise: float = 0.0
) -> Trial:
    """The trial that tunes an agent on a task."""
    panel = random_search.panel(env, reward_delay, obs_noise)
    return dataclasses.replace(
        random_search.search(env, agent, reward_delay, obs_noise),
        name=f"{panel}{two_stage.PANEL_SUFFIX}/{agent}",
        normalize_rewards=True,
    )


def best(
    env: str, agent: str, reward_delay: int = 1, obs_noise: float = 0.0
) -> Point | None:
    """What the search that tunes an agent on a task has chosen; None before that."""
    trial = search(env, agent, reward_delay, obs_noise)
    return two_stage.best(trial, trials.RESULTS / FIGURE.name)


#: Whether rewards are normalized -> what the search with such rewards has found.
TUNED: Mapping[bool, Callable[..., Point | None]] = {
    False: random_search.best,
    True: best,
}


def panel_of(name: str, normalized: bool) -> str:
    """The name of a panel in a figure that has both rewards."""
    return name + ("-normalized" if normalized else "")


def make() -> list[Trial]:
    """Each agent's search on each task, and seeds of its best point once whole.

    Under noise two agents' on walker2d, for figure 6.
    """
    every = [
        (search(env, agent, delay), comparison.seeds(env, delay))
        for delay in _DELAYS
        for env in TASKS
        for agent in AGENTS
    ]
    every += [
        (search("walker2d", agent, 1, random_search.NOISE), Trial.seeds)
        for agent in PAIR
    ]
    folder = trials.RESULTS / FIGURE.name
    return [
        trial
        for each, seeds in every
        for trial in two_stage.trials_of(each, folder, seeds)
    ]


def write(figure: Figure, wanted: Sequence[Trial], results: pathlib.Path) -> None:
    """Write the page, with the searches, and the figure of what there is."""
    searches = [trial for trial in wanted if two_stage.is_search(trial)]
    folder = results / figure.name
    found = (
        random_search.table(searches, folder),
        random_search.effects(searches, folder),
    )
    two_stage.write(figure, wanted, results, "\n\n".join(x for x in found if x))


def quick(wanted: Sequence[Trial]) -> list[Trial]:
    """Four points each of PPO and PPO+GASIL on delayed hopper."""
    names = [search("hopper", agent, random_search.DELAY).name for agent in PAIR]
    return two_stage.quick(wanted, names)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    return command.main(FIGURE, make, quick, arguments, write)


if __name__ == "__main__":
    sys.exit(main())

"""The appendix's search (table 1): ``python -m experiments.random_search``.

First every agent gets as many runs of full length on a task, 32 of 1M steps: PPO the
appendix's four learning rates with eight seeds each; the others the higher two of them
(PPO's search shows what the lower two cost in 1M steps). PPO+BC and PPO+SIL have one
hyperparameter more, so eight points with four seeds each; PPO+GASIL has the appendix's
four more, which makes 256 points, of which an orthogonal array of sixteen gets two
seeds each: any two hyperparameters have every pair of their values equally often. Then
the best four points get four seeds more, for the best of many points on few seeds is
partly the luckiest (PPO's points have eight from the start); the command lists and
trains them once the first stage is complete. The seeds are other than those of the
figures, which use the point with the best mean return. Ant and humanoid, whose runs
cost several times as much, have half as many in either stage: 16 for each agent, PPO
two learning rates, and two seeds more for the best four points (PPO+GASIL's best two on
delayed ant were tried with two further ones, which are not used; with them its second
point would be first); humanoid's are a third as long as those of its figure. For figure
6 walker2d has a search with noise 0.1 on the observations, the middle of the paper's
three. On the point mass both agents have the learning rates 1e-3, 3e-4, 1e-4 and 3e-5,
eight seeds each, and PPO+GASIL else what its preset has (alpha 1, 20 updates at 3e-4).

Rewards are as they are; `normalized_rewards.md` has the same search with normalized
ones. Nothing uses what is in `results/first_search/`: a first search that drew
PPO+GASIL's points otherwise, each value equally often but not each pair (no point had
20 discriminator updates with the policy's learning rate 3e-4, nor alpha 1 with more
than one update at it), figures from it and of points that more seeds or a search under
noise replaced, a search of all of PPO+GASIL's hyperparameters on the point mass, and
PPO's on ant with 128 environments of 16 steps (64 of 32 now: a reward comes every 20);
nor `locomotion.csv` and `ppo.csv`, of PPO+GASIL and PPO before there was a search.
"""

import itertools
import pathlib
import sys
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from experiments import command, report, trials, two_stage
from experiments.report import Figure
from experiments.trials import AGENTS, PAIR, TASKS, Trial
from gasil_jax.points import Point

DELAY = 20
#: On walker2d, standard deviation of the observations' noise.
NOISE = 0.1
_FIRST_SEED = 1000
_RUNS = 32
# Where a run costs several times as much.
_RUNS_OF = {"ant": 16, "humanoid": 16}

#: Lengths other than the trial's own; humanoid is tuned over a third of its figure's.
STEPS = {"point_mass": 500_000, "humanoid": 333_000}
_LEARNING_RATES = (3e-4, 1e-4, 5e-5, 3e-5)
_HIGHER = _LEARNING_RATES[:2]
_POINT_MASS_LEARNING_RATES = (1e-3, 3e-4, 1e-4, 3e-5)

#: What each agent's search draws from.
SPACES: Mapping[str, Mapping[str, tuple[Any, ...]]] = {
    "ppo": {"learning_rate": _LEARNING_RATES},
    "ppo+bc": {
        "learning_rate": _HIGHER,
        "behavior_cloning_coefficient": (0.01, 0.1, 0.3, 1.0),
    },
    "ppo+sil": {
        "learning_rate": _HIGHER,
        "sil_coefficient": (0.01, 0.1, 0.3, 1.0),
    },
    "ppo+gasil": {
        "learning_rate": _HIGHER,
        "discriminator_updates": (1, 5, 10, 20),
        "discriminator_learning_rate": (3e-4, 1e-4, 2e-5, 1e-5),
        "buffer_steps": (1000, 10000),
        "alpha": (0.02, 0.1, 0.2, 1.0),
    },
}

_OTHER_SPACES: Mapping[tuple[str, str], Mapping[str, tuple[Any, ...]]] = {
    ("ant", "ppo"): {"learning_rate": _HIGHER},
    ("humanoid", "ppo"): {"learning_rate": _HIGHER},
    ("point_mass", "ppo"): {"learning_rate": _POINT_MASS_LEARNING_RATES},
    ("point_mass", "ppo+gasil"): {
        "learning_rate": _POINT_MASS_LEARNING_RATES,
        "discriminator_updates": (20,),
        "discriminator_learning_rate": (3e-4,),
        "alpha": (1.0,),
    },
}

FIGURE = Figure(
    name="random_search",
    title="Hyperparameters of every agent (paper, table 1)",
    claim="A search over the appendix's ranges, for every task.",
    favourite=None,
)


# Multiplication by 1, 2 and 3 in the field of four elements; its sum is exclusive or.
_TIMES = ((0, 1, 2, 3), (0, 2, 3, 1), (0, 3, 1, 2))


def every_point(values_of: Mapping[str, Sequence[Any]]) -> tuple[Point, ...]:
    """All points of a space."""
    every = itertools.product(*values_of.values())
    return tuple(dict(zip(values_of, values, strict=True)) for values in every)


def draw(values_of: Mapping[str, Sequence[Any]]) -> tuple[Point, ...]:
    """At most sixteen distinct points of a space of up to five hyperparameters.

    All there are where there are no more than sixteen. Else an orthogonal array: any
    two hyperparameters have every pair of their values equally often, so that none is
    judged by what it happened to be drawn with.

    Raises:
      ValueError: more than sixteen points of more than five hyperparameters, or of
        other than two or four values.
    """
    if len(every := every_point(values_of)) <= 16:
        return every
    if len(values_of) > 5 or any(len(x) not in (2, 4) for x in values_of.values()):
        raise ValueError(
            f"{dict(values_of)}: at most five hyperparameters of two or four values"
        )
    rng = np.random.default_rng(0)
    # Which value is which level is left to chance; two levels are one of two values.
    of_level = {
        name: [values[i % len(values)] for i in rng.permutation(4)]
        for name, values in values_of.items()
    }
    return tuple(
        {
            name: of_level[name][level]
            for name, level in zip(
                values_of, (a, b, *(a ^ times[b] for times in _TIMES)), strict=False
            )
        }
        for a in range(4)
        for b in range(4)
    )


def space(env: str, agent: str) -> Mapping[str, tuple[Any, ...]]:
    """What an agent's search on a task draws from."""
    return _OTHER_SPACES.get((env, agent), SPACES[agent])


def panel(name: str, reward_delay: int, obs_noise: float = 0.0) -> str:
    """The name of a panel about a task, or about something else on it."""
    delayed = "" if reward_delay == 1 else "-delayed"
    return name + delayed + ("-noise" if obs_noise else "")


def search(
    env: str, agent: str, reward_delay: int = 1, obs_noise: float = 0.0
) -> Trial:
    """The trial that tunes an agent on a task."""
    points = draw(space(env, agent))
    return Trial(
        name=f"{panel(env, reward_delay, obs_noise)}/{agent}",
        env=env,
        agent=agent,
        points=points,
        reward_delay=reward_delay,
        obs_noise=obs_noise,
        seeds=_RUNS_OF.get(env, _RUNS) // len(points),
        first_seed=_FIRST_SEED,
        total_steps=STEPS.get(env, 1_000_000),
        rows=10,
    )


def stages(
    env: str, agent: str, reward_delay: int = 1, obs_noise: float = 0.0
) -> two_stage.Stages | None:
    """What there is of a search; None where its first stage is not complete."""
    trial = search(env, agent, reward_delay, obs_noise)
    return two_stage.read(trial, trials.RESULTS / FIGURE.name)


def confirmation(
    env: str, agent: str, reward_delay: int = 1, obs_noise: float = 0.0
) -> Trial | None:
    """The second stage of the search that tunes an agent on a task."""
    found = stages(env, agent, reward_delay, obs_noise)
    return found and found.again


def make() -> list[Trial]:
    """Every agent on every task, dense and delayed; two under noise, on point_mass."""
    every: list[tuple[Any, ...]] = [
        (env, agent, delay) for env in TASKS for delay in (1, DELAY) for agent in AGENTS
    ]
    every += [("walker2d", agent, 1, NOISE) for agent in PAIR]
    every += [("point_mass", agent) for agent in PAIR]
    second = [confirmation(*each) for each in every]
    return [search(*each) for each in every] + [x for x in second if x is not None]


def best(
    env: str, agent: str, reward_delay: int = 1, obs_noise: float = 0.0
) -> Point | None:
    """What the search that tunes an agent on a task has chosen; None before that."""
    trial = search(env, agent, reward_delay, obs_noise)
    return two_stage.best(trial, trials.RESULTS / FIGURE.name)


def write(figure: Figure, wanted: Sequence[Trial], results: pathlib.Path) -> None:
    """The page: each search's best point, and how far apart the points are."""
    lines = [
        f"# {figure.title}",
        "",
        " ".join(__doc__.split("\n\n", 1)[1].split()),
        "",
        table(wanted, results / figure.name),
        "",
        effects(wanted, results / figure.name),
    ]
    results.mkdir(parents=True, exist_ok=True)
    trials.write_whole(results / f"{figure.name}.md", "\n".join(lines) + "\n")


def table(wanted: Sequence[Trial], folder: pathlib.Path) -> str:
    """What searches have found, and what is what: Markdown, empty where none is there.

    Args:
      wanted: both stages of each.
      folder: of their results.
    """
    lines = []
    for name, curves in report.panels(wanted, folder).items():
        for agent, known in curves.items():
            if agent.endswith(two_stage.SUFFIX):
                continue
            second = curves.get(agent + two_stage.SUFFIX)
            if second is not None and not second.complete:
                second = None
            chosen, final = two_stage.best_point(known, second)
            said = report.point(chosen)
            cells = [name, agent, _size(known), _size(second), said]
            score = two_stage.scores(known)
            cells += [f"{final.mean():.0f}", str(len(final))]
            cells += [f"{x:.0f}" for x in (np.median(score), score.min())]
            lines.append(f"| {' | '.join(cells)} |")
    if lines:
        lines[:0] = [
            "Returns are of the last fifth of training. The best point's mean is over "
            "its seeds of both stages, by which it was chosen, so that new seeds tend "
            "to have less; median and worst are of the first stage's points. Where an "
            "agent other than PPO has no second stage yet, its best point may change.",
            "",
            "| task | agent | first stage | second | best point | its mean | seeds "
            "| median | worst |",
            "|---|---|---|---|---|---|---|---|---|",
        ]
    return "\n".join(lines)


def effects(wanted: Sequence[Trial], folder: pathlib.Path) -> str:
    """What the values of PPO+GASIL's hyperparameters do: Markdown, empty for nothing.

    Every value meets every value of each other equally often, so that the mean over the
    points that have it is of no other's doing; what two do together is not told apart.

    Args:
      wanted: both stages of each search.
      folder: of their results.
    """
    names = list(SPACES["ppo+gasil"])
    lines = []
    for panel, curves in report.panels(wanted, folder).items():
        known = curves.get("ppo+gasil")
        if known is None or not all(
            set(point) == set(names) for point in known.trial.points
        ):
            continue
        score, cells = two_stage.scores(known), [panel]
        for name in names:
            values = np.array([point[name] for point in known.trial.points])
            means = [(x, score[values == x].mean()) for x in np.unique(values)]
            cells.append(", ".join(f"{x:g}: {mean:.0f}" for x, mean in means))
        lines.append(f"| {' | '.join(cells)} |")
    if lines:
        lines[:0] = [
            "PPO+GASIL's points by each hyperparameter: the mean return of those that "
            "have a value, in the first stage (what two values do together is not told "
            "apart).",
            "",
            f"| task | {' | '.join(names)} |",
            "|---|" + "---|" * len(names),
        ]
    return "\n".join(lines)


def _size(known: trials.Results | None) -> str:
    return "" if known is None else f"{len(known.trial.points)} x {len(known.seeds)}"


def quick(wanted: Sequence[Trial]) -> list[Trial]:
    """Four points each of PPO and PPO+GASIL on hopper."""
    return two_stage.quick(wanted, ("hopper/ppo", "hopper/ppo+gasil"))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    return command.main(FIGURE, make, quick, arguments, write)


if __name__ == "__main__":
    sys.exit(main())

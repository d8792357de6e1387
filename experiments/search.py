"""The search for hyperparameters: many points on few seeds, then the best on more.

The best of many points on few seeds is partly the luckiest, so the best four are tried
again on new seeds, and the mean over both decides. Figures train the chosen point with
seeds of their own. The spaces are the ranges of the paper's appendix.
"""

import dataclasses
import functools
import itertools
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np

from experiments.store import Run, Store
from gasil_jax.config import Config

Point = Mapping[str, Any]
Space = Mapping[str, tuple[Any, ...]]

AGENTS = ("ppo", "ppo+bc", "ppo+sil", "ppo+gasil")
#: The agents of the figures that compare two.
PAIR = ("ppo", "ppo+gasil")
TASKS = ("hopper", "walker2d", "halfcheetah", "swimmer", "ant", "humanoid")
#: The steps between two rewards where they are delayed (paper, section 5.4).
DELAY = 20
#: Noise on walker2d's observations in its search: the middle of the paper's three.
NOISE = 0.1
#: Environments per seed: more where physics is slow, because a GPU is fast only with
#: thousands of environments.
NUM_ENVS, NUM_ENVS_OF = 32, {"ant": 64, "humanoid": 64}
#: The runs of these figures and searches had all environments reset together.
STAGGER_EPISODES, ALGORITHM_VERSION = False, 1

_RATES = (3e-4, 1e-4, 5e-5, 3e-5)
# PPO's search shows how much the lower two rates cost in 1M steps.
_RATE, _HIGHER = {"learning_rate": _RATES}, {"learning_rate": _RATES[:2]}
_COEFFICIENTS = (0.01, 0.1, 0.3, 1.0)
#: What each agent's search draws from.
SPACES: Mapping[str, Space] = {
    "ppo": _RATE,
    "ppo+bc": {**_HIGHER, "behavior_cloning_coefficient": _COEFFICIENTS},
    "ppo+sil": {**_HIGHER, "sil_coefficient": _COEFFICIENTS},
    "ppo+gasil": {
        **_HIGHER,
        "discriminator_updates": (1, 5, 10, 20),
        "discriminator_learning_rate": (3e-4, 1e-4, 2e-5, 1e-5),
        "buffer_steps": (1000, 10000),
        "alpha": (0.02, 0.1, 0.2, 1.0),
    },
}
_POINT_MASS = {"learning_rate": (1e-3, 3e-4, 1e-4, 3e-5)}
_STRONG = {
    "discriminator_updates": (20,),
    "discriminator_learning_rate": (3e-4,),
    "alpha": (1.0,),
}
_OTHER_SPACES: Mapping[tuple[str, str], Space] = {
    ("ant", "ppo"): _HIGHER,
    ("humanoid", "ppo"): _HIGHER,
    ("point_mass", "ppo"): _POINT_MASS,
    ("point_mass", "ppo+gasil"): {**_POINT_MASS, **_STRONG},
}
#: Steps of a run in a search where they are not 1M; humanoid's figure has three times
#: as many.
STEPS = {"point_mass": 500_000, "humanoid": 333_000}
# Runs of the first stage; points of the second stage, and their seeds.
_RUNS, _RUNS_OF = 32, {"ant": 16, "humanoid": 16}
_BEST, _SEEDS, _SEEDS_OF = 4, 4, {"ant": 2, "humanoid": 2}
_FIRST_SEED, _SECOND_SEED = 1000, 2000
#: With this number of seeds in the first stage there is no second stage.
_ENOUGH_SEEDS = 8
# Multiplication by 1, 2 and 3 in the field of four elements; its sum is exclusive or.
_TIMES = ((0, 1, 2, 3), (0, 2, 3, 1), (0, 3, 1, 2))


def every_point(space: Space) -> tuple[Point, ...]:
    """Return all points of a space."""
    every = itertools.product(*space.values())
    return tuple(dict(zip(space, values, strict=True)) for values in every)


def draw(space: Space) -> tuple[Point, ...]:
    """Return at most sixteen points of a space of up to five hyperparameters.

    If the space has no more points, these are all of them. Otherwise they are an
    orthogonal array: any two hyperparameters have every pair of their values equally
    often, so that no value's score depends on the values it was drawn with.
    """
    if len(every := every_point(space)) <= 16:
        return every
    if len(space) > 5 or any(len(values) not in (2, 4) for values in space.values()):
        raise ValueError(
            f"{dict(space)}: at most five hyperparameters of two or four values"
        )
    rng = np.random.default_rng(0)
    # Values are assigned to levels at random; each of two values has two levels.
    of_level = {
        name: [values[i % len(values)] for i in rng.permutation(4)]
        for name, values in space.items()
    }
    pairs = itertools.product(range(4), repeat=2)
    rows = [(a, b, *(a ^ times[b] for times in _TIMES)) for a, b in pairs]
    return tuple(
        {name: of_level[name][level] for name, level in zip(space, row, strict=False)}
        for row in rows
    )


class Stage(NamedTuple):
    """Points and the seeds that each of them gets."""

    points: tuple[Point, ...]
    seeds: range


def scores(runs: Sequence[Sequence[Run]], store: Store) -> np.ndarray | None:
    """Return the mean return over the last fifth of training, (points, seeds).

    Args:
      runs: the runs of each point.
      store: where they are; the result is None if it lacks one of them.
    """
    if store.missing(itertools.chain(*runs)):
        return None
    return np.array([[store[run].part(0.8, 1.0) for run in x] for x in runs])


@dataclasses.dataclass(frozen=True)
class Search:
    """A search for an agent's hyperparameters on a task.

    Attributes:
      env: name of the environment.
      agent: name of the agent.
      reward_delay: the environment's reward delay.
      obs_noise: the environment's observation noise.
      normalize_rewards: whether PPO's rewards are normalized.
      after: an earlier search to continue. Hyperparameters that are not `free` are
        fixed at the value whose points had the best average score in it.
      free: the hyperparameters to search then: all their points, on two seeds each.
    """

    env: str
    agent: str
    reward_delay: int = 1
    obs_noise: float = 0.0
    normalize_rewards: bool = False
    after: "Search | None" = None
    free: tuple[str, ...] = ()
    #: The version of the algorithm that its runs are of.
    version: ClassVar[int] = ALGORITHM_VERSION

    @property
    def space(self) -> Space:
        """The space that points are drawn from, if no earlier search is continued."""
        return _OTHER_SPACES.get((self.env, self.agent), SPACES[self.agent])

    def config(self, point: Point) -> Config:
        """Return a point's config: its values, our batch and the appendix's values."""
        return Config(
            agent=self.agent,
            total_steps=STEPS.get(self.env, 1_000_000),
            num_envs=NUM_ENVS_OF.get(self.env, NUM_ENVS),
            normalize_rewards=self.normalize_rewards,
            stagger_episodes=STAGGER_EPISODES,
        ).replace(**point)

    def runs(self, stage: Stage) -> list[list[Run]]:
        """Return the runs of a stage, a list for each point."""
        run = functools.partial(
            Run,
            self.env,
            reward_delay=self.reward_delay,
            obs_noise=self.obs_noise,
            algorithm_version=ALGORITHM_VERSION,
        )
        return [
            [run(self.config(point), seed) for seed in stage.seeds]
            for point in stage.points
        ]

    def scores(self, stage: Stage, store: Store) -> np.ndarray | None:
        """Return the mean return over the last fifth of training, (points, seeds).

        The result is None if the store lacks a run of the stage.
        """
        return scores(self.runs(stage), store)

    def first(self, store: Store) -> Stage | None:
        """Return the first stage, or None if an earlier search must end first."""
        if self.after is None:
            points = draw(self.space)
            seeds = _RUNS_OF.get(self.env, _RUNS) // len(points)
        else:
            before = self.after.first(store)
            scores = None if before is None else self.after.scores(before, store)
            if before is None or scores is None:
                return None
            space = dict(self.after.space)
            for name in set(space) - set(self.free):
                of_values = by_value(name, before.points, means(scores))
                space[name] = (max(of_values, key=lambda x: of_values[x]),)
            points, seeds = every_point(space), 2
        return Stage(points, range(_FIRST_SEED, _FIRST_SEED + seeds))

    def stages(self, store: Store) -> list[Stage]:
        """Return the stages whose points are known from the runs in the store."""
        first = self.first(store)
        if first is None:
            return []
        scores = self.scores(first, store)
        if len(first.seeds) >= _ENOUGH_SEEDS or scores is None:
            return [first]
        order = np.argsort(-means(scores), kind="stable")[:_BEST]
        seeds = range(_SECOND_SEED, _SECOND_SEED + _SEEDS_OF.get(self.env, _SEEDS))
        return [first, Stage(tuple(first.points[i] for i in order), seeds)]

    def best(self, store: Store) -> tuple[Point, np.ndarray] | None:
        """Return the best point and its scores in all stages, or None if incomplete."""
        stages = self.stages(store)
        scores = [self.scores(stage, store) for stage in stages]
        if not stages or (all_scores := scores[0]) is None or scores[-1] is None:
            return None
        points = stages[-1].points
        if len(stages) > 1:
            among = [stages[0].points.index(point) for point in points]
            all_scores = np.hstack([all_scores[among], scores[-1]])
        chosen = int(means(all_scores).argmax())
        return points[chosen], all_scores[chosen]

    def chosen(self, store: Store) -> Point | None:
        """Return the chosen point, or None if the search is incomplete."""
        best = self.best(store)
        return None if best is None else best[0]


def means(scores: np.ndarray) -> np.ndarray:
    """Return the mean over seeds, (points,); -inf if a seed ended no episode."""
    means = scores.mean(axis=1)
    return np.where(np.isfinite(means), means, -np.inf)


def by_value(name: str, points: Sequence[Point], means: np.ndarray) -> dict[Any, float]:
    """Return the mean over the points with each value of a hyperparameter."""
    values = np.array([point[name] for point in points])
    return {
        value: float(means[values == value].mean())
        for value in dict.fromkeys(point[name] for point in points)
    }

"""The paper's agents and tasks, out of step, tuned alike and controlled: the plan.

Every agent is searched with the same number of points on every task, dense and delayed,
with two seeds of the search's own. Where the best point has a value at an end of its
grid, the next value beyond is tried too. So one table gives the best point of each
task, which is the paper's protocol, and the best point over all tasks. The figures
train the chosen points with seeds of their own.
"""

import dataclasses
import itertools
import zlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np

from experiments.search import DELAY, TASKS, Point, Space, Stage, means, scores
from experiments.store import ALGORITHM_VERSION, Run, Store
from gasil_jax.config import Config
from gasil_jax.figures import statistics

#: Points of each agent's search; their seeds.
_POINTS, _SEEDS = 12, range(1000, 1002)
#: Every agent's hyperparameters, and those of one or two.
_SHARED: Space = {
    "learning_rate": (1e-4, 3e-4, 6e-4),
    "gae_lambda": (0.95, 0.98, 0.995),
    "gamma": (0.99, 0.995),
    "initial_deviation": (0.15, 0.25, 0.4, 0.6, 1.0),
}
_ALPHA: Space = {"alpha": (0.02, 0.1, 0.2, 1.0)}
_DISCRIMINATOR: Space = {
    "discriminator_updates": (1, 5, 20),
    "discriminator_learning_rate": (2e-5, 1e-4, 3e-4),
    "buffer_steps": (1000, 10_000),
}
#: What each agent's search draws from, in increasing order.
SPACES: Mapping[str, Space] = {
    "ppo": _SHARED,
    "ppo+bc": {**_SHARED, "behavior_cloning_coefficient": (0.01, 0.1, 0.3, 1.0)},
    "ppo+sil": {**_SHARED, "sil_coefficient": (0.01, 0.1, 0.3, 1.0)},
    "gasil": {**_SHARED, **_DISCRIMINATOR},
    "ppo+gasil": {**_SHARED, **_DISCRIMINATOR, **_ALPHA},
    "ppo+bonus": {**_SHARED, **_ALPHA},
    "ppo+gasil-adaptive": {
        **_SHARED,
        **_DISCRIMINATOR,
        "imitation_weight": (0.35, 0.7, 1.0),
    },
}
AGENTS = tuple(SPACES)
#: The values below and above a grid, where an agent may have them.
_BEYOND: Mapping[str, tuple[Any, Any]] = {
    "learning_rate": (3e-5, 1.2e-3),
    "gae_lambda": (0.9, None),
    "gamma": (0.98, 0.998),
    "initial_deviation": (0.08, 1.5),
    "alpha": (0.005, 3.0),
    "behavior_cloning_coefficient": (0.003, 3.0),
    "sil_coefficient": (0.003, 3.0),
    "discriminator_updates": (None, 40),
    "discriminator_learning_rate": (5e-6, 1e-3),
    "buffer_steps": (500, 20_000),
    "imitation_weight": (0.15, None),
}
#: The agents that decompose rewards where these are delayed.
_DECOMPOSED = ("ppo+gasil-adaptive",)


def draw(agent: str) -> tuple[Point, ...]:
    """Return the points of an agent's search, all different.

    Each value of a hyperparameter is equally often among them, or once more than
    another; which values meet is random.
    """
    rng = np.random.default_rng(zlib.crc32(agent.encode()))
    rows: list[tuple[Any, ...]] = []
    while len(set(rows)) < _POINTS:
        columns = [
            rng.permutation([values[i % len(values)] for i in range(_POINTS)]).tolist()
            for values in SPACES[agent].values()
        ]
        rows = list(zip(*columns, strict=True))
    return tuple(dict(zip(SPACES[agent], row, strict=True)) for row in rows)


def beyond(agent: str, point: Point) -> Iterator[Point]:
    """Give a point with each of its values at an end of a grid one step further."""
    for name, values in SPACES[agent].items():
        for end, further in zip((values[0], values[-1]), _BEYOND[name], strict=True):
            if point[name] == end and further is not None:
                yield {**point, name: further}


@dataclasses.dataclass(frozen=True)
class Cell:
    """The search of one agent on one task.

    Attributes:
      env: name of the environment.
      agent: name of the agent.
      reward_delay: the environment's reward delay.
      obs_noise: the environment's observation noise; figures with noise use what was
        chosen without.
      decompose_rewards: decompose rewards where they are delayed, even if the agent
        does not by itself.
    """

    env: str
    agent: str
    reward_delay: int = 1
    obs_noise: float = 0.0
    decompose_rewards: bool = False
    #: The version of the algorithm that its runs are of.
    version: ClassVar[int] = ALGORITHM_VERSION

    def config(self, point: Point) -> Config:
        """Return a point's config."""
        decompose = self.decompose_rewards or self.agent in _DECOMPOSED
        return Config(
            agent=self.agent,
            total_steps=1_000_000,
            num_envs=32,
            normalize_rewards=True,
            decompose_rewards=decompose and self.reward_delay > 1,
        ).replace(**point)

    def runs(self, stage: Stage) -> list[list[Run]]:
        """Return the runs of a stage, a list for each point."""
        return [
            [Run(self.env, self.config(x), seed, self.reward_delay) for seed in _SEEDS]
            for x in stage.points
        ]

    def scores(self, stage: Stage, store: Store) -> np.ndarray | None:
        """Return the mean return over the last fifth of training, (points, seeds).

        The result is None if the store lacks a run of the stage.
        """
        return scores(self.runs(stage), store)

    def stages(self, store: Store) -> list[Stage]:
        """Return the drawn points and, if all their runs are stored, those beyond."""
        first = Stage(draw(self.agent), _SEEDS)
        scores = self.scores(first, store)
        if scores is None:
            return [first]
        best = first.points[int(means(scores).argmax())]
        further = tuple(beyond(self.agent, best))
        return [first, Stage(further, _SEEDS)] if further else [first]

    def best(self, store: Store) -> tuple[Point, np.ndarray] | None:
        """Return the best point and its scores, or None if the search is incomplete."""
        stages = self.stages(store)
        scores = [self.scores(stage, store) for stage in stages]
        if any(x is None for x in scores):
            return None
        points = list(itertools.chain(*(stage.points for stage in stages)))
        every = np.concatenate([x for x in scores if x is not None])
        chosen = int(means(every).argmax())
        return points[chosen], every[chosen]

    def chosen(self, store: Store) -> Point | None:
        """Return the chosen point, or None if the search is incomplete."""
        best = self.best(store)
        return None if best is None else best[0]


#: Every task with its delay.
CELLS = tuple(itertools.product(TASKS, (1, DELAY)))


def cells(env: str, reward_delay: int) -> dict[str, Cell]:
    """Return the searches on a task by the names of their curves.

    Beside the agents there is PPO with decomposed rewards: what it shares with
    `ppo+gasil-adaptive` is no merit of imitation.
    """
    searches = {agent: Cell(env, agent, reward_delay) for agent in AGENTS}
    if reward_delay > 1:
        decomposed = Cell(env, "ppo", reward_delay, decompose_rewards=True)
        searches["ppo, decomposed"] = decomposed
    return searches


@dataclasses.dataclass(frozen=True)
class Single(Cell):
    """The search of one agent for one point for all tasks, dense and delayed."""

    def chosen(self, store: Store) -> Point | None:
        """Return the drawn point of the best mean rank, or None if cells are missing.

        Points are ranked within each task and delay, because returns of tasks have
        different units.
        """
        ranks = []
        for env, delay in CELLS:
            cell = dataclasses.replace(self, env=env, reward_delay=delay)
            scores = cell.scores(Stage(draw(self.agent), _SEEDS), store)
            if scores is None:
                return None
            ranks.append(means(scores).argsort().argsort())
        return draw(self.agent)[int(np.mean(ranks, axis=0).argmax())]


def seeds(env: str, reward_delay: int) -> int:
    """Return the number of seeds of a figure; delayed, three tasks are bimodal."""
    return 20 if reward_delay > 1 and env in TASKS[:3] else 10


def importance(agent: str, store: Store) -> dict[str, float]:
    """Return how much of its points' variance each hyperparameter explains alone.

    It is the mean over the tasks, dense and delayed, of `statistics.importance`; empty
    while a task's search is incomplete.
    """
    points, shares = draw(agent), dict.fromkeys(SPACES[agent], 0.0)
    for env, delay in CELLS:
        scores = Cell(env, agent, delay).scores(Stage(points, _SEEDS), store)
        if scores is None:
            return {}
        for name in shares:
            values = [point[name] for point in points]
            share = statistics.importance(values, scores.mean(axis=1))
            shares[name] += (share or 0.0) / len(CELLS)
    return shares


class Coverage(NamedTuple):
    """How many runs of a curve on a task are stored and planned.

    A search that is incomplete has a plan of its drawn points alone.
    """

    cell: Cell
    name: str
    searched: int
    to_search: int
    trained: int
    to_train: int

    @property
    def complete(self) -> bool:
        """Whether all planned runs are stored."""
        return (self.searched, self.trained) == (self.to_search, self.to_train)


def coverage(store: Store, curves: Sequence[Any]) -> list[Coverage]:
    """Return what is stored of the plan, for each task, delay and agent.

    Args:
      store: the store of all runs.
      curves: the figure's curves.
    """
    stored = lambda runs: sum(run in store for run in runs)
    rows = []
    searches = itertools.chain(*(cells(*task).items() for task in CELLS))
    for name, cell in searches:
        points = [runs for stage in cell.stages(store) for runs in cell.runs(stage)]
        search = list(itertools.chain(*points))
        mine = [curve for curve in curves if curve.search == cell]
        trained = sum(stored(curve.runs(store)) for curve in mine)
        planned = sum(curve.seeds for curve in mine)
        of = (stored(search), len(search), trained, planned)
        rows.append(Coverage(cell, name, *of))
    return rows

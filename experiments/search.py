"""The searches of hyperparameters.

Episodes are staggered and rewards are normalized, but not in the paper's own protocol.
Every agent is searched with the same number of points on every task, dense and delayed,
with two seeds. If the best point has a value at an end of its grid, the next value
beyond is tried too. The best of all these points are trained with more seeds before one
is chosen, because two seeds decide little on tasks with bimodal outcomes. So the same
runs give the best point of each task, which is the paper's protocol, and the best
single point for all delayed tasks. Figures train the chosen points with other seeds
than the searches.
"""

import dataclasses
import functools
import itertools
import zlib
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, ClassVar

import numpy as np

from experiments.agents import algorithm
from experiments.store import Store
from gasil_jax.algorithms import Algorithm
from gasil_jax.host.environments import Settings, make_env
from gasil_jax.host.points import PAPER_RANGES
from gasil_jax.host.runs import Run

Point = Mapping[str, Any]
Space = Mapping[str, tuple[Any, ...]]

TASKS = ("hopper", "walker2d", "halfcheetah", "swimmer", "ant", "humanoid")
#: Tasks on which nothing was ever chosen.
NEW_TASKS = ("inverted_double_pendulum", "reacher", "pusher", "humanoidstandup")
#: The steps between two rewards where they are delayed (paper, section 5.4).
DELAY = 20
#: The two agents that most figures compare, the paper's, and the adaptive one.
PAIR, PAPERS = ("ppo", "ppo+gasil"), ("ppo", "ppo+bc", "ppo+sil", "ppo+gasil")
ADAPTIVE = "ppo+gasil-adaptive"
#: Steps of a run in a search.
STEPS, _STEPS_OF = 1_000_000, {"point_mass": 500_000}
#: Number of points of each agent's search, and their seeds.
_POINTS, SEEDS = 12, range(1000, 1002)
#: Number of best points that are trained with more seeds, and all their seeds.
_FINALISTS, FINALIST_SEEDS = 3, range(1000, 1006)
#: The values for every agent, and those for some.
_SHARED: Space = {
    "learning_rate": (1e-4, 3e-4, 6e-4),
    "gae_lambda": (0.95, 0.98, 0.995),
    "gamma": (0.99, 0.995),
    "initial_std": (0.15, 0.25, 0.4, 0.6, 1.0),
}
_ALPHA: Space = {"alpha": (0.02, 0.1, 0.2, 1.0)}
_DISCRIMINATOR: Space = {
    "discriminator_updates": (1, 5, 20),
    "discriminator_learning_rate": (2e-5, 1e-4, 3e-4),
    "buffer_steps": (1000, 10_000),
}
#: The values that each agent's search draws from, in increasing order.
SPACES: Mapping[str, Space] = {
    "ppo": _SHARED,
    "ppo+bc": {**_SHARED, "behavior_cloning_coefficient": (0.01, 0.1, 0.3, 1.0)},
    "ppo+sil": {**_SHARED, "sil_coefficient": (0.01, 0.1, 0.3, 1.0)},
    "gasil": {**_SHARED, **_DISCRIMINATOR},
    "ppo+gasil": {**_SHARED, **_DISCRIMINATOR, **_ALPHA},
    "ppo+bonus": {**_SHARED, **_ALPHA},
    ADAPTIVE: {
        **_SHARED,
        **_DISCRIMINATOR,
        "imitation_weight": (0.35, 0.7, 1.0),
    },
}
AGENTS = tuple(SPACES)
#: The next value below and above each grid, or None if none is tried. The buffer's size
#: is studied in the figure "hyperparameters".
BEYOND: Mapping[str, tuple[Any, Any]] = {
    "learning_rate": (3e-5, 1.2e-3),
    "gae_lambda": (0.9, None),
    "gamma": (0.98, 0.998),
    "initial_std": (0.08, 1.5),
    "alpha": (0.005, 3.0),
    "behavior_cloning_coefficient": (0.003, 3.0),
    "sil_coefficient": (0.003, 3.0),
    "discriminator_updates": (None, 40),
    "discriminator_learning_rate": (5e-6, 1e-3),
    "buffer_steps": (None, None),
    "imitation_weight": (0.15, None),
}


def draw(agent: str) -> tuple[Point, ...]:
    """Return the points of an agent's search, all different."""
    return _drawn(SPACES[agent], _POINTS, agent)


def generator(name: str) -> np.random.Generator:
    """Return a generator of random numbers that a name seeds."""
    return np.random.default_rng(zlib.crc32(name.encode()))


def _drawn(space: Space, count: int, name: str) -> tuple[Point, ...]:
    """Return points of a space, all different and the same for the same name."""
    rng = generator(name)
    rows: list[tuple[Any, ...]] = []
    while len(set(rows)) < count:
        columns = [
            rng.permutation([values[i % len(values)] for i in range(count)]).tolist()
            for values in space.values()
        ]
        rows = list(zip(*columns, strict=True))
    return tuple(dict(zip(space, row, strict=True)) for row in rows)


def beyond(agent: str, point: Point) -> Iterator[Point]:
    """Yield, for each value at an end of its grid, the point with the value beyond."""
    for name, values in SPACES[agent].items():
        for end, further in zip((values[0], values[-1]), BEYOND[name], strict=True):
            if point[name] == end and further is not None:
                yield {**point, name: further}


def _ranks(scores: np.ndarray) -> np.ndarray:
    """Return the ranks of points, (points,), 0 the worst, from (points, seeds)."""
    return scores.mean(axis=1).argsort().argsort()


@dataclasses.dataclass(frozen=True)
class Search:
    """The search of one agent on one task.

    Attributes:
      env: name of the environment.
      agent: name of the agent.
      reward_delay: the environment's reward delay.
      decompose_rewards: whether to decompose delayed rewards; adaptive imitation does
        so in any case.
      chooser: another agent. What its search chose is used in place of the own search's
        choice, for all hyperparameters that both agents have.
    """

    _final_seeds: ClassVar[range] = FINALIST_SEEDS
    env: str
    agent: str
    reward_delay: int = 1
    decompose_rewards: bool = False
    chooser: str | None = None

    def algorithm(self, point: Point) -> Algorithm:
        """Return a point's algorithm."""
        return self._base().replace(**point)

    def _base(self) -> Algorithm:
        """Return the settings that all points share."""
        decompose = self.decompose_rewards or self.agent == ADAPTIVE
        return algorithm(
            self.agent,
            total_steps=_STEPS_OF.get(self.env, STEPS),
            num_envs=32,
            normalize_rewards=True,
            decompose_rewards=decompose and self.reward_delay > 1,
        )

    def runs(
        self, points: Iterable[Point], seeds: Iterable[int] = SEEDS
    ) -> list[list[Run]]:
        """Return the runs of points, a list for each."""
        seeds, settings = tuple(seeds), Settings(reward_delay=self.reward_delay)
        return [
            [Run(self.env, one, seed, settings) for seed in seeds]
            for one in map(self.algorithm, points)
        ]

    def scores(
        self, points: Iterable[Point], store: Store, seeds: Iterable[int] = SEEDS
    ) -> np.ndarray | None:
        """Return returns of the last fifth, (points, seeds), or None if runs lack."""
        points, seeds = tuple(points), tuple(seeds)
        # The curves of all pages ask again and again.
        asked = (self, tuple(tuple(x.items()) for x in points), seeds)
        if asked not in store.answers:
            runs, finals = self.runs(points, seeds), None
            if not store.missing(itertools.chain(*runs)):
                every = [[store[run].part(0.8, 1.0) for run in x] for x in runs]
                finals = np.where(np.isfinite(every), every, -np.inf)
            store.answers[asked] = finals
        return store.answers[asked]

    def points(self, store: Store) -> tuple[Point, ...]:
        """Return the drawn points and, if all their runs are stored, those beyond."""
        drawn = draw(self.agent)
        scores = self.scores(drawn, store)
        if scores is None:
            return drawn
        best = drawn[int(scores.mean(axis=1).argmax())]
        return (*drawn, *beyond(self.agent, best))

    def finalists(self, store: Store) -> tuple[Point, ...]:
        """Return the best points, best first, or none if runs of any are missing."""
        points = self.points(store)
        scores = self.scores(points, store)
        # Until the drawn points are stored, those beyond are unknown.
        if scores is None:
            return ()
        order = np.argsort(-scores.mean(axis=1), kind="stable")
        return tuple(points[i] for i in order[:_FINALISTS])

    def requested(self, store: Store) -> list[Run]:
        """Return all runs of the search that are known so far."""
        runs = self.runs(self.points(store))
        runs += self.runs(self.finalists(store), self._final_seeds)
        return list(dict.fromkeys(itertools.chain(*runs)))

    def best(self, store: Store) -> tuple[Point, np.ndarray] | None:
        """Return the best finalist and its scores, or None if runs are missing."""
        finalists = self.finalists(store)
        scores = self.scores(finalists, store, self._final_seeds)
        if scores is None or not finalists:
            return None
        chosen = int(scores.mean(axis=1).argmax())
        return finalists[chosen], scores[chosen]

    def chosen(self, store: Store) -> Point | None:
        """Return the chosen point, or None if runs of a search are missing."""
        best = self.best(store)
        if best is None or self.chooser is None:
            return best and best[0]
        other = dataclasses.replace(self, agent=self.chooser, chooser=None)
        if (shared := other.chosen(store)) is None:
            return None
        own = self.algorithm({}).settings
        return {**best[0], **{name: x for name, x in shared.items() if name in own}}


class SingleStage(Search):
    """A search that chooses among all of its points, which have the same seeds."""

    _final_seeds = SEEDS

    def finalists(self, store: Store) -> tuple[Point, ...]:
        """Return all points of the search."""
        return self.points(store)


def _grid(space: Space) -> tuple[Point, ...]:
    """Return all points of a space."""
    rows = itertools.product(*space.values())
    return tuple(dict(zip(space, row, strict=True)) for row in rows)


#: The values of the paper's appendix, and for PPO+BC and PPO+SIL, of which it gives
#: none, those around what the authors of SIL used.
_PAPER: Space = {name: tuple(sorted(x)) for name, x in PAPER_RANGES.items()}
_PAPER_RATES: Space = {"learning_rate": _PAPER["learning_rate"]}
_COEFFICIENTS = (0.01, 0.1, 0.3, 1.0)
PAPER_SPACES: Mapping[str, Space] = {
    "ppo": _PAPER_RATES,
    "ppo+bc": {**_PAPER_RATES, "behavior_cloning_coefficient": _COEFFICIENTS},
    "ppo+sil": {**_PAPER_RATES, "sil_coefficient": _COEFFICIENTS},
    "ppo+gasil": _PAPER,
    # The control: PPO+GASIL's bonus as a constant.
    "ppo+bonus": {name: _PAPER[name] for name in ("learning_rate", "alpha")},
}
#: The largest number of points that are tried; of more, as many are drawn.
_PAPER_POINTS = 32


#: The paper's rule for humanoid with dense rewards: alpha is 0 for 2M steps and then
#: raised to 0.02 until 3M.
HUMANOID: Point = {"alpha": 0.02, "alpha_schedule": ((2e6, 0.0), (3e6, 1.0))}
#: The steps of a run under the paper's protocol where they are not `STEPS`.
PAPER_STEPS_OF = {"humanoid": 3_000_000}


@functools.cache
def paper_points(agent: str) -> tuple[Point, ...]:
    """Return the points of an agent's search under the paper's protocol."""
    every = _grid(PAPER_SPACES[agent])
    if len(every) <= _PAPER_POINTS:
        return every
    return _drawn(PAPER_SPACES[agent], _PAPER_POINTS, f"paper {agent}")


@dataclasses.dataclass(frozen=True)
class PaperSearch(SingleStage):
    """The search of one agent on one task under the paper's own protocol.

    It has the paper's batch, 2,048 steps of one environment that starts at age 0, and
    all else of its appendix. The best of `paper_points` by the mean of two seeds is
    chosen.

    Attributes:
      normalize_rewards: whether rewards are normalized, as in the code of the authors'
        SIL, or raw, as in baselines' ppo1 and GAIL. The paper does not say which.
      bonus: the form of PPO+GASIL's bonus; None for the agent's own.
    """

    normalize_rewards: bool = True
    bonus: str | None = None

    def _base(self) -> Algorithm:
        base = algorithm(
            self.agent,
            total_steps=PAPER_STEPS_OF.get(self.env, STEPS),
            num_envs=1,
            stagger_episodes=False,
            normalize_rewards=self.normalize_rewards,
            **({"bonus": self.bonus} if self.bonus else {}),
        )
        return base.replace(**HUMANOID) if self._has_schedule else base

    @property
    def _has_schedule(self) -> bool:
        task = (self.env, self.agent, self.reward_delay)
        return task == ("humanoid", "ppo+gasil", 1)

    def points(self, store: Store) -> tuple[Point, ...]:
        """Return all points of the search."""
        points = paper_points(self.agent)
        own = {"alpha": HUMANOID["alpha"]} if self._has_schedule else {}
        return tuple({**point, **own} for point in points)


class SecondStage(PaperSearch):
    """`PaperSearch`, whose best points by two seeds get ten others for the choice."""

    _final_seeds = range(10)

    def finalists(self, store: Store) -> tuple[Point, ...]:
        """Return the best points by the search's two seeds."""
        return Search.finalists(self, store)


#: The sparse tasks, and the ways to explore and imitate that are compared on them.
SPARSE = tuple(
    f"sparse:{name}"
    for name in (
        *("u_maze", "u_maze_short", "key_maze", "key_maze_short", "four_rooms"),
        *("apple_maze", "key_grid", "deep_sea_10", "deep_sea_20", "mountain_car"),
        # Chosen for how often PPO solves them; no search trains on them.
        *("key_grid_large", "u_maze_large", "two_keys_maze", "far_key_maze"),
    )
)
#: Sparse tasks that are trained longer, for `STEPS`: robots, and a grid of navix. No
#: search trains on them. (In navix 0.7.4 no action reaches the ball of KeyCorridor.)
SPARSE_ROBOTS = ("sparse:hopper", "sparse:halfcheetah")
SPARSE_GRIDS = ("navix:Navix-DoorKey-8x8-v0",)
_ENTROPIES: Space = {"entropy_coefficient": (0.0, 0.01, 0.03)}
#: Those that the searches train on; the others have no part in any choice.
SPARSE_SEARCHED = tuple(SPARSE[i] for i in (0, 2, 4, 6, 7))
#: Six points for each agent.
SPARSE_SPACES: Mapping[str, Space] = {
    "ppo": {**_ENTROPIES, "learning_rate": (3e-4, 1e-3)},
    "ppo+bc": {**_ENTROPIES, "behavior_cloning_coefficient": (0.1, 1.0)},
    "ppo+sil": {**_ENTROPIES, "sil_coefficient": (0.1, 1.0)},
    "ppo+gasil": {**_ENTROPIES, "alpha": (0.02, 0.1)},
    "ppo+novelty": {**_ENTROPIES, "novelty_coefficient": (0.1, 1.0)},
    "ppo+bc+novelty": {**_ENTROPIES, "novelty_coefficient": (0.1, 1.0)},
}
SPARSE_STEPS = 500_000
#: What does not differ between agents on the sparse tasks.
SPARSE_BASE: Point = {"num_envs": 16, "normalize_rewards": True}


@dataclasses.dataclass(frozen=True)
class SparseSearch(SingleStage):
    """The search of an agent for one setting for all sparse tasks.

    The point with the highest mean progress, over the tasks of the search and two
    seeds, is chosen.
    The progress is the return over the last fifth of training divided by `solved_from`,
    the return that counts as a success, and clipped to [0, 1].
    """

    def _base(self) -> Algorithm:
        own = {"behavior_cloning_coefficient": 1.0}
        own = own if self.agent == "ppo+bc+novelty" else {}
        return algorithm(self.agent, total_steps=SPARSE_STEPS, **SPARSE_BASE, **own)

    def points(self, store: Store) -> tuple[Point, ...]:
        """Return all points of the search."""
        return _grid(SPARSE_SPACES[self.agent])

    def scores(
        self, points: Iterable[Point], store: Store, seeds: Iterable[int] = SEEDS
    ) -> np.ndarray | None:
        """Return the progress, (points, seeds of all tasks), or None if runs lack."""
        points, every = tuple(points), list[np.ndarray]()
        for env in SPARSE_SEARCHED:
            one = dataclasses.replace(self, env=env)
            scores = super(SparseSearch, one).scores(points, store, seeds)
            if scores is None:
                return None
            every.append(np.clip(scores / solved_from(env), 0.0, 1.0))
        return np.hstack(every)


@functools.cache
def solved_from(env: str) -> float:
    """Return the return from which on a sparse task is solved."""
    if env.startswith("navix:"):
        # They pay 1 for a success, and their package may be missing.
        return 1.0
    return make_env(env).unwrapped.solved


#: Every task with its delay, delayed ones first.
CELLS = tuple((env, delay) for delay in (DELAY, 1) for env in TASKS)


def searches(env: str, reward_delay: int) -> dict[str, Search]:
    """Return the searches on a task, also of PPO on decomposed rewards."""
    by_name = {agent: Search(env, agent, reward_delay) for agent in AGENTS}
    if reward_delay > 1:
        decomposed = Search(env, "ppo", reward_delay, decompose_rewards=True)
        by_name["ppo (decomposed)"] = decomposed
    return by_name


@dataclasses.dataclass(frozen=True)
class SingleSetting(Search):
    """The search of one agent for one point for all tasks, at one reward delay."""

    def chosen(self, store: Store) -> Point | None:
        """Return the drawn point with the best mean rank, or None if runs lack."""
        ranks, drawn = [], draw(self.agent)
        for env in TASKS:
            scores = dataclasses.replace(self, env=env).scores(drawn, store)
            if scores is None:
                return None
            ranks.append(_ranks(scores))
        return drawn[int(np.mean(ranks, axis=0).argmax())]

"""What each figure is: its panels and curves, as questions to the store of runs.

A new figure is one more entry of `FIGURES`. Its page is `notes/NAME.md`, filled in.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

from experiments.search import (
    AGENTS,
    DELAY,
    NOISE,
    PAIR,
    TASKS,
    Point,
    Search,
)
from experiments.store import ALGORITHM_VERSION, Run, Store
from gasil_jax import presets

#: What is compared: a weighted sum of the interquartile means of curves, which are
#: named by panel and curve. By (panel, ours, other), or (panel, ours, other, a panel
#: whose difference is subtracted).
Terms = tuple[tuple[float, str, str], ...]
Comparisons = Mapping[tuple[str, ...], Terms]


@dataclasses.dataclass(frozen=True)
class Curve:
    """Seeds of one agent on one task.

    Attributes:
      search: the search that chose the hyperparameters, for this agent and task.
      seeds: number of seeds, from seed 0 on.
      total_steps: environment steps per seed.
      obs_noise: the environment's noise, if it is not the search's.
      preset: whether the tuned preset has the hyperparameters instead.
      changes: of these, and of other fields of `Config`.
    """

    search: Search
    seeds: int = 10
    total_steps: int = 1_000_000
    obs_noise: float | None = None
    preset: bool = False
    changes: Point = dataclasses.field(default_factory=dict)

    def point(self, searched: Store) -> Point | None:
        """What differs from the appendix's or the preset's values.

        None before the search is complete, whose runs are in the store `searched`.
        """
        chosen = {} if self.preset else self.search.chosen(searched)
        return None if chosen is None else {**chosen, **self.changes}

    def runs(self, searched: Store) -> tuple[Run, ...]:
        """Its runs, none before its search is complete."""
        point, of = self.point(searched), self.search
        if point is None:
            return ()
        if self.preset:
            config = presets.preset(of.env, of.agent, "tuned", of.reward_delay)
        else:
            config = of.config({})
        config = config.replace(**{"total_steps": self.total_steps, **point})
        noise = of.obs_noise if self.obs_noise is None else self.obs_noise
        changes: dict[str, Any] = {"obs_noise": noise}
        if self.preset:
            changes["algorithm_version"] = ALGORITHM_VERSION
        return tuple(of.run(config, seed, **changes) for seed in range(self.seeds))


Panels = Mapping[str, Mapping[str, Curve]]


@dataclasses.dataclass(frozen=True)
class Figure:
    """A figure and its page.

    Attributes:
      title: of the page.
      claim: what the paper says; empty where it says nothing of the matter.
      panels: panel -> name -> curve.
      favourite: the curve that is compared with each other one of its panel; None
        compares all with all.
      comparisons: comparisons to make instead of those with the favourite.
      searches: that are trained before the curves, by the name in their table.
      quick: panels and searches of the small version.
      over: the field of `Config` that final returns are drawn over; None for learning
        curves.
      early: environment steps whose mean return is compared too, as curve "NAME early".
    """

    title: str
    claim: str
    panels: Panels = dataclasses.field(default_factory=dict)
    favourite: str | None = "ppo+gasil"
    comparisons: Comparisons | None = None
    searches: Mapping[str, Search] = dataclasses.field(default_factory=dict)
    quick: tuple[str, ...] = ()
    over: str | None = None
    early: int | None = None

    def compared(self) -> Comparisons:
        """Everything that its page compares: one family of tests."""
        if self.comparisons is not None:
            return self.comparisons
        return {
            (panel, ours, other): difference(panel, ours, other)
            for panel, curves in self.panels.items()
            for i, ours in enumerate(curves)
            for j, other in enumerate(curves)
            if (ours == self.favourite != other) or (self.favourite is None and i < j)
        }

    def requested(self, store: Store, searched: Store) -> list[Run]:
        """All its runs that are settled so far.

        Args:
          store: of its own runs.
          searched: of the runs of searches, its own if it has some.
        """
        stages = [
            (x, stage) for x in self.searches.values() for stage in x.stages(store)
        ]
        runs = [
            run for x, stage in stages for of_point in x.runs(stage) for run in of_point
        ]
        curves = [curve for panel in self.panels.values() for curve in panel.values()]
        runs += [run for curve in curves for run in curve.runs(searched)]
        return list(dict.fromkeys(runs))


def difference(panel: str, ours: str, other: str) -> Terms:
    """One curve less another of the same panel."""
    return ((1.0, panel, ours), (-1.0, panel, other))


def name_of(env: str, reward_delay: int = 1, *more: str) -> str:
    """Return the name of a panel, such as hopper-delayed."""
    return "-".join([env, *(["delayed"] if reward_delay > 1 else []), *more])


def tuned(
    env: str, agent: str, delay: int = 1, normalized: bool = False, **more: Any
) -> Curve:
    """Return a curve with the hyperparameters chosen by the search on its own task."""
    # All noise levels use what the search chose at the middle one.
    noise = NOISE if more.get("obs_noise") else 0.0
    return Curve(Search(env, agent, delay, noise, normalized), **more)


#: Those that normalized rewards were tuned on: ant and humanoid cost several times as
#: much, and no agent has learned to walk there.
NORMALIZED = TASKS[:4]
#: Ten seeds tell few agents apart where one learns to run and another does not.
_DELAYED_SEEDS = {"hopper": 20, "walker2d": 20, "halfcheetah": 20}
_BOTH = (False, True)


def _agents(env: str, delay: int, normalized: bool = False) -> dict[str, Curve]:
    seeds = _DELAYED_SEEDS.get(env, 10) if delay > 1 else 10
    return {x: tuned(env, x, delay, normalized, seeds=seeds) for x in AGENTS}


def _searches(normalized: bool, tasks: tuple[str, ...]) -> dict[str, Search]:
    return {
        f"{name_of(env, delay)} {agent}": Search(
            env, agent, delay, normalize_rewards=normalized
        )
        for env in tasks
        for delay in (1, DELAY)
        for agent in AGENTS
    } | {
        f"walker2d-noise {agent}": Search("walker2d", agent, 1, NOISE, normalized)
        for agent in PAIR
    }


def _noise_panel(noise: float, normalized: bool) -> str:
    return f"noise-{noise:g}" + ("-normalized" if normalized else "")


_NOISES = (0.0, 0.05, 0.1, 0.5)


def _noise_comparisons() -> Comparisons:
    """Return comparisons of the gap at each noise, and of its growth with noise."""
    compared: dict[tuple[str, ...], Terms] = {}
    for normalized in _BOTH:
        calm = _noise_panel(0.0, normalized)
        for noise in _NOISES:
            panel = _noise_panel(noise, normalized)
            gap = difference(panel, "ppo+gasil", "ppo")
            compared[panel, "ppo+gasil", "ppo"] = gap
            if noise:
                less = difference(calm, "ppo", "ppo+gasil")
                compared[panel, "ppo+gasil", "ppo", calm] = (*gap, *less)
    return compared


#: Figure 8's numbers.
_VALUES = {
    "buffer_steps": (500, 1000, 2000, 5000, 10000),
    "discriminator_updates": (1, 5, 10, 20),
}


#: A discriminator that its entropy bonus holds at 1/2 everywhere: alpha log 2 a step.
#: Against this weight what tells good from other moves a logit by 4 / 1000.
CONSTANT = {
    "discriminator_entropy_coefficient": 1e3,
    "discriminator_updates": 5,
    "discriminator_learning_rate": 3e-4,
}


def _bonus_panel(env: str) -> dict[str, Curve]:
    curve = lambda agent, **more: tuned(env, agent, DELAY, True, seeds=20, **more)
    constant = curve("ppo+gasil", changes=CONSTANT)
    return {"ppo": curve("ppo"), "constant": constant, "ppo+gasil": curve("ppo+gasil")}


def _bonus_comparisons() -> Comparisons:
    """What the bonus adds, what imitation adds to that, and which adds more."""
    compared: dict[tuple[str, ...], Terms] = {}
    for panel in ("hopper-delayed", "walker2d-delayed"):
        pairs = (("ppo+gasil", "ppo"), ("ppo+gasil", "constant"), ("constant", "ppo"))
        compared |= {(panel, *pair): difference(panel, *pair) for pair in pairs}
        imitation = difference(panel, "ppo+gasil", "constant")
        more = (*imitation, *difference(panel, "ppo", "constant"))
        compared[panel, "imitation", "bonus"] = more
    return compared


#: The paper's schedule of alpha for humanoid (appendix).
_SCHEDULED = {"alpha": 0.02, "alpha_schedule": ((2e6, 0.0), (3e6, 1.0))}


def _humanoid(delay: int) -> dict[str, Curve]:
    curve = lambda agent, **more: tuned(
        "humanoid", agent, delay, total_steps=3_000_000, **more
    )
    panel = {agent: curve(agent) for agent in AGENTS}
    if delay == 1:
        panel["ppo+gasil-from-2M"] = curve("ppo+gasil", changes=_SCHEDULED)
    return panel


def _wider(env: str) -> Search:
    free = ("discriminator_updates", "discriminator_learning_rate", "buffer_steps")
    before = Search(env, "ppo+gasil", DELAY)
    return dataclasses.replace(before, after=before, free=free)


def _wider_panel(env: str) -> dict[str, Curve]:
    return {**_agents(env, DELAY), "wider": Curve(_wider(env))}


#: Environments a seed of the figure on batch geometry, and whether they start at
#: random ages, in words.
GEOMETRY_NUM_ENVS = (1, 8, 32, 128)
AGES = {True: "drawn", False: "not-drawn"}


def geometry_curve(agent: str, drawn: bool, num_envs: int) -> str:
    """Return the name of a curve of the figure on batch geometry."""
    return f"{agent}-{num_envs}-{AGES[drawn]}"


def _geometry_panel(env: str, delay: int) -> dict[str, Curve]:
    return {
        geometry_curve(agent, drawn, num_envs): Curve(
            Search(env, agent, delay),
            seeds=20 if env == "halfcheetah" else 10,
            preset=True,
            changes={
                "num_envs": num_envs,
                "batch_steps": 2048,
                "stagger_episodes": drawn,
            },
        )
        for agent in PAIR
        for drawn in AGES
        for num_envs in GEOMETRY_NUM_ENVS
    }


_GEOMETRY = {
    name_of(env, delay): _geometry_panel(env, delay)
    for env in ("halfcheetah", "swimmer")
    for delay in (1, DELAY)
}
_GEOMETRY_COMPARISONS = {
    (panel, *names): difference(panel, *names)
    for panel in _GEOMETRY
    for agent in PAIR
    for num_envs in GEOMETRY_NUM_ENVS
    for names in [tuple(geometry_curve(agent, drawn, num_envs) for drawn in AGES)]
}

_DENSE = (
    "PPO+GASIL improves PPO on most of the tasks, and outperforms PPO+BC and PPO+SIL "
    "on most of them."
)
_DELAYED = (
    "With the reward given every 20 steps, PPO+GASIL improves PPO, and outperforms "
    "PPO+BC and PPO+SIL, on all tasks by a large margin."
)

FIGURES: Mapping[str, Figure] = {
    "point_mass": Figure(
        "2D point mass (paper, figures 2 to 4)",
        "PPO learns a sub-optimal policy quickly; PPO+GASIL learns a little more "
        "slowly at first and ends with a better policy.",
        {
            "point_mass": {
                agent: tuned("point_mass", agent, seeds=40, total_steps=500_000)
                for agent in PAIR
            }
        },
        comparisons={
            ("point_mass", *names): difference("point_mass", *names)
            for names in (("ppo+gasil", "ppo"), ("ppo+gasil early", "ppo early"))
        },
        quick=("point_mass",),
        early=30_000,
    ),
    "mujoco": Figure(
        "MuJoCo tasks (paper, figure 5)",
        _DENSE,
        {env: _agents(env, 1) for env in TASKS},
        quick=("hopper",),
    ),
    "stochastic_walker2d": Figure(
        "Walker2d with noisy observations (paper, figure 6)",
        "The gap between PPO and PPO+GASIL is larger when Gaussian noise, of standard "
        "deviation 0.05, 0.1 and 0.5, is added to the observations.",
        {
            _noise_panel(noise, normalized): {
                agent: tuned("walker2d", agent, 1, normalized, obs_noise=noise)
                for agent in PAIR
            }
            for normalized in _BOTH
            for noise in _NOISES
        },
        comparisons=_noise_comparisons(),
        quick=("noise-0", "noise-0.1"),
    ),
    "delayed_mujoco": Figure(
        "MuJoCo tasks with delayed rewards (paper, figure 7)",
        _DELAYED,
        {env: _agents(env, DELAY) for env in TASKS},
        quick=("hopper",),
    ),
    "hyperparameters": Figure(
        "Effect of GASIL's hyperparameters (paper, figure 8)",
        "The agent performs poorly when the buffer is too small (500 steps) or too "
        "large (5000 steps), and with too few or too many discriminator updates.",
        {
            name_of(name, delay, *(["normalized"] if normalized else [])): {
                str(value): tuned(
                    "walker2d",
                    "ppo+gasil",
                    delay,
                    normalized,
                    changes={name: value},
                )
                for value in values
            }
            for normalized in _BOTH
            for delay in (1, DELAY)
            for name, values in _VALUES.items()
        },
        favourite=None,
        quick=("discriminator_updates",),
    ),
    "random_search": Figure(
        "Hyperparameters of every agent (paper, table 1)",
        "A search over the appendix's ranges, for every task.",
        searches=_searches(False, TASKS)
        | {f"point_mass {agent}": Search("point_mass", agent) for agent in PAIR},
        quick=("hopper ppo", "hopper ppo+gasil"),
    ),
    "normalized_rewards": Figure(
        "Normalized rewards (paper, figures 5 and 7)",
        f"{_DELAYED} {_DENSE}",
        {
            name_of(env, delay): _agents(env, delay, True)
            for delay in (DELAY, 1)
            for env in NORMALIZED
        },
        searches=_searches(True, NORMALIZED),
        quick=("hopper-delayed ppo", "hopper-delayed ppo+gasil"),
    ),
    "constant_bonus": Figure(
        "Delayed rewards and a bonus that knows nothing",
        "The discriminator's reward, learned from good trajectories, acts as a useful "
        "reward shaping that makes learning easier.",
        {name_of(env, DELAY): _bonus_panel(env) for env in ("hopper", "walker2d")},
        comparisons=_bonus_comparisons(),
        quick=("hopper-delayed",),
    ),
    "humanoid": Figure(
        "Humanoid over 3M steps (paper, figures 5 and 7)",
        "PPO+GASIL improves PPO and outperforms PPO+BC and PPO+SIL, by a large margin "
        "where the reward is delayed.",
        {"dense": _humanoid(1), "delayed": _humanoid(DELAY)},
        quick=("delayed",),
    ),
    "wider_search": Figure(
        "PPO+GASIL on delayed tasks, searched further",
        _DELAYED,
        {env: _wider_panel(env) for env in NORMALIZED},
        favourite="wider",
        searches={name_of(env, DELAY): _wider(env) for env in NORMALIZED},
        quick=("hopper-delayed",),
    ),
    "batch_geometry": Figure(
        "Number of environments, and episodes in step",
        "",
        _GEOMETRY,
        comparisons=_GEOMETRY_COMPARISONS,
        quick=("swimmer",),
        over="num_envs",
    ),
}

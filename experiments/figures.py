"""The figures: a table of which curves each has, as questions to the store of runs.

A new figure is one more row of `FIGURES`, and its page is ``notes/NAME.md``. Panels are
made by `grid` from tasks, delays and arms; an arm is a name, an agent and what it
changes. Two examples with one setting for all tasks instead of the tuned presets:

    "ablation": Figure(
        "Parts of the method", "",
        grid(TASKS, (Arm("whole", "ppo+gasil"), Arm("no bonus", "ppo+gasil",
             {"alpha": 0.0}), "ppo"), delays=(DELAY,), base=None, num_envs=64),
        favourite="whole",
    ),
    "delays": Figure(
        "Delays of the reward", "",
        grid(TASKS, AGENTS, delays=(1, 5, 20, 100, 1000), panel="{env}",
             curve="{arm}-{delay}", base=None, num_envs=64),
        over=("reward_delay", "delay"),
    ),
"""

import dataclasses
import itertools
import types
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from experiments.search import AGENTS, DELAY, NOISE, PAIR, TASKS, Point, Search
from experiments.search import ALGORITHM_VERSION as SEARCHED_VERSION
from experiments.store import ALGORITHM_VERSION, Run, Store
from gasil_jax import presets
from gasil_jax.config import Config

#: A weighted sum of the interquartile means of curves, by panel and curve.
Terms = tuple[tuple[float, str, str], ...]
#: What is compared: terms by (panel, ours, other), or (panel, ours, other, a panel
#: whose difference is subtracted).
Comparisons = Mapping[tuple[str, ...], Terms]
#: What a curve's settings start from: a search, the name of a preset, or None for the
#: defaults of `Config`.
Base = Search | str | None


@dataclasses.dataclass(frozen=True)
class Curve:
    """Seeds of one agent on one task.

    Attributes:
      env: name of the task.
      agent: name of the agent.
      reward_delay: the task's reward delay.
      obs_noise: the task's observation noise.
      base: the settings to start from.
      changes: hyperparameters and other fields of `Config` to change.
      seeds: number of seeds, from seed 0 on.
      total_steps: environment steps per seed.
    """

    env: str
    agent: str
    reward_delay: int = 1
    obs_noise: float = 0.0
    base: Base = "tuned"
    changes: Point = dataclasses.field(default_factory=dict)
    seeds: int = 10
    total_steps: int = 1_000_000

    def point(self, searched: Store) -> Point | None:
        """Return what differs from the appendix's or the preset's values.

        It is None if the curve's search is not complete in the store `searched`.
        """
        chosen = self.base.chosen(searched) if isinstance(self.base, Search) else {}
        return None if chosen is None else {**chosen, **self.changes}

    def runs(self, searched: Store) -> tuple[Run, ...]:
        """Return its runs, or none if its search is not complete."""
        if (point := self.point(searched)) is None:
            return ()
        version = ALGORITHM_VERSION
        if isinstance(self.base, Search):
            config, version = self.base.config({}), SEARCHED_VERSION
        elif self.base is None:
            config = Config(agent=self.agent)
        else:
            config = presets.preset(self.env, self.agent, self.base, self.reward_delay)
        config = config.replace(**{"total_steps": self.total_steps, **point})
        delay, noise = self.reward_delay, self.obs_noise
        return tuple(
            Run(self.env, config, seed, delay, noise, algorithm_version=version)
            for seed in range(self.seeds)
        )


Panels = Mapping[str, Mapping[str, Curve]]


@dataclasses.dataclass(frozen=True)
class Figure:
    """A figure and its page.

    Attributes:
      title: title of the page.
      claim: what the paper says; empty if it says nothing about the matter.
      panels: the curves of each panel, by their names.
      favourite: the curve that is compared with each other one of its panel; None
        compares all with all.
      comparisons: comparisons to make instead of those with the favourite.
      searches: searches that are trained before the curves, by their names.
      over: the field of the runs that final returns are drawn over, and its name on
        the axis; None for learning curves. Curves whose names differ in its value
        alone are points of one line.
      early: environment steps whose mean return is compared too, as curve "NAME early".
    """

    title: str
    claim: str
    panels: Panels = dataclasses.field(default_factory=dict)
    favourite: str | None = "ppo+gasil"
    comparisons: Comparisons | None = None
    searches: Mapping[str, Search] = dataclasses.field(default_factory=dict)
    over: tuple[str, str] | None = None
    early: int | None = None

    def curves(self) -> list[tuple[str, str, Curve]]:
        """Return all curves, each with its panel and name."""
        panels = self.panels.items()
        return [
            (panel, name, x) for panel, curves in panels for name, x in curves.items()
        ]

    def point_of(self, panel: str, name: str) -> tuple[str, Any]:
        """Return the line that a curve is a point of, and its place on the axis."""
        if self.over is None:
            return name, None
        curve = self.panels[panel][name]
        value = {**vars(curve), **curve.changes}[self.over[0]]
        return name.replace(f"-{value}", "", 1), value

    def compared(self) -> Comparisons:
        """Return everything that its page compares: one family of tests."""
        if self.comparisons is not None:
            return self.comparisons
        parts = ("", " early") if self.early else ("",)
        return {
            (panel, ours + part, other + part): difference(
                panel, ours + part, other + part
            )
            for panel, curves in self.panels.items()
            for part in parts
            for ours, other in itertools.permutations(curves, 2)
            if self._are_compared(panel, ours, other)
        }

    def _are_compared(self, panel: str, ours: str, other: str) -> bool:
        names = list(self.panels[panel])
        line, value = self.point_of(panel, ours)
        if value != self.point_of(panel, other)[1]:
            return False
        if self.favourite is None:
            return names.index(ours) < names.index(other)
        return line == self.favourite

    def requested(self, searched: Store) -> list[Run]:
        """Return all its runs that are known so far.

        Args:
          searched: the store of the searches' runs.
        """
        searches = self.searches.values()
        stages = [x.runs(stage) for x in searches for stage in x.stages(searched)]
        runs = [run for points in stages for seeds in points for run in seeds]
        runs += [run for *_, curve in self.curves() for run in curve.runs(searched)]
        return list(dict.fromkeys(runs))


def difference(panel: str, ours: str, other: str) -> Terms:
    """Return the terms of one curve less another of the same panel."""
    return ((1.0, panel, ours), (-1.0, panel, other))


def name_of(env: str, reward_delay: int = 1) -> str:
    """Return the name of a task with its delay, such as hopper-delayed."""
    delayed = {1: "", DELAY: "-delayed"}.get(reward_delay, f"-delayed-{reward_delay}")
    return f"{env}{delayed}"


def searched(env: str, agent: str, delay: int, noise: float = 0.0) -> Search:
    """Return the search on a task; all noises use what it chose at the middle one."""
    return Search(env, agent, delay, NOISE if noise else 0.0)


def searched_normalized(env: str, agent: str, delay: int, noise: float = 0.0) -> Search:
    """Return the search on a task with normalized rewards."""
    return Search(env, agent, delay, NOISE if noise else 0.0, normalize_rewards=True)


class Arm(NamedTuple):
    """A curve of each panel of a grid.

    Attributes:
      name: its name in the panels.
      agent: name of the agent.
      changes: hyperparameters and other fields of `Config` to change.
      base: the settings to start from, if they are not the grid's.
      seeds: number of seeds, if it is not the grid's.
    """

    name: str
    agent: str
    changes: Point = types.MappingProxyType({})
    base: Callable[..., Search] | str | None = None
    seeds: int | None = None


def grid(
    tasks: Sequence[str],
    arms: Sequence[Arm | str],
    *,
    delays: Sequence[int] = (1,),
    obs_noise: float = 0.0,
    base: Callable[..., Search] | str | None = "tuned",
    seeds: int | Mapping[str, int] = 10,
    total_steps: int = 1_000_000,
    panel: str = "{task}",
    curve: str = "{arm}",
    **changes: Any,
) -> Panels:
    """Return the panels of all tasks and delays, with a curve for each arm.

    Args:
      tasks: names of the tasks.
      arms: the arms; a name alone is that of an agent without changes.
      delays: reward delays of the tasks.
      obs_noise: observation noise of the tasks.
      base: the settings to start from, see `Base`, or a function of task, agent, delay
        and noise that returns a search.
      seeds: number of seeds, or the numbers by task if they are not 10.
      total_steps: environment steps per seed.
      panel: name of a panel, of {task} with its delay, {env} without, and {delay}.
      curve: name of a curve, of {arm} and {delay}.
      **changes: hyperparameters and other fields of `Config` to change in all arms.
    """
    panels: dict[str, dict[str, Curve]] = {}
    for env, delay, arm in itertools.product(tasks, delays, arms):
        own = Arm(arm, arm) if isinstance(arm, str) else arm
        start = own.base or base
        start = start(env, own.agent, delay, obs_noise) if callable(start) else start
        of_task = seeds if isinstance(seeds, int) else seeds.get(env, 10)
        name = panel.format(task=name_of(env, delay), env=env, delay=delay)
        panels.setdefault(name, {})[curve.format(arm=own.name, delay=delay)] = Curve(
            env,
            own.agent,
            delay,
            obs_noise,
            start,
            {**changes, **own.changes},
            own.seeds or of_task,
            total_steps,
        )
    return panels


#: The tasks with normalized rewards: ant and humanoid cost several times as much, and
#: no agent has learned to walk there.
NORMALIZED = TASKS[:4]
#: Ten seeds tell few agents apart where one learns to run and another does not.
_DELAYED_SEEDS = {"hopper": 20, "walker2d": 20, "halfcheetah": 20}
#: Searches without and with normalized rewards, and how names of panels end.
_REWARDS = ((searched, ""), (searched_normalized, "-normalized"))


def _searches(base: Callable[..., Search], tasks: Sequence[str]) -> dict[str, Search]:
    """Return the searches of all agents, and those with noise."""
    searches = {
        f"{name_of(env, delay)} {agent}": base(env, agent, delay)
        for env, delay, agent in itertools.product(tasks, (1, DELAY), AGENTS)
    }
    noisy = {f"walker2d-noise {x}": base("walker2d", x, 1, NOISE) for x in PAIR}
    return searches | noisy


_NOISES = (0.0, 0.05, 0.1, 0.5)


def _noise_panels() -> tuple[Panels, Comparisons]:
    """Return a panel for each noise; compare the gaps, and their growth with noise."""
    panels: dict[str, Mapping[str, Curve]] = {}
    compared: dict[tuple[str, ...], Terms] = {}
    for (base, suffix), noise in itertools.product(_REWARDS, _NOISES):
        panel, calm = f"noise-{noise:g}{suffix}", f"noise-0{suffix}"
        panels |= grid(("walker2d",), PAIR, obs_noise=noise, base=base, panel=panel)
        gap = difference(panel, "ppo+gasil", "ppo")
        compared[panel, "ppo+gasil", "ppo"] = gap
        if noise:
            less = difference(calm, "ppo", "ppo+gasil")
            compared[panel, "ppo+gasil", "ppo", calm] = (*gap, *less)
    return panels, compared


#: The values of the paper's figure 8.
_VALUES = {
    "buffer_steps": (500, 1000, 2000, 5000, 10000),
    "discriminator_updates": (1, 5, 10, 20),
}


def _value_panels() -> Panels:
    """Return a panel for each hyperparameter, delay and scale of rewards."""
    panels: dict[str, Mapping[str, Curve]] = {}
    for (base, suffix), delay, name in itertools.product(_REWARDS, (1, DELAY), _VALUES):
        panels |= grid(
            ("walker2d",),
            [Arm(str(value), "ppo+gasil", {name: value}) for value in _VALUES[name]],
            delays=(delay,),
            base=base,
            panel=f"{name_of(name, delay)}{suffix}",
        )
    return panels


#: A discriminator that its entropy bonus holds at 1/2 everywhere: alpha log 2 a step.
#: Against this weight what tells good from other moves a logit by 4 / 1000.
CONSTANT = {
    "discriminator_entropy_coefficient": 1e3,
    "discriminator_updates": 5,
    "discriminator_learning_rate": 3e-4,
}


def _bonus_comparisons() -> Comparisons:
    """Compare what the bonus adds, what imitation adds to that, and which adds more."""
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
_LONG: Any = {"base": searched, "total_steps": 3_000_000}


def _wider(env: str, agent: str, delay: int, noise: float = 0.0) -> Search:
    """Return a search that continues the first one of a task."""
    free = ("discriminator_updates", "discriminator_learning_rate", "buffer_steps")
    before = searched(env, agent, delay, noise)
    return dataclasses.replace(before, after=before, free=free)


#: Numbers of environments per seed in the figure on batch geometry, and whether they
#: start at random ages, in words.
GEOMETRY_NUM_ENVS = (1, 8, 32, 128)
AGES = {True: "drawn", False: "not-drawn"}
_GEOMETRY = grid(
    ("halfcheetah", "swimmer"),
    [
        Arm(
            f"{agent}-{num_envs}-{AGES[drawn]}",
            agent,
            {"num_envs": num_envs, "batch_steps": 2048, "stagger_episodes": drawn},
        )
        for agent, drawn, num_envs in itertools.product(PAIR, AGES, GEOMETRY_NUM_ENVS)
    ],
    delays=(1, DELAY),
    seeds={"halfcheetah": 20},
)
_GEOMETRY_COMPARISONS = {
    (panel, *names): difference(panel, *names)
    for panel, agent, count in itertools.product(_GEOMETRY, PAIR, GEOMETRY_NUM_ENVS)
    for names in [tuple(f"{agent}-{count}-{ages}" for ages in AGES.values())]
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
        grid(("point_mass",), PAIR, base=searched, seeds=40, total_steps=500_000),
        early=30_000,
    ),
    "mujoco": Figure(
        "MuJoCo tasks (paper, figure 5)", _DENSE, grid(TASKS, AGENTS, base=searched)
    ),
    "stochastic_walker2d": Figure(
        "Walker2d with noisy observations (paper, figure 6)",
        "The gap between PPO and PPO+GASIL is larger when Gaussian noise, of standard "
        "deviation 0.05, 0.1 and 0.5, is added to the observations.",
        _noise_panels()[0],
        comparisons=_noise_panels()[1],
    ),
    "delayed_mujoco": Figure(
        "MuJoCo tasks with delayed rewards (paper, figure 7)",
        _DELAYED,
        grid(
            TASKS,
            AGENTS,
            delays=(DELAY,),
            base=searched,
            seeds=_DELAYED_SEEDS,
            panel="{env}",
        ),
    ),
    "hyperparameters": Figure(
        "Effect of GASIL's hyperparameters (paper, figure 8)",
        "The agent performs poorly when the buffer is too small (500 steps) or too "
        "large (5000 steps), and with too few or too many discriminator updates.",
        _value_panels(),
        favourite=None,
    ),
    "random_search": Figure(
        "Hyperparameters of every agent (paper, table 1)",
        "A search over the appendix's ranges, for every task.",
        searches=_searches(searched, TASKS)
        | {f"point_mass {agent}": searched("point_mass", agent, 1) for agent in PAIR},
    ),
    "normalized_rewards": Figure(
        "Normalized rewards (paper, figures 5 and 7)",
        f"{_DELAYED} {_DENSE}",
        {
            **grid(
                NORMALIZED,
                AGENTS,
                delays=(DELAY,),
                base=searched_normalized,
                seeds=_DELAYED_SEEDS,
            ),
            **grid(NORMALIZED, AGENTS, base=searched_normalized),
        },
        searches=_searches(searched_normalized, NORMALIZED),
    ),
    "constant_bonus": Figure(
        "Delayed rewards and a bonus that knows nothing",
        "The discriminator's reward, learned from good trajectories, acts as a useful "
        "reward shaping that makes learning easier.",
        grid(
            ("hopper", "walker2d"),
            ("ppo", Arm("constant", "ppo+gasil", CONSTANT), "ppo+gasil"),
            delays=(DELAY,),
            base=searched_normalized,
            seeds=20,
        ),
        comparisons=_bonus_comparisons(),
    ),
    "humanoid": Figure(
        "Humanoid over 3M steps (paper, figures 5 and 7)",
        "PPO+GASIL improves PPO and outperforms PPO+BC and PPO+SIL, by a large margin "
        "where the reward is delayed.",
        {
            **grid(
                ("humanoid",),
                (*AGENTS, Arm("ppo+gasil-from-2M", "ppo+gasil", _SCHEDULED)),
                panel="dense",
                **_LONG,
            ),
            **grid(("humanoid",), AGENTS, delays=(DELAY,), panel="delayed", **_LONG),
        },
    ),
    "wider_search": Figure(
        "PPO+GASIL on delayed tasks, searched further",
        _DELAYED,
        grid(
            NORMALIZED,
            (*AGENTS, Arm("wider", "ppo+gasil", base=_wider, seeds=10)),
            delays=(DELAY,),
            base=searched,
            seeds=_DELAYED_SEEDS,
            panel="{env}",
        ),
        favourite="wider",
        searches={name_of(x, DELAY): _wider(x, "ppo+gasil", DELAY) for x in NORMALIZED},
    ),
    "batch_geometry": Figure(
        "Number of environments, and episodes in step",
        "",
        _GEOMETRY,
        favourite=None,
        comparisons=_GEOMETRY_COMPARISONS,
        over=("num_envs", "environments"),
    ),
}

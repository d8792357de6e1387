"""The table of figures: the curves of each, whose runs are requested from the store.

A new figure is one more row of `FIGURES`, and its page is ``notes/NAME.md``. Its panels
are a `grid` of tasks, delays and arms: a name, an agent and what the arm changes.
For example, an ablation with the same settings on all tasks, and many delays:

    grid(TASKS, ("ppo", "ppo+gasil", Arm("no bonus", "ppo+gasil", {"alpha": 0.0})),
         (DELAY,), base=None, changes={"num_envs": 64})
    grid(TASKS, AGENTS, (1, 5, 20, 100, 1000), panel="{env}", curve="{arm}-{delay}")

The second is drawn over the delay with ``over=("reward_delay", "delay")``.
"""

import dataclasses
import functools
import itertools
import types
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from experiments import matrix
from experiments.search import AGENTS, DELAY, NOISE, PAIR, TASKS, Point, Search
from experiments.store import ALGORITHM_VERSION, Run, Store
from gasil_jax import presets
from gasil_jax.config import Config

#: A weighted sum of the interquartile means of curves, by panel and curve.
Terms = tuple[tuple[float, str, str], ...]
#: What is compared: terms by (panel, ours, other), or (panel, ours, other, a panel
#: whose difference is subtracted).
Comparisons = Mapping[tuple[str, ...], Terms]


@dataclasses.dataclass(frozen=True)
class Curve:
    """Seeds of one agent on one task.

    Attributes:
      env: name of the task.
      agent: name of the agent.
      changes: hyperparameters and other fields of `Config` to change.
      reward_delay: the task's reward delay.
      obs_noise: the task's observation noise.
      base: the settings that are changed: a preset's by its name, the defaults of
        `Config` (None), or what a search chose, by a function of task, agent, delay
        and noise that returns the search.
      seeds: number of seeds, from seed 0 on.
      total_steps: environment steps per seed.
    """

    env: str
    agent: str
    changes: Point = dataclasses.field(default_factory=dict)
    reward_delay: int = 1
    obs_noise: float = 0.0
    base: str | Callable[..., Search | matrix.Cell] | None = "tuned"
    seeds: int = 10
    total_steps: int = 1_000_000

    @property
    def search(self) -> Search | matrix.Cell | None:
        """The search whose choice it uses, if any."""
        task = (self.env, self.agent, self.reward_delay, self.obs_noise)
        return self.base(*task) if callable(self.base) else None

    def point(self, searched: Store) -> Point | None:
        """Return what differs from the appendix's or the preset's values.

        It is None if the curve's search is not complete in the store `searched`.
        """
        chosen = self.search.chosen(searched) if self.search else {}
        return None if chosen is None else {**chosen, **self.changes}

    def runs(self, searched: Store) -> tuple[Run, ...]:
        """Return its runs, or none if its search is not complete."""
        if (point := self.point(searched)) is None:
            return ()
        config, version = Config(agent=self.agent), ALGORITHM_VERSION
        if self.search:
            config, version = self.search.config({}), self.search.version
        elif isinstance(self.base, str):
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
    searches: Mapping[str, Search | matrix.Cell] = dataclasses.field(
        default_factory=dict
    )
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

    def rival(self, panel: str, name: str) -> str | None:
        """Return the favourite's curve at the place of another curve, if it has one."""
        place = (self.favourite, self.point_of(panel, name)[1])
        curves = (x for x in self.panels[panel] if self.point_of(panel, x) == place)
        return next((x for x in curves if x != name), None)

    def compared(self) -> Comparisons:
        """Return everything that its page compares: one family of tests."""
        if self.comparisons is not None:
            return self.comparisons
        compared: dict[tuple[str, ...], Terms] = {}
        for panel, curves in self.panels.items():
            pairs = [(self.rival(panel, name), name) for name in curves]
            if self.favourite is None:
                pairs = [*itertools.combinations(curves, 2)]
            for part in ("", " early") if self.early else ("",):
                for ours, other in pairs:
                    if ours is not None:
                        names = f"{ours}{part}", f"{other}{part}"
                        compared[panel, *names] = difference(panel, *names)
        return compared

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
    """A curve of each panel of a grid: its name, its agent and what it changes."""

    name: str
    agent: str
    changes: Point = types.MappingProxyType({})


def grid(
    tasks: Sequence[str],
    arms: Sequence[Arm | str],
    delays: Sequence[int] = (1,),
    *,
    panel: str = "{task}",
    curve: str = "{arm}",
    changes: Point = types.MappingProxyType({}),
    **shared: Any,
) -> Panels:
    """Return the panels of all tasks and delays, with a curve for each arm.

    Args:
      tasks: names of the tasks.
      arms: the arms; an agent's name alone is the agent without changes.
      delays: reward delays of the tasks.
      panel: name of a panel, of {task} with its delay, {env} without, and {delay}.
      curve: name of a curve, of {arm} and {delay}.
      changes: what all arms change.
      **shared: other fields of all curves.
    """
    panels: dict[str, dict[str, Curve]] = {}
    for env, delay, arm in itertools.product(tasks, delays, arms):
        name, agent, own = Arm(arm, arm) if isinstance(arm, str) else arm
        curves = panels.setdefault(
            panel.format(task=name_of(env, delay), env=env, delay=delay), {}
        )
        curves[curve.format(arm=name, delay=delay)] = Curve(
            env, agent, {**changes, **own}, delay, **shared
        )
    return panels


def joined(grids: Iterable[Panels]) -> Panels:
    """Return the panels of several grids; those of the same name are one."""
    panels: dict[str, dict[str, Curve]] = {}
    for name, curves in itertools.chain(*(panels.items() for panels in grids)):
        panels.setdefault(name, {}).update(curves)
    return panels


#: The tasks with normalized rewards: ant and humanoid cost several times as much, and
#: no agent has learned to walk there.
NORMALIZED = TASKS[:4]
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


def _delayed(tasks: Sequence[str], **shared: Any) -> Panels:
    """Return all agents on delayed tasks.

    Where one seed learns to run and another does not, ten tell few agents apart.
    """
    runners = grid(tasks[:3], AGENTS, (DELAY,), seeds=20, **shared)
    return {**runners, **grid(tasks[3:], AGENTS, (DELAY,), **shared)}


_NOISES = (0.0, 0.05, 0.1, 0.5)


def _noisy(noise: float, end: str) -> str:
    """Return the name of a panel with noise."""
    return f"noise-{noise:g}{end}"


def _noise_comparisons() -> Comparisons:
    """Compare the gap at each noise, and its growth with noise."""
    compared: dict[tuple[str, ...], Terms] = {}
    for (_, end), noise in itertools.product(_REWARDS, _NOISES):
        panel, calm = _noisy(noise, end), _noisy(0.0, end)
        gap = difference(panel, "ppo+gasil", "ppo")
        compared[panel, "ppo+gasil", "ppo"] = gap
        if noise:
            less = difference(calm, "ppo", "ppo+gasil")
            compared[panel, "ppo+gasil", "ppo", calm] = (*gap, *less)
    return compared


#: The values of the paper's figure 8.
_VALUES = {
    "buffer_steps": (500, 1000, 2000, 5000, 10000),
    "discriminator_updates": (1, 5, 10, 20),
}
#: A discriminator that its entropy bonus holds at 1/2 everywhere, so that its reward is
#: alpha log 2 in each step. With this weight of the entropy, the difference between
#: good and other trajectories moves a logit by only 4 / 1000.
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
_WIDER = Arm("wider", "ppo+gasil")


def _wider(env: str, agent: str, delay: int, noise: float = 0.0) -> Search:
    """Return a search that continues the first one of a task."""
    free = ("discriminator_updates", "discriminator_learning_rate", "buffer_steps")
    before = searched(env, agent, delay, noise)
    return dataclasses.replace(before, after=before, free=free)


#: Numbers of environments per seed in the figure on batch geometry, and whether they
#: start at random ages, in words.
_NUM_ENVS, _AGES = (1, 8, 32, 128), {True: "drawn", False: "not-drawn"}
_GEOMETRY = [
    Arm(
        f"{agent}-{num_envs}-{_AGES[drawn]}",
        agent,
        {"num_envs": num_envs, "batch_steps": 2048, "stagger_episodes": drawn},
    )
    for agent, drawn, num_envs in itertools.product(PAIR, _AGES, _NUM_ENVS)
]
_ADAPTIVE, _RULES = "ppo+gasil-adaptive", ("agreement", "gap", "fixed")
#: What is stored of ant and humanoid: environments that were reset together.
_IN_STEP = [Arm(f"{agent}, in step", agent) for agent in PAIR]
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
        joined(
            grid(("walker2d",), PAIR, panel=_noisy(x, end), obs_noise=x, base=base)
            for (base, end), x in itertools.product(_REWARDS, _NOISES)
        ),
        comparisons=_noise_comparisons(),
    ),
    "delayed_mujoco": Figure(
        "MuJoCo tasks with delayed rewards (paper, figure 7)",
        _DELAYED,
        _delayed(TASKS, base=searched, panel="{env}"),
    ),
    "hyperparameters": Figure(
        "Effect of GASIL's hyperparameters (paper, figure 8)",
        "The agent performs poorly when the buffer is too small (500 steps) or too "
        "large (5000 steps), and with too few or too many discriminator updates.",
        joined(
            grid(
                ("walker2d",),
                [Arm(f"{value}", "ppo+gasil", {name: value}) for value in values],
                (delay,),
                panel=f"{name_of(name, delay)}{end}",
                base=base,
            )
            for base, end in _REWARDS
            for delay in (1, DELAY)
            for name, values in _VALUES.items()
        ),
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
            **_delayed(NORMALIZED, base=searched_normalized),
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
            (DELAY,),
            base=searched_normalized,
            seeds=20,
        ),
        comparisons=_bonus_comparisons(),
    ),
    "humanoid": Figure(
        "Humanoid over 3M steps (paper, figures 5 and 7)",
        "PPO+GASIL improves PPO and outperforms PPO+BC and PPO+SIL, by a large margin "
        "where the reward is delayed.",
        joined(
            grid(("humanoid",), arms, (delay,), panel=panel, **_LONG)
            for panel, delay, arms in (
                ("dense", 1, AGENTS),
                ("dense", 1, [Arm("ppo+gasil-from-2M", "ppo+gasil", _SCHEDULED)]),
                ("delayed", DELAY, AGENTS),
            )
        ),
    ),
    "wider_search": Figure(
        "PPO+GASIL on delayed tasks, searched further",
        _DELAYED,
        joined(
            [
                _delayed(NORMALIZED, base=searched, panel="{env}"),
                grid(NORMALIZED, [_WIDER], (DELAY,), panel="{env}", base=_wider),
            ]
        ),
        favourite="wider",
        searches={name_of(x, DELAY): _wider(x, "ppo+gasil", DELAY) for x in NORMALIZED},
    ),
    "batch_geometry": Figure(
        "Number of environments, and episodes in step",
        "",
        {
            **grid(("halfcheetah",), _GEOMETRY, (1, DELAY), seeds=20),
            **grid(("swimmer",), _GEOMETRY, (1, DELAY)),
        },
        comparisons={
            (f"{env}{end}", *names): difference(f"{env}{end}", *names)
            for env in ("halfcheetah", "swimmer")
            for end in ("", "-delayed")
            for agent, count in itertools.product(PAIR, _NUM_ENVS)
            for names in [[f"{agent}-{count}-{ages}" for ages in _AGES.values()]]
        },
        favourite=None,
        over=("num_envs", "environments"),
    ),
    "adaptive_imitation": Figure(
        "Delayed rewards with adaptive imitation, beyond the paper",
        "",
        joined(
            [
                grid(TASKS[:4], (*PAIR, _ADAPTIVE), (DELAY,), panel="{env}"),
                grid(TASKS[4:], _IN_STEP, (DELAY,), panel="{env}", base=searched),
                grid(TASKS[4:], (_ADAPTIVE,), (DELAY,), panel="{env}"),
            ]
        ),
        favourite=_ADAPTIVE,
    ),
    "matrix": Figure(
        "All agents on all tasks, tuned alike",
        f"{_DELAYED} {_DENSE}",
        joined(
            grid(
                (env,),
                [Arm(name, cell.agent)],
                (delay,),
                base=functools.partial(
                    matrix.Cell, decompose_rewards=cell.decompose_rewards
                ),
                seeds=matrix.seeds(env, delay),
            )
            for delay, env in itertools.product((DELAY, 1), TASKS)
            for name, cell in matrix.cells(env, delay).items()
        ),
        searches={
            f"{name_of(*task)} {name}": cell
            for task in matrix.CELLS
            for name, cell in matrix.cells(*task).items()
        },
    ),
    "single_setting": Figure(
        "All agents on delayed tasks, each with a single setting",
        "",
        joined(
            [
                grid(TASKS, matrix.AGENTS, (DELAY,), panel="{env}", base=matrix.Single),
                grid(
                    TASKS,
                    [Arm("ppo, decomposed", "ppo")],
                    (DELAY,),
                    panel="{env}",
                    base=functools.partial(matrix.Single, decompose_rewards=True),
                ),
            ]
        ),
        favourite=_ADAPTIVE,
    ),
    "adaptive_ablation": Figure(
        "Adaptive imitation, with each of its parts taken away",
        "",
        grid(
            TASKS[:4],
            [
                Arm("whole", _ADAPTIVE),
                Arm("rewards not decomposed", _ADAPTIVE, {"decompose_rewards": False}),
                Arm("no imitation", _ADAPTIVE, {"imitation_weight": 0.0}),
                *(Arm(f"rule {x}", _ADAPTIVE, {"imitation_rule": x}) for x in _RULES),
                Arm("deviation 1", _ADAPTIVE, {"initial_deviation": 1.0}),
            ],
            (DELAY,),
            panel="{env}",
        ),
        favourite="whole",
    ),
}

"""The table of figures, `FIGURES`: each figure's curves, comparisons and searches.

To add a figure, add a row to `FIGURES`, and {{NAME curves}} and {{NAME forest}} to the
text of a page in ``notes``. Its panels are a `grid` of tasks, delays and arms; an `Arm`
has a name, an agent and changed settings. For example, an ablation with the same
settings on all tasks, and many delays:

    grid(TASKS, ("ppo", "ppo+gasil", Arm("no bonus", "ppo+gasil", {"alpha": 0.0})),
         (DELAY,), base=None, changes={"num_envs": 64})
    grid(TASKS, PAIR, (1, 5, 20, 100, 1000), panel="{env}", curve="{arm}-{delay}")

With ``over=("reward_delay", "delay")`` the second is drawn over the delay.
"""

import functools
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from experiments.curves import (
    Arm,
    Comparisons,
    Figure,
    Panels,
    Terms,
    difference,
    grid,
    joined,
    name_of,
)
from experiments.search import (
    ADAPTIVE,
    CELLS,
    DELAY,
    HUMANOID,
    NEW_TASKS,
    PAIR,
    PAPER_STEPS_OF,
    PAPERS,
    SPARSE,
    SPARSE_BASE,
    SPARSE_GRIDS,
    SPARSE_ROBOTS,
    SPARSE_SEARCHED,
    SPARSE_SPACES,
    SPARSE_STEPS,
    STEPS,
    TASKS,
    PaperSearch,
    Search,
    SecondStage,
    SingleSetting,
    SparseSearch,
    searches,
    solved_from,
)
from gasil_jax import presets

#: The standard deviations of noise on observations (paper, figure 6).
_NOISES = (0.0, 0.05, 0.1, 0.5)


def _noise_comparisons() -> Comparisons:
    """Compare the gap at each noise, and its growth with noise."""
    compared: dict[tuple[str, ...], Terms] = {}
    calm, *noisy = (f"noise {noise:g}" for noise in _NOISES)
    less = difference(calm, "ppo", "ppo+gasil")
    for panel in (calm, *noisy):
        gap = difference(panel, "ppo+gasil", "ppo")
        compared[panel, "ppo+gasil", "ppo"] = gap
        if panel != calm:
            compared[panel, "ppo+gasil", "ppo", calm] = (*gap, *less)
    return compared


#: The values in the paper's figure 8. The middle ones are compared with the too small
#: and too large ones that the paper names.
_VALUES = {
    "buffer_steps": (500, 1000, 2000, 5000, 10000),
    "discriminator_updates": (1, 5, 10, 20),
}
_ENDS = [("1000", "500"), ("1000", "5000"), ("5", "1"), ("5", "20")]
_humanoid = functools.partial(grid, ("humanoid",), total_steps=3_000_000)
_walker2d = functools.partial(grid, ("walker2d",), base=Search)
_EFFECTS = joined(
    _walker2d(
        [Arm(f"{value}", "ppo+gasil", {name: value}) for value in values],
        (delay,),
        panel=name_of(name, delay),
    )
    for delay in (1, DELAY)
    for name, values in _VALUES.items()
)
_SCHEDULED = Arm("ppo+gasil-from-2M", "ppo+gasil", HUMANOID)


def _adaptive(name: str, **changes: Any) -> Arm:
    """Return adaptive imitation with its one setting for all delayed tasks, changed."""
    return Arm(name, ADAPTIVE, {**presets.ADAPTIVE_DELAYED, **changes})


#: Adaptive imitation as a whole, and with one part at a time removed.
_PARTS = [
    _adaptive("whole"),
    _adaptive("rewards not decomposed", decompose_rewards=False),
    _adaptive("no imitation", imitation_weight=0.0),
    *(
        _adaptive(f"rule {rule}", imitation_rule=rule)
        for rule in ("agreement", "gap", "fixed")
    ),
    _adaptive("deviation 1", initial_std=1.0),
]
#: PPO+GASIL with a bonus that doesn't favour long episodes.
_CENTERED = Arm("ppo+gasil (centered)", "ppo+gasil", {"bonus": "centered"})
_SCALED = Arm("ppo (decomposed, scaled)", "ppo")


#: The paper's agents without cloning.
_RIVALS = ("ppo", "ppo+sil", "ppo+gasil")

_on_new_seeds = functools.partial(grid, TASKS, delays=(DELAY,), seeds=20, first_seed=20)


#: The preset `scaled` had these settings when this was trained, and now similar ones.
_SIZE = presets.ACTION_SIZES["humanoid"]
_BY_ROOT = Arm(
    "ppo (decomposed, by the root)",
    "ppo",
    {
        "learning_rate": 1.5e-3 / _SIZE,
        "initial_std": 1 / math.sqrt(_SIZE),
        "gae_lambda": 1 - math.sqrt(_SIZE) / 40,
    },
)
_DENSE = (
    "PPO+GASIL improves PPO on most of the tasks, and outperforms PPO+BC and PPO+SIL "
    "on most of them."
)
_DELAYED = (
    "With the reward given every 20 steps, PPO+GASIL improves PPO, and outperforms "
    "PPO+BC and PPO+SIL, on all tasks by a large margin."
)


def _best_rank(env: str, agent: str, delay: int) -> Search:
    """Return the search of one setting for all tasks with a delay of `DELAY`."""
    return SingleSetting(env, agent, DELAY)


def _seeds(env: str, delay: int) -> int:
    """Return the number of seeds: more where delayed outcomes are bimodal."""
    return 20 if delay > 1 and env in TASKS[:4] else 10


def _matrix(cells: Iterable[tuple[str, int]] = CELLS) -> Panels:
    """Return all agents on tasks, each with what its search on the task chose."""
    return joined(
        grid(
            (env,),
            [Arm(name, search.agent)],
            (delay,),
            base=functools.partial(Search, decompose_rewards=search.decompose_rewards),
            seeds=_seeds(env, delay),
        )
        for env, delay in cells
        for name, search in searches(env, delay).items()
    )


#: The searches whose values are PPO's, and those of decomposed rewards.
_PPOS = functools.partial(Search, chooser="ppo")
_DECOMPOSED = functools.partial(Search, decompose_rewards=True)
_WITH_PPOS, _WITH_GASILS = "{} (PPO's values)", "{} (PPO+GASIL's values)"
#: The paper's agents with the values that PPO's search chose, and PPO with PPO+GASIL's.
_EQUAL = joined(
    grid(TASKS, arms, (delay,), base=base)
    for delay in (1, DELAY)
    for arms, base in (
        (PAIR, Search),
        ([Arm(_WITH_PPOS.format(x), x) for x in PAPERS[1:]], _PPOS),
        (
            [Arm(_WITH_GASILS.format("ppo"), "ppo")],
            functools.partial(Search, chooser="ppo+gasil"),
        ),
    )
)


#: PPO+GASIL, and each other agent that has the same values.
_EQUAL_PAIRS = [
    *(
        (_WITH_PPOS.format("ppo+gasil"), other)
        for other in ("ppo", _WITH_PPOS.format("ppo+bc"), _WITH_PPOS.format("ppo+sil"))
    ),
    ("ppo+gasil", _WITH_GASILS.format("ppo")),
]


#: The tasks on which some seeds learn a delayed task and others do not.
_BIMODAL = ("hopper", "walker2d")
#: Forty seeds are planned on halfcheetah too, and a machine's time ended after these.
_TIME_ENDED = {("halfcheetah-delayed", "ppo"): 22}


def _paper_panel(
    env: str, delay: int, normalize: bool, *, agents: Sequence[str]
) -> Panels:
    """Return agents under the paper's protocol; those that decide have more seeds."""
    bimodal = delay > 1 and env in _BIMODAL
    panel = name_of(env, delay) if normalize else f"{name_of(env, delay)} (raw)"
    return joined(
        grid(
            (env,),
            [agent],
            (delay,),
            panel=panel,
            base=functools.partial(PaperSearch, normalize_rewards=normalize),
            seeds=40
            if bimodal and agent != "ppo+bc"
            else _TIME_ENDED.get((panel, agent), 10),
            total_steps=PAPER_STEPS_OF.get(env, STEPS),
        )
        for agent in agents
    )


#: The panels under the paper's protocol, those first that decide most.
_PROTOCOL = joined(
    _paper_panel(env, delay, normalize, agents=agents)
    for tasks, delay, normalize, agents in (
        (TASKS[:4], DELAY, True, PAPERS),
        (TASKS[:4], DELAY, False, PAIR),
        (TASKS[:4], 1, True, PAPERS),
        (TASKS[4:], DELAY, True, PAPERS),
        (TASKS[4:], 1, True, PAPERS),
        (TASKS, 1, False, PAIR),
        (TASKS[4:], DELAY, False, PAIR),
    )
    for env in tasks
)


_CHOSEN_BY_TWO = Arm("ppo+bonus (chosen by two seeds)", "ppo+bonus")


def _control_panel(env: str, delay: int, normalize: bool) -> Panels:
    """Return PPO+GASIL and its controls on a task under the paper's own protocol."""
    panel = "{task}" if normalize else "{task} (raw)"
    search = functools.partial(PaperSearch, normalize_rewards=normalize)
    one = functools.partial(grid, (env,), delays=(delay,), panel=panel)
    bimodal = env in (*_BIMODAL, "halfcheetah")
    parts = [
        _paper_panel(env, delay, normalize, agents=PAIR),
    ]
    if (env, normalize) == ("hopper", True):
        # Two seeds chose a point that more did not confirm. The final seeds are new.
        parts.append(one([_CHOSEN_BY_TWO], base=search, seeds=40))
        parts.append(one(["ppo+bonus"], base=SecondStage, seeds=20, first_seed=10))
    else:
        parts.append(one(["ppo+bonus"], base=search, seeds=40 if bimodal else 20))
    if bimodal and normalize:
        base = functools.partial(search, bonus="centered")
        parts.append(one([_CENTERED], base=base, seeds=20))
        arms = [Arm(f"{agent} (sees the phase)", agent) for agent in PAIR]
        seen = {"observe_phase": True}
        parts.append(one(arms, base=search, settings=seen, seeds=20))
    return joined(parts)


_PROTOCOL_CONTROLS = joined(
    _control_panel(env, DELAY, normalize)
    for normalize in (True, False)
    for env in TASKS[:5]
)
#: What is compared in each panel of the controls that has both curves.
_CONTROL_PAIRS = [
    ("ppo+gasil", "ppo+bonus"),
    ("ppo+gasil", _CHOSEN_BY_TWO.name),
    (_CHOSEN_BY_TWO.name, "ppo"),
    ("ppo+gasil", _CENTERED.name),
    ("ppo+bonus", "ppo"),
    (_CENTERED.name, "ppo"),
    ("ppo (sees the phase)", "ppo"),
    ("ppo+gasil (sees the phase)", "ppo (sees the phase)"),
]


#: The tasks, delays and bonuses of the study of what delayed MuJoCo measures. A delay
#: of 1000 steps is an episode. A constant bonus and PPO+GASIL's have the same sizes.
_STUDIED, _STUDIED_DELAYS, _BONUSES = TASKS[:5], (1, DELAY, 100, 1000), (0.02, 0.1)
_BONUS_OF, _GASIL_OF = "ppo+bonus ({:g})", "ppo+gasil ({:g})"
#: A network that stays untrained, near 0: each step has the same share of a payout.
_EQUAL_SHARES = Arm("ppo (equal shares)", "ppo", {"decomposition_learning_rate": 1e-12})


def _study(env: str) -> Panels:
    """Return all explanations of a delayed task, with one setting and batch layout."""
    shared, decomposed = (
        # Clipping at 10 deviations would ruin rewards that come once an episode.
        {**presets.scaled(presets.ACTION_SIZES[env], x), "reward_clip": 1e9}
        for x in (False, True)
    )
    arms = [
        Arm("ppo", "ppo"),
        *(Arm(_BONUS_OF.format(x), "ppo+bonus", {"alpha": x}) for x in _BONUSES),
        Arm("ppo+sil", "ppo+sil"),
        *(Arm(_GASIL_OF.format(x), "ppo+gasil", {"alpha": x}) for x in _BONUSES),
        Arm(_CENTERED.name, "ppo+gasil", {"bonus": "centered", "alpha": _BONUSES[1]}),
    ]
    shares = [Arm("ppo (decomposed)", "ppo"), _EQUAL_SHARES]
    # Twenty seeds are planned; ten come first.
    one = functools.partial(grid, (env,), curve="{arm}-{delay}", base=None, seeds=10)
    seeing = {"panel": "{env} (phase seen)", "settings": {"observe_phase": True}}
    return joined(
        one(own, delays, changes=changes, **clock)
        for clock, first in (({"panel": "{env}"}, 0), (seeing, 1))
        for own, changes, delays in (
            (arms, shared, _STUDIED_DELAYS[first:]),
            (shares, decomposed, _STUDIED_DELAYS[1:]),
        )
    )


def _explanations(panels: Panels) -> Comparisons:
    """Compare each explanation with PPO, and PPO+GASIL with a constant bonus."""
    pairs = [
        *((name.format(x), "ppo") for name in (_BONUS_OF, _GASIL_OF) for x in _BONUSES),
        *((_GASIL_OF.format(x), _BONUS_OF.format(x)) for x in _BONUSES),
        (_CENTERED.name, "ppo"),
        ("ppo+sil", "ppo"),
        (_EQUAL_SHARES.name, "ppo"),
        ("ppo (decomposed)", _EQUAL_SHARES.name),
    ]
    named = [
        [f"{x}-{delay}" for x in pair] for delay in _STUDIED_DELAYS for pair in pairs
    ]
    compared: dict[tuple[str, ...], Terms] = {
        (panel, *pair): difference(panel, *pair)
        for panel, curves in panels.items()
        for pair in named
        if curves.keys() >= {*pair}
    }
    for env in _STUDIED:
        for delay in _STUDIED_DELAYS[1:]:
            seen = f"{env} (phase seen)"
            key = (env, f"ppo-{delay} (phase seen)", f"ppo-{delay}")
            compared[key] = (1.0, seen, f"ppo-{delay}"), (-1.0, env, f"ppo-{delay}")
    return compared


_STUDY = joined(map(_study, _STUDIED))


_LIMITED = [f"{agent} (terminal limits)" for agent in PAIR]
_LIMITS = joined(
    grid(
        TASKS[:4],
        [Arm(*x) for x in zip(names, PAIR)],
        (DELAY,),
        base=PaperSearch,
        settings={"terminal_limits": terminal},
    )
    for names, terminal in ((PAIR, False), (_LIMITED, True))
)


_GASIL, _CLONED = {"alpha": 0.1}, {"behavior_cloning_coefficient": 1.0}
_CENTRED = {**_GASIL, "bonus": "centered"}
#: The sparse tasks that are also tried with noise.
_NOISY = [f"{SPARSE[i]}_noisy" for i in (0, 2, 6, 7)]
#: The sparse robots, without and with noise.
_ROBOTS = [*SPARSE_ROBOTS, *(f"{env}_noisy" for env in SPARSE_ROBOTS)]
_SPARSE_SHARED = [
    Arm(_WITH_PPOS.format(x), x) for x in ("ppo+bc", "ppo+sil", "ppo+bc+novelty")
]
#: On the sparse robots: the control of PPO+GASIL, with the entropy that its search
#: chose and bonuses of several sizes, of which that search chose 0.1; and PPO+GASIL
#: without pay for staying.
_SPARSE_VALUES = {**SPARSE_BASE, "entropy_coefficient": 0.01}
_SPARSE_CONTROLS = [
    *(
        Arm(f"ppo+bonus ({alpha:g})", "ppo+bonus", {**_SPARSE_VALUES, "alpha": alpha})
        for alpha in (0.02, 0.1, 0.3)
    ),
    Arm("ppo+gasil (centered)", "ppo+gasil", {**_SPARSE_VALUES, **_CENTRED}),
]
#: What imitation, a bonus without it, and novelty change on the sparse tasks.
_SPARSE_PAIRS = [
    *((x, "ppo") for x in ("ppo+bc", "ppo+sil", "ppo+gasil", "ppo+gasil (centered)")),
    *((arm.name, "ppo") for arm in _SPARSE_SHARED[:2]),
    *(("ppo+gasil", arm.name) for arm in _SPARSE_CONTROLS[:3]),
    ("ppo+novelty", "ppo"),
    ("ppo+bc+novelty", "ppo+novelty"),
    ("ppo+bc+novelty (PPO+NOVELTY's values)", "ppo+novelty"),
]
#: It differs from `ppo+novelty` in cloning alone.
_CLONING_NOVELTY = Arm("ppo+bc+novelty (PPO+NOVELTY's values)", "ppo+bc+novelty")


def _sparse_panels(
    tasks: Sequence[str], shared: Sequence[str], total_steps: int
) -> list[Panels]:
    """Return all agents on tasks, also with values that others' searches chose."""
    with_ppos, with_noveltys = (
        functools.partial(SparseSearch, chooser=x) for x in ("ppo", "ppo+novelty")
    )
    return [
        grid(own, arms, base=base, seeds=20, total_steps=total_steps)
        for own, arms, base in (
            (tasks, [*SPARSE_SPACES], SparseSearch),
            (shared, _SPARSE_SHARED, with_ppos),
            (tasks, [_CLONING_NOVELTY], with_noveltys),
        )
    ]


#: The sparse tasks of the ablation.
_CAUSE_TASKS = [SPARSE[i] for i in (0, 2, 6)]
_LARGE = {"buffer_steps": 10_000}
_CAUSES = [
    Arm("ppo", "ppo"),
    Arm("gasil, as the paper", "ppo+gasil", _GASIL),
    Arm("gasil, logit", "ppo+gasil", {**_GASIL, "bonus": "logit"}),
    Arm("gasil, centered", "ppo+gasil", _CENTRED),
    Arm("gasil, centered, 10,000 steps", "ppo+gasil", {**_CENTRED, **_LARGE}),
    Arm("cloning", "ppo+bc", _CLONED),
    Arm("cloning, 10,000 steps", "ppo+bc", {**_CLONED, **_LARGE}),
    Arm("cloning, one episode", "ppo+bc", {**_CLONED, "buffer_episodes": 1}),
    Arm("novel ties", "ppo+bc+novelty", {**_CLONED, "novelty_coefficient": 0.0}),
    Arm("novelty", "ppo+novelty"),
    Arm("novelty, cloning", "ppo+bc+novelty", _CLONED),
]
#: Each arm of the causes with that from which it differs in one thing.
_CHANGES = [
    ("gasil, as the paper", "ppo"),
    ("gasil, logit", "gasil, as the paper"),
    ("gasil, centered", "gasil, as the paper"),
    ("gasil, centered, 10,000 steps", "gasil, centered"),
    ("cloning", "gasil, centered"),
    ("cloning", "ppo"),
    ("novel ties", "cloning"),
    *((f"cloning, {x}", "cloning") for x in ("10,000 steps", "one episode")),
    ("novelty", "ppo"),
    ("novelty, cloning", "novelty"),
]
_SEAS = ("sparse:deep_sea_10", "sparse:deep_sea_20")
#: Deep sea with rewards as they are, beside normalized ones. The last has the weight of
#: novelty that `ppo+novelty` has.
_RAW = {"normalize_rewards": False}
_DEEP_SEA: list[Arm | str] = [
    *SPARSE_SPACES,
    *(Arm(f"{agent} (raw)", agent, _RAW) for agent in SPARSE_SPACES),
    Arm(
        "ppo+bc+novelty (raw, more novelty)",
        "ppo+bc+novelty",
        {**_RAW, "novelty_coefficient": 1.0},
    ),
]


#: One agent with one rule for all tasks, the agent without each of its parts, and PPO
#: and PPO+NOVELTY with the same rule.
_ONE = "ppo+gasil+novelty"
_ONE_DELAYED = [
    Arm(_ONE, _ONE),
    Arm("without imitation", _ONE, {"alpha": 0.0}),
    Arm("without novelty", _ONE, {"novelty_coefficient": 0.0}),
    Arm("without decomposition", _ONE, {"decompose_rewards": False}),
    Arm("ppo", "ppo"),
    Arm("ppo+novelty", "ppo+novelty"),
]
_ONE_ARMS = [x for x in _ONE_DELAYED if x.name != "without decomposition"]
#: Beside them, of other figures: agents with what a search chose on the task or, where
#: rewards are sparse, on all sparse tasks.
_TUNED = [Arm(f"{agent} (tuned)", agent) for agent in PAIR]
_GYMNAX = [
    f"gymnax:{name}"
    for name in (
        *("CartPole-v1", "Acrobot-v1", "MountainCar-v0", "Catch-bsuite"),
        *(f"{x}-MinAtar" for x in ("Breakout", "Asterix", "SpaceInvaders", "Freeway")),
    )
]
_DOOR_KEYS = [f"navix:Navix-DoorKey-{size}-v0" for size in ("5x5", "6x6", "8x8")]
#: No search and no other figure has these seeds.
_on_own_seeds = functools.partial(grid, seeds=20, first_seed=100)


def _one_agent(
    tasks: Iterable[str], delays: Iterable[int] = (1,), total_steps: int = STEPS
) -> Panels:
    """Return the one agent and what it is compared with, all with its rule."""
    # Other tasks than robots have two dimensions, fewer, or discrete actions.
    sizes = presets.ACTION_SIZES
    robots = {env: env.removeprefix("sparse:").removesuffix("_noisy") for env in tasks}
    return joined(
        _on_own_seeds(
            (env,),
            _ONE_DELAYED if delay > 1 else _ONE_ARMS,
            (delay,),
            base=None,
            changes=presets.scaled_with_entropy(sizes.get(robot, 2), delay > 1),
            total_steps=total_steps,
        )
        for env, robot in robots.items()
        for delay in delays
    )


FIGURES: Mapping[str, Figure] = {
    "point_mass": Figure(
        "2D point mass (paper, figures 2 to 4)",
        "PPO learns a sub-optimal policy quickly; PPO+GASIL learns a little more "
        "slowly at first and ends with a better policy.",
        grid(("point_mass",), PAIR, base=Search, seeds=40, total_steps=500_000),
        searches={f"point_mass {agent}": Search("point_mass", agent) for agent in PAIR},
        early=30_000,
    ),
    "matrix": Figure(
        "All agents on all tasks (paper, figures 5 and 7, table 1)",
        f"{_DELAYED} {_DENSE}",
        _matrix(),
        shown=(*PAPERS, "ppo+bonus"),
        searches={
            f"{name_of(*task)} {name}": search
            for task in CELLS
            for name, search in searches(*task).items()
        },
    ),
    "paper_protocol": Figure(
        "The paper's own protocol (paper, figures 5 and 7)",
        f"{_DELAYED} {_DENSE}",
        _PROTOCOL,
        floor=True,
        searches={
            f"{panel} {name}": curve.search
            for panel, curves in _PROTOCOL.items()
            for name, curve in curves.items()
            if curve.search
        },
    ),
    "front": Figure(
        "The paper's own protocol, beside a bonus without imitation",
        _DELAYED,
        {
            f"{env}-delayed": {
                **_PROTOCOL[f"{env}-delayed"],
                "ppo+bonus": _PROTOCOL_CONTROLS[f"{env}-delayed"]["ppo+bonus"],
            }
            for env in _BIMODAL
        },
        floor=True,
    ),
    "paper_controls": Figure(
        "The paper's own protocol: PPO+GASIL beside its controls",
        "",
        _PROTOCOL_CONTROLS,
        floor=True,
        pairs=_CONTROL_PAIRS,
        shown=("ppo", "ppo+gasil", "ppo+bonus", _CENTERED.name, "ppo (sees the phase)"),
        searches={
            f"{panel} {name}": curve.search
            for panel, curves in _PROTOCOL_CONTROLS.items()
            for name, curve in curves.items()
            if curve.search and name in ("ppo+bonus", _CENTERED.name)
        },
    ),
    "delayed_mujoco": Figure(
        "What delayed MuJoCo measures",
        "",
        _STUDY,
        over=("reward_delay", "delay"),
        favourite=_GASIL_OF.format(0.1),
        comparisons=_explanations(_STUDY),
        shown=(
            *("ppo", _BONUS_OF.format(0.1), _GASIL_OF.format(0.1)),
            *("ppo (decomposed)", _EQUAL_SHARES.name),
        ),
        floor=True,
    ),
    "time_limits": Figure(
        "The paper's own protocol with terminal time limits",
        "",
        _LIMITS,
        pairs=[*zip(_LIMITED, PAIR), (_LIMITED[1], _LIMITED[0])],
    ),
    "delayed_rewards": Figure(
        "Delayed rewards: PPO on decomposed rewards beside all others",
        "",
        joined(
            [
                _matrix(x for x in CELLS if x[1] > 1),
                *(
                    grid(
                        (x,), [_SCALED], (DELAY,), base="scaled", seeds=_seeds(x, DELAY)
                    )
                    for x in TASKS
                ),
            ]
        ),
        favourite="ppo (decomposed)",
        shown=("ppo", "ppo+sil", "ppo+gasil", "ppo (decomposed)", _SCALED.name),
    ),
    "scaled_test": Figure(
        "Delayed rewards: the preset scaled on new seeds and on new tasks",
        "",
        joined(
            [
                _on_new_seeds([_SCALED], base="scaled"),
                _on_new_seeds(_RIVALS, base=Search),
                grid(NEW_TASKS, [_SCALED], (DELAY, 100), base="scaled"),
                grid(NEW_TASKS, _RIVALS, (DELAY, 100), base=_best_rank),
            ]
        ),
        favourite=_SCALED.name,
    ),
    "ppo_values": Figure(
        "The paper's agents with equal settings",
        "",
        _EQUAL,
        pairs=_EQUAL_PAIRS,
    ),
    "stochastic_walker2d": Figure(
        "Walker2d with noisy observations (paper, figure 6)",
        "The gap between PPO and PPO+GASIL is larger when Gaussian noise, of standard "
        "deviation 0.05, 0.1 and 0.5, is added to the observations.",
        joined(
            _walker2d(PAIR, panel=f"noise {x:g}", settings={"obs_noise": x})
            for x in _NOISES
        ),
        comparisons=_noise_comparisons(),
    ),
    "hyperparameters": Figure(
        "Effect of GASIL's hyperparameters (paper, figure 8)",
        "The agent performs poorly when the buffer is too small (500 steps) or too "
        "large (5000 steps), and with too few or too many discriminator updates.",
        _EFFECTS,
        pairs=_ENDS,
    ),
    "humanoid": Figure(
        "Humanoid over 3M steps (paper, figures 5 and 7)",
        "PPO+GASIL improves PPO and outperforms PPO+BC and PPO+SIL, by a large margin "
        "where the reward is delayed.",
        joined(
            [
                _humanoid([*PAIR, _SCHEDULED], base=Search),
                _humanoid(
                    [*PAPERS, _SCHEDULED], base=_PPOS, panel=_WITH_PPOS.format("{task}")
                ),
                _humanoid([Arm("ppo (decomposed)", "ppo")], (DELAY,), base=_DECOMPOSED),
                _humanoid([_BY_ROOT], (DELAY,), base="scaled"),
            ]
        ),
        pairs=[
            *(("ppo+gasil", x) for x in (*PAPERS[:-1], _SCHEDULED.name)),
            *((_SCHEDULED.name, x) for x in PAPERS[:-1]),
        ],
        shown=(*PAPERS, _SCHEDULED.name),
    ),
    "adaptive_ablation": Figure(
        "Adaptive imitation, with each of its parts taken away",
        "",
        joined(
            grid(tasks, arms, (DELAY,), base=None)
            for tasks, arms in (
                (TASKS[:4], _PARTS),
                (("ant",), [_PARTS[i] for i in (0, 2, 6)]),
                (("humanoid",), _PARTS[:1]),
            )
        ),
        favourite="whole",
    ),
    "sparse": Figure(
        "Sparse rewards: imitation, and exploration",
        "",
        joined(
            [
                *_sparse_panels((*SPARSE, *_NOISY), SPARSE, SPARSE_STEPS),
                *_sparse_panels(_ROBOTS, SPARSE_ROBOTS, STEPS),
                grid(_ROBOTS, _SPARSE_CONTROLS, base=None, seeds=20),
                *_sparse_panels(SPARSE_GRIDS, SPARSE_GRIDS, STEPS),
                grid(
                    SPARSE_GRIDS,
                    [*SPARSE_SPACES],
                    panel="{env}_noisy",
                    settings={"action_noise": 0.1},
                    base=SparseSearch,
                    seeds=20,
                    total_steps=STEPS,
                ),
            ]
        ),
        searches={
            f"{env} {agent}": SparseSearch(env, agent)
            for env in SPARSE_SEARCHED
            for agent in SPARSE_SPACES
        },
        favourite="ppo+novelty",
        pairs=_SPARSE_PAIRS,
        shown=("ppo", "ppo+bc", "ppo+gasil", "ppo+novelty", "ppo+bonus (0.02)"),
        solved_from=solved_from,
    ),
    "sparse_causes": Figure(
        "Sparse rewards: why imitation with a discriminator fails",
        "",
        grid(
            _CAUSE_TASKS,
            _CAUSES,
            base=None,
            changes=_SPARSE_VALUES,
            seeds=20,
            total_steps=SPARSE_STEPS,
        ),
        pairs=_CHANGES,
        # Absorbing ends, newer ties and admission, of cloning too, the oldest ties, and
        # cloning by the gap.
        dropped_pairs=7,
        solved_from=solved_from,
    ),
    "deep_sea": Figure(
        "Deep sea: rewards normalized, and as they are",
        "",
        grid(
            _SEAS,
            _DEEP_SEA,
            base=SparseSearch,
            seeds=20,
            total_steps=SPARSE_STEPS,
        ),
        pairs=[(f"{x} (raw)", x) for x in SPARSE_SPACES],
        solved_from=solved_from,
    ),
    "one_agent": Figure(
        "One agent with one rule for all tasks: dense and delayed rewards",
        "",
        joined(
            [
                _one_agent(TASKS, (1, DELAY, 100)),
                _one_agent(["point_mass", *_GYMNAX]),
                *(
                    grid(
                        (env,), _TUNED, (delay,), base=Search, seeds=_seeds(env, delay)
                    )
                    for env, delay in CELLS
                ),
                _on_own_seeds(_GYMNAX, [Arm("ppo (gymnax)", "ppo")], base="gymnax"),
            ]
        ),
        favourite=_ONE,
        shown=[arm.name for arm in _ONE_DELAYED],
    ),
    "one_agent_sparse": Figure(
        "One agent with one rule for all tasks: sparse rewards",
        "",
        joined(
            [
                _one_agent([*SPARSE, *_NOISY], total_steps=SPARSE_STEPS),
                _one_agent([*_ROBOTS, *_DOOR_KEYS]),
                *(
                    grid(own, _TUNED, base=SparseSearch, seeds=20, total_steps=steps)
                    for own, steps in (
                        ([*SPARSE, *_NOISY], SPARSE_STEPS),
                        ([*_ROBOTS, *SPARSE_GRIDS], STEPS),
                    )
                ),
            ]
        ),
        favourite=_ONE,
        shown=[arm.name for arm in _ONE_DELAYED],
        solved_from=solved_from,
    ),
}

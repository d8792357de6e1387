"""Tables of hyperparameters that runs start from, by environment, agent and delay.

A row overrides the defaults of `Config` and `Hyperparameters`; a flag overrides a row.

"tuned" holds only what was measured. For the locomotion tasks this is what the search
chose, with the number of environments that it ran with. Four tasks have normalized
rewards (experiments/results/normalized_rewards.md); ant and humanoid have plain ones
(random_search.md). Alpha was tuned in the unit of these rewards, so a flag that changes
the unit needs another alpha.

"paper" holds the paper's batch, one environment x 2,048 steps, and what its appendix
gives for a task. The rest are the defaults, which are the appendix's too. A single
environment is slow, because only the seeds share the cost of a step.
"""

import types
from collections.abc import Mapping
from typing import Any, NamedTuple

from gasil_jax.config import Config
from gasil_jax.errors import unknown
from gasil_jax.imitation import find_agent

Overrides = Mapping[str, Any]
#: (environment, agent) -> overrides.
Rows = Mapping[tuple[str, str], Overrides]


class _Chosen(NamedTuple):
    """The hyperparameters that the search chose for the agents of a task."""

    behavior_cloning_coefficient: float
    sil_coefficient: float
    alpha: float
    discriminator_updates: int
    discriminator_learning_rate: float
    buffer_steps: int
    #: Agents with the learning rate 1e-4; the others have 3e-4.
    slower: tuple[str, ...] = ()


# The chosen hyperparameters that each agent uses.
_NAMES: Mapping[str, tuple[str, ...]] = {
    "ppo": (),
    "ppo+bc": ("behavior_cloning_coefficient",),
    "ppo+sil": ("sil_coefficient",),
    "ppo+gasil": (
        "alpha",
        "discriminator_updates",
        "discriminator_learning_rate",
        "buffer_steps",
    ),
}


def _rows(tasks: Mapping[str, _Chosen], shared: Overrides) -> Rows:
    """Return the rows of every agent on every task, with the shared overrides."""
    rows: dict[tuple[str, str], Overrides] = {}
    for env, chosen in tasks.items():
        for agent, names in _NAMES.items():
            row = {name: getattr(chosen, name) for name in names} | dict(shared)
            if agent in chosen.slower:
                row["learning_rate"] = 1e-4
            rows[env, agent] = row
    return rows


_NORMALIZED = {"normalize_rewards": True, "num_envs": 32}
_DENSE = {
    "hopper": _Chosen(0.1, 0.01, 0.1, 10, 1e-4, 10_000),
    "walker2d": _Chosen(0.1, 1.0, 0.02, 5, 2e-5, 10_000),
    "halfcheetah": _Chosen(0.01, 0.1, 0.02, 5, 2e-5, 10_000),
    "swimmer": _Chosen(1.0, 1.0, 0.02, 5, 2e-5, 10_000),
}
_DELAYED = {
    "hopper": _Chosen(1.0, 1.0, 0.2, 20, 1e-5, 1_000),
    "walker2d": _Chosen(1.0, 0.1, 1.0, 1, 3e-4, 1_000, slower=("ppo",)),
    "halfcheetah": _Chosen(0.3, 0.3, 0.02, 5, 2e-5, 10_000),
    "swimmer": _Chosen(1.0, 0.3, 0.02, 1, 1e-5, 10_000, slower=("ppo+gasil",)),
}
_PLAIN = {"num_envs": 64}
_DENSE_PLAIN = {
    "ant": _Chosen(0.01, 0.01, 1.0, 10, 1e-5, 10_000),
    "humanoid": _Chosen(0.01, 0.01, 0.1, 1, 2e-5, 1_000),
}
_DELAYED_PLAIN = {
    "ant": _Chosen(0.01, 1.0, 0.1, 10, 1e-4, 10_000),
    "humanoid": _Chosen(0.1, 0.01, 0.1, 1, 2e-5, 1_000),
}

# One setting for every locomotion task, chosen on two seeds a task with rewards delayed
# by 20 steps (docs/algorithm.md).
_ADAPTIVE = {
    "normalize_rewards": True,
    "num_envs": 32,
    "gamma": 0.995,
    "initial_deviation": 0.4,
    "imitation_weight": 0.7,
    "discriminator_updates": 20,
    "discriminator_learning_rate": 1e-4,
    "buffer_steps": 10_000,
}
_ADAPTIVE_DELAYED = {**_ADAPTIVE, "decompose_rewards": True}


def _adaptive(overrides: Overrides) -> Rows:
    tasks = (*_DENSE, *_DENSE_PLAIN)
    return {(env, "ppo+gasil-adaptive"): overrides for env in tasks}


_STRONG_DISCRIMINATOR = {
    "alpha": 1.0,
    "discriminator_updates": 20,
    "discriminator_learning_rate": 3e-4,
}
# Measured on the locomotion tasks with delayed rewards, 4 to 8 seeds each; those runs
# are not kept.
_STRONG = {
    ("point_mass", "gasil"): _STRONG_DISCRIMINATOR,
    ("point_mass", "ppo+gasil"): _STRONG_DISCRIMINATOR,
    ("point_mass", "gail"): _STRONG_DISCRIMINATOR,
    ("hopper", "gasil"): _STRONG_DISCRIMINATOR,
    ("walker2d", "gasil"): _STRONG_DISCRIMINATOR,
    ("halfcheetah", "gasil"): _STRONG_DISCRIMINATOR,
    ("swimmer", "gasil"): _STRONG_DISCRIMINATOR,
}


class Preset(NamedTuple):
    """The overrides of a preset, by environment and agent.

    Attributes:
      dense: rows for rewards that are given at every step.
      delayed: rows for delayed rewards.
      every: overrides for all tasks and agents; a row takes precedence.
    """

    dense: Rows
    delayed: Rows
    every: Overrides = types.MappingProxyType({})


PRESETS: Mapping[str, Preset] = {
    "tuned": Preset(
        {
            **_STRONG,
            **_rows(_DENSE, _NORMALIZED),
            **_rows(_DENSE_PLAIN, _PLAIN),
            **_adaptive(_ADAPTIVE),
        },
        {
            **_STRONG,
            **_rows(_DELAYED, _NORMALIZED),
            **_rows(_DELAYED_PLAIN, _PLAIN),
            **_adaptive(_ADAPTIVE_DELAYED),
        },
    ),
    "paper": Preset(
        {
            # Alpha is 0 for 2M steps and then raised to 0.02 until 3M.
            ("humanoid", "ppo+gasil"): {
                "alpha": 0.02,
                "alpha_schedule": ((2e6, 0.0), (3e6, 1.0)),
            },
        },
        {},
        # The paper's horizon is 2,048 steps of one environment.
        every={"num_envs": 1},
    ),
}


def names() -> tuple[str, ...]:
    """Return the names of the presets."""
    return tuple(PRESETS)


def preset(env: str, agent: str, name: str = "tuned", reward_delay: int = 1) -> Config:
    """Return the config that runs of `agent` in `env` start from.

    Args:
      env: name of the environment. One without a row gets the defaults and the
        preset's overrides for all tasks.
      agent: name of the agent, or MODULE:NAME of one of your own.
      name: name of the preset, one of `names()`.
      reward_delay: the environment's reward delay, in steps.

    Raises:
      ValueError: if the agent or the preset is unknown.
    """
    if name not in PRESETS:
        raise ValueError(unknown("preset", name, names()))
    find_agent(agent)
    chosen = PRESETS[name]
    rows = chosen.delayed if reward_delay > 1 else chosen.dense
    return Config(agent=agent).replace(**{**chosen.every, **rows.get((env, agent), {})})

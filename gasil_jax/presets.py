"""Where a run's hyperparameters start from: a table, by environment, agent and delay.

A row overrides `Config`'s and `Hyperparameters`' defaults; a flag overrides a row.
"tuned" has only what was measured: of the locomotion tasks what the search chose, with
the environments that it ran with. Four have normalized rewards
(experiments/results/normalized_rewards.md), ant and humanoid rewards as they are
(random_search.md): an alpha is of the unit that it was tuned in, so that another is
wanted where a flag changes that. "paper" has the paper's batch, one environment x 2,048
steps, what the appendix names for a task, and the defaults, which are the appendix's,
for the rest. One environment is slow: the cost of a step is shared by the seeds alone.
"""

import types
from collections.abc import Mapping
from typing import Any, NamedTuple

from gasil_jax.config import Config
from gasil_jax.errors import unknown
from gasil_jax.imitation import agents

Overrides = Mapping[str, Any]
#: (environment, agent) -> overrides.
Rows = Mapping[tuple[str, str], Overrides]


class _Found(NamedTuple):
    """What the search chose for the agents of a task."""

    behavior_cloning_coefficient: float
    sil_coefficient: float
    alpha: float
    discriminator_updates: int
    discriminator_learning_rate: float
    buffer_steps: int
    #: Agents whose learning rate is 1e-4; the others' is 3e-4.
    slower: tuple[str, ...] = ()


# What each agent has of it.
_NAMES: Mapping[str, tuple[str, ...]] = {
    "ppo": (),
    "ppo+bc": ("behavior_cloning_coefficient",),
    "ppo+sil": ("sil_coefficient",),
    "ppo+gasil": (
        *("alpha", "discriminator_updates"),
        *("discriminator_learning_rate", "buffer_steps"),
    ),
}


def _rows(found: Mapping[str, _Found], shared: Overrides) -> Rows:
    """Rows of every agent on every task, with what all of them share."""
    rows: dict[tuple[str, str], Overrides] = {}
    for env, chosen in found.items():
        for agent, names in _NAMES.items():
            row = {name: getattr(chosen, name) for name in names} | dict(shared)
            if agent in chosen.slower:
                row["learning_rate"] = 1e-4
            rows[env, agent] = row
    return rows


_NORMALIZED = {"normalize_rewards": True, "num_envs": 32}
_DENSE = {
    "hopper": _Found(0.1, 0.01, 0.1, 10, 1e-4, 10_000),
    "walker2d": _Found(0.1, 1.0, 0.02, 5, 2e-5, 10_000),
    "halfcheetah": _Found(0.01, 0.1, 0.02, 5, 2e-5, 10_000),
    "swimmer": _Found(1.0, 1.0, 0.02, 5, 2e-5, 10_000),
}
_DELAYED = {
    "hopper": _Found(1.0, 1.0, 0.2, 20, 1e-5, 1_000),
    "walker2d": _Found(1.0, 0.1, 1.0, 1, 3e-4, 1_000, slower=("ppo",)),
    "halfcheetah": _Found(0.3, 0.3, 0.02, 5, 2e-5, 10_000),
    "swimmer": _Found(1.0, 0.3, 0.02, 1, 1e-5, 10_000, slower=("ppo+gasil",)),
}
_AS_THEY_ARE = {"num_envs": 64}
_DENSE_AS_THEY_ARE = {
    "ant": _Found(0.01, 0.01, 1.0, 10, 1e-5, 10_000),
    "humanoid": _Found(0.01, 0.01, 0.1, 1, 2e-5, 1_000),
}
_DELAYED_AS_THEY_ARE = {
    "ant": _Found(0.01, 1.0, 0.1, 10, 1e-4, 10_000),
    "humanoid": _Found(0.1, 0.01, 0.1, 1, 2e-5, 1_000),
}

_STRONG_DISCRIMINATOR = {
    "alpha": 1.0,
    "discriminator_updates": 20,
    "discriminator_learning_rate": 3e-4,
}
# On the locomotion tasks of delayed rewards, 4 to 8 seeds each, which are not kept.
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
    """Overrides by environment and agent, and those of every one.

    Attributes:
      dense: rows for rewards that are given at every step.
      delayed: rows for delayed rewards.
      every: what all tasks and agents have; a row overrides it.
    """

    dense: Rows
    delayed: Rows
    every: Overrides = types.MappingProxyType({})


PRESETS: Mapping[str, Preset] = {
    "tuned": Preset(
        {
            **_STRONG,
            **_rows(_DENSE, _NORMALIZED),
            **_rows(_DENSE_AS_THEY_ARE, _AS_THEY_ARE),
        },
        {
            **_STRONG,
            **_rows(_DELAYED, _NORMALIZED),
            **_rows(_DELAYED_AS_THEY_ARE, _AS_THEY_ARE),
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
    """The presets' names."""
    return tuple(PRESETS)


def preset(env: str, agent: str, name: str = "tuned", reward_delay: int = 1) -> Config:
    """The configuration that runs of `agent` in `env` start from.

    Args:
      env: environment's name; of one that has no row it is the defaults and what the
        preset gives to every task.
      agent: agent's name.
      name: one of `names()`.
      reward_delay: of the environment.

    Raises:
      ValueError: an agent or preset that is unknown.
    """
    if name not in PRESETS:
        raise ValueError(unknown("preset", name, names()))
    if agent not in agents():
        raise ValueError(unknown("agent", agent, agents()))
    chosen = PRESETS[name]
    rows = chosen.delayed if reward_delay > 1 else chosen.dense
    return Config(agent=agent).replace(**{**chosen.every, **rows.get((env, agent), {})})

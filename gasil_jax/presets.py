"""Where a run's hyperparameters start from: one table, by environment and agent.

A row overrides `Config`'s and `Hyperparameters`' defaults; a flag overrides a row.
"tuned" has only what was measured; "paper" has what the appendix names for a task, with
the defaults, which are the appendix's, for the rest.
"""

from collections.abc import Mapping
from typing import Any

from gasil_jax.config import Config

Overrides = Mapping[str, Any]

_STRONG_DISCRIMINATOR = {
    "alpha": 1.0,
    "discriminator_updates": 20,
    "discriminator_learning_rate": 3e-4,
}

#: name -> (environment, agent) -> overrides.
PRESETS: Mapping[str, Mapping[tuple[str, str], Overrides]] = {
    # Locomotion: with the reward delayed by 20 steps, 1M steps, 4 to 10 seeds a point
    # (experiments/results/delayed_agents.csv). What is not here was no better
    # than the defaults, or not tried.
    "tuned": {
        ("point_mass", "gasil"): _STRONG_DISCRIMINATOR,
        ("point_mass", "ppo+gasil"): _STRONG_DISCRIMINATOR,
        ("point_mass", "gail"): _STRONG_DISCRIMINATOR,
        ("hopper", "gasil"): _STRONG_DISCRIMINATOR,
        ("hopper", "ppo+gasil"): {"alpha": 1.0},
        ("hopper", "ppo+bc"): {"behavior_cloning_coefficient": 0.3},
        ("walker2d", "gasil"): _STRONG_DISCRIMINATOR,
        ("walker2d", "ppo+gasil"): {"alpha": 1.0},
        ("halfcheetah", "gasil"): _STRONG_DISCRIMINATOR,
        ("halfcheetah", "ppo+bc"): {"behavior_cloning_coefficient": 0.01},
        ("swimmer", "gasil"): _STRONG_DISCRIMINATOR,
    },
    "paper": {
        # Alpha is 0 for 2M steps and then raised to 0.02 until 3M.
        ("humanoid", "ppo+gasil"): {
            "alpha": 0.02,
            "alpha_schedule": ((2e6, 0.0), (3e6, 1.0)),
        },
    },
}


def names() -> tuple[str, ...]:
    """The presets' names."""
    return tuple(PRESETS)


def preset(env: str, agent: str, name: str = "tuned") -> Config:
    """The configuration that runs of `agent` in `env` start from.

    Args:
      env: environment's name.
      agent: agent's name.
      name: one of `names()`.
    """
    overrides = PRESETS[name].get((env, agent), {})
    return Config(agent=agent).updated(overrides)

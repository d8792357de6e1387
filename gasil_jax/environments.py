"""Environments by name: the one place where the library knows ``gasil_envs``."""

from typing import Any

import gasil_envs


def make_env(
    name: str, *, reward_delay: int = 1, obs_noise: float = 0.0, solver: str = "small"
) -> Any:
    """Build an environment; see `gasil_envs.make` for arguments and errors."""
    return gasil_envs.make(
        name, reward_delay=reward_delay, obs_noise=obs_noise, solver=solver
    )

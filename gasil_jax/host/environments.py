"""What the host needs of ``gasil_envs``: to make environments, and what they are."""

import contextlib
from typing import Any

import gasil_envs
from gasil_envs import registry, worlds
from gasil_envs.physics.host_threads import available_cores
from gasil_envs.registry import Settings, check, made_with, prepare, without_effect
from gasil_envs.registry import make as make_env
from gasil_envs.worlds import FAMILIES
from gasil_envs.wrappers import is_discrete

__all__ = [
    "FAMILIES",
    "Settings",
    "available_cores",
    "can_be_drawn",
    "check",
    "ends_early",
    "is_discrete",
    "is_locomotion",
    "made_with",
    "make_env",
    "names",
    "prepare",
    "without_effect",
]


def names() -> list[str]:
    """Return the names of all environments, also of other packages, if installed."""
    every = list(registry.names())
    for family in FAMILIES:
        with contextlib.suppress(ValueError):
            every += worlds.names(family)
    return every


def can_be_drawn(env: Any) -> bool:
    """Return whether `render` can draw an environment."""
    return gasil_envs.pictures.can_draw(env)


def ends_early(env: Any) -> bool:
    """Return whether an episode may end before its step limit; true if unknown."""
    return getattr(env.unwrapped, "ends_early", True)


def is_locomotion(env: Any) -> bool:
    """Return whether an environment, wrapped or not, is one of the MuJoCo tasks."""
    return isinstance(env.unwrapped, gasil_envs.Locomotion)

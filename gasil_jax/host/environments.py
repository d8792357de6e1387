"""Make environments by name; the registry of ``gasil_envs`` is used only here."""

from typing import Any

from gasil_envs import pictures
from gasil_envs.locomotion import Locomotion
from gasil_envs.physics.native import available_cores
from gasil_envs.registry import (
    Settings,
    check,
    made_with,
    make,
    prepare,
    without_effect,
)
from gasil_envs.wrappers import is_discrete

make_env = make

__all__ = [
    "Settings",
    "available_cores",
    "can_be_drawn",
    "check",
    "ends_early",
    "is_discrete",
    "is_locomotion",
    "made_with",
    "make_env",
    "prepare",
    "without_effect",
]


def ends_early(env: Any) -> bool:
    """Return whether an episode may end before its step limit; true if unknown."""
    return getattr(env.unwrapped, "ends_early", True)


def is_locomotion(env: Any) -> bool:
    """Return whether an environment, wrapped or not, is one of the MuJoCo tasks."""
    return isinstance(env.unwrapped, Locomotion)


def can_be_drawn(env: Any) -> bool:
    """Return whether there are pictures of an environment, wrapped or not."""
    return pictures.can_draw(env)

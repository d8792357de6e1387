"""Make environments by name; the registry of ``gasil_envs`` is used only here."""

from typing import Any

from gasil_envs.locomotion import Locomotion
from gasil_envs.physics.native import available_cores
from gasil_envs.point_mass import PointMass
from gasil_envs.registry import (
    Settings,
    check,
    made_with,
    make,
    prepare,
    without_effect,
)

make_env = make

__all__ = [
    "Settings",
    "available_cores",
    "check",
    "ends_early",
    "is_locomotion",
    "is_point_mass",
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


def is_point_mass(env: Any) -> bool:
    """Return whether an environment, wrapped or not, is the point mass."""
    return isinstance(env.unwrapped, PointMass)

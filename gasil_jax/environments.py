"""Environments by name: the one place where the library knows ``gasil_envs``."""

from typing import Any

from gasil_envs.physics.native import available_cores
from gasil_envs.registry import Settings, check, make, prepare

make_env = make

__all__ = [
    "Settings",
    "available_cores",
    "check",
    "is_locomotion",
    "is_point_mass",
    "make_env",
    "prepare",
]


def is_locomotion(env: Any) -> bool:
    """Whether it is one of the MuJoCo tasks, wrapped or not."""
    # A program that trains the point mass has no need of MuJoCo.
    from gasil_envs.locomotion import Locomotion

    return isinstance(env.unwrapped, Locomotion)


def is_point_mass(env: Any) -> bool:
    """Whether it is the point mass, wrapped or not."""
    from gasil_envs.point_mass import PointMass

    return isinstance(env.unwrapped, PointMass)

"""Environments by name: the one place where the library knows ``gasil_envs``."""

from gasil_envs.physics.native import available_cores
from gasil_envs.registry import Settings, check, make, prepare

make_env = make

__all__ = ["Settings", "available_cores", "check", "make_env", "prepare"]

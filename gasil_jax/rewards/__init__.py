"""Reward models: what PPO learns from instead of the environment's own rewards."""

from gasil_jax.rewards.decomposition import Decompose
from gasil_jax.rewards.interface import RewardModel
from gasil_jax.rewards.normalization import Normalize

#: The package's own models, in the order in which an algorithm by name chains them.
REWARD_MODELS: tuple[type[RewardModel], ...] = (Decompose, Normalize)

__all__ = ["REWARD_MODELS", "Decompose", "Normalize", "RewardModel"]

"""Rewards in units of their discounted return's standard deviation.

OpenAI baselines' ``VecNormalize``, with which its ``ppo2`` trains on MuJoCo tasks: each
environment keeps a running sum, discounted into the past and begun anew with each
episode, and rewards are divided by the standard deviation of all these sums so far.
Their mean is not taken away, so that no reward changes its sign.
"""

from typing import Any

import chex
import jax
import jax.numpy as jnp
from flax import struct

from gasil_jax import normalization


class RewardNormalizer(struct.PyTreeNode):
    """What the scale is computed from.

    Attributes:
      running: float32 (env,), sum of gamma^age reward over the running episode.
      sums: moments of all such sums so far, of size 1.
    """

    running: jax.Array
    sums: normalization.Normalizer


def init(num_envs: int) -> RewardNormalizer:
    """A normalizer that has seen nothing."""
    return RewardNormalizer(jnp.zeros(num_envs, jnp.float32), normalization.init(1))


def update(
    normalizer: RewardNormalizer,
    reward: jax.Array,
    ended: jax.Array,
    gamma: jax.Array | float,
) -> RewardNormalizer:
    """Take in a batch.

    Args:
      normalizer: before it.
      reward: float32 (time, env), finite.
      ended: bool (time, env), the episode ended with this step.
      gamma: discount.
    """
    chex.assert_equal_shape([reward, ended])
    chex.assert_equal(reward.shape[1:], normalizer.running.shape)

    def step(running: jax.Array, now: Any) -> Any:
        reward, ended = now
        running = gamma * running + reward
        return jnp.where(ended, 0.0, running), running

    running, sums = jax.lax.scan(step, normalizer.running, (reward, ended))
    return RewardNormalizer(
        running, normalization.update(normalizer.sums, sums[..., None])
    )


def scale(normalizer: RewardNormalizer) -> jax.Array:
    """What rewards are divided by, (), more than 0."""
    _, deviation = normalization.moments(normalizer.sums)
    return deviation[0]


def normalize(
    normalizer: RewardNormalizer, reward: jax.Array, clip: float = 10.0
) -> jax.Array:
    """Rewards of any shape in units of `scale`, clipped to +-`clip`."""
    return jnp.clip(reward / scale(normalizer), -clip, clip)

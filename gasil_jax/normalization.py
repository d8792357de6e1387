"""Running normalization of observations."""

import chex
import jax
import jax.numpy as jnp
from flax import struct

from gasil_envs import wrappers

#: Largest absolute value of a normalized number; `numpy_policy` has the same.
CLIP = 10.0


class Normalizer(struct.PyTreeNode):
    """The mean and variance of all observations so far; float32."""

    count: jax.Array  # (), number of observations
    mean: jax.Array  # (obs,)
    m2: jax.Array  # (obs,), sum of squared differences from the mean


def init(observation_size: int) -> Normalizer:
    """Return a normalizer without observations, which has mean 0 and variance 1."""

    # Each field needs its own array: a shared one could not be donated.
    def zeros() -> jax.Array:
        return jnp.zeros(observation_size, jnp.float32)

    return Normalizer(jnp.float32(0), zeros(), zeros())


def update(normalizer: Normalizer, observation: jax.Array) -> Normalizer:
    """Return the normalizer updated by a batch of observations (..., obs).

    Observations with a number for which `wrappers.is_sound` is false are left out. Mean
    and sum of squares are updated as in Chan, Golub, LeVeque 1979.
    """
    chex.assert_equal(observation.shape[-1:], normalizer.mean.shape)
    rows = observation.reshape(-1, observation.shape[-1])
    valid = jnp.all(wrappers.is_sound(rows), axis=-1, keepdims=True)
    rows = jnp.where(valid, rows, 0.0)
    count = jnp.sum(valid, dtype=jnp.float32)
    mean = jnp.sum(rows, axis=0) / jnp.maximum(count, 1.0)
    m2 = jnp.sum(jnp.where(valid, (rows - mean[None]) ** 2, 0.0), axis=0)
    total = normalizer.count + count
    delta = mean - normalizer.mean
    share = count / jnp.maximum(total, 1.0)
    return Normalizer(
        count=total,
        mean=normalizer.mean + delta * share,
        m2=normalizer.m2 + m2 + delta**2 * normalizer.count * share,
    )


def moments(normalizer: Normalizer) -> tuple[jax.Array, jax.Array]:
    """Return the mean and scale that `normalize` uses, (..., obs) each."""
    count = normalizer.count[..., None]
    variance = jnp.where(count > 0, normalizer.m2 / jnp.maximum(count, 1.0), 1.0)
    return normalizer.mean, jnp.sqrt(variance + 1e-8)


def normalize(normalizer: Normalizer, observation: jax.Array) -> jax.Array:
    """Scale observations (..., obs) to mean 0 and variance 1, clipped to +-`CLIP`."""
    mean, scale = (jnp.broadcast_to(x, observation.shape) for x in moments(normalizer))
    return jnp.clip((observation - mean) / scale, -CLIP, CLIP)

"""Running normalization of observations."""

import chex
import jax
import jax.numpy as jnp
from flax import struct

# Of C MuJoCo (mjMAXVAL): what is larger it takes for a simulation that has failed.
_LARGEST = 1e10


def is_sound(x: jax.Array) -> jax.Array:
    """Whether numbers are finite and of a size that physics gives, bool, x's shape."""
    return jnp.abs(x) < _LARGEST  # NaN is not.


class Normalizer(struct.PyTreeNode):
    """Mean and variance of all observations so far.

    Attributes:
      count: observations seen, float32 ().
      mean: float32 (obs,).
      m2: sum of squared differences from the mean, float32 (obs,).
    """

    count: jax.Array
    mean: jax.Array
    m2: jax.Array


def init(observation_size: int) -> Normalizer:
    """A normalizer that has seen nothing and changes nothing but the clip."""
    # An array for each: one in two places could not be donated.
    zeros = lambda: jnp.zeros(observation_size, jnp.float32)
    return Normalizer(jnp.float32(0), zeros(), zeros())


def update(normalizer: Normalizer, observation: jax.Array) -> Normalizer:
    """Take in a batch (..., obs); rows with a number that is not sound are left out.

    Chan, Golub, LeVeque 1979: parallel update of mean and sum of squares.
    """
    chex.assert_equal(observation.shape[-1:], normalizer.mean.shape)
    rows = observation.reshape(-1, observation.shape[-1])
    valid = jnp.all(is_sound(rows), axis=-1, keepdims=True)
    rows = jnp.where(valid, rows, 0.0)
    count = jnp.sum(valid, dtype=jnp.float32)
    mean = jnp.sum(rows, axis=0) / jnp.maximum(count, 1.0)
    m2 = jnp.sum(jnp.where(valid, (rows - mean) ** 2, 0.0), axis=0)
    total = normalizer.count + count
    delta = mean - normalizer.mean
    share = count / jnp.maximum(total, 1.0)
    return Normalizer(
        count=total,
        mean=normalizer.mean + delta * share,
        m2=normalizer.m2 + m2 + delta**2 * normalizer.count * share,
    )


def moments(normalizer: Normalizer) -> tuple[jax.Array, jax.Array]:
    """What `normalize` subtracts and divides by, (..., obs) each."""
    count = normalizer.count[..., None]
    variance = jnp.where(count > 0, normalizer.m2 / jnp.maximum(count, 1.0), 1.0)
    return normalizer.mean, jnp.sqrt(variance + 1e-8)


def normalize(
    normalizer: Normalizer, observation: jax.Array, clip: float = 10.0
) -> jax.Array:
    """Observations (..., obs) at mean 0 and variance 1, clipped to +-`clip`."""
    mean, scale = moments(normalizer)
    return jnp.clip((observation - mean) / scale, -clip, clip)

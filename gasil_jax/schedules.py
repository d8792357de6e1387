"""Schedules: numbers that change over the environment steps of training."""

from collections.abc import Mapping

import jax
import jax.numpy as jnp

from gasil_jax.algorithms import Algorithm
from gasil_jax.config import SCHEDULE_SUFFIX, Schedule


def factor(schedule: Schedule, env_steps: jax.Array) -> jax.Array:
    """Return a schedule's factor at `env_steps`, ().

    Args:
      schedule: an Optax schedule, or (steps, factor) points with increasing steps. The
        factor is linear between points and constant beyond them.
      env_steps: float32 (), number of environment steps that the run has taken.
    """
    if callable(schedule):
        return jnp.asarray(schedule(env_steps), jnp.float32)
    if not schedule:
        return jnp.float32(1.0)
    steps, factors = (jnp.array(column, jnp.float32) for column in zip(*schedule))
    return jnp.interp(env_steps, steps, factors)


def at(
    algorithm: Algorithm, hyperparameters: Mapping[str, jax.Array], iteration: jax.Array
) -> Algorithm:
    """Return an algorithm with its numbers in an iteration, all schedules applied.

    Args:
      algorithm: the algorithm.
      hyperparameters: the run's own numbers by name, () each, before schedules.
      iteration: int32 (), number of iterations before this one.
    """
    config, numbers = algorithm.config, dict(hyperparameters)
    # In float32, because int32 would overflow at 2^31 steps.
    env_steps = iteration.astype(jnp.float32) * config.batch_steps
    # A user's own loop may run for more iterations than the config has.
    decay = numbers["learning_rate_decay"]
    remaining_share = jnp.maximum(1.0 - decay * (iteration / config.num_iterations), 0)
    numbers["learning_rate"] = numbers["learning_rate"] * remaining_share
    for name, value in algorithm.settings.items():
        if name.endswith(SCHEDULE_SUFFIX):
            number = name.removesuffix(SCHEDULE_SUFFIX)
            numbers[number] = numbers[number] * factor(value, env_steps)
    return algorithm.replace(**numbers)

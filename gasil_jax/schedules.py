"""Schedules: hyperparameters that change over the environment steps of training."""

import jax
import jax.numpy as jnp

from gasil_jax.config import Config, Hyperparameters, Schedule


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
    config: Config, hyperparameters: Hyperparameters, iteration: jax.Array
) -> Hyperparameters:
    """Return the hyperparameters of an iteration, with all schedules applied."""
    # In float32, because int32 would overflow at 2^31 steps.
    env_steps = iteration.astype(jnp.float32) * config.batch_steps
    # A user's own loop may run for more iterations than the config has.
    remaining_share = jnp.maximum(
        1.0 - hyperparameters.learning_rate_decay * (iteration / config.num_iterations),
        0.0,
    )
    return hyperparameters.replace(
        learning_rate=hyperparameters.learning_rate
        * remaining_share
        * factor(config.learning_rate_schedule, env_steps),
        clip_epsilon=hyperparameters.clip_epsilon
        * factor(config.clip_epsilon_schedule, env_steps),
        alpha=hyperparameters.alpha * factor(config.alpha_schedule, env_steps),
    )

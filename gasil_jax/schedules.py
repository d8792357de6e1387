"""Hyperparameters that change with the environment steps of training."""

import jax
import jax.numpy as jnp

from gasil_jax.config import Config, Hyperparameters, Schedule


def factor(schedule: Schedule, env_steps: jax.Array) -> jax.Array:
    """The factor at `env_steps`, (): linear between points, constant beyond.

    Args:
      schedule: (steps, factor) points, steps increasing, or an Optax schedule.
      env_steps: float32 (), environment steps that a run has taken.
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
    """What an iteration trains with: the learning rate annealed, schedules applied."""
    # In float32: as int32 it ends at 2^31 steps.
    env_steps = iteration.astype(jnp.float32) * config.batch_steps
    # A loop of one's own may go on for longer than it was annealed for.
    left = jnp.maximum(
        1.0 - hyperparameters.learning_rate_decay * (iteration / config.num_iterations),
        0.0,
    )
    return hyperparameters.replace(
        learning_rate=hyperparameters.learning_rate
        * left
        * factor(config.learning_rate_schedule, env_steps),
        clip_epsilon=hyperparameters.clip_epsilon
        * factor(config.clip_epsilon_schedule, env_steps),
        alpha=hyperparameters.alpha * factor(config.alpha_schedule, env_steps),
    )

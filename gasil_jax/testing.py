"""A helper for the tests of your own agent."""

from typing import Any

import jax

from gasil_envs.precision import full_precision
from gasil_jax import checks, schedules, train
from gasil_jax.config import Config
from gasil_jax.imitation.interface import Context


@full_precision
def example_context(env: Any, config: Config, key: jax.Array) -> Context:
    """Return the `Context` that an agent's functions get in the first iteration.

    The batch is collected with the untrained policy. The buffer holds the whole
    episodes that ended in the batch, so it is empty unless one ends within
    `config.num_steps` steps of its environment. With `config.stagger_episodes` first
    episodes that are cut short don't count.

    Args:
      env: one environment.
      config: the config of a run of the agent.
      key: random key; consumed.

    Raises:
      ValueError: if the config is not valid.
    """
    checks.check_environment(env)
    checks.check(env, config)
    state = train.init(env, config, key)
    hyperparameters = schedules.at(config, state.hyperparameters, state.iteration)
    _, act_key, _, _, _, decompose_key = jax.random.split(state.key, 6)
    _, batch = train.sample_trajectories(env, config, state, act_key, hyperparameters)
    history, buffer = train.update_good_trajectories(
        config, state, batch, hyperparameters
    )
    rewards, _ = train.learner_rewards(
        env,
        config,
        state,
        batch=batch,
        history=history,
        key=decompose_key,
        hyperparameters=hyperparameters,
    )
    return train.make_context(
        env,
        config,
        state,
        rewards=rewards,
        buffer=buffer,
        hyperparameters=hyperparameters,
    )

"""A helper for the tests of your own agent."""

from typing import Any

import jax

from gasil_envs.precision import full_precision
from gasil_jax import train
from gasil_jax.algorithms import Algorithm
from gasil_jax.context import Context


@full_precision
def example_context(env: Any, algorithm: Algorithm, key: jax.Array) -> Context:
    """Return the `Context` that an agent's functions get in the first iteration.

    The batch is collected with the untrained policy. With `stagger_episodes` first
    episodes that are cut short don't count as whole ones.

    Args:
      env: one environment.
      algorithm: the algorithm of a run of the agent.
      key: random key; consumed.

    Raises:
      ValueError: if the algorithm is not valid.
    """
    state, data = train.init(env, algorithm, key), algorithm.agent.data()
    algorithm = algorithm.at(state.hyperparameters, state.iteration)
    keys = train.Keys(*jax.random.split(state.key, 6))
    return train.collect(env, algorithm, state, keys=keys, data=data).context

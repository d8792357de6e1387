"""The distributions of actions: a Gaussian, or a categorical where they are discrete.

Each is a small table of pure functions. `of` chooses one where a policy is made, and
nothing else asks whether actions are discrete: everything but the environment sees a
discrete action as a one-hot vector, float32 (num_actions,).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from gasil_envs import wrappers
from gasil_jax.networks import CategoricalPolicy, GaussianPolicy

_LOG_2PI = 1.8378770664093453


class Distribution(NamedTuple):
    """The functions of a kind of distribution.

    Its parameters are what the policy's network returns: mean (..., action) and log
    standard deviation (action,) of a Gaussian; logits (..., action) of a categorical.

    Attributes:
      network: class of the policy's network.
      explore: (params, deviation) -> the params of an untrained policy whose actions
        have this standard deviation, if the distribution has one.
      sample: (key, parameters) -> action (..., action); consumes the key.
      log_prob: (parameters, action) -> log density or log probability, (...).
      entropy: parameters -> the entropy in nats, () or (...).
      mode: parameters -> the most probable action (..., action).
      executed: (action, low, high) -> what the environment's step gets.
    """

    network: Callable[..., Any]
    explore: Callable[[Any, jax.Array], Any]
    sample: Callable[[jax.Array, Any], jax.Array]
    log_prob: Callable[[Any, jax.Array], jax.Array]
    entropy: Callable[[Any], jax.Array]
    mode: Callable[[Any], jax.Array]
    executed: Callable[[jax.Array, Any, Any], jax.Array]


def _with_deviation(params: Any, deviation: jax.Array) -> Any:
    own = params["params"]
    log_std = own["log_std"] + jnp.log(deviation)
    return {**params, "params": {**own, "log_std": log_std}}


def _gaussian_sample(key: jax.Array, parameters: Any) -> jax.Array:
    mean, log_std = parameters
    noise = jax.random.normal(key, mean.shape, mean.dtype)
    return mean + jax.lax.broadcast_to_rank(jnp.exp(log_std), mean.ndim) * noise


def _gaussian_log_prob(parameters: Any, action: jax.Array) -> jax.Array:
    mean, log_std = parameters
    log_std, precision = (
        jax.lax.broadcast_to_rank(x, mean.ndim) for x in (log_std, jnp.exp(-log_std))
    )
    z = (action - mean) * precision
    return jnp.sum(-0.5 * z**2 - log_std - 0.5 * _LOG_2PI, axis=-1)


def _gaussian_entropy(parameters: Any) -> jax.Array:
    _, log_std = parameters
    return jnp.sum(log_std + 0.5 * (_LOG_2PI + 1.0), axis=-1)


#: A diagonal Gaussian whose deviation does not depend on the state.
GAUSSIAN = Distribution(
    network=GaussianPolicy,
    explore=_with_deviation,
    sample=_gaussian_sample,
    log_prob=_gaussian_log_prob,
    entropy=_gaussian_entropy,
    mode=lambda parameters: parameters[0],
    executed=jnp.clip,
)


def _one_hot(index: jax.Array, logits: jax.Array) -> jax.Array:
    return jax.nn.one_hot(index, logits.shape[-1], dtype=logits.dtype)


def _categorical_entropy(logits: jax.Array) -> jax.Array:
    return -jnp.sum(jax.nn.softmax(logits) * jax.nn.log_softmax(logits), axis=-1)


#: One of `num_actions` actions.
CATEGORICAL = Distribution(
    network=CategoricalPolicy,
    explore=lambda params, deviation: params,
    sample=lambda key, logits: _one_hot(jax.random.categorical(key, logits), logits),
    log_prob=lambda logits, action: jnp.sum(
        action * jax.nn.log_softmax(logits), axis=-1
    ),
    entropy=_categorical_entropy,
    mode=lambda logits: _one_hot(jnp.argmax(logits, axis=-1), logits),
    executed=lambda action, low, high: jnp.argmax(action, axis=-1).astype(jnp.int32),
)


def of(env: Any) -> Distribution:
    """Return the distribution of a policy's actions in an environment."""
    return CATEGORICAL if wrappers.is_discrete(env) else GAUSSIAN

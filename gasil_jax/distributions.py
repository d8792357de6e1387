"""The distributions of actions: Gaussians, or a categorical where they are discrete.

Each is a small table of pure functions, and `of` returns the one for an environment. So
PPO and the agents need not distinguish discrete actions from vectors: in training a
discrete action is a one-hot vector, float32 (num_actions,), and only the environment's
step gets it as an int32.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from gasil_envs import wrappers
from gasil_jax.networks import CategoricalPolicy, GaussianPolicy, MixturePolicy

_LOG_2PI = 1.8378770664093453


class Distribution(NamedTuple):
    """The functions of a kind of distribution.

    Its parameters are what the policy's network returns: mean (..., action) and log
    standard deviation (action,) of a Gaussian; logits (..., action) of a categorical;
    means (..., component, action), log standard deviation (action,) and the components'
    logits (..., component) of a mixture of Gaussians.

    Attributes:
      network: class of the policy's network.
      explore: (params, std) -> the params of an untrained policy whose actions
        have this standard deviation, if the distribution has one.
      sample: (key, parameters) -> action (..., action); consumes the key.
      log_prob: (parameters, action) -> log density or log probability, (...).
      entropy: parameters -> the entropy in nats, or a lower bound, () or (...).
      mode: parameters -> the most probable action (..., action); of a mixture, the mean
        of the most probable component.
      executed: (action, low, high) -> what the environment's step gets.
    """

    network: Callable[..., Any]
    explore: Callable[[Any, jax.Array], Any]
    sample: Callable[[jax.Array, Any], jax.Array]
    log_prob: Callable[[Any, jax.Array], jax.Array]
    entropy: Callable[[Any], jax.Array]
    mode: Callable[[Any], jax.Array]
    executed: Callable[[jax.Array, Any, Any], jax.Array]


def _with_std(params: Any, std: jax.Array) -> Any:
    own = params["params"]
    log_std = own["log_std"] + jnp.log(std)
    return {**params, "params": {**own, "log_std": log_std}}


def _gaussian_sample(key: jax.Array, parameters: Any) -> jax.Array:
    mean, log_std = parameters
    noise = jax.random.normal(key, mean.shape, mean.dtype)
    return mean + jax.lax.broadcast_to_rank(jnp.exp(log_std), mean.ndim) * noise


def _gaussian_log_prob(parameters: Any, action: jax.Array) -> jax.Array:
    mean, log_std = parameters
    precision = jax.lax.broadcast_to_rank(jnp.exp(-log_std), mean.ndim)
    log_std = jax.lax.broadcast_to_rank(log_std, mean.ndim)
    z = (action - mean) * precision
    return jnp.sum(-0.5 * z**2 - log_std - 0.5 * _LOG_2PI, axis=-1)


def _gaussian_entropy(parameters: Any) -> jax.Array:
    _, log_std = parameters
    return jnp.sum(log_std + 0.5 * (_LOG_2PI + 1.0), axis=-1)


#: A diagonal Gaussian whose deviation does not depend on the state.
GAUSSIAN = Distribution(
    network=GaussianPolicy,
    explore=_with_std,
    sample=_gaussian_sample,
    log_prob=_gaussian_log_prob,
    entropy=_gaussian_entropy,
    mode=lambda parameters: parameters[0],
    executed=jnp.clip,
)


def _one_hot(index: jax.Array, logits: jax.Array) -> jax.Array:
    return jax.nn.one_hot(index, logits.shape[-1], dtype=logits.dtype)


def _spread(params: Any, std: jax.Array) -> Any:
    def scaled(path: Any, x: jax.Array) -> jax.Array:
        # Those of hidden layers are still 0.
        return x * std if path[-1].key == "bias" else x

    return jax.tree_util.tree_map_with_path(scaled, _with_std(params, std))


def _mean_of(index: jax.Array, parameters: Any) -> jax.Array:
    """Return the mean of one component, (..., action)."""
    mean, _, logits = parameters
    return jnp.sum(_one_hot(index, logits)[..., None] * mean, axis=-2)


def _mixture_sample(key: jax.Array, parameters: Any) -> jax.Array:
    _, log_std, logits = parameters
    component_key, noise_key = jax.random.split(key)
    component = jax.random.categorical(component_key, logits)
    return _gaussian_sample(noise_key, (_mean_of(component, parameters), log_std))


def _mixture_log_prob(parameters: Any, action: jax.Array) -> jax.Array:
    mean, log_std, logits = parameters
    each = _gaussian_log_prob((mean, log_std), action[..., None, :])
    return jax.nn.logsumexp(jax.nn.log_softmax(logits) + each, axis=-1)


def _mixture_entropy(parameters: Any) -> jax.Array:
    """Return a lower bound of the entropy, which has no closed form.

    It is that of Kolchinsky and Tracey (2017) with Bhattacharyya distances: exact where
    all means are the same and where all are far apart, and rising in between.
    """
    mean, log_std, logits = parameters
    scaled = mean * jax.lax.broadcast_to_rank(jnp.exp(-log_std), mean.ndim)
    between = scaled[..., :, None, :] - scaled[..., None, :, :]
    distance = jnp.sum(between**2, axis=-1) / 8.0
    log_weight = jax.nn.log_softmax(logits)
    overlap = jax.nn.logsumexp(log_weight[..., None, :] - distance, axis=-1)
    added = -jnp.sum(jnp.exp(log_weight) * overlap, axis=-1)
    return _gaussian_entropy((mean, log_std)) + added


#: Several Gaussians with weights, all with the same deviations.
MIXTURE = Distribution(
    network=MixturePolicy,
    explore=_spread,
    sample=_mixture_sample,
    log_prob=_mixture_log_prob,
    entropy=_mixture_entropy,
    mode=lambda parameters: _mean_of(jnp.argmax(parameters[2], axis=-1), parameters),
    executed=jnp.clip,
)


def _categorical_entropy(logits: jax.Array) -> jax.Array:
    return -jnp.sum(jax.nn.softmax(logits) * jax.nn.log_softmax(logits), axis=-1)


#: One of `num_actions` actions.
CATEGORICAL = Distribution(
    network=CategoricalPolicy,
    explore=lambda params, std: params,
    sample=lambda key, logits: _one_hot(jax.random.categorical(key, logits), logits),
    log_prob=lambda logits, action: jnp.sum(
        action * jax.nn.log_softmax(logits), axis=-1
    ),
    entropy=_categorical_entropy,
    mode=lambda logits: _one_hot(jnp.argmax(logits, axis=-1), logits),
    executed=lambda action, low, high: jnp.argmax(action, axis=-1).astype(jnp.int32),
)


def of(env: Any, components: int) -> Distribution:
    """Return the distribution of actions; `components` is the number of Gaussians."""
    if wrappers.is_discrete(env):
        return CATEGORICAL
    return MIXTURE if components > 1 else GAUSSIAN

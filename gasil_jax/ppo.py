"""Proximal policy optimization (Schulman et al. 2017) on one batch."""

from collections.abc import Callable
from typing import Any

import chex
import jax
import jax.numpy as jnp
import optax
from flax import struct

from gasil_jax.config import Config, Hyperparameters
from gasil_jax.networks import gaussian_entropy, gaussian_log_prob


class Batch(struct.PyTreeNode):
    """What PPO learns from; the leading axis is (steps,) or (minibatch,).

    Attributes:
      observation: float32 (steps, obs), normalized.
      action: float32 (steps, action).
      log_prob: float32 (steps,), under the policy that acted.
      advantage: float32 (steps,).
      return_: float32 (steps,), target of the value.
    """

    observation: jax.Array
    action: jax.Array
    log_prob: jax.Array
    advantage: jax.Array
    return_: jax.Array


def generalized_advantage_estimation(
    reward: jax.Array,
    value: jax.Array,
    next_value: jax.Array,
    terminated: jax.Array,
    ended: jax.Array,
    *,
    gamma: jax.Array | float,
    gae_lambda: jax.Array | float,
) -> jax.Array:
    """GAE(lambda), Schulman et al. 2016, equation 16: (time, env) -> (time, env).

    Args:
      reward: float32 (time, env).
      value: float32 (time, env), V of the observation.
      next_value: float32 (time, env), V of the observation that followed, the
        final one of an episode that ended: a truncated episode is bootstrapped.
      terminated: bool (time, env), the future is worth nothing.
      ended: bool (time, env), terminated or truncated: the sum stops here.
      gamma: discount.
      gae_lambda: lambda.
    """
    chex.assert_equal_shape([reward, value, next_value, terminated, ended])
    delta = reward + gamma * next_value * (1.0 - terminated) - value
    decay = gamma * gae_lambda * (1.0 - ended)

    def backward(advantage: jax.Array, step: tuple[jax.Array, jax.Array]) -> Any:
        delta, decay = step
        advantage = delta + decay * advantage
        return advantage, advantage

    return jax.lax.scan(
        backward, jnp.zeros_like(delta[0]), (delta, decay), reverse=True
    )[1]


def loss(
    params: Any,
    batch: Batch,
    *,
    policy: Callable[[Any, jax.Array], tuple[jax.Array, jax.Array]],
    value: Callable[[Any, jax.Array], jax.Array],
    hyperparameters: Hyperparameters,
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Clipped surrogate (Schulman et al. 2017, equation 7), value error and entropy.

    Args:
      params: of policy and value.
      batch: a minibatch.
      policy: (params, observation) -> mean, log standard deviation.
      value: (params, observation) -> value.
      hyperparameters: clip range and weights.

    Returns:
      The loss, (), and its parts.
    """
    chex.assert_equal_shape([batch.log_prob, batch.advantage, batch.return_])
    mean, log_std = policy(params["policy"], batch.observation)
    values = value(params["value"], batch.observation)
    log_prob = gaussian_log_prob(mean, log_std, batch.action)
    log_ratio = log_prob - batch.log_prob
    ratio = jnp.exp(log_ratio)
    epsilon = hyperparameters.clip_epsilon
    clipped = jnp.clip(ratio, 1.0 - epsilon, 1.0 + epsilon)
    surrogate = jnp.minimum(ratio * batch.advantage, clipped * batch.advantage)
    policy_loss = -jnp.mean(surrogate)
    value_loss = 0.5 * jnp.mean((values - batch.return_) ** 2)
    entropy = gaussian_entropy(log_std)
    total = (
        policy_loss
        + hyperparameters.value_coefficient * value_loss
        - hyperparameters.entropy_coefficient * entropy
    )
    metrics = {
        "policy_loss": policy_loss,
        "value_loss": value_loss,
        "entropy": entropy,
        # Schulman's low-variance estimate of KL(old || new).
        "approx_kl": jnp.mean(ratio - 1.0 - log_ratio),
        "clip_fraction": jnp.mean(jnp.abs(ratio - 1.0) > epsilon),
    }
    return total, metrics


def optimizer(hyperparameters: Hyperparameters) -> optax.GradientTransformation:
    """Adam behind a clip of the gradient's norm, for one network; no step size.

    On the parameters as one vector: of networks this small an operation costs its
    start, so one for each layer cost a CPU a tenth of the training time.
    """
    transform = optax.chain(
        optax.clip_by_global_norm(hyperparameters.max_grad_norm),
        optax.scale_by_adam(eps=1e-5),
    )
    return optax.flatten(transform)


def descend(
    params: Any,
    optimizer_state: Any,
    gradient: Any,
    learning_rate: jax.Array | float,
    hyperparameters: Hyperparameters,
) -> tuple[Any, Any]:
    """One step of `optimizer` for one network: its new params and state."""
    updates, optimizer_state = optimizer(hyperparameters).update(
        gradient, optimizer_state
    )
    params = jax.tree.map(lambda p, u: p - learning_rate * u, params, updates)
    return params, optimizer_state


def descend_each(
    params: dict[str, Any],
    optimizer_state: dict[str, Any],
    gradient: dict[str, Any],
    learning_rate: jax.Array | float,
    hyperparameters: Hyperparameters,
) -> tuple[dict[str, Any], dict[str, Any]]:
    """`descend` for every network by name, each clipped and stepped for itself."""
    stepped = {
        name: descend(
            params[name],
            optimizer_state[name],
            gradient[name],
            learning_rate,
            hyperparameters,
        )
        for name in params
    }
    return (
        {name: network for name, (network, _) in stepped.items()},
        {name: state for name, (_, state) in stepped.items()},
    )


def update(
    params: Any,
    optimizer_state: Any,
    batch: Batch,
    key: jax.Array,
    *,
    policy: Callable[[Any, jax.Array], tuple[jax.Array, jax.Array]],
    value: Callable[[Any, jax.Array], jax.Array],
    learning_rate: jax.Array | float,
    config: Config,
    hyperparameters: Hyperparameters,
) -> tuple[Any, Any, dict[str, jax.Array]]:
    """`num_epochs` passes over the batch in shuffled minibatches.

    Args:
      params: {"policy": ..., "value": ...}; each is clipped and stepped for itself.
      optimizer_state: {"policy": ..., "value": ...}.
      batch: (steps, ...), advantages already normalized.
      key: consumed.
      policy: (params, observation) -> mean, log standard deviation.
      value: (params, observation) -> value.
      learning_rate: step size of this iteration.
      config: counts and sizes.
      hyperparameters: the floats.

    Returns:
      params, optimizer state, and the metrics' means over all minibatches.
    """

    def minibatch_step(carry: Any, minibatch: Batch) -> Any:
        params, optimizer_state = carry
        gradient, metrics = jax.grad(loss, has_aux=True)(
            params,
            minibatch,
            policy=policy,
            value=value,
            hyperparameters=hyperparameters,
        )
        carry = descend_each(
            params, optimizer_state, gradient, learning_rate, hyperparameters
        )
        return carry, metrics

    def epoch(carry: Any, key: jax.Array) -> Any:
        order = jax.random.permutation(key, config.batch_steps)
        order = order.reshape(config.num_minibatches, config.minibatch_size)
        return jax.lax.scan(
            lambda carry, rows: minibatch_step(
                carry, jax.tree.map(lambda x: x[rows], batch)
            ),
            carry,
            order,
        )

    (params, optimizer_state), metrics = jax.lax.scan(
        epoch, (params, optimizer_state), jax.random.split(key, config.num_epochs)
    )
    return params, optimizer_state, jax.tree.map(jnp.mean, metrics)

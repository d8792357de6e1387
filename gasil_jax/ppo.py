"""Proximal policy optimization (Schulman et al. 2017) on one batch."""

from collections.abc import Callable
from typing import Any

import chex
import jax
import jax.numpy as jnp
import optax
from flax import struct

from gasil_jax import learner
from gasil_jax.config import Config, Hyperparameters
from gasil_jax.learner import Learner
from gasil_jax.networks import gaussian_entropy, gaussian_log_prob


class ActorCritic(struct.PyTreeNode):
    """The policy, and a value for each reward stream, each with its optimizer.

    Attributes:
      policy: of `networks.Policy`.
      values: of `networks.Value`, (stream) of them.
    """

    policy: Learner
    values: tuple[Learner, ...]

    @property
    def params(self) -> dict[str, Any]:
        """Parameters of every network: {"policy": ..., "values": (stream)}."""
        return {
            "policy": self.policy.params,
            "values": tuple(value.params for value in self.values),
        }


class Batch(struct.PyTreeNode):
    """What PPO learns from; the leading axis is (steps,) or (minibatch,).

    Attributes:
      observation: float32 (steps, obs), normalized.
      action: float32 (steps, action).
      log_prob: float32 (steps,), under the policy that acted.
      advantage: float32 (steps,).
      returns: float32 (steps, stream), targets of the values.
    """

    observation: jax.Array
    action: jax.Array
    log_prob: jax.Array
    advantage: jax.Array
    returns: jax.Array


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
    """GAE(lambda), Schulman et al. 2016, equation 16: (time, ...) -> (time, ...).

    Args:
      reward: float32 (time, ...), of environments, or of environments and streams.
      value: float32 (time, ...), V of the observation.
      next_value: float32 (time, ...), V of the observation that followed, the
        final one of an episode that ended: a truncated episode is bootstrapped.
      terminated: bool, of a shape that broadcasts to it: the future is worth nothing.
      ended: bool, the same: terminated or truncated, the sum stops here.
      gamma: discount.
      gae_lambda: lambda.
    """
    chex.assert_equal_shape([reward, value, next_value])
    chex.assert_equal_shape([terminated, ended])
    delta = reward + gamma * next_value * (1.0 - terminated) - value
    decay = gamma * gae_lambda * (1.0 - ended)

    def backward(advantage: jax.Array, step: tuple[jax.Array, jax.Array]) -> Any:
        delta, decay = step
        advantage = delta + decay * advantage
        return advantage, advantage

    return jax.lax.scan(
        backward, jnp.zeros_like(delta[0]), (delta, decay), reverse=True
    )[1]


def standardize(advantage: jax.Array) -> jax.Array:
    """Advantages (time, env, stream) at mean 0 and variance 1, each stream for itself.

    Over the whole batch, as OpenAI baselines' ppo1 has it.
    """
    mean = jnp.mean(advantage, axis=(0, 1))
    return (advantage - mean) / (jnp.std(advantage, axis=(0, 1)) + 1e-8)


def evaluate_streams(
    actor_critic: ActorCritic,
    rewards: jax.Array,
    observation: jax.Array,
    next_observation: jax.Array,
    terminated: jax.Array,
    ended: jax.Array,
    *,
    value: Callable[[Any, jax.Array], jax.Array],
    hyperparameters: Hyperparameters,
) -> tuple[jax.Array, jax.Array]:
    """Values and advantages of every reward stream, (time, env, stream) each.

    Args:
      actor_critic: with a value for each stream.
      rewards: float32 (time, env, stream).
      observation: float32 (time, env, obs), normalized.
      next_observation: the same of those that followed.
      terminated: bool (time, env).
      ended: bool (time, env).
      value: (params, observation) -> value.
      hyperparameters: discount and lambda.
    """
    chex.assert_equal(rewards.shape, (*terminated.shape, len(actor_critic.values)))
    of_all = lambda observation: jnp.stack(
        [value(critic.params, observation) for critic in actor_critic.values], axis=-1
    )
    values = of_all(observation)
    advantage = generalized_advantage_estimation(
        rewards,
        values,
        of_all(next_observation),
        terminated[..., None],
        ended[..., None],
        gamma=hyperparameters.gamma,
        gae_lambda=hyperparameters.gae_lambda,
    )
    return values, advantage


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
      params: {"policy": ..., "values": (stream)}.
      batch: a minibatch.
      policy: (params, observation) -> mean, log standard deviation.
      value: (params, observation) -> value.
      hyperparameters: clip range and weights.

    Returns:
      The loss, (), and its parts.
    """
    chex.assert_equal_shape([batch.log_prob, batch.advantage])
    chex.assert_equal(
        batch.returns.shape, (*batch.log_prob.shape, len(params["values"]))
    )
    mean, log_std = policy(params["policy"], batch.observation)
    log_prob = gaussian_log_prob(mean, log_std, batch.action)
    log_ratio = log_prob - batch.log_prob
    ratio = jnp.exp(log_ratio)
    epsilon = hyperparameters.clip_epsilon
    clipped = jnp.clip(ratio, 1.0 - epsilon, 1.0 + epsilon)
    surrogate = jnp.minimum(ratio * batch.advantage, clipped * batch.advantage)
    policy_loss = -jnp.mean(surrogate)
    squared_errors = [
        (value(critic, batch.observation) - batch.returns[:, i]) ** 2
        for i, critic in enumerate(params["values"])
    ]
    value_loss = jnp.stack([0.5 * jnp.mean(x) for x in squared_errors]).sum()
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
    """Adam behind a clip of the gradient's norm, for one network, without step size.

    On the parameters as one vector: of networks this small an operation costs its
    start, so one for each layer cost a CPU a tenth of the training time.
    """
    transform = optax.chain(
        optax.clip_by_global_norm(hyperparameters.max_grad_norm),
        optax.scale_by_adam(eps=1e-5),
    )
    return optax.flatten(transform)


def descend(
    actor_critic: ActorCritic, gradient: Any, hyperparameters: Hyperparameters
) -> ActorCritic:
    """One step of every network, each clipped for itself.

    Args:
      actor_critic: before it.
      gradient: {"policy": ..., "values": (stream)}.
      hyperparameters: the step size and the largest norm of a gradient.
    """
    return ActorCritic(
        policy=descend_one(actor_critic.policy, gradient["policy"], hyperparameters),
        values=tuple(
            descend_one(value, own, hyperparameters)
            for value, own in zip(actor_critic.values, gradient["values"], strict=True)
        ),
    )


def descend_one(
    network: Learner, gradient: Any, hyperparameters: Hyperparameters
) -> Learner:
    """One step of one network, by its gradient."""
    transform = optimizer(hyperparameters)
    return learner.descend(network, gradient, transform, hyperparameters.learning_rate)


def update(
    actor_critic: ActorCritic,
    batch: Batch,
    key: jax.Array,
    *,
    policy: Callable[[Any, jax.Array], tuple[jax.Array, jax.Array]],
    value: Callable[[Any, jax.Array], jax.Array],
    config: Config,
    hyperparameters: Hyperparameters,
) -> tuple[ActorCritic, dict[str, jax.Array]]:
    """`num_epochs` passes over the batch in shuffled minibatches.

    Args:
      actor_critic: before it.
      batch: (steps, ...), advantages already standardized.
      key: consumed.
      policy: (params, observation) -> mean, log standard deviation.
      value: (params, observation) -> value.
      config: counts and sizes.
      hyperparameters: the floats of this iteration.

    Returns:
      the networks, and the metrics' means over all minibatches.
    """

    def minibatch_step(actor_critic: ActorCritic, rows: jax.Array) -> Any:
        gradient, metrics = jax.grad(loss, has_aux=True)(
            actor_critic.params,
            jax.tree.map(lambda x: x[rows], batch),
            policy=policy,
            value=value,
            hyperparameters=hyperparameters,
        )
        return descend(actor_critic, gradient, hyperparameters), metrics

    def epoch(actor_critic: ActorCritic, key: jax.Array) -> Any:
        order = jax.random.permutation(key, config.batch_steps)
        order = order.reshape(config.num_minibatches, config.minibatch_size)
        return jax.lax.scan(minibatch_step, actor_critic, order)

    actor_critic, metrics = jax.lax.scan(
        epoch, actor_critic, jax.random.split(key, config.num_epochs)
    )
    return actor_critic, jax.tree.map(jnp.mean, metrics)

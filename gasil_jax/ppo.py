"""Proximal policy optimization (Schulman et al. 2017) on one batch."""

from typing import Any

import chex
import jax
import jax.numpy as jnp
import optax
from flax import struct

from gasil_jax import learner, normalization
from gasil_jax.config import Config
from gasil_jax.context import Context, Metrics
from gasil_jax.learner import Learner
from gasil_jax.permutation import permutation


class ActorCritic(struct.PyTreeNode):
    """The policy and a value for each reward stream, all with their own optimizers."""

    policy: Learner
    values: tuple[Learner, ...]

    @property
    def params(self) -> dict[str, Any]:
        """The parameters of every network: {"policy": ..., "values": (stream)}."""
        return {
            "policy": self.policy.params,
            "values": tuple(value.params for value in self.values),
        }


class Batch(struct.PyTreeNode):
    """The steps that PPO learns from, all of a batch or a minibatch; float32."""

    observation: jax.Array  # (steps, obs), normalized
    action: jax.Array  # (steps, action)
    log_prob: jax.Array  # (steps,), under the policy that acted
    advantage: jax.Array  # (steps,)
    returns: jax.Array  # (steps, stream), targets of the values


def generalized_advantage_estimation(
    reward: jax.Array,
    value: jax.Array,
    next_value: jax.Array,
    *,
    terminated: jax.Array,
    ended: jax.Array,
    gamma: jax.Array | float,
    gae_lambda: jax.Array | float,
) -> jax.Array:
    """Return the advantages of GAE(lambda) (Schulman et al. 2016, equation 16).

    Args:
      reward: float32 (time, env) or (time, env, stream).
      value: float32, the same shape, V of the observation.
      next_value: float32, the same shape, V of the next observation. At the end of an
        episode it is V of the final observation, which bootstraps truncated episodes.
      terminated: bool, broadcasts to the reward's shape; the value after a terminated
        step is 0.
      ended: bool, the shape of `terminated`: terminated or truncated, where the sum
        over later steps stops.
      gamma: discount.
      gae_lambda: lambda.

    Returns:
      float32, the shape of the reward.
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
    """Scale the advantages (time, env, stream) of each stream to mean 0 and variance 1.

    Mean and variance are over the whole batch, as in OpenAI baselines' ppo1.
    """
    mean = jnp.mean(advantage, axis=(0, 1), keepdims=True)
    std = jnp.std(advantage, axis=(0, 1), keepdims=True)
    return (advantage - mean) / (std + 1e-8)


@jax.named_scope("advantages")
def advantages(
    actor_critic: ActorCritic, rewards: jax.Array, context: Context
) -> tuple[jax.Array, jax.Array, Metrics]:
    """Return standardized advantages and returns, float32 (time, env, stream) each.

    Rewards are float32 (time, env) for one stream, or (time, env, stream). The metric
    is the share of the returns' variance that the values explain, a mean over streams.
    """
    batch = context.rollout
    rewards = rewards[..., None] if rewards.ndim == 2 else rewards
    chex.assert_equal(rewards.shape, (*batch.ended.shape, len(actor_critic.values)))

    def evaluate(observation: jax.Array) -> jax.Array:
        observation = normalization.normalize(context.normalizer, observation)
        values = [context.value(x.params, observation) for x in actor_critic.values]
        return jnp.stack(values, axis=-1)

    values = evaluate(batch.observation)
    advantage = generalized_advantage_estimation(
        rewards,
        values,
        evaluate(batch.next_observation),
        terminated=batch.terminated[..., None],
        ended=batch.ended[..., None],
        gamma=context.config.gamma,
        gae_lambda=context.config.gae_lambda,
    )
    returns = advantage + values
    residual = jnp.var(returns - values, axis=(0, 1))
    explained = 1.0 - residual / (jnp.var(returns, axis=(0, 1)) + 1e-8)
    metrics = {"explained_variance": jnp.mean(explained)}
    return standardize(advantage), returns, metrics


def batch_of(context: Context, advantage: jax.Array, returns: jax.Array) -> Batch:
    """Return the steps of an iteration, with their mixed advantage (time, env)."""
    steps = context.rollout
    observation = normalization.normalize(context.normalizer, steps.observation)
    batch = Batch(observation, steps.action, steps.log_prob, advantage, returns)
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), batch)


def loss(params: Any, batch: Batch, context: Context) -> tuple[jax.Array, Metrics]:
    """Return PPO's loss: clipped surrogate, value error and entropy.

    See Schulman et al. 2017, equations 7 and 9.

    Args:
      params: {"policy": ..., "values": (stream)}.
      batch: a minibatch.
      context: the iteration's data, with the networks and the config.

    Returns:
      The loss, (), and its parts as metrics.
    """
    chex.assert_equal_shape([batch.log_prob, batch.advantage])
    chex.assert_equal(
        batch.returns.shape, (*batch.log_prob.shape, len(params["values"]))
    )
    config, distribution = context.config, context.distribution
    parameters = context.policy(params["policy"], batch.observation)
    log_ratio = distribution.log_prob(parameters, batch.action) - batch.log_prob
    ratio = jnp.exp(log_ratio)
    epsilon = config.clip_epsilon
    clipped = jnp.clip(ratio, 1.0 - epsilon, 1.0 + epsilon)
    surrogate = jnp.minimum(ratio * batch.advantage, clipped * batch.advantage)
    policy_loss = -jnp.mean(surrogate)
    squared_errors = [
        (context.value(critic, batch.observation) - batch.returns[:, i]) ** 2
        for i, critic in enumerate(params["values"])
    ]
    value_loss = jnp.stack([0.5 * jnp.mean(x) for x in squared_errors]).sum()
    entropy = jnp.mean(distribution.entropy(parameters))
    # The value needs no weight: it has its own network, gradient clip and Adam.
    total = policy_loss + value_loss - config.entropy_coefficient * entropy
    metrics = {
        "policy_loss": policy_loss,
        "value_loss": value_loss,
        "entropy": entropy,
        # Schulman's low-variance estimate of KL(old || new).
        "approx_kl": jnp.mean(ratio - 1.0 - log_ratio),
        "clip_fraction": jnp.mean(jnp.abs(ratio - 1.0) > epsilon),
    }
    return total, metrics


def optimizer(config: Config) -> optax.GradientTransformation:
    """Return one network's optimizer: a clip of the gradient's norm, then Adam.

    The caller applies the step size. All parameters are treated as one vector, because
    with networks this small the time goes into starting operations: separate operations
    for each layer took a tenth of the training time on a CPU.
    """
    transform = optax.chain(
        optax.clip_by_global_norm(config.max_grad_norm),
        optax.scale_by_adam(eps=1e-5),
    )
    return optax.flatten(transform)


def descend(actor_critic: ActorCritic, gradient: Any, config: Config) -> ActorCritic:
    """Take one gradient step of every network; each clips its own gradient's norm."""
    networks = (actor_critic.policy, *actor_critic.values)
    gradients = (gradient["policy"], *gradient["values"])
    pairs = zip(networks, gradients, strict=True)
    policy, *values = (descend_one(x, y, config) for x, y in pairs)
    return ActorCritic(policy, tuple(values))


def descend_one(network: Learner, gradient: Any, config: Config) -> Learner:
    """Take one gradient step of one network."""
    transform = optimizer(config)
    return learner.descend(network, gradient, transform, step_size=config.learning_rate)


@jax.named_scope("ppo")
def update(
    actor_critic: ActorCritic, batch: Batch, key: jax.Array, context: Context
) -> tuple[ActorCritic, Metrics]:
    """Train for `num_epochs` passes over the batch, in shuffled minibatches.

    Returns:
      The networks after the update, and the mean of each metric over all minibatches.
    """
    config = context.config

    def minibatch_step(actor_critic: ActorCritic, rows: jax.Array) -> Any:
        gradient, metrics = jax.grad(loss, has_aux=True)(
            actor_critic.params, jax.tree.map(lambda x: x[rows], batch), context
        )
        return descend(actor_critic, gradient, config), metrics

    def epoch(actor_critic: ActorCritic, key: jax.Array) -> Any:
        order = permutation(key, config.batch_steps)
        order = order.reshape(config.num_minibatches, config.minibatch_size)
        return jax.lax.scan(minibatch_step, actor_critic, order)

    actor_critic, metrics = jax.lax.scan(
        epoch, actor_critic, jax.random.split(key, config.num_epochs)
    )
    return actor_critic, jax.tree.map(jnp.mean, metrics)

"""PPO+SIL: PPO and self-imitation learning (Oh, Guo, Singh, Lee 2018).

A replay buffer holds (s, a, R) of the steps of ended episodes, where R is the
discounted return from that step on. After PPO's gradient steps the policy and the value
take `sil_updates` further ones on minibatches, drawn with probability proportional to
max(R - V(s), 0)^0.6. They minimize `sil_coefficient` times the loss (equations 1 to 4
of Oh et al.)

    -E[w log pi(a | s) (R - V(s))+] + sil_value_coefficient / 2 E[w ((R - V(s))+)^2]

with w the importance weights of the prioritized sampling. As in the authors' code the
advantage is clipped at one standard deviation of the returns (they divide rewards by
it). The mean is over the steps with a positive advantage, or over 64 if they are fewer.
In the first term the advantage is divided by that standard deviation; in the second it
is not, as in PPO's value loss here.

R is a sum of rewards that were not clipped, but V learns from PPO's rewards. So if many
normalized rewards are clipped (the metric `clipped_rewards`), R - V is too large.
"""

from typing import Any, ClassVar

import chex
import jax
import jax.numpy as jnp
from flax import struct

from gasil_jax import learner, normalization, ppo
from gasil_jax.agents.interface import Agent
from gasil_jax.config import count, number
from gasil_jax.context import Context, Metrics, Sizes
from gasil_jax.ppo import ActorCritic
from gasil_jax.rollout import History

_PRIORITY_EXPONENT, _IMPORTANCE_EXPONENT = 0.6, 0.1
_MIN_PRIORITY, _MIN_SCALE, _MIN_SAMPLES = 1e-6, 1e-8, 64
_MAX_ADVANTAGE = 1.0


class Replay(struct.PyTreeNode):
    """The last `capacity` steps of ended episodes, as a ring buffer; float32."""

    observation: jax.Array  # (capacity, obs), not normalized
    action: jax.Array  # (capacity, action)
    return_: jax.Array  # (capacity,), discounted return from the step on
    priority: jax.Array  # (capacity,), 0 where empty
    cursor: jax.Array  # int32 (), index at which the next step is written


def init_replay(capacity: int, observation_size: int, action_size: int) -> Replay:
    """Return an empty replay."""
    return Replay(
        observation=jnp.zeros((capacity, observation_size), jnp.float32),
        action=jnp.zeros((capacity, action_size), jnp.float32),
        return_=jnp.zeros(capacity, jnp.float32),
        priority=jnp.zeros(capacity, jnp.float32),
        cursor=jnp.int32(0),
    )


def returns_to_go(
    history: History, num_steps: int, gamma: jax.Array | float
) -> tuple[jax.Array, jax.Array]:
    """Return the discounted returns of a history's steps, and which of them count.

    Both are (env, steps), oldest step first. Those count that are finite and of
    episodes that ended in the last `num_steps` steps, the batch.
    """
    reward, ended = history.in_time(history.reward), history.in_time(history.ended)
    num_envs, length = reward.shape

    def backward(carry: Any, step: Any) -> Any:
        return_, is_complete = carry
        reward, ended, is_new = step
        return_ = reward + jnp.where(ended, 0.0, gamma * return_)
        is_complete = jnp.where(ended, is_new, is_complete)
        return (return_, is_complete), (return_, is_complete)

    start = (jnp.zeros(num_envs), jnp.zeros(num_envs, bool))
    is_new = jnp.arange(length) >= length - num_steps
    _, (return_, is_complete) = jax.lax.scan(
        backward, start, (reward.T, ended.T, is_new), reverse=True
    )
    return return_.T, is_complete.T & jnp.isfinite(return_.T)


def insert(replay: Replay, history: History, num_steps: int, *, gamma: Any) -> Replay:
    """Return the replay with the steps of the episodes that ended in the last batch.

    Steps are added one environment after the other, each in time order. They get the
    highest priority that a step can have, so that each is drawn soon.
    """
    return_, complete = returns_to_go(history, num_steps, gamma)

    def flat(x: jax.Array) -> jax.Array:
        return x.reshape(-1, *x.shape[2:])

    capacity = replay.return_.shape[0]
    complete = flat(complete)
    count = jnp.sum(complete)
    rank = jnp.cumsum(complete) - 1
    # If there are more steps than fit, the last ones are kept. The index `capacity` is
    # out of bounds, so steps with it are dropped.
    kept = complete & (rank >= count - capacity)
    index = jnp.where(kept, (replay.cursor + rank) % capacity, capacity)

    def write(ring: jax.Array, new: Any) -> jax.Array:
        return ring.at[index].set(new, mode="drop")

    return Replay(
        observation=write(
            replay.observation, flat(history.in_time(history.observation))
        ),
        action=write(replay.action, flat(history.in_time(history.action))),
        return_=write(replay.return_, flat(return_)),
        priority=write(replay.priority, _MAX_ADVANTAGE),
        cursor=(replay.cursor + count) % capacity,
    )


def sample(
    key: jax.Array, replay: Replay, num_samples: int
) -> tuple[jax.Array, jax.Array]:
    """Draw indices by priority, with their importance weights, (samples,) each.

    See Schaul et al. 2016. The weights are divided by their largest possible value.
    """
    mass = jnp.where(replay.priority > 0, replay.priority**_PRIORITY_EXPONENT, 0.0)
    cumulative = jnp.cumsum(mass)
    total = cumulative[-1]
    drawn = jax.random.uniform(key, (num_samples,)) * total
    index = jnp.searchsorted(cumulative, drawn, side="right")
    # In float32 the total may come out higher than the sum up to the last filled index.
    last = jnp.max(jnp.where(mass > 0, jnp.arange(mass.shape[0]), 0))
    index = jnp.minimum(index, last)
    size = jnp.sum(replay.priority > 0)

    def weight(mass: jax.Array) -> jax.Array:
        return (mass / total * size) ** -_IMPORTANCE_EXPONENT

    least = jnp.min(jnp.where(mass > 0, mass, jnp.inf))
    return index, weight(jnp.maximum(mass[index], least)) / weight(least)


def return_scale(replay: Replay) -> jax.Array:
    """Return the standard deviation of the returns in the replay, ()."""
    filled = replay.priority > 0
    size = jnp.maximum(jnp.sum(filled), 1)
    mean = jnp.sum(jnp.where(filled, replay.return_, 0.0)) / size
    square = jnp.sum(jnp.where(filled, (replay.return_ - mean) ** 2, 0.0)) / size
    return jnp.maximum(jnp.sqrt(square), _MIN_SCALE)


def loss(
    log_prob: jax.Array,
    value: jax.Array,
    return_: jax.Array,
    *,
    weight: jax.Array,
    scale: jax.Array | float,
    value_coefficient: jax.Array | float,
) -> tuple[jax.Array, jax.Array]:
    """Return a minibatch's loss, (), and its clipped advantages, (samples,).

    Args:
      log_prob: float32 (samples,), log pi(a | s) of the replayed actions.
      value: float32 (samples,), V(s).
      return_: float32 (samples,), R, in the unit of the value.
      weight: float32 (samples,), the importance weights.
      scale: (), the standard deviation of the returns, in the unit of the value.
      value_coefficient: weight of the value's loss.
    """
    chex.assert_equal_shape([log_prob, value, return_, weight])
    advantage = jnp.clip((return_ - value) / scale, 0.0, _MAX_ADVANTAGE)
    num_samples = jnp.maximum(jnp.sum(advantage > 0), _MIN_SAMPLES)
    constant = jax.lax.stop_gradient(advantage)
    policy_loss = -jnp.sum(weight * constant * log_prob) / num_samples
    # Its gradient with respect to the value is minus the clipped advantage, in the unit
    # of the returns. That is the gradient of half the square where the advantage is not
    # clipped; where it is, the gradient is a constant instead of 0.
    value_loss = -jnp.sum(weight * scale * constant * value) / num_samples
    return policy_loss + value_coefficient * value_loss, advantage


class PPOSIL(Agent):
    """PPO on the environment's reward, then self-imitation of the replay, its state.

    Attributes:
      sil_coefficient: weight of the loss of PPO+SIL.
      sil_value_coefficient: weight of the value's loss within PPO+SIL's loss.
      sil_updates: gradient steps on PPO+SIL's loss in an iteration.
      sil_minibatch_size: replayed steps in one gradient step on PPO+SIL's loss.
      sil_buffer_steps: capacity of PPO+SIL's replay buffer, in steps.
    """

    name = "ppo+sil"
    history_episodes: ClassVar[int] = 1

    sil_coefficient: float = number(0.1, 0.0)
    sil_value_coefficient: float = number(0.01, 0.0)
    sil_updates: int = count(10)
    sil_minibatch_size: int = count(512)
    sil_buffer_steps: int = count(50_000)

    def init(self, key: jax.Array, sizes: Sizes) -> Replay:
        return init_replay(self.sil_buffer_steps, sizes.observation, sizes.action)

    def remember(self, state: Replay, context: Context) -> Replay:
        config = context.config
        assert context.history is not None  # Ensured by `history_episodes`.
        return insert(state, context.history, config.num_steps, gamma=config.gamma)

    def update_policy(
        self, state: Replay, actor_critic: ActorCritic, context: Context, key: jax.Array
    ) -> tuple[Replay, ActorCritic, Metrics]:
        # The replay's returns are in the environment's unit, the value's targets in
        # that of the normalized reward.
        scale = return_scale(state) / context.reward_scale

        def objective(params: Any, index: jax.Array, weight: jax.Array) -> Any:
            observation = state.observation[index]
            observation = normalization.normalize(context.normalizer, observation)
            parameters = context.policy(params["policy"], observation)
            (critic,) = params["values"]
            total, advantage = loss(
                context.distribution.log_prob(parameters, state.action[index]),
                context.value(critic, observation),
                state.return_[index] / context.reward_scale,
                weight=weight,
                scale=scale,
                value_coefficient=self.sil_value_coefficient,
            )
            return self.sil_coefficient * total, advantage

        def step(carry: Any, key: jax.Array) -> Any:
            actor_critic, priority = carry
            replay = state.replace(priority=priority)
            index, weight = sample(key, replay, self.sil_minibatch_size)
            gradient, advantage = jax.grad(objective, has_aux=True)(
                actor_critic.params, index, weight
            )
            actor_critic = ppo.descend(actor_critic, gradient, context.config)
            priority = priority.at[index].set(jnp.maximum(advantage, _MIN_PRIORITY))
            return (actor_critic, priority), jnp.mean(advantage > 0)

        before = (actor_critic, state.priority)
        keys = jax.random.split(key, self.sil_updates)
        after, fraction = jax.lax.scan(step, before, keys)
        filled = jnp.any(state.priority > 0)
        actor_critic, priority = learner.select(filled, after, before)
        metrics = {"sil_fraction": jnp.where(filled, jnp.mean(fraction), jnp.nan)}
        return state.replace(priority=priority), actor_critic, metrics

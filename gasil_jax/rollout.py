"""Collect one batch of experience; keep the running episodes and the last steps."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from gasil_envs import wrappers
from gasil_jax.distributions import Distribution


class Rollout(struct.PyTreeNode):
    """One batch of experience; every field is (time, env, ...).

    Attributes:
      observation: float32 (time, env, obs), before the action, not normalized.
      next_observation: float32 (time, env, obs), after the action. Where an episode
        ended, it is its final observation and not the start of the next episode.
      action: float32 (time, env, action), as drawn from the policy, not clipped; where
        actions are discrete, one-hot.
      log_prob: float32 (time, env), log density, or log probability, of the action when
        it was drawn.
      reward: float32 (time, env), the reward that the environment gives, which may be
        delayed; in an agent's `Context`, what the reward models make of it.
      terminated: bool (time, env), whether the episode terminated with this step: the
        value after it is 0.
      truncated: bool (time, env), whether the episode was cut off with this step: the
        value after it is bootstrapped.
      episode_return: float32 (time, env), the episode's sum of undelayed rewards up to
        this step.
      discounted_return: float32 (time, env), the episode's sum of gamma^t reward up to
        this step, of the environment's own rewards; NaN from the first faulty step on,
        and where the episode was cut short.
      episode_length: int32 (time, env), number of steps up to this one.
      faulty: bool (time, env), whether the physics failed in this step.
      cut_short: bool (time, env), whether the episode was truncated before it reached
        its full length, because it began at an age above 0.
    """

    observation: jax.Array
    next_observation: jax.Array
    action: jax.Array
    log_prob: jax.Array
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    episode_return: jax.Array
    discounted_return: jax.Array
    episode_length: jax.Array
    faulty: jax.Array
    cut_short: jax.Array

    @property
    def ended(self) -> jax.Array:
        """Whether the episode ended with this step, bool (time, env)."""
        return self.terminated | self.truncated

    @property
    def completed(self) -> jax.Array:
        """Whether a whole episode ended with this step, bool (time, env).

        Only returns of such episodes are reported; one that was cut short is left out.
        """
        return self.ended & ~self.cut_short


class EnvironmentStates(struct.PyTreeNode):
    """The running episodes; every field is (env, ...), its sums those of `Rollout`."""

    state: Any  # Brax's `State`
    episode_return: jax.Array
    discounted_return: jax.Array
    discount: jax.Array  # float32, gamma^t
    episode_length: jax.Array  # int32, number of steps so far
    # int32, the age in steps at which the episode began; above 0 in the first one only.
    # The episode is truncated when this plus its length reaches the limit.
    starting_age: jax.Array


class History(struct.PyTreeNode):
    """The last H steps of each of N environments, as a ring buffer over time.

    Attributes:
      observation: float32 (N, H, obs).
      action: float32 (N, H, action).
      reward: float32 (N, H), the reward, never normalized; in an agent's context it may
        be decomposed. NaN in faulty steps, in the last step of an episode that was cut
        short, and where no step is recorded yet.
      ended: bool (N, H), whether the step was the last of its episode.
      cursor: int32 (), index at which the next step is written.
      next_observation: float32 (N, H, obs), after the action; None if it is not kept.
    """

    observation: jax.Array
    action: jax.Array
    reward: jax.Array
    ended: jax.Array
    cursor: jax.Array
    next_observation: jax.Array | None = None

    def in_time(self, ring: jax.Array) -> jax.Array:
        """Return a ring (N, H, ...) of this history in time order, oldest first."""
        return jnp.roll(ring, -self.cursor, axis=1)


def max_episode_steps(env: Any) -> int:
    """Return the environment's limit, after which an episode is truncated, or 1000."""
    return int(getattr(env, "episode_length", 1000))


def _cast(x: Any, dtype: Any) -> jax.Array:
    x = jnp.asarray(x)
    # Outside jit, an array of keys has no `astype`.
    return x if jnp.issubdtype(dtype, jax.dtypes.prng_key) else x.astype(dtype)


def init(
    env: Any, key: jax.Array, num_envs: int, *, age_limit: int | None = None
) -> EnvironmentStates:
    """Start an episode in each of `num_envs` environments.

    Each first episode begins at an age drawn uniformly from [0, age_limit), or at 0 if
    `age_limit` is None. In a task whose episodes never end early, environments that
    start together stay together, and each batch then holds one thin slice of the
    episode (Staggered Environment Resets, arXiv 2511.21011). The key is consumed.
    """
    keys = jax.random.split(key, num_envs + 1)
    state = jax.vmap(env.reset)(keys[:-1])
    starting_age = jnp.zeros(num_envs, jnp.int32)
    if age_limit is not None:
        starting_age = jax.random.randint(keys[-1], (num_envs,), 0, age_limit)
    # A weak type in the first state alone would make JAX compile everything twice.
    state = jax.tree.map(lambda x: _cast(x, jnp.asarray(x).dtype), state)
    # Each field needs its own array: a shared one could not be donated.
    return EnvironmentStates(
        state=state,
        episode_return=jnp.zeros(num_envs, jnp.float32),
        discounted_return=jnp.zeros(num_envs, jnp.float32),
        discount=jnp.ones(num_envs, jnp.float32),
        episode_length=jnp.zeros(num_envs, jnp.int32),
        starting_age=starting_age,
    )


def _restart_all(env: Any, states: Any, ended: jax.Array, *, keys: jax.Array) -> Any:
    """Return the states (env, ...) with a new episode where one has ended."""

    def select(new: jax.Array, old: jax.Array) -> jax.Array:
        is_new = ended.reshape((-1,) + (1,) * (old.ndim - 1))
        return _cast(jnp.where(is_new, new, old), old.dtype)

    return jax.tree.map(select, jax.vmap(env.reset)(keys), states)


def _restart_few(env: Any, states: Any, ended: jax.Array, *, keys: jax.Array) -> Any:
    """Do what `_restart_all` does, but reset an eighth of the environments at a time.

    Few episodes end in a step. Where a reset takes as long as a step, resets of all
    environments would take a third of the time; where it is fast, this is slower.
    """
    num_envs = ended.shape[0]
    at_once = -(-num_envs // 8)
    # Behind those that ended come rows that are out of bounds, and are not written.
    (rows,) = jnp.nonzero(ended, size=num_envs + at_once, fill_value=num_envs)

    def restart(carry: tuple[jax.Array, Any]) -> tuple[jax.Array, Any]:
        done, states = carry
        now = jax.lax.dynamic_slice_in_dim(rows, done, at_once)
        fresh = jax.vmap(env.reset)(keys.at[now].get(mode="clip"))
        states = jax.tree.map(
            lambda old, new: old.at[now].set(_cast(new, old.dtype), mode="drop"),
            states,
            fresh,
        )
        return done + at_once, states

    def some_are_left(carry: tuple[jax.Array, Any]) -> jax.Array:
        return carry[0] < jnp.sum(ended)

    return jax.lax.while_loop(some_are_left, restart, (jnp.int32(0), states))[1]


def collect(
    env: Any,
    policy: Callable[[jax.Array], Any],
    environments: EnvironmentStates,
    key: jax.Array,
    *,
    distribution: Distribution,
    num_steps: int,
    max_episode_steps: int,
    gamma: jax.Array | float,
) -> tuple[EnvironmentStates, Rollout]:
    """Take `num_steps` steps in each environment; ended episodes start again.

    Args:
      env: a single environment with Brax's interface, not wrapped to reset itself.
      policy: observation (env, obs) -> the parameters of the actions' distribution.
      environments: the running episodes.
      key: random key; consumed.
      distribution: the distribution of actions.
      num_steps: number of steps in each environment.
      max_episode_steps: length at which an episode is truncated.
      gamma: discount of `Rollout.discounted_return`.

    If the physics fails (`wrappers.step_is_sound`), the episode terminates with reward
    0 and the step is marked in ``faulty``. If an episode is truncated here, its last
    step also gets the reward that the environment still holds back,
    ``info["held_reward"]``.

    An episode that began at an age above 0 is truncated when its age reaches the limit,
    and marked in ``cut_short``. PPO learns from its steps, but its return is not
    reported.
    """
    num_envs = environments.episode_length.shape[0]
    low, high = wrappers.action_range(env)
    restart = _restart_few if wrappers.resets_slowly(env) else _restart_all

    @jax.named_scope("environment")
    def step_one(state: Any, action: jax.Array) -> Any:
        return env.step(state, distribution.executed(action, low, high))

    def step(carry: EnvironmentStates, key: jax.Array) -> Any:
        action_key, reset_key = jax.random.split(key)
        # The observation may be that of a reset, whose physics may have failed too.
        visible = wrappers.is_sound(carry.state.obs).all(axis=-1)
        observation = jnp.where(visible[:, None], carry.state.obs, 0.0)
        with jax.named_scope("policy"):
            parameters = policy(observation)
        action = distribution.sample(action_key, parameters)
        reset_keys = jax.random.split(reset_key, num_envs)
        stepped = jax.vmap(step_one)(carry.state, action)

        true_reward = stepped.info.get("true_reward", stepped.reward)
        held = stepped.info.get("held_reward", jnp.zeros_like(stepped.reward))
        sound = wrappers.step_is_sound(carry.state.obs, stepped)
        length = carry.episode_length + 1
        true_reward = jnp.where(sound, true_reward, 0.0)
        cut_off = wrappers.truncated(stepped)
        done = stepped.done > 0
        terminated = (done & ~cut_off) | ~sound
        age = carry.starting_age + length
        truncated = ~terminated & (cut_off | (age >= max_episode_steps))
        ended = terminated | truncated
        cut_short = truncated & ~cut_off & (length < max_episode_steps)
        reward = stepped.reward + jnp.where(truncated, held, 0.0)
        reward = jnp.where(sound, reward, 0.0)

        next_observation = jnp.where(sound[:, None], stepped.obs, 0.0)
        episode_return = carry.episode_return + true_reward
        own_reward = jnp.where(sound, reward, jnp.nan)
        discounted_return = carry.discounted_return + carry.discount * own_reward
        transition = Rollout(
            observation=observation,
            next_observation=next_observation,
            action=action,
            log_prob=distribution.log_prob(parameters, action),
            reward=reward,
            terminated=terminated,
            truncated=truncated,
            episode_return=episode_return,
            discounted_return=jnp.where(cut_short, jnp.nan, discounted_return),
            episode_length=length,
            faulty=~sound,
            cut_short=cut_short,
        )

        with jax.named_scope("environment"), jax.named_scope("reset"):
            state = restart(env, stepped, ended, keys=reset_keys)
        carry = EnvironmentStates(
            state=state,
            episode_return=jnp.where(ended, 0.0, episode_return),
            discounted_return=jnp.where(ended, 0.0, discounted_return),
            discount=jnp.where(ended, 1.0, carry.discount * gamma),
            episode_length=jnp.where(ended, 0, length),
            starting_age=jnp.where(ended, 0, carry.starting_age),
        )
        return carry, transition

    return jax.lax.scan(step, environments, jax.random.split(key, num_steps))


def init_history(
    num_envs: int,
    num_steps: int,
    max_episode_steps: int,
    *,
    observation_size: int,
    action_size: int,
    keep_next: bool = False,
    num_episodes: int = 1,
) -> History:
    """Return an empty history, long enough for every episode that ends in a batch.

    Its length H is a multiple of `num_steps`, so that a batch is written in one piece,
    and at least the length of `num_episodes` episodes and a batch. With `keep_next` the
    history also has the observation after each action.
    """
    batches = -(-(num_episodes * max_episode_steps + num_steps) // num_steps)
    length = batches * num_steps

    # Each field needs its own array: a shared one could not be donated.
    def observations() -> jax.Array:
        return jnp.zeros((num_envs, length, observation_size), jnp.float32)

    return History(
        observation=observations(),
        action=jnp.zeros((num_envs, length, action_size), jnp.float32),
        # No episode begins before the first recorded step, and none is valid there.
        reward=jnp.full((num_envs, length), jnp.nan, jnp.float32),
        ended=jnp.ones((num_envs, length), bool),
        cursor=jnp.int32(0),
        next_observation=observations() if keep_next else None,
    )


@jax.named_scope("good_trajectories")
def record(history: History, batch: Rollout) -> History:
    """Return the history with a batch, (time, N, ...), written over the oldest steps.

    The batch's rewards are the environment's own.
    """
    cursor, next_ring = history.cursor, history.next_observation
    if next_ring is not None:
        next_ring = write(next_ring, batch.next_observation, cursor)
    # A NaN marks an episode without a valid return: one with a faulty step, or one that
    # was cut short.
    reward = jnp.where(batch.faulty | batch.cut_short, jnp.nan, batch.reward)
    return History(
        observation=write(history.observation, batch.observation, cursor),
        action=write(history.action, batch.action, cursor),
        reward=write(history.reward, reward, cursor),
        ended=write(history.ended, batch.ended, cursor),
        cursor=(cursor + batch.reward.shape[0]) % history.reward.shape[1],
        next_observation=next_ring,
    )


def write(ring: jax.Array, new: jax.Array, cursor: jax.Array) -> jax.Array:
    """Return a ring (N, H, ...) with a batch (time, N, ...) written at `cursor`."""
    return jax.lax.dynamic_update_slice_in_dim(
        ring, jnp.swapaxes(new, 0, 1), cursor, axis=1
    )


def metrics(batch: Rollout) -> dict[str, jax.Array]:
    """Return the metrics of a batch, (time, env, ...).

    Means over the whole episodes that ended in the batch are NaN if none did.
    """
    completed = batch.completed

    def mean(x: jax.Array) -> jax.Array:
        return jnp.sum(jnp.where(completed, x, 0)) / jnp.sum(completed)

    return {
        "episode_return": mean(batch.episode_return),
        "episode_length": mean(batch.episode_length),
        "episodes": jnp.sum(completed),
        "faulty_steps": jnp.sum(batch.faulty),
    }

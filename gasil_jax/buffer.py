"""The good-trajectory buffer: the steps of the top-K episodes, in fixed arrays.

Paper, section 4.1. An episode is offered to the buffer as a whole once it has ended. It
is ranked by the return of the environment's own reward: R = sum_t gamma^t r_t, or the
undiscounted sum if `buffer_discounts` is false. The capacity is in steps: all
steps that were ever offered are ordered by (return descending, episode, time), and the
first `capacity` of them are kept. So the last episode in the buffer may be cut, and on
a tie the older episode stays. All functions are pure and work under jit, vmap and
shard_map; an empty buffer is a normal state.
"""

import chex
import jax
import jax.numpy as jnp
from flax import struct

# Shape letters: C capacity in steps, E offered episodes, H steps of history per
# environment, N environments.


class GoodTrajectories(struct.PyTreeNode):
    """The best steps so far: best episode first, and in time order within each.

    Attributes:
      observation: float32 (C, obs), not normalized.
      action: float32 (C, action).
      return_: float32 (C,), the return of the step's episode; 0 where empty.
      time: int32 (C,), the step's index in its episode.
      size: int32 (), number of filled steps; they are the first ones.
    """

    observation: jax.Array
    action: jax.Array
    return_: jax.Array
    time: jax.Array
    size: jax.Array

    @property
    def capacity(self) -> int:
        """The largest number of steps that fit."""
        return self.return_.shape[-1]

    @property
    def filled(self) -> jax.Array:
        """Which slots hold a step, bool (C,)."""
        return jnp.arange(self.capacity) < self.size


class History(struct.PyTreeNode):
    """The last H steps of each environment, as a ring buffer over time.

    Attributes:
      observation: float32 (N, H, obs).
      action: float32 (N, H, action).
      reward: float32 (N, H), the reward, never normalized; in an agent's context it may
        be decomposed. NaN in faulty steps, and in the last step of an episode that was
        cut short.
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


class Episodes(struct.PyTreeNode):
    """Ended episodes that are offered to the buffer; length 0 marks an empty entry.

    Attributes:
      return_: float32 (E,), the return that the episode is ranked by.
      length: int32 (E,), number of steps.
      env: int32 (E,), index of the environment that the episode ran in.
      last: int32 (E,), index of its last step in that environment's ring.
    """

    return_: jax.Array
    length: jax.Array
    env: jax.Array
    last: jax.Array


def init_buffer(
    capacity: int, observation_size: int, action_size: int
) -> GoodTrajectories:
    """Return an empty buffer for `capacity` steps."""
    return GoodTrajectories(
        observation=jnp.zeros((capacity, observation_size), jnp.float32),
        action=jnp.zeros((capacity, action_size), jnp.float32),
        return_=jnp.zeros(capacity, jnp.float32),
        time=jnp.zeros(capacity, jnp.int32),
        size=jnp.int32(0),
    )


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
        reward=jnp.zeros((num_envs, length), jnp.float32),
        # No episode begins before the first recorded step.
        ended=jnp.ones((num_envs, length), bool),
        cursor=jnp.int32(0),
        next_observation=observations() if keep_next else None,
    )


def record(
    history: History,
    observation: jax.Array,
    action: jax.Array,
    *,
    reward: jax.Array,
    ended: jax.Array,
    next_observation: jax.Array | None = None,
) -> History:
    """Return the history with a batch written over the oldest steps.

    Args:
      history: the history before the batch.
      observation: float32 (time, N, obs).
      action: float32 (time, N, action).
      reward: float32 (time, N).
      ended: bool (time, N).
      next_observation: float32 (time, N, obs), needed if the history keeps it.
    """
    chex.assert_equal_shape_prefix([observation, action, reward, ended], 2)
    num_steps = observation.shape[0]
    cursor, next_ring = history.cursor, history.next_observation
    if next_ring is not None:
        assert next_observation is not None, "this history keeps next observations"
        next_ring = write(next_ring, next_observation, cursor)
    return History(
        observation=write(history.observation, observation, cursor),
        action=write(history.action, action, cursor),
        reward=write(history.reward, reward, cursor),
        ended=write(history.ended, ended, cursor),
        cursor=(cursor + num_steps) % history.observation.shape[1],
        next_observation=next_ring,
    )


def write(ring: jax.Array, new: jax.Array, cursor: jax.Array) -> jax.Array:
    """Return a ring (N, H, ...) with a batch (time, N, ...) written at `cursor`."""
    return jax.lax.dynamic_update_slice_in_dim(
        ring, jnp.swapaxes(new, 0, 1), cursor, axis=1
    )


def ended_episodes(
    history: History, ended: jax.Array, return_: jax.Array, *, length: jax.Array
) -> Episodes:
    """Return the episodes that ended in the last recorded batch, oldest first.

    Args:
      history: the history after `record` of that batch.
      ended: bool (time, N), whether the episode ended with this step.
      return_: float32 (time, N), the episode's return up to this step, by which it is
        ranked.
      length: int32 (time, N), the episode's number of steps up to this one.
    """
    chex.assert_equal_shape([ended, return_, length])
    num_steps, num_envs = ended.shape
    ring = history.observation.shape[1]
    first = history.cursor - num_steps  # the batch's first index in the ring
    index = (first + jnp.arange(num_steps, dtype=jnp.int32)) % ring
    env = jnp.arange(num_envs, dtype=jnp.int32)
    return Episodes(
        return_=return_.ravel(),
        length=jnp.where(ended, length, 0).ravel(),
        env=jnp.broadcast_to(env, ended.shape).ravel(),
        last=jnp.broadcast_to(index[:, None], ended.shape).ravel(),
    )


def _kept_lengths(buffer: GoodTrajectories) -> jax.Array:
    """Return the lengths of the buffer's episodes, int32 (C,), each at its first step.

    All other entries are 0. An episode ends where the next one starts.
    """
    slot = jnp.arange(buffer.capacity, dtype=jnp.int32)
    starts = buffer.filled & (buffer.time == 0)
    next_start = jax.lax.cummin(jnp.where(starts, slot, buffer.size), reverse=True)
    following = jnp.append(next_start[1:], buffer.size)
    return jnp.where(starts, following - slot, 0)


def insert(
    buffer: GoodTrajectories,
    history: History,
    episodes: Episodes,
    *,
    max_episodes: int | None = None,
) -> GoodTrajectories:
    """Return the buffer with the best of its own and the offered episodes.

    The function sorts whole episodes, not steps, and then gathers every kept step.

    Args:
      buffer: the buffer before the insertion.
      history: the history that holds the steps of the offered episodes.
      episodes: the offered episodes. Those whose return is not finite are rejected, so
        an episode in which any number is not finite must have such a return.
      max_episodes: number of episodes to keep at most; None for any number.
    """
    capacity = buffer.capacity
    slot = jnp.arange(capacity, dtype=jnp.int32)
    kept_length = _kept_lengths(buffer)
    offered = jnp.isfinite(episodes.return_) & (episodes.length > 0)
    length = jnp.concatenate([kept_length, jnp.where(offered, episodes.length, 0)])
    return_ = jnp.concatenate([buffer.return_, episodes.return_])
    # The sort is stable and the buffer's own episodes come first, so that on a tie the
    # older episode stays.
    order = jnp.argsort(jnp.where(length > 0, -return_, jnp.inf), stable=True)
    if max_episodes is not None:
        # Entries of length 0 come last, so the first ones are the best episodes.
        length = length.at[order[max_episodes:]].set(0)
    end = jnp.cumsum(length[order])
    size = jnp.minimum(end[-1], capacity)

    rank = jnp.minimum(jnp.searchsorted(end, slot, side="right"), order.shape[0] - 1)
    source = order[rank]
    time = slot - (end[rank] - length[source])
    is_kept = source < capacity
    kept_index = jnp.where(is_kept, source + time, 0)
    offer = jnp.where(is_kept, 0, source - capacity)
    env = episodes.env[offer]
    ring = history.observation.shape[1]
    recorded_index = (episodes.last[offer] - episodes.length[offer] + 1 + time) % ring

    filled = slot < size

    def gather(kept: jax.Array, recorded: jax.Array) -> jax.Array:
        steps = (kept[kept_index], recorded[env, recorded_index])
        return jnp.where(filled[:, None], jnp.where(is_kept[:, None], *steps), 0.0)

    return GoodTrajectories(
        observation=gather(buffer.observation, history.observation),
        action=gather(buffer.action, history.action),
        return_=jnp.where(filled, return_[source], 0.0),
        time=jnp.where(filled, time, 0),
        size=size,
    )


def sample(
    key: jax.Array,
    buffer: GoodTrajectories,
    num_samples: int,
    *,
    by_return: bool = False,
) -> tuple[jax.Array, jax.Array]:
    """Draw observations (samples, obs) and actions (samples, action) with replacement.

    From an empty buffer they are zeros, so check ``size`` first.

    Args:
      key: random key; consumed.
      buffer: the buffer.
      num_samples: number of steps.
      by_return: draw with probabilities proportional to `return_weights`; otherwise
        uniformly.
    """
    uniform = jax.random.uniform(key, (num_samples,))
    if by_return:
        cumulative = jnp.cumsum(return_weights(buffer))
        index = jnp.searchsorted(cumulative, uniform * cumulative[-1], side="right")
    else:
        index = (uniform * buffer.size).astype(jnp.int32)
    index = jnp.clip(index, 0, jnp.maximum(buffer.size - 1, 0))
    return buffer.observation[index], buffer.action[index]


def return_weights(buffer: GoodTrajectories) -> jax.Array:
    """Return exp((R - best R) / standard deviation of R), (C,); 0 where empty.

    R is the return of the step's episode.
    """
    filled = buffer.filled
    return_ = jnp.where(filled, buffer.return_, 0.0)
    std = jnp.std(return_, where=filled)
    # The best episode comes first.
    excess = (return_ - return_[0]) / jnp.maximum(std, 1e-8)
    return jnp.where(filled, jnp.exp(excess), 0.0)


def mean_return(buffer: GoodTrajectories) -> jax.Array:
    """Return the mean of `return_` over all kept steps, (); NaN if there are none."""
    filled = buffer.filled
    total = jnp.sum(jnp.where(filled, buffer.return_, 0.0))
    return jnp.where(buffer.size > 0, total / jnp.maximum(buffer.size, 1), jnp.nan)

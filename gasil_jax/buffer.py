"""The good-trajectory buffer: the steps of the top-K episodes, in fixed arrays.

Paper, section 4.1. An episode is offered to the buffer as a whole once it has ended. It
is ranked by the return of the environment's own reward, R = sum_t gamma^t r_t. The
capacity is in steps: all steps that were ever offered are ordered by (return
descending, episode, time), and the first `capacity` of them are kept. So the last
episode in the buffer may be cut, and on a tie the older episode stays. All functions
are pure and work under jit, vmap and shard_map; an empty buffer is a normal state.
"""

import chex
import jax
import jax.numpy as jnp
from flax import struct

from gasil_jax.rollout import History

# Shape letters: C capacity in steps, N environments.


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
    ended: jax.Array,
    return_: jax.Array,
    *,
    length: jax.Array,
    max_episodes: int | None = None,
) -> GoodTrajectories:
    """Return the buffer with the best of its own episodes and of a batch's.

    Whole episodes are sorted, not steps; then every kept step is gathered.

    Args:
      buffer: the buffer before the batch.
      history: the history after `rollout.record` of the batch.
      ended: bool (time, N), whether an episode ended with this step. All that did are
        offered to the buffer.
      return_: float32 (time, N), the return that such an episode is ranked by. If it is
        not finite, the episode is rejected; so an episode in which any number is not
        finite must have such a return.
      length: int32 (time, N), the episode's number of steps up to this one.
      max_episodes: number of episodes to keep at most; None for any number.
    """
    chex.assert_equal_shape([ended, return_, length])
    capacity, (num_steps, num_envs) = buffer.capacity, ended.shape
    slot = jnp.arange(capacity, dtype=jnp.int32)
    # An entry of length 0 is no episode.
    offered = jnp.where(ended & jnp.isfinite(return_), length, 0).ravel()
    length = jnp.concatenate([_kept_lengths(buffer), offered])
    return_ = jnp.concatenate([buffer.return_, return_.ravel()])
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
    # The offered entries are the batch's steps, one time step after the other.
    offer = jnp.where(is_kept, 0, source - capacity)
    last = history.cursor - num_steps + offer // num_envs
    env, ring = offer % num_envs, history.observation.shape[1]
    recorded_index = (last - offered[offer] + 1 + time) % ring

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
    key: jax.Array, buffer: GoodTrajectories, num_samples: int
) -> tuple[jax.Array, jax.Array]:
    """Draw observations (samples, obs) and actions (samples, action) with replacement.

    Every step is equally probable. From an empty buffer they are zeros, so check
    ``size`` first. The key is consumed.
    """
    uniform = jax.random.uniform(key, (num_samples,))
    index = (uniform * buffer.size).astype(jnp.int32)
    index = jnp.clip(index, 0, jnp.maximum(buffer.size - 1, 0))
    return buffer.observation[index], buffer.action[index]


def mean_return(buffer: GoodTrajectories) -> jax.Array:
    """Return the mean of `return_` over all kept steps, (); NaN if there are none."""
    filled = buffer.filled
    total = jnp.sum(jnp.where(filled, buffer.return_, 0.0))
    return jnp.where(buffer.size > 0, total / jnp.maximum(buffer.size, 1), jnp.nan)

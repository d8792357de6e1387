"""PPO+NOVELTY, a bonus for what is seldom seen, and PPO+BC+NOVELTY, which also clones.

Each observation falls into one of many cells: it is normalized, projected to a few
random directions, and rounded. With n the number of visits to its cell so far, its
novelty is 1 / sqrt(n) (count-based exploration by hashing, Tang et al. 2017). PPO
maximizes

    r + novelty_coefficient (novelty - its mean over the batch).

The mean is subtracted because a bonus that is never negative would reward the policy
for prolonging its episodes. PPO+NOVELTY is the control of PPO+BC+NOVELTY: the
difference of their returns is the effect of imitation.

PPO+BC+NOVELTY also clones its best episodes. Where episodes have the same return, as
all have before the first reward, the buffer keeps those with the most novelty. So the
policy clones what is new until something is paid, and then what was paid best.
"""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from gasil_jax import normalization
from gasil_jax.agents.behavior_cloning import PPOBC
from gasil_jax.agents.interface import Agent
from gasil_jax.config import number
from gasil_jax.context import Context, Metrics, Sizes

# The numbers of counters, which cells of the same hash share, and of random directions,
# each with a prime that the hash multiplies by.
_COUNTERS, _DIRECTIONS = 2**14, 4
_PRIMES = (73856093, 19349663, 83492791, 49979687)
#: Weight of an episode's novelty, from 0 to 1, in its rank. It decides only between
#: episodes whose returns differ by less than this.
TIE = 1e-3


class Visits(struct.PyTreeNode):
    """How often each cell was visited; float32."""

    count: jax.Array  # (counters,), number of visits to the cells of each counter
    directions: jax.Array  # (obs, directions), random
    offset: jax.Array  # (directions,), where the cells begin, from 0 to 1


class Explorer(struct.PyTreeNode):
    """The state of an agent that seeks what is new; the last two to clone as well."""

    visits: Visits
    buffer: Any = None  # `GoodTrajectories`
    novelty: Any = None  # float32 (env,), sum over the running episode


class PPONovelty(Agent):
    """PPO on the environment's reward plus the centred novelty of where a step leads.

    Attributes:
      novelty_coefficient: weight of the novelty in the reward.
      novelty_cell: width of a cell, in standard deviations of the observations.
    """

    name = "ppo+novelty"

    novelty_coefficient: float = number(0.1, 0.0)
    novelty_cell: float = number(0.5, 0.0, excludes_low=True)

    def init(self, key: jax.Array, sizes: Sizes) -> Any:
        return Explorer(self.init_visits(key, sizes))

    def init_visits(self, key: jax.Array, sizes: Sizes) -> Visits:
        """Return counters of no visits; consumes the key."""
        key, offset_key = jax.random.split(key)
        return Visits(
            count=jnp.zeros(_COUNTERS),
            directions=jax.random.normal(key, (sizes.observation, _DIRECTIONS)),
            offset=jax.random.uniform(offset_key, (_DIRECTIONS,)),
        )

    def count(self, visits: Visits, context: Context) -> Visits:
        """Return the counters with a batch's visits."""
        visited = self._counters(visits, context).ravel()
        return visits.replace(count=visits.count.at[visited].add(1.0))

    def novelty(self, visits: Visits, context: Context) -> jax.Array:
        """Return the novelty of each next observation, (time, env), from 0 to 1."""
        count = visits.count[self._counters(visits, context)]
        return jax.lax.rsqrt(jnp.maximum(count, 1.0))

    def _counters(self, visits: Visits, context: Context) -> jax.Array:
        """Return the index of each next observation's counter, int32 (time, env)."""
        observation = normalization.normalize(
            context.normalizer, context.rollout.next_observation
        )
        along = observation @ visits.directions / self.novelty_cell
        offset, primes = (
            jax.lax.broadcast_to_rank(x, along.ndim)
            for x in (visits.offset, jnp.array(_PRIMES, jnp.int32))
        )
        cell = jnp.floor(along + offset).astype(jnp.int32)
        mixed = jnp.sum(cell * primes, axis=-1)
        return (mixed ^ (mixed >> 15)) & (_COUNTERS - 1)

    def follow_novelty(
        self, total: jax.Array, visits: Visits, context: Context
    ) -> tuple[jax.Array, jax.Array]:
        """Return the sums of the running episodes' novelty after and in a batch.

        Args:
          total: float32 (env,), the sums before the batch.
          visits: the counters with the batch's visits.
          context: the iteration's data.

        Returns:
          The sums after the batch, (env,); and up to each of its steps, (time, env).
        """

        def add(total: jax.Array, step: Any) -> Any:
            novelty, ended = step
            total += novelty
            return jnp.where(ended, 0.0, total), total

        steps = self.novelty(visits, context), context.rollout.ended
        return jax.lax.scan(add, total, steps)

    def remember(self, state: Any, context: Context) -> Any:
        return state.replace(visits=self.count(state.visits, context))

    def update_and_reward(
        self, state: Any, context: Context, key: jax.Array
    ) -> tuple[Any, jax.Array, Metrics]:
        novelty = self.novelty(state.visits, context)
        bonus = self.novelty_coefficient * (novelty - jnp.mean(novelty))
        metrics = {"novelty": jnp.mean(novelty)}
        return state, context.rollout.reward + bonus, metrics


class PPOBCNovelty(PPONovelty, PPOBC):
    """PPO+NOVELTY, then cloning of the buffer, which keeps the more novel of equals."""

    name = "ppo+bc+novelty"

    def init(self, key: jax.Array, sizes: Sizes) -> Explorer:
        return Explorer(
            self.init_visits(key, sizes),
            buffer=self.init_buffer(sizes),
            novelty=jnp.zeros(sizes.num_envs),
        )

    def remember(self, state: Explorer, context: Context) -> Explorer:
        batch, visits = context.rollout, self.count(state.visits, context)
        novelty, total = self.follow_novelty(state.novelty, visits, context)
        return_ = batch.discounted_return + TIE * total / batch.episode_length
        return Explorer(visits, self.insert(state.buffer, context, return_), novelty)

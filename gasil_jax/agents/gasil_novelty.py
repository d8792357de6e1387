"""PPO+GASIL+NOVELTY: explore where rewards are sparse, imitate what is better.

PPO maximizes the environment's reward r, a bonus b from the discriminator in its
centred form, which pays nothing on average (see `adversarial`), and one for novelty n
(see `novelty`), both with weights that follow rewards and returns:

    r + alpha q b + novelty_coefficient (1 - d g) (n - its mean over the batch).

Rewards are dense, with d up to 1, if all steps have one of about the same size, and
sparse if few have: d is the share of a batch's steps that would have rewards if all
that are not 0 were of one size,

    d = mean(|r|)^2 / mean(r^2).

Let m be the mean return of the policy's whole episodes over the latest batches,
discounted as the buffer ranks them, m_0 the lowest m so far, R_1 the best return of an
episode, and s what rewards are divided by, so that their unit does not matter. Then

    g = clip((m - m_0) / (R_1 - m_0 + 0.01 s), 0, 1)

is the share that the policy has of what was ever gained. So with sparse rewards the
policy always explores. With dense ones PPO learns by itself, and novelty ends as the
policy comes to return what its best episodes do.

Of the buffer, only episodes with a return above m are imitated, as self-imitation
learning (Oh et al. 2018) uses steps whose return is above the value. With R the mean
return over their steps,

    q = clip((R - m) / (R_1 - m_0 + 0.01 s), 0, 1)

is the share that the policy still lacks; 0 if no episode is better. The buffer ranks
episodes by their return plus 0.001 s times their novelty, the sum over their steps from
0 to 1. So where all returns are equal, as before the first reward, the policy imitates
what is new, with a weight q below 0.1.
"""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from gasil_jax.agents.adversarial import BONUSES, PPOGASIL
from gasil_jax.agents.novelty import TIE, PPONovelty, Visits
from gasil_jax.buffer import GoodTrajectories, mean_return
from gasil_jax.config import choice, number
from gasil_jax.context import Context, Metrics, Sizes
from gasil_jax.learner import Learner
from gasil_jax.rollout import Rollout

# What a batch's episodes still weigh in the policy's mean return after the next batch.
_LATEST = 0.9
# Added to the gain of which g and q are shares, in units of s: q is below 0.1 for
# novelty alone.
_GAIN = 0.01
# Returns that differ by less than this share of their size are equal: float32 sums of
# equal returns differ by less.
_EQUAL = 1e-3


class Returns(struct.PyTreeNode):
    """What the policy's episodes returned; all float32 ()."""

    weight: jax.Array  # sum of the latest episodes' weights
    total: jax.Array  # weighted sum of their returns
    lowest: jax.Array  # m_0; the largest float32 before the first episode

    @property
    def mean(self) -> jax.Array:
        """The mean m, (); 0 before the first episode."""
        return self.total / jnp.maximum(self.weight, 1e-8)


class ImitatingExplorer(struct.PyTreeNode):
    """The state of the agent."""

    visits: Visits
    discriminator: Learner
    buffer: GoodTrajectories
    novelty: jax.Array  # float32 (env,), sum over the running episode
    returns: Returns


def no_returns() -> Returns:
    """Return the sums before the first episode."""
    # Each field needs its own array: a shared one could not be donated.
    largest = jnp.float32(jnp.finfo(jnp.float32).max)
    return Returns(jnp.zeros(()), jnp.zeros(()), largest)


def follow(returns: Returns, batch: Rollout) -> Returns:
    """Return the sums with a batch's whole episodes, of which the return is valid."""
    return_ = batch.discounted_return
    counted = batch.completed & jnp.isfinite(return_)
    after = returns.replace(
        weight=_LATEST * returns.weight + jnp.sum(counted),
        total=_LATEST * returns.total + jnp.sum(jnp.where(counted, return_, 0.0)),
    )
    lowest = jnp.minimum(returns.lowest, after.mean)
    return after.replace(lowest=jnp.where(after.weight > 0, lowest, returns.lowest))


def density(reward: jax.Array) -> jax.Array:
    """Return d, how dense the rewards of a batch are, from 0 to 1, ().

    Args:
      reward: float32 (time, env).
    """
    # It is the squared cosine of the angle to rewards of one size.
    squares = jnp.mean(reward**2)
    return jnp.mean(jnp.abs(reward)) ** 2 / jnp.maximum(squares, 1e-12)


def better(buffer: GoodTrajectories, returns: Returns) -> GoodTrajectories:
    """Return the buffer without episodes that are no better than the policy's mean."""
    least = returns.mean + _EQUAL * jnp.abs(returns.mean) + 1e-12
    # They come first, because the buffer is sorted by return.
    is_better = buffer.filled & (buffer.return_ > least)
    return buffer.replace(size=jnp.sum(is_better & (returns.weight > 0)))


def shares(
    buffer: GoodTrajectories, returns: Returns, unit: jax.Array | float
) -> tuple[jax.Array, jax.Array]:
    """Return g and q, the shares of the gain that the policy has and lacks, () each.

    Args:
      buffer: the good episodes.
      returns: the policy's returns.
      unit: the number that rewards were divided by, (): the unit of the 0.01.
    """
    good = better(buffer, returns)
    gained = buffer.return_[0] - returns.lowest + _GAIN * unit
    has = jnp.clip((returns.mean - returns.lowest) / gained, 0.0, 1.0)
    lacks = jnp.clip((mean_return(good) - returns.mean) / gained, 0.0, 1.0)
    is_known = (buffer.size > 0) & (returns.weight > 0)
    return jnp.where(is_known, has, 0.0), jnp.where(good.size > 0, lacks, 0.0)


class PPOGASILNovelty(PPONovelty, PPOGASIL):
    """PPO+GASIL and PPO+NOVELTY, each as far as rewards and returns say.

    It has one rule of settings for all tasks, `presets.scaled_with_entropy`.
    """

    name = "ppo+gasil+novelty"

    alpha: float = number(0.05, 0.0)
    bonus: str = choice("centered", BONUSES)

    def init(self, key: jax.Array, sizes: Sizes) -> Any:
        key, discriminator_key = jax.random.split(key)
        return ImitatingExplorer(
            visits=self.init_visits(key, sizes),
            discriminator=self.init_discriminator(discriminator_key, sizes),
            buffer=self.init_buffer(sizes),
            novelty=jnp.zeros(sizes.num_envs),
            returns=no_returns(),
        )

    def remember(self, state: Any, context: Context) -> Any:
        batch, visits = context.rollout, self.count(state.visits, context)
        novelty, total = self.follow_novelty(state.novelty, visits, context)
        assert context.history is not None  # Ensured by `history_episodes`.
        # The history is as long as the longest episode, or a little longer.
        tie = TIE * context.reward_scale * total / context.history.ended.shape[1]
        rank = batch.discounted_return + tie
        return state.replace(
            visits=visits,
            buffer=self.insert(state.buffer, context, rank),
            novelty=novelty,
            returns=follow(state.returns, batch),
        )

    def update_and_reward(
        self, state: Any, context: Context, key: jax.Array
    ) -> tuple[Any, jax.Array, Metrics]:
        has, lacks = shares(state.buffer, state.returns, context.reward_scale)
        exploring = 1.0 - density(context.rollout.reward) * has
        weighted = self.replace(
            alpha=self.alpha * lacks,
            novelty_coefficient=self.novelty_coefficient * exploring,
        )
        good = better(state.buffer, state.returns)
        imitated, reward, metrics = PPOGASIL.update_and_reward(
            weighted, state.replace(buffer=good), context, key
        )
        context = context.replace(rollout=context.rollout.replace(reward=reward))
        _, reward, own = PPONovelty.update_and_reward(weighted, state, context, key)
        own |= {"imitation_weight": lacks, "novelty_weight": exploring}
        own |= self.buffer_metrics(state.buffer)
        return imitated.replace(buffer=state.buffer), reward, metrics | own

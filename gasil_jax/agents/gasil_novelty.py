"""PPO+GASIL+NOVELTY: explore while returns do not rise, imitate what is better.

PPO maximizes the environment's reward r, a bonus b from the discriminator in its
centred form, which pays nothing on average (see `adversarial`), and one for novelty n
(see `novelty`), both with weights that follow the policy's returns:

    r + (1 - p) (alpha q b + novelty_coefficient (n - its mean over the batch)).

Let m be the mean return of the policy's whole episodes over the latest batches,
discounted as the buffer ranks them, M and S mean and standard deviation over five times
as many, and m_0 the lowest m so far. Then p is the learning progress (Oudeyer, Kaplan
and Hafner 2007), the rise of the returns in units of half their spread,

    p = clip(2 (m - M) / S, 0, 1).

So where PPO learns by itself, as from dense rewards, it is left alone; where nothing is
rewarded, or returns have come to a stand, it explores and imitates.

Of the buffer, only episodes with a return above m are imitated, as self-imitation
learning (Oh et al. 2018) uses steps whose return is above the value. With R the mean
return over their steps, and R_1 the best return,

    q = clip((R - m) / (R_1 - m_0 + 0.01 s), 0, 1),

the share of all that was gained since the start that the policy still lacks; 0 if no
episode is better. The buffer ranks episodes by their return plus 0.001 s times their
mean novelty, from 0 to 1, like PPO+BC+NOVELTY's. So where all returns are equal, as
before the first reward, the policy imitates what is new, with a weight q below 0.1. The
number s is what rewards are divided by, so that their unit does not matter.
"""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from gasil_jax.agents.adversarial import BONUSES, PPOGASIL
from gasil_jax.agents.novelty import TIE, PPONovelty, Visits
from gasil_jax.buffer import GoodTrajectories, mean_return
from gasil_jax.config import choice
from gasil_jax.context import Context, Metrics, Sizes
from gasil_jax.learner import Learner
from gasil_jax.rollout import Rollout

# What a batch's episodes still weigh in the moments after the next batch: in those of
# the latest batches, and in those of more.
_LATEST, _MORE = 0.9, 0.98
# Added to the gain that q is a share of, so that q is below 0.1 for novelty alone.
_GAIN = 0.01
# Returns that differ by less than this share of their size are equal: float32 sums of
# equal returns differ by less.
_EQUAL = 1e-3


class Returns(struct.PyTreeNode):
    """Weighted sums of 1, R and R^2 over episodes, and the lowest mean."""

    latest: jax.Array  # float32 (3,)
    more: jax.Array  # float32 (3,)
    lowest: jax.Array  # float32 (), m_0; the largest float32 before the first episode


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
    return Returns(jnp.zeros(3), jnp.zeros(3), largest)


def follow(returns: Returns, batch: Rollout) -> Returns:
    """Return the sums with a batch's whole episodes, of which the return is valid."""
    return_ = batch.discounted_return
    counted = batch.completed & jnp.isfinite(return_)
    return_ = jnp.where(counted, return_, 0.0)
    own = jnp.stack([jnp.sum(x) for x in (counted, return_, return_**2)])
    latest, more = _LATEST * returns.latest + own, _MORE * returns.more + own
    mean, _ = moments(latest)
    lowest = jnp.where(latest[0] > 0, jnp.minimum(returns.lowest, mean), returns.lowest)
    return Returns(latest, more, lowest)


def moments(sums: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the mean and the standard deviation of sums, (3,); 0 without episodes."""
    count, total, squares = sums
    count = jnp.maximum(count, 1e-8)
    mean = total / count
    return mean, jnp.sqrt(jnp.maximum(squares / count - mean**2, 0.0))


def resolution(mean: jax.Array) -> jax.Array:
    """Return the difference up to which returns around a mean are equal, ()."""
    return _EQUAL * jnp.abs(mean) + 1e-12


def progress(returns: Returns) -> jax.Array:
    """Return p, how fast the returns rise, from 0 to 1, ()."""
    mean, deviation = moments(returns.more)
    rise = moments(returns.latest)[0] - mean
    # A steady rise of all returns gives a ratio of 0.8.
    return jnp.clip(2.0 * rise / (deviation + resolution(mean)), 0.0, 1.0)


def better(buffer: GoodTrajectories, returns: Returns) -> GoodTrajectories:
    """Return the buffer without episodes that are no better than the policy's mean."""
    mean, _ = moments(returns.latest)
    # They come first, because the buffer is sorted by return.
    is_better = buffer.filled & (buffer.return_ > mean + resolution(mean))
    return buffer.replace(size=jnp.sum(is_better & (returns.latest[0] > 0)))


def lack(
    good: GoodTrajectories, returns: Returns, unit: jax.Array | float
) -> jax.Array:
    """Return q, the share of the gain that the policy lacks, from 0 to 1, ().

    Args:
      good: the buffer's better episodes, from `better`.
      returns: the policy's returns.
      unit: the number that rewards were divided by, (): the unit of the 0.01.
    """
    mean, _ = moments(returns.latest)
    gained = good.return_[0] - returns.lowest + _GAIN * unit
    share = (mean_return(good) - mean) / gained
    return jnp.where(good.size > 0, jnp.clip(share, 0.0, 1.0), 0.0)


class PPOGASILNovelty(PPONovelty, PPOGASIL):
    """PPO+GASIL and PPO+NOVELTY, each as far as returns say that it is needed.

    It has one setting for all tasks: that of the preset `scaled`, also in `tuned`.
    """

    name = "ppo+gasil+novelty"

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
        tie = TIE * context.reward_scale * total / batch.episode_length
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
        good = better(state.buffer, state.returns)
        exploring = 1.0 - progress(state.returns)
        imitating = exploring * lack(good, state.returns, context.reward_scale)
        faded = self.replace(
            alpha=self.alpha * imitating,
            novelty_coefficient=self.novelty_coefficient * exploring,
        )
        imitated, reward, metrics = PPOGASIL.update_and_reward(
            faded, state.replace(buffer=good), context, key
        )
        context = context.replace(rollout=context.rollout.replace(reward=reward))
        _, reward, own = PPONovelty.update_and_reward(faded, state, context, key)
        own |= {"imitation_weight": imitating, "novelty_weight": exploring}
        own |= self.buffer_metrics(state.buffer)
        return imitated.replace(buffer=state.buffer), reward, metrics | own

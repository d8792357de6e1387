"""Normalize rewards by the standard deviation of their running discounted sums.

This is OpenAI baselines' ``VecNormalize``, with which its ``ppo2`` trains on MuJoCo
tasks. Each environment keeps a running sum of rewards, discounted into the past, which
starts again at 0 with each episode. Rewards are divided by the standard deviation of
all these sums so far. Their mean is not subtracted, so no reward changes its sign.
"""

from typing import Any

import chex
import jax
import jax.numpy as jnp
from flax import struct

from gasil_jax import normalization
from gasil_jax.config import number
from gasil_jax.context import Context, Metrics, Sizes
from gasil_jax.rewards.interface import RewardModel

#: Largest absolute value of a normalized reward, in baselines and by default.
CLIP = 10.0


class RewardNormalizer(struct.PyTreeNode):
    """The running sums and their moments, from which the scale is computed."""

    running: jax.Array  # float32 (env,), sum of gamma^age reward over the episode
    sums: normalization.Normalizer  # moments of all such sums so far, (1,)


def init(num_envs: int) -> RewardNormalizer:
    """Return a normalizer without rewards, whose scale is 1."""
    return RewardNormalizer(jnp.zeros(num_envs, jnp.float32), normalization.init(1))


def update(
    normalizer: RewardNormalizer,
    reward: jax.Array,
    ended: jax.Array,
    *,
    gamma: jax.Array | float,
) -> RewardNormalizer:
    """Return the normalizer updated by a batch of finite rewards, (time, env)."""
    chex.assert_equal_shape([reward, ended])

    def step(running: jax.Array, now: Any) -> Any:
        reward, ended = now
        running = gamma * running + reward
        return jnp.where(ended, 0.0, running), running

    running, sums = jax.lax.scan(step, normalizer.running, (reward, ended))
    return RewardNormalizer(
        running, normalization.update(normalizer.sums, sums[..., None])
    )


def scale(normalizer: RewardNormalizer) -> jax.Array:
    """Return the number that rewards are divided by, (), more than 0."""
    _, std = normalization.moments(normalizer.sums)
    return std[0]


def normalize(
    normalizer: RewardNormalizer, reward: jax.Array, clip: jax.Array | float
) -> jax.Array:
    """Return rewards of any shape divided by `scale` and clipped to +-`clip`.

    If an episode of n steps is paid only at its end, all of its sums but the last are
    0, so `scale` is about the payment divided by sqrt(n). A clip at 10 then makes many
    payments equal if n is above about 100, and almost all if n is near 1000.
    """
    return jnp.clip(reward / scale(normalizer), -clip, clip)


def clipped(
    normalizer: RewardNormalizer, reward: jax.Array, clip: jax.Array | float
) -> jax.Array:
    """Return the share of rewards other than 0 that `normalize` clips, (), or NaN."""
    is_clipped = jnp.abs(reward) > clip * scale(normalizer)
    return jnp.sum(is_clipped) / jnp.sum(reward != 0.0)


class Normalize(RewardModel):
    """Divide rewards by the standard deviation of their running discounted sum.

    As in OpenAI baselines' ppo2. Alpha is then in that unit, not in the environment's.
    It has no effect on agents that do not use the environment's reward.

    Attributes:
      reward_clip: largest absolute value of a normalized reward. If an episode is
        rewarded only at its end, the default clips most rewards to the same number:
        use 1e9, which clips none.
    """

    switch = "normalize_rewards"
    reward_clip: float = number(CLIP, 0.0, excludes_low=True)

    def init(self, key: jax.Array, sizes: Sizes) -> RewardNormalizer:
        return init(sizes.num_envs)

    def update(
        self, state: RewardNormalizer, context: Context, key: jax.Array
    ) -> tuple[RewardNormalizer, Context, jax.Array, Metrics]:
        batch = context.rollout
        state = update(state, batch.reward, batch.ended, gamma=context.config.gamma)
        divisor = scale(state)
        metrics = {
            "reward_scale": divisor,
            "clipped_rewards": clipped(state, batch.reward, self.reward_clip),
        }
        reward = normalize(state, batch.reward, self.reward_clip)
        context = context.replace(
            rollout=batch.replace(reward=reward),
            reward_scale=context.reward_scale * divisor,
        )
        return state, context, jnp.bool_(True), metrics

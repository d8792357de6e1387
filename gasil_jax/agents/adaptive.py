"""PPO+GASIL-adaptive: the weight of imitation follows how much imitation helps.

The environment's reward and the discriminator's bonus are two streams, each with its
own value. With A_r and A_b their advantages, each standardized over the batch, the
policy's advantage is

    (1 - w) A_r + w A_b.

Standardized advantages have no unit, so there is no alpha to tune. The weight w is
`imitation_weight` times two factors between 0 and 1:

- the agreement max(0, corr(A_r, A_b)) over the batch: imitation counts more, the more
  the two advantages favour the same actions;
- the gap clip((R_B - R_pi) / (|R_B| / 4), 0, 1) between R_B, the mean return over the
  buffer's steps, each with its episode's return, and R_pi, the mean over the policy's
  latest episodes, both discounted as the buffer ranks them: imitation counts more, the
  better the buffer is than the policy.

`imitation_rule` names the factors that are used. While the buffer is empty, w is 0.
"""

from collections.abc import Callable, Mapping
from typing import ClassVar

import jax
import jax.numpy as jnp
from flax import struct

from gasil_jax.agents.adversarial import SelfImitatingAgent
from gasil_jax.buffer import GoodTrajectories, mean_return
from gasil_jax.config import choice, number
from gasil_jax.context import Context, Metrics, Sizes
from gasil_jax.learner import Learner
from gasil_jax.rewards import normalization as reward_normalization

# Decay of the moving mean of the policy's returns, for each new episode.
_DECAY = 0.9
# The gap is 1 if the buffer is better by at least this share of its own return.
_FULL_GAP = 0.25

#: The factor of `imitation_weight` in w, as a function of agreement and gap, () each.
RULES: Mapping[str, Callable[[jax.Array, jax.Array], jax.Array]] = {
    "both": lambda agreement, gap: agreement * gap,
    "agreement": lambda agreement, gap: agreement,
    "gap": lambda agreement, gap: gap,
    "fixed": lambda agreement, gap: jnp.float32(1.0),
}


class Adaptive(struct.PyTreeNode):
    """The state of the agent."""

    discriminator: Learner
    # The targets of the bonus's value have the scale of a normalized reward's.
    bonus_normalizer: reward_normalization.RewardNormalizer
    policy_return: jax.Array  # float32 (), moving mean over the latest whole episodes
    has_episodes: jax.Array  # bool (), whether an episode has been counted
    buffer: GoodTrajectories


def follow_return(
    policy_return: jax.Array,
    has_episodes: jax.Array,
    completed: jax.Array,
    *,
    return_: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Return the first two arguments, as in `Adaptive`, after a batch's episodes.

    Args:
      policy_return: float32 (), the moving mean before the batch.
      has_episodes: bool (), whether an episode was counted before the batch.
      completed: bool (time, env), whether a whole episode ended with this step.
      return_: float32 (time, env), its return; NaN if it does not count.
    """
    counted = completed & jnp.isfinite(return_)
    count = jnp.sum(counted)
    mean = jnp.sum(jnp.where(counted, return_, 0.0)) / jnp.maximum(count, 1)
    past = jnp.where(has_episodes, _DECAY**count, 0.0)
    moved = past * policy_return + (1.0 - past) * mean
    return jnp.where(count > 0, moved, policy_return), has_episodes | (count > 0)


def gap(good_return: jax.Array, policy_return: jax.Array) -> jax.Array:
    """Return how much better the buffer is than the policy, from 0 to 1, ()."""
    spread = _FULL_GAP * jnp.abs(good_return) + 1e-8
    return jnp.clip((good_return - policy_return) / spread, 0.0, 1.0)


class PPOGASILAdaptive(SelfImitatingAgent):
    """PPO on two streams, the environment's reward and the discriminator's bonus.

    Where rewards are delayed, its preset also decomposes them.

    Attributes:
      imitation_weight: largest share of imitation in the policy's advantage, in
        ppo+gasil-adaptive.
      imitation_rule: how ppo+gasil-adaptive weights imitation in the policy's
        advantage: by the "agreement" of the two advantages, by the "gap" between the
        buffer's returns and the policy's, by "both", or by neither, "fixed".
    """

    name = "ppo+gasil-adaptive"
    num_streams: ClassVar[int] = 2

    imitation_weight: float = number(0.7, 0.0, 1.0)
    imitation_rule: str = choice("both", RULES)

    def init(self, key: jax.Array, sizes: Sizes) -> Adaptive:
        return Adaptive(
            discriminator=self.init_discriminator(key, sizes),
            bonus_normalizer=reward_normalization.init(sizes.num_envs),
            policy_return=jnp.float32(0.0),
            has_episodes=jnp.bool_(False),
            buffer=self.init_buffer(sizes),
        )

    def update_and_reward(
        self, state: Adaptive, context: Context, key: jax.Array
    ) -> tuple[Adaptive, jax.Array, Metrics]:
        """Train the discriminator, and return both streams, (time, env, 2)."""
        discriminator, bonus, metrics = self.update_and_score(state, context, key)
        batch = context.rollout
        normalizer = reward_normalization.update(
            state.bonus_normalizer, bonus, batch.ended, gamma=context.config.gamma
        )
        past = (state.policy_return, state.has_episodes)
        policy_return, has_episodes = follow_return(
            *past, batch.completed, return_=batch.discounted_return
        )
        metrics |= {"bonus": jnp.mean(bonus), "bonus_std": jnp.std(bonus)}
        metrics |= self.buffer_metrics(state.buffer)
        normalized = reward_normalization.normalize(
            normalizer, bonus, reward_normalization.CLIP
        )
        streams = jnp.stack([batch.reward, normalized], axis=-1)
        state = state.replace(
            discriminator=discriminator,
            bonus_normalizer=normalizer,
            policy_return=policy_return,
            has_episodes=has_episodes,
        )
        return state, streams, metrics

    def mix(
        self, state: Adaptive, advantages: jax.Array, context: Context
    ) -> tuple[jax.Array, Metrics]:
        reward, bonus = advantages[..., 0], advantages[..., 1]
        # They are standardized, so this is their correlation.
        agreement = jnp.mean(reward * bonus)
        return_gap = gap(mean_return(state.buffer), state.policy_return)
        factor = RULES[self.imitation_rule](jnp.maximum(agreement, 0.0), return_gap)
        weight = self.imitation_weight * factor
        weight = jnp.where(state.buffer.size > 0, weight, 0.0)
        metrics = {
            "imitation_weight": weight,
            "advantage_correlation": agreement,
            "return_gap": return_gap,
        }
        return (1.0 - weight) * reward + weight * bonus, metrics

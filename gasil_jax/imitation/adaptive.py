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

`Config.imitation_rule` names the factors that are used. While the buffer is empty, w
is 0.
"""

from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp
from flax import struct

from gasil_jax import good_trajectories, reward_normalization
from gasil_jax.config import Config, Hyperparameters
from gasil_jax.imitation import adversarial
from gasil_jax.imitation.interface import Context, Imitation, Metrics, leave_policy
from gasil_jax.learner import Learner
from gasil_jax.rollout import Rollout

# The hyperparameter's own value clips only the environment's rewards.
_BONUS_CLIP = Hyperparameters.reward_clip
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
    """The state of the agent.

    Attributes:
      discriminator: the discriminator D.
      bonus_normalizer: normalizes the bonus, so that the targets of its value have the
        same scale as those of a normalized reward's.
      policy_return: float32 (), moving mean of the returns of the policy's latest
        episodes, discounted as the buffer ranks them; 0 before the first episode.
      has_episodes: bool (), whether an episode has been counted.
    """

    discriminator: Learner
    bonus_normalizer: reward_normalization.RewardNormalizer
    policy_return: jax.Array
    has_episodes: jax.Array


def _init(
    key: jax.Array, config: Config, observation_size: int, action_size: int
) -> Adaptive:
    return Adaptive(
        discriminator=adversarial.init(key, config, observation_size, action_size),
        bonus_normalizer=reward_normalization.init(config.num_envs),
        policy_return=jnp.float32(0.0),
        has_episodes=jnp.bool_(False),
    )


def follow_return(
    policy_return: jax.Array, has_episodes: jax.Array, batch: Rollout
) -> tuple[jax.Array, jax.Array]:
    """Return the moving mean of the policy's returns, updated by a batch's episodes.

    Args:
      policy_return: float32 (), the mean before the batch.
      has_episodes: bool (), whether there were episodes before the batch.
      batch: of the environment's own rewards; episodes that were cut short or have a
        faulty step do not count.

    Returns:
      The mean, and whether there are episodes after the batch.
    """
    counted = batch.completed & jnp.isfinite(batch.discounted_return)
    count = jnp.sum(counted)
    mean = jnp.sum(jnp.where(counted, batch.discounted_return, 0.0)) / jnp.maximum(
        count, 1
    )
    past = jnp.where(has_episodes, _DECAY**count, 0.0)
    moved = past * policy_return + (1.0 - past) * mean
    return jnp.where(count > 0, moved, policy_return), has_episodes | (count > 0)


def _update_and_reward(
    state: Adaptive, context: Context, key: jax.Array
) -> tuple[Adaptive, jax.Array, Metrics]:
    discriminator, bonus, metrics = adversarial.update_and_score(
        state.discriminator, context, key
    )
    batch = context.rollout
    normalizer = reward_normalization.update(
        state.bonus_normalizer, bonus, batch.ended, context.hyperparameters.gamma
    )
    policy_return, has_episodes = follow_return(
        state.policy_return, state.has_episodes, batch
    )
    metrics["bonus"] = jnp.mean(bonus)
    metrics["bonus_deviation"] = jnp.std(bonus)
    normalized = reward_normalization.normalize(normalizer, bonus, _BONUS_CLIP)
    streams = jnp.stack([batch.reward, normalized], axis=-1)
    state = Adaptive(discriminator, normalizer, policy_return, has_episodes)
    return state, streams, metrics


def correlation(advantages: jax.Array) -> jax.Array:
    """Return the correlation of two standardized advantages (time, env, 2), ()."""
    return jnp.mean(advantages[..., 0] * advantages[..., 1])


def gap(good_return: jax.Array, policy_return: jax.Array) -> jax.Array:
    """Return how much better the buffer is than the policy, from 0 to 1, ()."""
    spread = _FULL_GAP * jnp.abs(good_return) + 1e-8
    return jnp.clip((good_return - policy_return) / spread, 0.0, 1.0)


def mix(advantages: jax.Array, weight: jax.Array | float) -> jax.Array:
    """Return (1 - w) A_r + w A_b of advantages (time, env, 2): (time, env)."""
    return (1.0 - weight) * advantages[..., 0] + weight * advantages[..., 1]


def _mix(
    state: Adaptive, advantages: jax.Array, context: Context
) -> tuple[jax.Array, Metrics]:
    advantage_correlation = correlation(advantages)
    buffer = context.good_trajectories
    good_return = good_trajectories.mean_return(buffer)
    return_gap = gap(good_return, state.policy_return)
    factor = RULES[context.config.imitation_rule](
        jnp.maximum(advantage_correlation, 0.0), return_gap
    )
    weight = context.hyperparameters.imitation_weight * factor
    weight = jnp.where(buffer.size > 0, weight, 0.0)
    metrics = {
        "imitation_weight": weight,
        "advantage_correlation": advantage_correlation,
        "return_gap": return_gap,
    }
    return mix(advantages, weight), metrics


#: Where rewards are delayed, its preset also decomposes them.
PPO_GASIL_ADAPTIVE = Imitation(
    _init,
    _update_and_reward,
    leave_policy,
    fields=(
        "imitation_weight",
        "imitation_rule",
        *adversarial.FIELDS,
        *good_trajectories.FIELDS,
    ),
    num_streams=2,
    mix=_mix,
)

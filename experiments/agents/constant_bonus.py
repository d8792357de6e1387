"""The control of PPO+GASIL: PPO with the same bonus alpha in every step.

The paper's bonus -alpha log D is never negative, so it favours long episodes even
without imitation. So does this agent's bonus. How much better PPO+GASIL is than this
agent is the effect of imitation. It is named
``experiments.agents.constant_bonus:PPOBonus``.
"""

import jax

import gasil_jax
from gasil_jax.config import Schedule, number, schedule
from gasil_jax.context import Context, Metrics


class PPOBonus(gasil_jax.Agent):
    """PPO on the environment's reward plus a constant in each step.

    Attributes:
      alpha: the bonus of a step.
      alpha_schedule: factor that multiplies alpha, over environment steps.
    """

    alpha: float = number(0.1, 0.0)
    alpha_schedule: Schedule = schedule()

    def update_and_reward(
        self, state: tuple[()], context: Context, key: jax.Array
    ) -> tuple[tuple[()], jax.Array, Metrics]:
        """Add the bonus to the environment's reward."""
        return state, context.rollout.reward + self.alpha, {}

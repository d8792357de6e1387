"""PPO+BONUS, the control of PPO+GASIL: the same bonus alpha in every step.

The paper's bonus -alpha log D is never negative, so it favours long episodes even
without imitation. So does this agent's bonus. How much better PPO+GASIL is than this
agent is the effect of imitation.
"""

import jax

from gasil_jax.imitation.interface import Context, Imitation, Metrics, leave_policy
from gasil_jax.imitation.none import no_state


def _reward_and_constant(
    state: tuple[()], context: Context, key: jax.Array
) -> tuple[tuple[()], jax.Array, Metrics]:
    return state, context.rollout.reward + context.hyperparameters.alpha, {}


PPO_BONUS = Imitation(
    no_state, _reward_and_constant, leave_policy, fields=("alpha", "alpha_schedule")
)

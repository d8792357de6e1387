"""The control of GASIL: a bonus that is the same in every step, without imitation.

The paper's bonus -alpha log D is never negative, so it pays for staying up. This agent
is paid for staying up alone. What GASIL has over it is what imitation gives.
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

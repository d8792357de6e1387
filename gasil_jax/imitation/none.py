"""No imitation: PPO alone."""

import jax

from gasil_jax.config import Config
from gasil_jax.imitation.interface import Context, Imitation, Metrics, leave_policy


def no_state(
    key: jax.Array, config: Config, observation_size: int, action_size: int
) -> tuple[()]:
    """Return an empty state: the `init` of agents without a state."""
    return ()


def plain_reward(
    state: tuple[()], context: Context, key: jax.Array
) -> tuple[tuple[()], jax.Array, Metrics]:
    """Return the environment's reward: the `update_and_reward` without imitation."""
    return state, context.rollout.reward, {}


PPO = Imitation(no_state, plain_reward, leave_policy, fields=())

"""No imitation: PPO alone."""

import jax

from gasil_jax.config import Config
from gasil_jax.imitation.interface import Context, Imitation, Metrics, leave_policy


def _init(
    key: jax.Array, config: Config, observation_size: int, action_size: int
) -> tuple[()]:
    return ()


def _update_and_reward(
    state: tuple[()], context: Context, key: jax.Array
) -> tuple[tuple[()], jax.Array, Metrics]:
    return state, context.rollout.reward, {}


PPO = Imitation(_init, _update_and_reward, leave_policy)

"""PPO+BC whose cloning fades as the policy becomes as good as its buffer.

The weight of the cloning loss is multiplied by the gap of PPO+GASIL-ADAPTIVE (see
`gasil_jax.agents.adaptive`): how much higher the buffer's returns are than the
policy's, from 0 to 1. If the gap is 0, the policy takes no cloning step. The agent is
named ``experiments.agents.adaptive_cloning:PPOBCAdaptive``.
"""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

import gasil_jax
from gasil_jax.agents.adaptive import follow_return, gap
from gasil_jax.buffer import GoodTrajectories, mean_return
from gasil_jax.context import Context, Metrics, Sizes
from gasil_jax.ppo import ActorCritic


class AdaptiveCloningState(struct.PyTreeNode):
    """The buffer, and a moving mean of the returns of the policy's episodes."""

    buffer: GoodTrajectories
    policy_return: jax.Array
    has_episodes: jax.Array


class PPOBCAdaptive(gasil_jax.PPOBC):
    """PPO+BC whose cloning has the gap between buffer and policy as a factor."""

    def init(self, key: jax.Array, sizes: Sizes) -> AdaptiveCloningState:
        """Return the state before the first batch."""
        return AdaptiveCloningState(
            self.init_buffer(sizes), jnp.float32(0.0), jnp.bool_(False)
        )

    def remember(
        self, state: AdaptiveCloningState, context: Context
    ) -> AdaptiveCloningState:
        """Insert a batch's episodes into the buffer, and follow the policy's return."""
        batch, past = context.rollout, (state.policy_return, state.has_episodes)
        return_ = batch.discounted_return
        followed = follow_return(*past, batch.completed, return_=return_)
        buffer = self.insert(state.buffer, context, return_)
        return AdaptiveCloningState(buffer, *followed)

    def update_policy(
        self, state: Any, actor_critic: ActorCritic, context: Context, key: jax.Array
    ) -> tuple[Any, ActorCritic, Metrics]:
        """Take gradient steps on the cloning loss as far as the buffer is better."""
        # NaN for an empty buffer.
        factor = gap(mean_return(state.buffer), state.policy_return)
        coefficient = factor * self.behavior_cloning_coefficient
        weighted = self.replace(behavior_cloning_coefficient=coefficient)
        _, cloned, metrics = super(PPOBCAdaptive, weighted).update_policy(
            state, actor_critic, context, key
        )
        policy = jax.tree.map(
            lambda new, old: jnp.where(factor > 0, new, old),
            cloned.policy,
            actor_critic.policy,
        )
        metrics["return_gap"] = factor
        return state, actor_critic.replace(policy=policy), metrics

"""PPO+BC: PPO and behaviour cloning of the good trajectories (paper, section 5.1).

After PPO's gradient steps the policy takes further ones, with the same optimizer, on
minibatches of the good-trajectory buffer B. They minimize

    -behavior_cloning_coefficient E_B[log pi(a | s)].

While the buffer is empty, the policy is left as it is.

PPO+BC-ADAPTIVE multiplies the coefficient by the gap of PPO+GASIL-ADAPTIVE (see
`adaptive`): how much higher the buffer's returns are than the policy's, from 0 to 1. So
cloning fades as the policy becomes as good as the buffer. If the gap is 0, the policy
takes no cloning step.
"""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from gasil_jax import good_trajectories, learner, normalization, ppo
from gasil_jax.agents.adaptive import follow_return, gap
from gasil_jax.agents.buffered import BufferedAgent
from gasil_jax.config import count, number
from gasil_jax.context import Context, Metrics, Sizes
from gasil_jax.good_trajectories import GoodTrajectories
from gasil_jax.learner import Learner
from gasil_jax.ppo import ActorCritic


class PPOBC(BufferedAgent):
    """PPO on the environment's reward, then cloning of the buffer, which is its state.

    Attributes:
      behavior_cloning_coefficient: weight of the cloning loss of PPO+BC.
      behavior_cloning_updates: gradient steps on PPO+BC's cloning loss in an iteration.
      behavior_cloning_minibatch_size: good steps in one gradient step on PPO+BC's
        cloning loss.
    """

    name = "ppo+bc"

    behavior_cloning_coefficient: float = number(0.1, 0.0)
    behavior_cloning_updates: int = count(10)
    behavior_cloning_minibatch_size: int = count(64)

    def update_policy(
        self,
        state: GoodTrajectories,
        actor_critic: ActorCritic,
        context: Context,
        key: jax.Array,
    ) -> tuple[GoodTrajectories, ActorCritic, Metrics]:
        """Take gradient steps on the cloning loss, if the buffer is not empty."""

        def objective(params: Any, observation: jax.Array, action: jax.Array) -> Any:
            parameters = context.policy(params, observation)
            value = -jnp.mean(context.distribution.log_prob(parameters, action))
            return self.behavior_cloning_coefficient * value, value

        def step(policy: Learner, key: jax.Array) -> Any:
            observation, action = self.sample(
                state, key, self.behavior_cloning_minibatch_size
            )
            observation = normalization.normalize(context.normalizer, observation)
            gradient, value = jax.grad(objective, has_aux=True)(
                policy.params, observation, action
            )
            return ppo.descend_one(policy, gradient, context.config), value

        cloned, values = jax.lax.scan(
            step,
            actor_critic.policy,
            jax.random.split(key, self.behavior_cloning_updates),
        )
        filled = state.size > 0
        policy = learner.select(filled, cloned, actor_critic.policy)
        cloning_loss = jnp.where(filled, jnp.mean(values), jnp.nan)
        metrics = {
            "behavior_cloning_loss": cloning_loss,
            **self.buffer_metrics(state),
        }
        return state, actor_critic.replace(policy=policy), metrics


class AdaptiveCloningState(struct.PyTreeNode):
    """The state of PPO+BC-ADAPTIVE; see `adaptive.Adaptive`."""

    buffer: GoodTrajectories
    policy_return: jax.Array
    has_episodes: jax.Array


class PPOBCAdaptive(PPOBC):
    """PPO+BC whose cloning has the gap between buffer and policy as a factor."""

    name = "ppo+bc-adaptive"

    def init(self, key: jax.Array, sizes: Sizes) -> AdaptiveCloningState:
        """Return the state before the first batch."""
        return AdaptiveCloningState(
            self.init_buffer(sizes), jnp.float32(0.0), jnp.bool_(False)
        )

    def good_trajectories(self, state: AdaptiveCloningState) -> GoodTrajectories:
        """Return the buffer in a state."""
        return state.buffer

    def remember(
        self, state: AdaptiveCloningState, context: Context
    ) -> AdaptiveCloningState:
        """Insert a batch's episodes into the buffer, and follow the policy's return."""
        batch, past = context.rollout, (state.policy_return, state.has_episodes)
        followed = follow_return(*past, batch.completed, return_=self.ranked_by(batch))
        return AdaptiveCloningState(self.insert(state.buffer, context), *followed)

    def update_policy(
        self, state: Any, actor_critic: ActorCritic, context: Context, key: jax.Array
    ) -> tuple[Any, ActorCritic, Metrics]:
        """Take gradient steps on the cloning loss as far as the buffer is better."""
        good_return = good_trajectories.mean_return(state.buffer)
        factor = gap(good_return, state.policy_return)  # NaN for an empty buffer.
        coefficient = factor * self.behavior_cloning_coefficient
        weighted = self.replace(behavior_cloning_coefficient=coefficient)
        _, cloned, metrics = super(PPOBCAdaptive, weighted).update_policy(
            state.buffer, actor_critic, context, key
        )
        policy = learner.select(factor > 0, cloned.policy, actor_critic.policy)
        metrics["return_gap"] = factor
        return state, actor_critic.replace(policy=policy), metrics

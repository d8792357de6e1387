"""PPO+BC: PPO and behaviour cloning of the good trajectories (paper, section 5.1).

After PPO's gradient steps the policy takes further ones, with the same optimizer, on
minibatches of the good-trajectory buffer B. They minimize

    -behavior_cloning_coefficient E_B[log pi(a | s)].

While the buffer is empty, the policy is left as it is.
"""

from typing import Any

import jax
import jax.numpy as jnp

from gasil_jax import buffer as good_trajectories
from gasil_jax import learner, normalization, ppo
from gasil_jax.agents.buffered import BufferedAgent
from gasil_jax.config import count, number
from gasil_jax.context import Context, Metrics
from gasil_jax.learner import Learner
from gasil_jax.ppo import ActorCritic


class PPOBC(BufferedAgent):
    """PPO on the environment's reward, then cloning of the buffer.

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
        self, state: Any, actor_critic: ActorCritic, context: Context, key: jax.Array
    ) -> tuple[Any, ActorCritic, Metrics]:
        buffer = state.buffer

        def objective(params: Any, observation: jax.Array, action: jax.Array) -> Any:
            parameters = context.policy(params, observation)
            value = -jnp.mean(context.distribution.log_prob(parameters, action))
            return self.behavior_cloning_coefficient * value, value

        def step(policy: Learner, key: jax.Array) -> Any:
            observation, action = good_trajectories.sample(
                key, buffer, self.behavior_cloning_minibatch_size
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
        filled = buffer.size > 0
        policy = learner.select(filled, cloned, actor_critic.policy)
        cloning_loss = jnp.where(filled, jnp.mean(values), jnp.nan)
        metrics = {"behavior_cloning_loss": cloning_loss, **self.buffer_metrics(buffer)}
        return state, actor_critic.replace(policy=policy), metrics

"""PPO+BC: PPO and behaviour cloning of the good trajectories (paper, section 5.1).

After PPO's gradient steps the policy takes further ones, with the same optimizer, on
minibatches of the good-trajectory buffer B. They minimize

    -behavior_cloning_coefficient E_B[log pi(a | s)].

While the buffer is empty, the policy is left as it is.
"""

from typing import Any

import jax
import jax.numpy as jnp

from gasil_jax import good_trajectories, learner, normalization, ppo
from gasil_jax.imitation.interface import Context, Imitation, Metrics
from gasil_jax.imitation.none import no_state, plain_reward
from gasil_jax.learner import Learner
from gasil_jax.networks import gaussian_log_prob
from gasil_jax.ppo import ActorCritic


def loss(mean: jax.Array, log_std: jax.Array, action: jax.Array) -> jax.Array:
    """Return the mean negative log likelihood of actions (steps, action), ()."""
    return -jnp.mean(gaussian_log_prob(mean, log_std, action))


def _update_policy(
    state: tuple[()], actor_critic: ActorCritic, context: Context, key: jax.Array
) -> tuple[tuple[()], ActorCritic, Metrics]:
    config = context.config
    coefficient = context.hyperparameters.behavior_cloning_coefficient

    def objective(params: Any, observation: jax.Array, action: jax.Array) -> Any:
        mean, log_std = context.policy(params, observation)
        value = loss(mean, log_std, action)
        return coefficient * value, value

    def step(policy: Learner, key: jax.Array) -> Any:
        observation, action = good_trajectories.sample(
            key,
            context.good_trajectories,
            config.behavior_cloning_minibatch_size,
            config.sample_by_return,
        )
        observation = normalization.normalize(context.normalizer, observation)
        gradient, value = jax.grad(objective, has_aux=True)(
            policy.params, observation, action
        )
        return ppo.descend_one(policy, gradient, context.hyperparameters), value

    cloned, values = jax.lax.scan(
        step,
        actor_critic.policy,
        jax.random.split(key, config.behavior_cloning_updates),
    )
    filled = context.good_trajectories.size > 0
    policy = learner.select(filled, cloned, actor_critic.policy)
    cloning_loss = jnp.where(filled, jnp.mean(values), jnp.nan)
    metrics = {"behavior_cloning_loss": cloning_loss}
    return state, actor_critic.replace(policy=policy), metrics


PPO_BC = Imitation(
    no_state,
    plain_reward,
    _update_policy,
    fields=(
        *good_trajectories.FIELDS,
        "behavior_cloning_coefficient",
        "behavior_cloning_updates",
        "behavior_cloning_minibatch_size",
    ),
)

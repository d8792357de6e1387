"""PPO+BC: behaviour cloning of the good trajectories beside PPO (paper, section 5.1).

After PPO's own steps the policy descends, with the same optimizer, the loss

    -behavior_cloning_coefficient E_B[log pi(a | s)]

on minibatches of the good-trajectory buffer. Nothing happens while it is empty.
"""

from typing import Any

import jax
import jax.numpy as jnp

from gasil_jax import good_trajectories, normalization, ppo
from gasil_jax.config import Config
from gasil_jax.imitation.interface import Context, Imitation, Metrics
from gasil_jax.imitation.none import no_state, plain_reward
from gasil_jax.networks import gaussian_log_prob


def loss(mean: jax.Array, log_std: jax.Array, action: jax.Array) -> jax.Array:
    """Mean negative log likelihood of `action`, (steps, action): -> ()."""
    return -jnp.mean(gaussian_log_prob(mean, log_std, action))


def _update_policy(
    state: tuple[()],
    params: Any,
    optimizer_state: Any,
    learning_rate: jax.Array | float,
    context: Context,
    key: jax.Array,
) -> tuple[tuple[()], Any, Any, Metrics]:
    config: Config = context.config
    coefficient = context.hyperparameters.behavior_cloning_coefficient

    def objective(policy: Any, observation: jax.Array, action: jax.Array) -> Any:
        mean, log_std = context.policy(policy, observation)
        value = loss(mean, log_std, action)
        return coefficient * value, value

    def step(carry: Any, key: jax.Array) -> Any:
        observation, action = good_trajectories.sample(
            key, context.good_trajectories, config.behavior_cloning_minibatch_size
        )
        observation = normalization.normalize(context.normalizer, observation)
        policy, policy_state = carry
        gradient, value = jax.grad(objective, has_aux=True)(policy, observation, action)
        carry = ppo.descend(
            policy, policy_state, gradient, learning_rate, context.hyperparameters
        )
        return carry, value

    before = (params["policy"], optimizer_state["policy"])
    after, values = jax.lax.scan(
        step, before, jax.random.split(key, config.behavior_cloning_updates)
    )
    has_good = context.good_trajectories.size > 0
    policy, policy_state = jax.tree.map(
        lambda a, b: jnp.where(has_good, a, b), after, before
    )
    params = {**params, "policy": policy}
    optimizer_state = {**optimizer_state, "policy": policy_state}
    cloning_loss = jnp.where(has_good, jnp.mean(values), jnp.nan)
    return state, params, optimizer_state, {"behavior_cloning_loss": cloning_loss}


PPO_BC = Imitation(
    no_state,
    plain_reward,
    _update_policy,
    fields=(
        *("buffer_steps", "max_buffer_steps", "behavior_cloning_coefficient"),
        *("behavior_cloning_updates", "behavior_cloning_minibatch_size"),
    ),
)

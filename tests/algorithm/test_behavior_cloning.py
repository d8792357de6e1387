"""PPO+BC-ADAPTIVE: its weight of cloning against NumPy, and PPO where that is 0."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_train import SMALL

import gasil_jax
from gasil_jax.testing import example_context

ENV, KEY = gasil_jax.make_env("point_mass"), jax.random.key(0)
CLONING = SMALL["ppo+bc-adaptive"]


@functools.cache
def context_and_state():
    context = jax.jit(lambda key: example_context(ENV, CLONING, key))(KEY)
    sizes = gasil_jax.context.sizes_of(ENV, CLONING.config.num_envs, 200)
    return context, CLONING.agent.remember(CLONING.agent.init(KEY, sizes), context)


@functools.cache
def networks():
    return gasil_jax.init(ENV, CLONING, KEY).actor_critic


def cloned(agent, state):
    """The policy after cloning in the context, and the metrics."""
    (context, _), before = context_and_state(), networks()
    update = jax.jit(lambda x: agent.update_policy(x, before, context, KEY)[1:])
    actor_critic, metrics = update(state)
    return actor_critic.policy, metrics


@pytest.mark.parametrize("behind", [0.3, 0.1, 0.0, -0.1])
def test_the_weight_is_the_gap_in_quarters_of_the_buffers_return(behind):
    _, state = context_and_state()
    filled = int(state.buffer.size)
    good = np.array(state.buffer.return_)[:filled].mean()
    policy_return = np.float32(good - behind * abs(good))
    weight = min(max((good - policy_return) / (0.25 * abs(good)), 0.0), 1.0)
    policy, metrics = cloned(
        CLONING.agent, state.replace(policy_return=jnp.float32(policy_return))
    )
    np.testing.assert_allclose(metrics["return_gap"], weight, atol=1e-5)
    # It is PPO+BC with the weight as a factor, and PPO's own policy without weight.
    plain = gasil_jax.PPOBC(
        buffer_steps=CLONING.agent.buffer_steps,
        behavior_cloning_coefficient=0.1 * float(metrics["return_gap"]),
    )
    expected = cloned(plain, state.buffer)[0] if weight > 0 else networks().policy
    jax.tree.map(
        functools.partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-7),
        policy.params,
        expected.params,
    )


def test_the_policy_is_followed_and_left_alone_while_nothing_is_kept():
    context, state = context_and_state()
    batch = context.rollout
    ended = np.array(batch.discounted_return)[np.array(batch.completed)]
    assert len(ended) > 0 and state.has_episodes
    np.testing.assert_allclose(state.policy_return, ended.mean(), rtol=1e-5)
    empty = state.replace(buffer=state.buffer.replace(size=jnp.int32(0)))
    policy, metrics = cloned(CLONING.agent, empty)
    assert np.isnan(metrics["return_gap"])
    jax.tree.map(np.testing.assert_array_equal, policy.params, networks().policy.params)


def test_equal_episodes_are_not_cloned():
    """Before the first reward PPO+BC holds the policy at its untrained self."""
    _, state = context_and_state()
    buffer = state.buffer.replace(return_=0.0 * state.buffer.return_)
    tied = state.replace(buffer=buffer, policy_return=jnp.float32(0.0))
    policy, metrics = cloned(CLONING.agent, tied)
    assert metrics["return_gap"] == 0.0
    jax.tree.map(np.testing.assert_array_equal, policy.params, networks().policy.params)

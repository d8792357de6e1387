"""While the buffer is empty nothing is imitated, and nothing is learned of it."""

import jax
import numpy as np
import pytest
from test_train import SMALL

import gasil_jax
from gasil_jax.testing import example_context


def assert_equal(left, right):
    """Two pytrees are the same, bit for bit."""
    for a, b in zip(jax.tree.leaves(left), jax.tree.leaves(right), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("agent", ["ppo+bc", "ppo+sil", "ppo+gasil-adaptive"])
def test_nothing_is_imitated_while_the_buffer_is_empty(agent):
    env, key = gasil_jax.make_env("point_mass"), jax.random.key(0)
    # No episode, of 50 steps, ends within a batch of 16 steps in each environment.
    algorithm = SMALL[agent].replace(batch_steps=64, stagger_episodes=False)

    @jax.jit
    def first(key):
        used, state = algorithm.agent, gasil_jax.init(env, algorithm, key)
        context = example_context(env, algorithm, key)
        remembered = used.remember(state.agent, context)
        after, rewards, learned = used.update_and_reward(remembered, context, key)
        after, actor_critic, own = used.update_policy(
            after, state.actor_critic, context, key
        )
        reward = context.rollout.reward
        return state, remembered, reward, rewards, after, actor_critic, learned, own

    state, remembered, reward, rewards, after, actor_critic, learned, own = first(key)
    assert_equal(remembered, state.agent)
    assert_equal(actor_critic, state.actor_critic)
    if agent == "ppo+gasil-adaptive":
        np.testing.assert_array_equal(rewards[..., 0], reward)
        np.testing.assert_array_equal(rewards[..., 1], 0.0)
        assert_equal(after.discriminator, state.agent.discriminator)
    else:
        np.testing.assert_array_equal(rewards, reward)
        assert_equal(after, state.agent)
    unknown = {"ppo+bc": "behavior_cloning_loss", "ppo+sil": "sil_fraction"}.get(
        agent, "discriminator_loss"
    )
    assert np.isnan({**learned, **own}[unknown])

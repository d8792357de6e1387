"""What the tests of an agent of one's own get."""

import jax
import numpy as np
import pytest

import gasil_jax
from gasil_jax.imitation import AGENTS, none
from gasil_jax.testing import example_context


@pytest.mark.parametrize("switched", [False, True])
def test_an_example_is_what_the_first_iteration_gives(monkeypatch, switched):
    """Arrays by their kinds, and the batch by its numbers, which an agent has kept."""
    given = []

    def reward(state, context, key):
        given.append(context)
        return state, context.rollout.reward, {"sum": context.rollout.reward.sum()}

    monkeypatch.setitem(AGENTS, "kept", none.PPO._replace(update_and_reward=reward))
    env, key = gasil_jax.make_env("point_mass", reward_delay=5), jax.random.key(3)
    config = gasil_jax.Config(
        agent="kept",
        batch_steps=256,
        num_envs=2,
        num_epochs=1,
        hidden_sizes=(4,),
        normalize_rewards=switched,
        decompose_rewards=switched,
        learning_rate_schedule=((0.0, 0.5), (1.0, 1.0)),
    )
    example = jax.jit(lambda key: example_context(env, config, key))(key)
    first = jax.jit(
        lambda key: gasil_jax.iterate(env, config, gasil_jax.init(env, config, key))
    )
    _, metrics = first(key)
    kinds = lambda tree: jax.tree.map(lambda x: (x.shape, x.dtype), tree)
    of = lambda x: kinds(x.replace(policy=None, value=None))
    assert of(example) == of(given[-1])
    np.testing.assert_allclose(metrics["sum"], example.rollout.reward.sum(), rtol=1e-5)
    assert example.good_trajectories.size > 0
    np.testing.assert_allclose(example.hyperparameters.learning_rate, 1.5e-4)

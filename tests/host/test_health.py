"""Numbers that are not finite affect one step or update of one member alone."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import test_members
from brax.envs import State
from small_training import SETTINGS

import gasil_jax
from gasil_envs import wrappers
from gasil_jax import evaluation


def as_arrays(tree):
    plain = lambda x: (
        jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x
    )
    return [np.asarray(plain(x)) for x in jax.tree.leaves(tree)]


def assert_others_are_equal(states, others_states):
    """All but the second of three members are the same, bit for bit."""
    others = np.array([0, 2])
    for left, right in zip(as_arrays(states), as_arrays(others_states), strict=True):
        np.testing.assert_array_equal(left[others], right[others])


@pytest.mark.xdist_group("members")
def test_a_nan_in_one_environment_of_one_seed():
    _, first, _ = test_members.compiled()
    is_float = lambda x: jnp.issubdtype(x.dtype, jnp.floating)
    hurt = lambda x: x.at[1, 2].set(jnp.nan) if is_float(x) else x
    environments = first.environments
    physics = jax.tree.map(hurt, environments.state.pipeline_state)
    state = environments.state.replace(pipeline_state=physics)
    clean, clean_metrics = test_members.trained(first, 3)
    after, metrics = test_members.trained(
        first.replace(environments=environments.replace(state=state)), 3
    )

    # One step of the second seed is counted, and its episode is over with it.
    np.testing.assert_array_equal(metrics["faulty_steps"].sum(axis=1), [0, 1, 0])
    assert metrics["skipped_updates"].sum() == 0
    # The agent's state has the good trajectories.
    learned = (after.actor_critic.params, after.agent, after.normalizer)
    for leaf in as_arrays(learned):
        assert np.isfinite(leaf).all()
    # Its return is unknown.
    assert np.isnan(after.history.reward).sum(axis=(1, 2)).tolist() == [0, 1, 0]
    assert_others_are_equal(after, clean)
    assert_others_are_equal(metrics, clean_metrics)


@pytest.mark.xdist_group("members")
def test_an_update_that_is_not_finite_is_skipped_and_flagged():
    _, first, _ = test_members.compiled()
    numbers = first.hyperparameters
    rate = numbers["learning_rate"].at[1].set(jnp.inf)
    wild = first.replace(hyperparameters={**numbers, "learning_rate": rate})
    after, metrics = test_members.trained(wild, 2)
    np.testing.assert_array_equal(metrics["skipped_updates"].sum(axis=1), [0, 2, 0])
    before = as_arrays(first.actor_critic)
    for left, right in zip(as_arrays(after.actor_critic), before, strict=True):
        np.testing.assert_array_equal(left[1], right[1])
    expected, _ = test_members.trained(first, 2)
    assert_others_are_equal(after.actor_critic, expected.actor_critic)


class Fragile:
    """A line, observed far from 0, whose reward alone is NaN beyond a position.

    The first observation of half of the episodes is NaN, too.
    """

    observation_size, action_size, episode_length = 1, 1, 20

    def reset(self, key):
        position = jax.random.uniform(key, (1,), minval=-0.5, maxval=0.5)
        seen = jnp.where(position > 0.0, jnp.nan, position + 100.0)
        return State(position, seen, jnp.float32(0), jnp.float32(0))

    def step(self, state, action):
        position = state.pipeline_state + 0.1 * action
        reward = jnp.where(position[0] > 0.6, jnp.nan, -(position[0] ** 2))
        seen = position + 100.0
        return state.replace(pipeline_state=position, obs=seen, reward=reward)


def test_a_first_observation_is_looked_at_too():
    """It must not reach the buffer, nor the return of an evaluation."""
    small = gasil_jax.algorithm("ppo+bc", **SETTINGS | {"total_steps": 8 * 128})
    env = wrappers.EpisodeLimit(Fragile(), 20)
    train = jax.jit(gasil_jax.make_train(env, small))
    state, metrics = train(jax.random.key(0))
    assert metrics["faulty_steps"].sum() > 0
    assert metrics["skipped_updates"].sum() == 0
    assert state.agent.buffer.size > 0
    assert np.isfinite(state.agent.buffer.observation).all()
    assert abs(state.normalizer.mean - 100.0).max() < 2.0
    scores = jax.jit(
        lambda key: evaluation.evaluate(env, small, state, key=key, num_episodes=20)
    )(jax.random.key(1))
    assert np.isfinite(scores["episode_return"]).all()
    # Such an episode is over with its first step, as in training.
    bad = scores["episode_length"] == 1
    assert bad.any() and not bad.all() and (scores["episode_return"][bad] == 0.0).all()

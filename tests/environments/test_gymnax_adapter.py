"""Our environments under gymnax' interface."""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import gasil_envs
from gasil_envs.gymnax_adapter import GymnaxEnv

SETTINGS = {"reward_delay": 7, "obs_noise": 0.1}


def rollout(env, reset_key, keys):
    """The start, the last state, and what each step gives and was given; one scan."""

    def step(carry, key):
        observation, state = carry
        action = jnp.sin(jnp.arange(2.0) + 9.0 * observation[:2])
        observation, state, *rest = env.step(key, state, action, env.default_params)
        return (observation, state), (action, observation, *rest)

    start = env.reset(reset_key, env.default_params)
    return start, *jax.lax.scan(step, start, keys)


def test_episodes_are_those_of_our_environment():
    env = GymnaxEnv("point_mass", **SETTINGS)
    ours = gasil_envs.make("point_mass", **SETTINGS)
    step, reset = jax.jit(ours.step), jax.jit(ours.reset)
    keys = jax.random.split(jax.random.key(0), 120)
    (first, _), _, steps = jax.jit(lambda *x: rollout(env, *x))(jax.random.key(1), keys)
    state = reset(jax.random.key(1))
    np.testing.assert_allclose(first, state.obs, atol=1e-6)
    for i, key in enumerate(keys):
        action, observation, reward, terminated, truncated, info = jax.tree.map(
            lambda x, i=i: x[i], steps
        )
        stepped = step(state, action)
        np.testing.assert_allclose(info["final_observation"], stepped.obs, atol=1e-5)
        np.testing.assert_allclose(reward, stepped.reward, atol=1e-5)
        true_reward = stepped.info["true_reward"]
        np.testing.assert_allclose(info["true_reward"], true_reward, atol=1e-5)
        assert not terminated and bool(truncated) == (i % 50 == 49)
        state = reset(key) if truncated else stepped
        np.testing.assert_allclose(observation, state.obs, atol=1e-5)


def test_gymnax_own_wrappers_take_it():
    wrappers = pytest.importorskip("gymnax.wrappers")
    env = GymnaxEnv("point_mass", **SETTINGS)
    params = env.default_params
    space = env.action_space(params)
    assert space.shape == (2,) and space.contains(space.sample(jax.random.key(0)))
    flat = wrappers.FlattenObservationWrapper(env)
    assert flat.observation_space(params).shape == (11,)
    logged = wrappers.LogWrapper(flat)
    keys = jax.random.split(jax.random.key(0), 120)
    roll = jax.vmap(lambda key: rollout(logged, key, keys))
    _, _, steps = jax.jit(roll)(jax.random.split(jax.random.key(1), 2))
    *_, rewards, _, truncated, info = steps
    ends = np.flatnonzero(info["returned_episode"][0])
    assert ends.tolist() == np.flatnonzero(truncated[0]).tolist() == [49, 99]
    assert info["returned_episode_lengths"][:, ends].tolist() == [[50, 50]] * 2
    for first, end in zip((0, 50), ends):
        np.testing.assert_allclose(
            info["returned_episode_returns"][:, end],
            rewards[:, first : end + 1].sum(axis=1),
            atol=1e-4,
        )


def test_a_missing_package_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "gymnax.environments", None)
    with pytest.raises(ImportError, match=r"pip install \"gasil_jax\[gymnax\]\""):
        GymnaxEnv("point_mass").action_space()

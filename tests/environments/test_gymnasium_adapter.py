"""Our environments as Gymnasium's, checked by Gymnasium."""

import gymnasium
import jax
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

import gasil_envs
from gasil_envs import gymnasium_adapter


@pytest.mark.parametrize(
    ("name", "settings"),
    [("point_mass", {"reward_delay": 7}), ("hopper", {"physics": "mujoco"})],
)
@pytest.mark.filterwarnings("ignore")
def test_gymnasiums_own_check(name, settings):
    env = gymnasium.make(f"gasil_envs/{name}", **settings)
    check_env(env.unwrapped, skip_render_check=True)


def test_every_name_is_registered():
    for name in gasil_envs.names():
        assert f"gasil_envs/{name}" in gymnasium.registry


def test_an_episode_is_that_of_our_environment():
    ours = gasil_envs.make("point_mass", reward_delay=7)
    theirs = gymnasium.make("gasil_envs/point_mass", reward_delay=7)
    observation, _ = theirs.reset(seed=3)
    key = gymnasium_adapter._key(np.random.Generator(np.random.PCG64(3)))
    state = jax.jit(ours.reset)(key)
    np.testing.assert_array_equal(observation, state.obs)
    step = jax.jit(ours.step)
    for count in range(50):
        action = np.sin([count, 2.0 * count]).astype(np.float32)
        state = step(state, action)
        observation, reward, terminated, truncated, info = theirs.step(action)
        np.testing.assert_array_equal(observation, state.obs)
        assert reward == float(state.reward)
        assert info["true_reward"] == float(state.info["true_reward"])
        assert not terminated and truncated == (count == 49)


def test_a_batch_begins_anew_with_the_step_after_the_last():
    env = gymnasium.make_vec("gasil_envs/point_mass", num_envs=3)
    assert env.metadata["autoreset_mode"] == AutoresetMode.NEXT_STEP
    first, _ = env.reset(seed=1)
    assert env.observation_space.contains(first)
    assert not np.array_equal(first[0], first[1])
    again, _ = env.reset(seed=1)
    np.testing.assert_array_equal(first, again)
    for count in range(1, 103):
        actions = env.action_space.sample()
        observation, reward, terminated, truncated, info = env.step(actions)
        assert env.observation_space.contains(observation)
        assert not terminated.any()
        # 50 steps, and one that begins the next episode.
        np.testing.assert_array_equal(truncated, [count % 51 == 50] * 3)
        if count % 51 == 0:
            np.testing.assert_array_equal(reward, 0.0)
            assert (np.abs(observation[:, :2] - (0.0, -0.2)) <= 0.1 + 1e-6).all()
        assert info["true_reward"].shape == (3,)

"""Our environments under the interfaces of Gymnasium and gymnax."""

import multiprocessing
import sys

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs import Env, State
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers import TimeLimit

import gasil_envs
from gasil_envs import gymnasium_adapter
from gasil_envs.gymnax_adapter import GymnaxEnv


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


def test_a_mask_resets_some_of_a_batch():
    env = gymnasium.make_vec("gasil_envs/point_mass", num_envs=3)
    mask = np.array([False, True, False])
    with pytest.raises(gymnasium.error.ResetNeeded, match="needs a reset before it"):
        env.reset(options={"reset_mask": mask})
    env.reset(seed=1)
    for _ in range(3):
        before = env.step(env.action_space.sample())[0]
    after, _ = env.reset(seed=2, options={"reset_mask": mask})
    np.testing.assert_array_equal(after[~mask], before[~mask])
    assert not np.array_equal(after[1], before[1])
    # The others still end after 50 steps.
    for _ in range(47):
        *_, truncated, _ = env.step(env.action_space.sample())
    np.testing.assert_array_equal(truncated, ~mask)
    for wrong in (mask[:2], ~mask & mask, mask.astype(float)):
        with pytest.raises(ValueError, match="must be 3 bools, one or more of them"):
            env.reset(options={"reset_mask": wrong})


def episode(env, num_steps):
    """The rewards given and earned, and whether it was truncated at its end alone."""
    env.reset(seed=0)
    given, earned, cut = 0.0, 0.0, []
    for _ in range(num_steps):
        _, reward, _, truncated, info = env.step(env.action_space.sample())
        given, earned = given + reward, earned + info["true_reward"]
        cut.append(np.all(truncated))
    assert cut == [False] * (num_steps - 1) + [True]
    return given, earned


@pytest.mark.parametrize(
    "make",
    [
        lambda **x: gymnasium.make("gasil_envs/point_mass", max_episode_steps=30, **x),
        lambda **x: TimeLimit(gymnasium_adapter.GymnasiumEnv("point_mass", **x), 30),
        lambda **x: gymnasium_adapter.GymnasiumEnv(
            "point_mass", max_episode_steps=30, **x
        ),
        lambda **x: gymnasium.make_vec(
            "gasil_envs/point_mass", num_envs=2, max_episode_steps=30, **x
        ),
    ],
)
def test_no_reward_is_lost_where_a_limit_cuts_the_episode(make):
    given, earned = episode(make(reward_delay=20), 30)
    np.testing.assert_allclose(given, earned, rtol=1e-5)
    assert np.all(earned != 0.0)


def test_a_limit_around_it_above_its_own_is_refused():
    env = gymnasium.make("gasil_envs/point_mass", max_episode_steps=51)
    with pytest.raises(ValueError, match=r"max_episode_steps is 51: .* limit is 50"):
        env.reset()


SINGLE_AND_BATCH = pytest.mark.parametrize(
    "make",
    [
        lambda: gymnasium_adapter.GymnasiumEnv("point_mass"),
        lambda: gymnasium_adapter.GymnasiumVectorEnv("point_mass", 3),
    ],
)


def _told_by_a_child(connection, uses):
    for use in uses:
        try:
            use()
        except RuntimeError as error:
            connection.send(str(error))
    connection.close()


@pytest.mark.filterwarnings("ignore")
@SINGLE_AND_BATCH
def test_a_forked_process_is_refused(make):
    """JAX would wait there for ever."""
    env = make()
    env.reset()
    uses = (make, env.reset, lambda: env.step(env.action_space.sample()))
    processes = multiprocessing.get_context("fork")
    ours, theirs = processes.Pipe()
    child = processes.Process(target=_told_by_a_child, args=(theirs, uses))
    child.start()
    for _ in uses:
        assert ours.poll(60)
        assert 'vector_kwargs={"context": "spawn"}' in ours.recv()
    child.join(60)


@SINGLE_AND_BATCH
def test_a_wrong_use_is_told_and_info_has_the_same_entries_after_reset_and_step(make):
    env = make()
    with pytest.raises(gymnasium.error.ResetNeeded, match="needs a reset"):
        env.step(env.action_space.sample())
    _, first = env.reset(seed=0)
    *_, then = env.step(env.action_space.sample())
    describe = lambda info: {key: (type(x), np.shape(x)) for key, x in info.items()}
    assert describe(first) == describe(then)
    assert not np.any(first["true_reward"])
    with pytest.raises(ValueError, match=r"action has shape \(5, 2\): it must have \("):
        env.step(np.zeros((5, 2)))


def test_pictures_show_the_episode():
    env = gymnasium.make("gasil_envs/point_mass", render_mode="rgb_array", width=200)
    env.reset(seed=0)
    first = env.render()
    assert first.shape == (360, 200, 3) and first.dtype == np.uint8
    for _ in range(5):
        env.step(np.ones(2, np.float32))
    assert np.abs(env.render().astype(int) - first).max() > 50
    assert env.metadata["render_fps"] == 10
    with pytest.raises(ValueError, match="it must be 'rgb_array'"):
        gymnasium_adapter.GymnasiumEnv("point_mass", render_mode="ansi")


class Breaking(Env):
    """Its third observation is not a number."""

    observation_size, action_size, backend = 1, 1, "none"

    def reset(self, rng):
        return State(None, jnp.zeros(1), jnp.float32(0), jnp.float32(0))

    def step(self, state, action):
        count = state.obs + 1
        broken = jnp.where(count == 3, jnp.nan, count)
        return state.replace(obs=broken, reward=jnp.float32(1))


def test_a_step_of_failed_physics_terminates_in_every_adapter():
    name = f"{__name__}:Breaking"
    one = gymnasium_adapter.GymnasiumEnv(name)
    many = gymnasium_adapter.GymnasiumVectorEnv(name, 2)
    for env, shape in ((one, (1,)), (many, (2, 1))):
        env.reset(seed=0)
        for count in (1, 2, 3):
            obs, reward, terminated, truncated, _ = env.step(np.zeros(shape))
            np.testing.assert_array_equal(obs, np.full(shape, min(count, 2)))
            np.testing.assert_array_equal(reward, np.full(shape[:-1], count < 3))
            np.testing.assert_array_equal(terminated, np.full(shape[:-1], count == 3))
            assert not np.any(truncated)
    env, key = GymnaxEnv(name), jax.random.key(0)
    _, state = env.reset(key)
    for count in (1, 2, 3):
        _, state, reward, terminated, truncated, info = env.step(
            key, state, jnp.zeros(1)
        )
        assert info["final_observation"] == min(count, 2) and reward == (count < 3)
        assert terminated == (count == 3) and not truncated


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

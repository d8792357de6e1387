"""Environments of other packages: the contract, their limits, what is refused."""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from environment_contract import check_reset_and_step

import gasil_envs
from gasil_envs import pictures, worlds, wrappers
from gasil_jax.host import video

gymnax = pytest.importorskip("gymnax")
from gymnax.environments import environment, spaces  # noqa: E402


# The episodes of some begin at a few places, or at one.
@pytest.mark.parametrize(
    ("name", "same_start"),
    [
        ("gymnax:CartPole-v1", False),
        ("gymnax:Pendulum-v1", False),
        ("gymnax:Breakout-MinAtar", True),
        ("gymnax:Catch-bsuite", True),
        ("navix:Navix-Empty-5x5-v0", True),
    ],
)
def test_reset_and_step(name, same_start):
    pytest.importorskip(name.split(":")[0])
    env = gasil_envs.make(name)
    reset, step = jax.jit(jax.vmap(env.reset)), jax.jit(jax.vmap(env.step))
    check_reset_and_step(env, reset, step, same_start=same_start)


def test_every_environment_of_gymnax_is_built_or_refused_in_a_line():
    refused = []
    for name in worlds.names("gymnax"):
        try:
            env = gasil_envs.make(name)
            assert env.observation_size > 0 and env.episode_length > 0
        except ValueError as error:
            refused.append(str(error))
    assert refused == [
        "env 'gymnax:MNISTBandit-bsuite' downloads data when it is built, which is not "
        "supported"
    ]


def test_an_episode_is_gymnax_own():
    env = gasil_envs.make("gymnax:CartPole-v1")
    theirs, params = gymnax.make("CartPole-v1")
    state, step = env.reset(jax.random.key(3)), jax.jit(env.step)
    inner, _ = state.pipeline_state
    for i in range(200):
        action = jnp.int32(i // 3 % 2)
        observation, inner, reward, terminated, _ = theirs.step_env(
            jax.random.key(0), inner, action, params
        )
        state = step(state, action)
        np.testing.assert_allclose(state.obs, observation, rtol=1e-5, atol=1e-6)
        assert float(state.reward) == float(reward) and bool(state.done) == terminated
        assert not wrappers.truncated(state)
        if terminated:
            break
    assert terminated and i > 5
    # It falls on, and does not start again.
    fallen = step(state, jnp.int32(0))
    assert jnp.abs(fallen.obs[2]) > jnp.abs(state.obs[2])


@pytest.mark.parametrize(
    ("name", "limit"),
    [("gymnax:Pendulum-v1", 200), ("navix:Navix-DoorKey-6x6-v0", 100)],
)
def test_its_own_time_limit_truncates(name, limit):
    pytest.importorskip(name.split(":")[0])
    env = gasil_envs.make(name)
    assert env.episode_length == limit
    zero = wrappers.zero_action(env)
    # Turning on the spot, of which no episode ends.
    step = lambda state, _: (lambda x: (x, (x.done, wrappers.truncated(x))))(
        env.step(state, zero)
    )
    last, (done, truncated) = jax.jit(
        lambda key: jax.lax.scan(step, env.reset(key), length=limit)
    )(jax.random.key(0))
    np.testing.assert_array_equal(done, np.arange(limit) == limit - 1)
    np.testing.assert_array_equal(truncated, done > 0)
    # The final observation is kept: an episode is not started by the step.
    assert last.info["steps"] == limit


def test_random_steps_are_decided_by_the_key_of_the_reset():
    env = gasil_envs.make("gymnax:FourRooms-misc")

    def step(state, _):
        state = env.step(state, jnp.int32(1))
        return state, state.obs

    walk = jax.jit(lambda key: jax.lax.scan(step, env.reset(key), length=30)[1])
    first, again, other = (walk(jax.random.key(x)) for x in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


class Odd(environment.Environment):
    """One whose spaces and observations are given."""

    def __init__(self, space, observe):
        self._space, self._observe = space, observe

    default_params = environment.EnvParams(max_steps_in_episode=7)
    action_space = lambda self, params=None: self._space

    def reset_env(self, key, params):
        return self._observe(0), environment.EnvState(time=0)

    def step_env(self, key, state, action, params):
        assert action.shape == self._space.shape
        state = environment.EnvState(time=state.time + 1.0)
        return self._observe(state.time), state, 1, False, {}


def parts(time):
    clock = jnp.asarray(time).astype(jnp.int8)
    return {"grid": jnp.full((2, 3), clock > 0), "clock": clock}


def broken(time):
    raise OSError("no licence")


DISCRETE, ones = spaces.Discrete(2), lambda time: jnp.ones(3)


@pytest.mark.parametrize(
    ("name", "space", "observe", "message"),
    [
        ("Odd", DISCRETE, parts, "several parts: choose one of clock, grid, as"),
        ("Odd:sky", DISCRETE, parts, "and none is 'sky': choose one of clock"),
        ("Odd", DISCRETE, lambda time: (time,), "of type tuple: they must be arrays"),
        ("Odd", spaces.Tuple([DISCRETE]), ones, "must be in a box or discrete"),
        ("Odd", DISCRETE, broken, "fails within gymnax .* itself: OSError: no licence"),
    ],
)
def test_what_can_not_be_trained_on_is_one_line(
    name, space, observe, message, monkeypatch
):
    monkeypatch.setitem(
        gymnax.registration._registry, "Odd", lambda: Odd(space, observe)
    )
    monkeypatch.setattr(gymnax, "registered_envs", ["Odd"])
    with pytest.raises(ValueError, match=f"env 'gymnax:{name}' .*{message}") as refused:
        gasil_envs.make(f"gymnax:{name}")
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("space", [DISCRETE, spaces.Box(-2.0, 1.0, (2, 2))])
def test_a_part_is_chosen_and_every_dtype_becomes_float32(space, monkeypatch):
    monkeypatch.setitem(gymnax.registration._registry, "Odd", lambda: Odd(space, parts))
    monkeypatch.setattr(gymnax, "registered_envs", ["Odd"])
    env = gasil_envs.make("gymnax:Odd:grid")
    assert env.observation_size == 6 and env.episode_length == 7
    if isinstance(space, spaces.Box):
        assert env.action_size == 4
        low, high = wrappers.action_range(env)
        np.testing.assert_array_equal([low, high], [[-2.0] * 4, [1.0] * 4])
    check_reset_and_step(env, *map(jax.vmap, (env.reset, env.step)), same_start=True)


def test_a_missing_package_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "gymnax", None)
    monkeypatch.delitem(sys.modules, "gasil_envs.of_gymnax", raising=False)
    with pytest.raises(ValueError, match=r'needs the package .*"gasil_jax\[gymnax\]"'):
        gasil_envs.make("gymnax:CartPole-v1")


@pytest.mark.parametrize("name", ["gymnax:Catch-bsuite", "gymnax:Breakout-MinAtar"])
def test_worlds_are_drawn(name):
    """Catch draws itself; MinAtar's planes have a color each."""
    env = gasil_envs.make(name)
    assert pictures.can_draw(env)
    assert not pictures.can_draw(gasil_envs.make("gymnax:CartPole-v1"))
    states = [jax.jit(env.reset)(jax.random.key(0))]
    states.append(jax.jit(env.step)(states[0], jnp.int32(1)))
    frames, _ = video.frames_of(env, [x.pipeline_state for x in states], (160, 120))
    assert frames[0].shape == (120, 160, 3) and (frames[0] != frames[1]).any()
    assert len(np.unique(frames[0].reshape(-1, 3), axis=0)) > 1


def test_control_tasks_are_built_and_robots_that_are_downloaded_refused():
    pytest.importorskip("mujoco_playground")
    env = gasil_envs.make("playground:CartpoleBalance")
    assert (env.observation_size, env.action_size, env.episode_length) == (5, 1, 1000)
    with pytest.raises(ValueError, match="downloads a robot's model"):
        gasil_envs.make("playground:Go1Getup")

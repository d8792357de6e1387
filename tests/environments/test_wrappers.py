"""Wrappers on a scripted environment with given rewards and endings."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs import Env, State

import gasil_envs
from gasil_envs import wrappers


class Scripted(Env):
    """Pays t + 1 at step t and terminates after `length` steps; starts at random."""

    def __init__(self, length):
        self.length = length

    observation_size, action_size, backend = 2, 1, "none"

    def reset(self, rng):
        start = jax.random.uniform(rng)
        zero = jnp.float32(0)
        return State(jnp.int32(0), jnp.stack([zero, start]), zero, zero)

    def step(self, state, action):
        t = state.pipeline_state + 1
        return state.replace(
            pipeline_state=t,
            obs=state.obs.at[0].set(t.astype(jnp.float32)),
            reward=t.astype(jnp.float32),
            done=(t >= self.length).astype(jnp.float32),
        )


def roll(env, steps, key=0):
    def one(state, _):
        state = env.step(state, jnp.zeros(1))
        return state, state

    start = env.reset(jax.random.key(key))
    return start, jax.jit(lambda s: jax.lax.scan(one, s, length=steps)[1])(start)


@pytest.mark.parametrize("delay", [1, 2, 3, 5, 50])
@pytest.mark.parametrize(("terminates", "limit"), [(7, 100), (100, 7)])
def test_delayed_reward_loses_nothing(delay, terminates, limit):
    env = wrappers.EpisodeLimit(Scripted(terminates), limit)
    _, states = roll(wrappers.RewardDelay(env, delay), 7)
    true = np.arange(1.0, 8.0)
    np.testing.assert_array_equal(states.info["true_reward"], true)
    expected = np.zeros(7)
    for first in range(0, 7, delay):
        last = min(first + delay, 7) - 1  # the end falls into the middle of a window
        expected[last] = true[first : last + 1].sum()
    np.testing.assert_array_equal(states.reward, expected)
    assert states.done[-1] == 1.0 and not states.done[:-1].any()


def test_the_phase_of_a_delay_is_seen():
    """The environment and the noise see nothing of it, and episodes begin with 0."""
    delayed = {"reward_delay": 4, "max_episode_steps": 6}
    envs = [
        gasil_envs.make("point_mass", **delayed, **more)
        for more in ({}, {"observe_phase": True})
    ]
    (_, plain), (start, seen) = (roll(env, 6) for env in envs)
    assert envs[1].observation_size == envs[0].observation_size + 1
    np.testing.assert_array_equal(start.obs[-1], 0.0)
    np.testing.assert_array_equal(seen.obs[:, -1], [0.25, 0.5, 0.75, 0.0, 0.25, 0.5])
    np.testing.assert_array_equal(seen.obs[:, :-1], plain.obs)
    np.testing.assert_array_equal(seen.reward, plain.reward)


class WithTrueReward(Scripted):
    """Its reward is shaped; the true one is 1 in every third step."""

    def reset(self, rng):
        return super().reset(rng).replace(info={"true_reward": jnp.float32(0)})

    def step(self, state, action):
        state = super().step(state, action)
        true = (state.pipeline_state % 3 == 0).astype(jnp.float32)
        return state.replace(info={**state.info, "true_reward": true})


def test_an_environments_own_true_reward_survives_a_delay():
    env = wrappers.EpisodeLimit(WithTrueReward(100), 6)
    start, states = roll(wrappers.RewardDelay(env, 2), 6)
    assert start.info["true_reward"] == 0.0
    np.testing.assert_array_equal(states.info["true_reward"], [0, 0, 1, 0, 0, 1])
    np.testing.assert_array_equal(states.reward, [0, 3, 0, 7, 0, 11])


def test_the_limit_truncates_and_an_end_does_not():
    _, cut = roll(wrappers.EpisodeLimit(Scripted(100), 4), 4)
    np.testing.assert_array_equal(cut.done, [0, 0, 0, 1])
    np.testing.assert_array_equal(cut.info["truncation"], [0, 0, 0, 1])
    _, ended = roll(wrappers.EpisodeLimit(Scripted(4), 4), 4)
    np.testing.assert_array_equal(ended.done, [0, 0, 0, 1])
    np.testing.assert_array_equal(ended.info["truncation"], [0, 0, 0, 0])


class Truncating(Scripted):
    """Says itself, and as an integer, that a limit ended its episode."""

    def reset(self, rng):
        return super().reset(rng).replace(info={"truncation": jnp.int32(0)})

    def step(self, state, action):
        state = super().step(state, action)
        info = {**state.info, "truncation": state.done.astype(jnp.int32)}
        return state.replace(info=info)


class OnlyTruncating(Truncating):
    """Says that its episode was cut off, and not that it is over."""

    def step(self, state, action):
        return super().step(state, action).replace(done=jnp.float32(0))


def test_a_truncation_alone_ends_the_episode_and_pays_the_held_reward():
    env = wrappers.EpisodeLimit(OnlyTruncating(4), 7)
    _, cut = roll(wrappers.RewardDelay(env, 3), 4)
    np.testing.assert_array_equal(cut.done, [0, 0, 0, 1])
    np.testing.assert_array_equal(cut.reward, [0, 0, 1 + 2 + 3, 4])


class Counted(Scripted):
    """It counts its steps under a name of one of the wrappers."""

    def __init__(self, name):
        super().__init__(9)
        self.name = name

    def reset(self, rng):
        return super().reset(rng).replace(info={self.name: jnp.int32(0)})


def test_a_wrappers_name_in_an_environments_info_is_refused():
    key = jax.random.key(0)
    with pytest.raises(ValueError, match=r"info\['steps'\] is used by a wrapper"):
        wrappers.EpisodeLimit(Counted("steps"), 9).reset(key)
    for name in ("held_reward", "delay_steps"):
        with pytest.raises(ValueError, match=f"{name}.* is used by a wrapper"):
            wrappers.RewardDelay(Counted(name), 3)
    for name in ("noise_key", "true_observation"):
        with pytest.raises(ValueError, match=f"{name}.* is used by a wrapper"):
            wrappers.ObservationNoise(Counted(name), 0.1).reset(key)
    wrappers.RewardDelay(wrappers.EpisodeLimit(Counted("count"), 9), 3).reset(key)


class Failing(Scripted):
    """Its third step gives numbers that are too large, or none at all."""

    def __init__(self, value, field):
        super().__init__(9)
        self.value, self.field = value, field

    def step(self, state, action):
        stepped = super().step(state, action)
        failed = {self.field: jnp.full_like(getattr(stepped, self.field), self.value)}
        select = lambda a, b: jnp.where(stepped.pipeline_state == 3, a, b)
        return jax.tree.map(select, stepped.replace(**failed), stepped)


@pytest.mark.parametrize("value", [np.nan, np.inf, -2e10])
@pytest.mark.parametrize("field", ["obs", "reward"])
def test_a_step_whose_physics_fails_ends_the_episode(value, field):
    env = wrappers.FaultyStepEnds(wrappers.RewardDelay(Failing(value, field), 2))
    _, states = roll(env, 3)
    np.testing.assert_array_equal(states.done, [0, 0, 1])
    np.testing.assert_array_equal(states.reward, [0, 3, 0])
    np.testing.assert_array_equal(states.info["true_reward"], [1, 2, 0])
    np.testing.assert_array_equal(states.obs[:, 0], [1, 2, 2])
    assert not wrappers.truncated(states).any()
    # Others are as they were.
    states.info.pop("unsound_start")
    _, plain = roll(wrappers.RewardDelay(Scripted(9), 2), 2)
    for same, other in zip(*map(jax.tree.leaves, (states, plain)), strict=True):
        np.testing.assert_array_equal(same[:2], other)


class BadStart(Scripted):
    """Its first observation is not finite."""

    def reset(self, key):
        state = super().reset(key)
        return state.replace(obs=jnp.full_like(state.obs, jnp.nan))


def test_an_episode_whose_first_observation_is_not_finite_ends_with_its_first_step():
    env = wrappers.FaultyStepEnds(BadStart(9))
    np.testing.assert_array_equal(env.reset(jax.random.key(0)).obs, [0, 0])
    _, states = roll(env, 2)
    np.testing.assert_array_equal(states.obs[:, 0], [0, 2])
    np.testing.assert_array_equal(states.reward, [0, 2])
    np.testing.assert_array_equal(states.done, [1, 0])


def test_noise_is_fresh_gaussian_and_only_on_the_observation():
    _, plain = roll(Scripted(10_000), 4000)
    _, noisy = roll(wrappers.ObservationNoise(Scripted(10_000), 0.5), 4000)
    noise = np.asarray(noisy.obs[:, 0] - plain.obs[:, 0])
    # The second entry is carried by the wrapped environment from its own last
    # observation: noise must not pile up there.
    other = np.asarray(noisy.obs[:, 1])
    for sample in (noise, other):
        assert abs(sample.mean() - np.median(sample)) < 0.05
        assert abs(sample.std() - 0.5) < 0.03
        assert abs(np.corrcoef(sample[1:], sample[:-1])[0, 1]) < 0.06
    np.testing.assert_array_equal(noisy.reward, plain.reward)
    np.testing.assert_array_equal(noisy.done, plain.done)


def test_auto_reset_starts_afresh_and_keeps_the_final_observation():
    env = wrappers.AutoReset(
        wrappers.RewardDelay(wrappers.EpisodeLimit(Scripted(100), 4), 3)
    )
    start, states = roll(env, 8)
    np.testing.assert_array_equal(states.done, [0, 0, 0, 1, 0, 0, 0, 1])
    np.testing.assert_array_equal(states.info["truncation"], states.done)
    np.testing.assert_array_equal(states.obs[:, 0], [1, 2, 3, 0, 1, 2, 3, 0])
    np.testing.assert_array_equal(
        states.info["final_observation"][:, 0], [1, 2, 3, 4, 1, 2, 3, 4]
    )
    np.testing.assert_array_equal(states.info["true_reward"], [1, 2, 3, 4] * 2)
    np.testing.assert_array_equal(states.reward, [0, 0, 6, 4] * 2)
    starts = [float(start.obs[1]), float(states.obs[3, 1]), float(states.obs[7, 1])]
    assert len(set(starts)) == 3


def test_a_terminal_limit_is_no_truncation():
    for terminal in (False, True):
        env = gasil_envs.make(
            "point_mass", max_episode_steps=2, terminal_limits=terminal
        )
        state = env.reset(jax.random.key(0))
        for _ in range(2):
            state = env.step(state, jnp.zeros(env.action_size))
        assert state.done == 1.0 and state.info["truncation"] == (not terminal)

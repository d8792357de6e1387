"""First episodes that begin at a drawn age, so that environments are out of step."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs import Env, State

import gasil_jax
from gasil_envs import wrappers
from gasil_jax import rollout
from gasil_jax.distributions import GAUSSIAN

LIMIT = 10


class Clock(Env):
    """Observes the steps of the episode; each costs 1, so a short episode is better.

    Args:
      last: the episode terminates by itself after so many steps.
    """

    observation_size, action_size, backend = 1, 1, "none"

    def __init__(self, last=10**6):
        self.last = last

    def reset(self, rng):
        return State(None, jnp.zeros(1), jnp.float32(0), jnp.float32(0))

    def step(self, state, action):
        obs = state.obs + 1
        done = (obs[0] >= self.last).astype(jnp.float32)
        return state.replace(obs=obs, reward=jnp.float32(-1), done=done)


def make(delay=1, **arguments):
    env = wrappers.EpisodeLimit(Clock(**arguments), LIMIT)
    return env if delay == 1 else wrappers.RewardDelay(env, delay)


def collect(env, num_envs, num_steps):
    environments = rollout.init(env, jax.random.key(1), num_envs, age_limit=LIMIT)
    policy = lambda observation: (jnp.zeros((num_envs, 1)), jnp.zeros(1))
    sizes = {"num_steps": num_steps, "max_episode_steps": LIMIT}
    given = env, policy, environments, jax.random.key(2)
    _, batch = rollout.collect(*given, distribution=GAUSSIAN, **sizes, gamma=1.0)
    return np.asarray(environments.starting_age), batch


def test_ages_are_uniform_over_the_episode_and_of_the_seeds_own_key():
    env = make()
    init = functools.partial(rollout.init, env, num_envs=8192, age_limit=1000)
    keys = jax.vmap(jax.random.key)(jnp.arange(3))
    ages = np.asarray(jax.vmap(lambda key: init(key).starting_age)(keys))
    assert ages.min() >= 0 and ages.max() < 1000
    # Each tenth has a tenth of them, to within five standard deviations.
    share = np.array([np.bincount(row // 100, minlength=10) for row in ages]) / 8192
    np.testing.assert_allclose(share, 0.1, atol=5 * np.sqrt(0.09 / 8192))
    np.testing.assert_array_equal(ages[2], init(keys[2]).starting_age)
    assert (ages[0] != ages[1]).any()


def test_a_first_episode_is_cut_at_the_limit_and_bootstrapped():
    ages, batch = collect(make(), num_envs=16, num_steps=3 * LIMIT)
    for env, age in enumerate(ages):
        (ends,) = np.nonzero(np.asarray(batch.ended[:, env]))
        first = LIMIT - age - 1
        np.testing.assert_array_equal(ends, np.arange(first, 3 * LIMIT, LIMIT))
        cut = np.asarray(batch.cut_short[:, env])
        assert cut[first] == (age > 0) and cut.sum() == (age > 0)
        assert batch.truncated[first, env] and not batch.terminated[first, env]
        # The next episode begins afresh and is whole.
        if age > 0:
            assert batch.episode_length[first + LIMIT, env] == LIMIT
            assert batch.observation[first + 1, env, 0] == 0
    assert len(set(ages.tolist())) > 5


@pytest.mark.parametrize("num_envs", [1, 20])
def test_a_few_resets_at_a_time_are_those_of_all_at_once(num_envs, monkeypatch):
    class Drawn(Clock):
        def reset(self, rng):
            begin = jax.random.randint(rng, (1,), 0, 1000).astype(jnp.float32)
            return super().reset(rng).replace(obs=begin)

    env = wrappers.EpisodeLimit(Drawn(), LIMIT)
    _, batch = collect(env, num_envs, num_steps=4 * LIMIT)
    monkeypatch.setattr(wrappers, "resets_slowly", lambda env: True)
    _, few = collect(env, num_envs, num_steps=4 * LIMIT)
    # In some steps more end than are reset at a time.
    assert batch.ended.sum(axis=1).max() > num_envs / 8
    begins = batch.observation[1:][batch.ended[:-1]]
    assert len(np.unique(begins)) > num_envs
    for name in ("observation", "next_observation", "ended", "episode_length"):
        np.testing.assert_array_equal(getattr(batch, name), getattr(few, name))


def test_an_episode_that_ends_by_itself_before_it_is_cut_is_whole():
    ages, batch = collect(make(last=4), num_envs=32, num_steps=4)
    early = np.asarray(batch.completed[-1])
    np.testing.assert_array_equal(early, LIMIT - ages >= 4)
    assert early.any() and not early.all()
    np.testing.assert_array_equal(batch.terminated[-1], early)
    assert (np.asarray(batch.episode_length[-1])[early] == 4).all()


@pytest.mark.parametrize(
    "agent",
    [
        gasil_jax.PPOBC(buffer_steps=30),
        gasil_jax.PPOSIL(sil_buffer_steps=300, sil_minibatch_size=8),
    ],
    ids=lambda agent: agent.name,
)
def test_a_cut_episode_counts_in_no_metric_no_buffer_and_no_replay(agent):
    """Each would prefer it: its return is higher than that of a whole episode."""
    env = make()
    sizes = {"total_steps": 3 * 64, "num_envs": 8, "batch_steps": 64, "num_epochs": 1}
    config = gasil_jax.Config(**sizes, hidden_sizes=(4,), gamma=1.0)
    algorithm = gasil_jax.Algorithm(agent, config=config)
    iterate = jax.jit(lambda state: gasil_jax.train_step(env, algorithm, state))

    def train(state):
        rows = []
        for _ in range(config.num_iterations):
            state, metrics = iterate(state)
            rows.append(metrics)
        return state, jax.tree.map(lambda *x: np.stack(x), *rows)

    first = jax.jit(lambda: gasil_jax.init(env, algorithm, jax.random.key(0)))()
    state, metrics = train(first)
    ended = np.asarray(metrics["episodes"]) > 0
    assert ended.any() and (metrics["episode_length"][ended] == LIMIT).all()
    assert (metrics["episode_return"][ended] == -LIMIT).all()
    if agent.name == "ppo+bc":
        assert int(state.agent.buffer.size) == 30
        np.testing.assert_array_equal(state.agent.buffer.return_, -LIMIT)
    else:
        # A whole episode's steps have the returns -1 to -LIMIT, each as often.
        replay = state.agent
        returns = -np.asarray(replay.return_)[np.asarray(replay.priority) > 0]
        counts = np.bincount(returns.astype(int), minlength=LIMIT + 1)[1:]
        assert (counts == counts[0]).all() and counts[0] > 0
        assert counts[0] == np.nansum(metrics["episodes"])
    # All began together: more whole episodes, none cut.
    ages = first.environments.starting_age
    assert ages.any()
    environments = first.environments.replace(starting_age=0 * ages)
    _, metrics = train(first.replace(environments=environments))
    assert np.nansum(metrics["episodes"]) == 8 * (24 // LIMIT)


@pytest.mark.parametrize("delay", [4, 100])
def test_a_delayed_reward_is_paid_once_where_the_episode_is_cut(delay):
    _, batch = collect(make(delay=delay), num_envs=16, num_steps=LIMIT)
    reward, ended = np.asarray(batch.reward), np.asarray(batch.ended)
    for env in range(16):
        (first, *_) = np.flatnonzero(ended[:, env])
        given = reward[: first + 1, env]
        assert given.sum() == -(first + 1)
        assert np.count_nonzero(given) == -(-(first + 1) // delay)

"""PPO+SIL's replay and loss against plain Python."""

import types

import jax
import jax.numpy as jnp
import numpy as np

from gasil_jax.agents import self_imitation
from gasil_jax.rollout import init_history, record

GAMMA = 0.9


def test_replay_holds_the_returns_of_ended_episodes_across_batches():
    """Four batches of three steps in two environments, against lists of episodes."""
    rng = np.random.default_rng(1)
    num_steps, num_envs, capacity = 3, 2, 15
    history = init_history(num_envs, num_steps, 9, observation_size=1, action_size=1)
    replay = self_imitation.init_replay(capacity, 1, 1)

    @jax.jit
    def add(replay, history, observation, reward, ended):
        steps = {"observation": observation, "action": -observation, "reward": reward}
        ends = {"ended": ended, "faulty": False, "cut_short": False}
        history = record(history, types.SimpleNamespace(**steps, **ends))
        replay = self_imitation.insert(replay, history, num_steps, gamma=GAMMA)
        return replay, history

    running = [[] for _ in range(num_envs)]
    expected = []
    for batch in range(6):
        observation = rng.normal(size=(num_steps, num_envs, 1)).astype("f")
        reward = rng.normal(size=(num_steps, num_envs)).astype("f")
        ended = rng.random((num_steps, num_envs)) < 0.3
        if batch == 3:
            reward[1, 0] = np.nan
        replay, history = add(replay, history, observation, reward, ended)
        for env in range(num_envs):
            for t in range(num_steps):
                running[env].append((observation[t, env, 0], reward[t, env]))
                if ended[t, env]:
                    return_ = 0.0
                    steps = []
                    for seen, r in reversed(running[env]):
                        return_ = r + GAMMA * return_
                        if np.isfinite(return_):
                            steps.append((seen, return_))
                    expected.extend(reversed(steps))
                    running[env] = []
        size = min(len(expected), capacity)
        assert int(jnp.sum(replay.priority > 0)) == size
        index = (np.arange(len(expected) - size, len(expected))) % capacity
        kept = np.array(expected[len(expected) - size :]).reshape(-1, 2)
        np.testing.assert_allclose(replay.observation[index, 0], kept[:, 0])
        np.testing.assert_allclose(replay.action[index, 0], -kept[:, 0])
        np.testing.assert_allclose(replay.return_[index], kept[:, 1], rtol=1e-5)
        if batch == 3:
            # As if the values predicted all stored returns.
            low = jnp.where(replay.priority > 0, 1e-6, 0.0)
            replay = replay.replace(priority=low)
    assert len(expected) > capacity
    # New steps come first, whatever the priorities of the others.
    assert set(np.unique(replay.priority)) <= {np.float32(1e-6), np.float32(1.0)}
    assert jnp.max(replay.priority) == 1.0


def test_sampling_follows_the_priorities():
    priority = jnp.array([0.0, 1.0, 0.25, 1e-6, 3.0, 0.0])
    replay = self_imitation.init_replay(6, 1, 1).replace(priority=priority)
    index, weight = self_imitation.sample(jax.random.key(0), replay, 100_000)
    mass = np.where(priority > 0, np.asarray(priority, np.float64) ** 0.6, 0.0)
    probability = mass / mass.sum()
    frequency = np.bincount(index, minlength=6) / 100_000
    np.testing.assert_allclose(frequency, probability, atol=5e-3)
    importance = (4 * probability[index]) ** -0.1
    importance /= (4 * probability[probability > 0].min()) ** -0.1
    np.testing.assert_allclose(weight, importance, rtol=1e-4)


def test_an_empty_place_is_never_drawn(monkeypatch):
    """Only filled indices are drawn, although rounding may put all mass beyond them."""
    priority = jnp.array([1.0, 2.0, 0.0, 0.0])
    replay = self_imitation.init_replay(4, 1, 1).replace(priority=priority)
    rounded = lambda mass: jnp.array([1.0, 2.5, 2.5, 2.5000002], jnp.float32)
    monkeypatch.setattr(self_imitation.jnp, "cumsum", rounded)
    highest = lambda key, shape: jnp.full(shape, 0.99999994, jnp.float32)
    monkeypatch.setattr(self_imitation.jax.random, "uniform", highest)
    index, weight = self_imitation.sample(jax.random.key(0), replay, 3)
    assert index.tolist() == [1, 1, 1] and np.isfinite(weight).all()


def test_the_scale_is_the_standard_deviation_of_the_stored_returns():
    returns = np.array([3.0, -1.0, 7.0, 1e6], np.float32)
    replay = self_imitation.init_replay(4, 1, 1).replace(
        return_=jnp.array(returns), priority=jnp.array([1.0, 0.1, 2.0, 0.0])
    )
    scale = self_imitation.return_scale(replay)
    np.testing.assert_allclose(scale, returns[:3].std(), rtol=1e-6)
    assert self_imitation.return_scale(self_imitation.init_replay(4, 1, 1)) > 0


def test_loss_and_its_gradient_against_numpy():
    rng = np.random.default_rng(2)
    # Some log probabilities far down: their gradient is not to vanish.
    log_prob, value, return_ = rng.normal(size=(3, 100)) * [[40.0], [5.0], [5.0]]
    weight, scale = rng.random(100), 4.0
    advantage = np.clip((return_ - value) / scale, 0.0, 1.0)
    count = max(np.sum(advantage > 0), 64)

    def total(log_prob, value):
        array = lambda x: jnp.asarray(x, jnp.float32)
        given = {"weight": array(weight), "scale": scale, "value_coefficient": 0.01}
        seen = array(log_prob), array(value), array(return_)
        return self_imitation.loss(*seen, **given)[0]

    by_log_prob, by_value = jax.grad(total, argnums=(0, 1))(
        jnp.asarray(log_prob, jnp.float32), jnp.asarray(value, jnp.float32)
    )
    expected = -weight * advantage / count
    np.testing.assert_allclose(by_log_prob, expected, rtol=1e-4, atol=1e-8)
    expected = -0.01 * weight * np.clip(return_ - value, 0.0, scale) / count
    np.testing.assert_allclose(by_value, expected, rtol=1e-4, atol=1e-8)
    policy_part = -np.sum(weight * advantage * log_prob) / count
    value_part = -0.01 * scale * np.sum(weight * advantage * value) / count
    np.testing.assert_allclose(
        total(log_prob, value), policy_part + value_part, rtol=1e-4
    )

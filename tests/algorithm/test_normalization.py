"""Running normalization of observations and of rewards against NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gasil_jax import normalization
from gasil_jax.rewards import normalization as rewards


def test_batches_give_the_statistics_of_all_rows():
    rng = np.random.default_rng(0)
    batches = [rng.normal(3.0, [0.1, 20.0], (n, 2)).astype("f") for n in (5, 1, 300)]
    normalizer = normalization.init(2)
    for batch in batches:
        normalizer = normalization.update(normalizer, jnp.asarray(batch))
    rows = np.concatenate(batches).astype(np.float64)
    np.testing.assert_allclose(normalizer.mean, rows.mean(0), rtol=1e-5)
    np.testing.assert_allclose(normalizer.m2 / len(rows), rows.var(0), rtol=1e-4)
    normalized = normalization.normalize(normalizer, jnp.asarray(rows, jnp.float32))
    expected = (rows - rows.mean(0)) / np.sqrt(rows.var(0) + 1e-8)
    np.testing.assert_allclose(normalized, expected, atol=1e-3)


@pytest.mark.parametrize("number", [np.nan, np.inf, -1e20, 1e11])
def test_rows_that_are_not_sound_are_left_out(number):
    rows = jnp.array([[1.0, 2.0], [number, 0.0], [0.0, number], [3.0, 6.0]])
    normalizer = normalization.update(normalization.init(2), rows)
    assert float(normalizer.count) == 2
    np.testing.assert_allclose(normalizer.mean, [2.0, 4.0])
    np.testing.assert_allclose(normalizer.m2, [2.0, 8.0])


def test_before_any_observation_it_only_clips():
    result = normalization.normalize(normalization.init(2), jnp.array([0.5, -1e6]))
    np.testing.assert_allclose(result, [0.5, -10.0], rtol=1e-6)


update = jax.jit(rewards.update)


def plain_scale(reward, ended, gamma):
    """Baselines' VecNormalize, a step at a time."""
    running, seen = np.zeros(reward.shape[1]), []
    for now, end in zip(reward, ended, strict=True):
        running = gamma * running + now
        seen.append(running.copy())
        running[end] = 0.0
    return np.sqrt(np.var(seen) + 1e-8)


def test_batches_of_rewards_give_the_scale_of_all_steps():
    rng = np.random.default_rng(0)
    reward = rng.normal(0.5, 30.0, (60, 3))
    ended = rng.random((60, 3)) < 0.1
    normalizer = rewards.init(3)
    for begin, end in ((0, 7), (7, 8), (8, 60)):
        batch = jnp.float32(reward[begin:end]), jnp.asarray(ended[begin:end])
        normalizer = update(normalizer, *batch, gamma=0.9)
        expected = plain_scale(reward[:end], ended[:end], 0.9)
        np.testing.assert_allclose(rewards.scale(normalizer), expected, rtol=1e-4)
    paid = jnp.array([30.0, -1e9])
    normalized = rewards.normalize(normalizer, paid, 10.0)
    np.testing.assert_allclose(normalized, [30.0 / expected, -10.0], rtol=1e-4)


def test_what_is_beyond_the_clip_counts_as_clipped():
    """Of the rewards that are paid: where one pays an episode, most are 0."""
    reward = np.zeros((2000, 4), np.float32)
    payments = np.random.default_rng(0).uniform(500, 3000, (2, 4))
    reward[999::1000] = payments
    normalizer = update(
        rewards.init(4), jnp.asarray(reward), jnp.asarray(reward > 0), gamma=0.99
    )
    share = rewards.clipped(normalizer, jnp.asarray(reward), 10.0)
    expected = np.mean(payments / plain_scale(reward, reward > 0, 0.99) > 10.0)
    np.testing.assert_allclose(share, expected)
    assert 0.5 < expected < 1.0
    assert np.isnan(rewards.clipped(normalizer, jnp.zeros((5, 4)), 10.0))

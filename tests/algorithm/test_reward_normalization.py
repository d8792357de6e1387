"""Normalization of rewards against a plain loop; for its use see test_agents.py."""

import jax
import jax.numpy as jnp
import numpy as np

from gasil_jax.rewards import normalization

update = jax.jit(normalization.update)


def plain_scale(reward, ended, gamma):
    """Baselines' VecNormalize, a step at a time."""
    running, seen = np.zeros(reward.shape[1]), []
    for now, end in zip(reward, ended, strict=True):
        running = gamma * running + now
        seen.append(running.copy())
        running[end] = 0.0
    return np.sqrt(np.var(seen) + 1e-8)


def test_batches_give_the_scale_of_all_steps():
    rng = np.random.default_rng(0)
    reward = rng.normal(0.5, 30.0, (60, 3))
    ended = rng.random((60, 3)) < 0.1
    normalizer = normalization.init(3)
    for begin, end in ((0, 7), (7, 8), (8, 60)):
        normalizer = update(
            normalizer,
            jnp.asarray(reward[begin:end], jnp.float32),
            jnp.asarray(ended[begin:end]),
            gamma=0.9,
        )
        expected = plain_scale(reward[:end], ended[:end], 0.9)
        np.testing.assert_allclose(normalization.scale(normalizer), expected, rtol=1e-4)
    rewards = jnp.array([30.0, -1e9])
    normalized = normalization.normalize(normalizer, rewards, 10.0)
    np.testing.assert_allclose(normalized, [30.0 / expected, -10.0], rtol=1e-4)


def test_what_is_beyond_the_clip_counts_as_clipped():
    """Of the rewards that are paid: where one pays an episode, most are 0."""
    reward = np.zeros((2000, 4), np.float32)
    payments = np.random.default_rng(0).uniform(500, 3000, (2, 4))
    reward[999::1000] = payments
    normalizer = update(
        normalization.init(4), jnp.asarray(reward), jnp.asarray(reward > 0), gamma=0.99
    )
    share = normalization.clipped(normalizer, jnp.asarray(reward), 10.0)
    expected = np.mean(payments / plain_scale(reward, reward > 0, 0.99) > 10.0)
    np.testing.assert_allclose(share, expected)
    assert 0.5 < expected < 1.0
    assert np.isnan(normalization.clipped(normalizer, jnp.zeros((5, 4)), 10.0))

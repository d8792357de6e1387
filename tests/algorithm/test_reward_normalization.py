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


def test_one_payment_an_episode_is_clipped_where_episodes_are_long():
    rng = np.random.default_rng(0)
    share = {}
    for length in (20, 1000):
        reward = np.zeros((2 * length, 4), np.float32)
        reward[length - 1 :: length] = payments = rng.uniform(500, 3000, (2, 4))
        normalizer = update(
            normalization.init(4),
            jnp.asarray(reward),
            jnp.asarray(reward > 0),
            gamma=0.99,
        )
        scale = plain_scale(reward, reward > 0, 0.99)
        expected = np.mean(payments / scale > 10.0)
        share[length] = normalization.clipped(normalizer, jnp.asarray(reward), 10.0)
        np.testing.assert_allclose(share[length], expected)
        for clip in (10.0, 1e9):
            np.testing.assert_allclose(
                normalization.normalize(normalizer, jnp.asarray(reward), clip),
                np.minimum(reward / scale, clip),
                rtol=1e-4,
            )
    assert share[20] == 0.0 and share[1000] > 0.5
    nothing = jnp.zeros((5, 4))
    assert np.isnan(normalization.clipped(normalizer, nothing, 10.0))

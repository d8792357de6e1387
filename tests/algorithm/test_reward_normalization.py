"""Normalization of rewards against a plain loop, and its use in training."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs import Wrapper
from test_train import SELF_TAUGHT, SMALL

import gasil_jax
from gasil_jax import reward_normalization


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
    normalizer = reward_normalization.init(3)
    for begin, end in ((0, 7), (7, 8), (8, 60)):
        normalizer = reward_normalization.update(
            normalizer,
            jnp.asarray(reward[begin:end], jnp.float32),
            jnp.asarray(ended[begin:end]),
            0.9,
        )
        expected = plain_scale(reward[:end], ended[:end], 0.9)
        np.testing.assert_allclose(
            reward_normalization.scale(normalizer), expected, rtol=1e-4
        )
    normalized = reward_normalization.normalize(normalizer, jnp.array([30.0, -1e9]))
    np.testing.assert_allclose(normalized, [30.0 / expected, -10.0], rtol=1e-4)


def test_no_reward_stays_none():
    nothing = jnp.zeros((5, 2))
    normalizer = reward_normalization.update(
        reward_normalization.init(2), nothing, nothing > 0, 0.99
    )
    assert not np.any(reward_normalization.normalize(normalizer, nothing))


class Scaled(Wrapper):
    """Rewards so many times as large."""

    def step(self, state, action):
        state = self.env.step(state, action)
        return state.replace(reward=1024.0 * state.reward)


@pytest.mark.parametrize("agent", SELF_TAUGHT)
def test_the_unit_of_the_reward_does_not_matter(agent):
    # Without normalization it does: to a bonus beside it, and to the value's loss.
    config = SMALL.replace(agent=agent, total_steps=1024, normalize_rewards=True)
    env = gasil_jax.make_env("point_mass")
    train = lambda env: jax.jit(gasil_jax.make_train(env, config))(jax.random.key(3))
    (_, metrics), (_, scaled) = train(env), train(Scaled(env))
    np.testing.assert_allclose(
        scaled["reward_scale"], 1024.0 * metrics["reward_scale"], rtol=1e-4
    )
    assert np.all(np.isfinite(metrics["reward_scale"]))
    for name in ("policy_loss", "value_loss", "entropy", "bonus", "sil_fraction"):
        if name in metrics:
            np.testing.assert_allclose(
                scaled[name], metrics[name], rtol=1e-3, atol=1e-5, err_msg=name
            )
    # The buffer has the environment's own.
    np.testing.assert_allclose(
        scaled["good_return"], 1024.0 * metrics["good_return"], rtol=1e-4
    )
    without = SMALL.replace(agent=agent, total_steps=1024)
    assert (
        "reward_scale"
        not in jax.eval_shape(gasil_jax.make_train(env, without), jax.random.key(3))[1]
    )

"""The distributions of actions against NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gasil_jax.distributions import CATEGORICAL, GAUSSIAN


def softmax(logits):
    exponentials = np.exp(logits - logits.max(axis=-1, keepdims=True))
    return exponentials / exponentials.sum(axis=-1, keepdims=True)


def test_a_gaussians_density_and_entropy_are_their_formulas():
    rng = np.random.default_rng(0)
    mean, action = rng.normal(size=(2, 5, 3))
    log_std = rng.normal(size=3)
    std = np.exp(log_std)
    density = np.exp(-0.5 * ((action - mean) / std) ** 2) / (std * np.sqrt(2 * np.pi))
    parameters = jnp.asarray(mean, jnp.float32), jnp.asarray(log_std, jnp.float32)
    log_prob = GAUSSIAN.log_prob(parameters, jnp.asarray(action, jnp.float32))
    np.testing.assert_allclose(log_prob, np.log(density).sum(axis=1), rtol=1e-5)
    entropy = np.sum(0.5 * np.log(2 * np.pi * np.e * std**2))
    np.testing.assert_allclose(GAUSSIAN.entropy(parameters), entropy, rtol=1e-5)
    np.testing.assert_array_equal(GAUSSIAN.mode(parameters), parameters[0])


def test_a_categoricals_probability_and_entropy_are_their_formulas():
    rng = np.random.default_rng(0)
    logits = np.append(3 * rng.normal(size=(6, 4)), [[90.0, 0.0, -90.0, 0.0]], axis=0)
    index = np.append(rng.integers(4, size=6), 0)
    p = softmax(logits)
    given = jnp.asarray(logits, jnp.float32)
    action = jax.nn.one_hot(index, 4)
    log_prob = np.log(p[np.arange(7), index])
    np.testing.assert_allclose(
        CATEGORICAL.log_prob(given, action), log_prob, rtol=1e-5, atol=1e-6
    )
    entropy = -np.sum(p * np.log(np.maximum(p, 1e-300)), axis=1)
    np.testing.assert_allclose(
        CATEGORICAL.entropy(given), entropy, rtol=1e-4, atol=1e-6
    )
    executed = CATEGORICAL.executed(CATEGORICAL.mode(given), 0.0, 1.0)
    np.testing.assert_array_equal(executed, logits.argmax(axis=1))
    assert executed.dtype == jnp.int32


@pytest.mark.parametrize("largest", [1.0, 90.0])
def test_a_categoricals_gradients_are_those_of_numpy(largest):
    logits = largest * np.array([[1.0, 0.2, -0.4], [-0.3, 0.0, 0.8]])
    p, action = softmax(logits), np.eye(3)[[1, 2]]
    given = jnp.asarray(logits, jnp.float32)
    likelier = jax.grad(lambda x: CATEGORICAL.log_prob(x, jnp.asarray(action)).sum())
    # The logit of the action that was taken rises, and the others fall.
    np.testing.assert_allclose(likelier(given), action - p, rtol=1e-4, atol=1e-6)
    entropy = -np.sum(p * np.log(np.maximum(p, 1e-300)), axis=1, keepdims=True)
    flatter = jax.grad(lambda x: CATEGORICAL.entropy(x).sum())(given)
    expected = -p * (np.log(np.maximum(p, 1e-300)) + entropy)
    np.testing.assert_allclose(flatter, expected, rtol=1e-3, atol=1e-6)
    assert (flatter[np.arange(2), p.argmax(axis=1)] <= 0).all()  # The largest falls.


def test_a_categorical_draws_by_probability():
    logits = jnp.log(jnp.array([0.5, 0.3, 0.2]))
    drawn = CATEGORICAL.sample(jax.random.key(0), jnp.tile(logits, (20_000, 1)))
    assert drawn.dtype == jnp.float32 and (drawn.sum(axis=1) == 1).all()
    np.testing.assert_allclose(drawn.mean(axis=0), [0.5, 0.3, 0.2], atol=0.015)

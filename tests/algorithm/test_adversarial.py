"""The discriminator's gradient and the bonus against the paper's formulas."""

import jax
import jax.numpy as jnp
import numpy as np

from gasil_jax.agents import adversarial


def test_gradient_is_the_papers():
    """E_pi[grad log D] + E_B[grad log(1 - D)], D = sigmoid(w . x), by hand."""
    rng = np.random.default_rng(0)
    policy, good = rng.normal(size=(2, 6, 4))
    w = rng.normal(size=4)
    sigmoid = lambda x: 1 / (1 + np.exp(-x))
    ascent = np.mean([(1 - sigmoid(x @ w)) * x for x in policy], axis=0) + np.mean(
        [-sigmoid(x @ w) * x for x in good], axis=0
    )
    descent = jax.grad(
        lambda w: adversarial.loss(
            jnp.asarray(policy, jnp.float32) @ w,
            jnp.asarray(good, jnp.float32) @ w,
            0.0,
        )[0]
    )(jnp.asarray(w, jnp.float32))
    np.testing.assert_allclose(descent, -ascent, rtol=1e-4, atol=1e-6)


def test_entropy_is_the_bernoulli_entropy():
    logits = np.linspace(-3, 3, 7)
    d = 1 / (1 + np.exp(-logits))
    entropy = np.mean(-d * np.log(d) - (1 - d) * np.log(1 - d))
    half = jnp.asarray(logits, jnp.float32)
    without = adversarial.loss(half, half, 0.0)[0]
    with_entropy = adversarial.loss(half, half, 1.0)[0]
    np.testing.assert_allclose(without - with_entropy, entropy, rtol=1e-5)


def test_accuracy_is_the_share_that_is_told_apart():
    metrics = adversarial.loss(
        jnp.array([2.0, -1.0, 3.0, 1.0]), jnp.array([-1.0, 4.0]), 0.0
    )[1]
    assert metrics["discriminator_policy_accuracy"] == 0.75
    assert metrics["discriminator_good_accuracy"] == 0.5

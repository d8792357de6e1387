"""The cloning loss against plain Python; for its effect see test_agents.py."""

import jax.numpy as jnp
import numpy as np

from gasil_jax.imitation import behavior_cloning


def test_loss_is_the_mean_negative_log_likelihood():
    rng = np.random.default_rng(0)
    mean, action = rng.normal(size=(2, 5, 3))
    log_std = rng.normal(size=3)
    total = 0.0
    for m, a in zip(mean, action, strict=True):
        for i in range(3):
            std = np.exp(log_std[i])
            density = np.exp(-0.5 * ((a[i] - m[i]) / std) ** 2)
            total -= np.log(density / (std * np.sqrt(2 * np.pi))) / 5
    arrays = (jnp.asarray(x, jnp.float32) for x in (mean, log_std, action))
    np.testing.assert_allclose(behavior_cloning.loss(*arrays), total, rtol=1e-5)

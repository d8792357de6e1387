"""The cloning loss against plain Python, and its effect on the policy."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

import gasil_jax
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


@functools.cache
def trained(coefficient):
    env = gasil_jax.make_env("point_mass")
    config = gasil_jax.Config(
        agent="ppo+bc",
        total_steps=2048,
        num_epochs=1,
        behavior_cloning_updates=100,
    )
    # The best two episodes: they differ from the rest.
    config = config.replace(buffer_steps=100)
    hyperparameters = config.hyperparameters.replace(
        behavior_cloning_coefficient=coefficient, learning_rate=1e-3
    )
    return jax.jit(gasil_jax.make_train(env, config))(
        jax.random.key(0), hyperparameters
    )


def test_cloning_makes_the_good_steps_likelier():
    likelier, plain = trained(10.0)[1], trained(0.0)[1]
    loss = lambda metrics: float(metrics["behavior_cloning_loss"][-1])
    assert loss(likelier) < loss(plain) - 0.01


def test_without_weight_it_is_ppo():
    env = gasil_jax.make_env("point_mass")
    config = gasil_jax.Config(agent="ppo", total_steps=2048, num_epochs=1)
    hyperparameters = config.hyperparameters.replace(learning_rate=1e-3)
    state, _ = jax.jit(gasil_jax.make_train(env, config))(
        jax.random.key(0), hyperparameters
    )
    # Adam's momentum goes on; only the value, which cloning leaves alone, is equal.
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6),
        state.actor_critic.params["values"],
        trained(0.0)[0].actor_critic.params["values"],
    )

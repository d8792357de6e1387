"""Schedules at their corners, and in a run."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from small_training import DISCRIMINATOR, SETTINGS

import gasil_jax
from gasil_jax.algorithms import schedule_factor

HUMANOID = ((2e6, 0.0), (3e6, 1.0))


@pytest.mark.parametrize(
    ("steps", "expected"), [(0, 0), (2e6, 0), (2.25e6, 0.25), (3e6, 1), (1e7, 1)]
)
def test_the_papers_rule_for_humanoid(steps, expected):
    result = jax.jit(lambda steps: schedule_factor(HUMANOID, steps))(steps)
    np.testing.assert_allclose(result, expected, atol=1e-6)


def test_steps_beyond_a_32_bit_integer():
    algorithm = gasil_jax.algorithm(batch_steps=2**21, alpha_schedule=HUMANOID)
    at = algorithm.at(algorithm.hyperparameters, jnp.int32(1024))
    np.testing.assert_allclose(at.agent.alpha, algorithm.agent.alpha)


def test_no_schedule_changes_nothing_but_the_annealed_learning_rate():
    algorithm = gasil_jax.algorithm(total_steps=4 * 2048, normalize_rewards=True)
    hyperparameters = algorithm.hyperparameters
    # A longer loop does not anneal below 0.
    for iteration in (0, 1, 2, 3, 4, 9):
        now = algorithm.at(hyperparameters, jnp.int32(iteration))
        rate = hyperparameters["learning_rate"] * max(0.0, 1 - iteration / 4)
        np.testing.assert_allclose(now.config.learning_rate, rate, rtol=1e-6)
        assert now == algorithm.replace(learning_rate=now.config.learning_rate)


def test_a_run_follows_its_schedules():
    algorithm = gasil_jax.algorithm("ppo+gasil", **SETTINGS, **DISCRIMINATOR).replace(
        total_steps=512,
        alpha_schedule=((128, 0.0), (256, 1.0)),
        learning_rate_schedule=((0, 1.0), (128, 0.0)),
    )
    env = gasil_jax.make_env("point_mass")
    _, metrics = jax.jit(gasil_jax.make_train(env, algorithm))(jax.random.key(0))
    bonus, rate = np.asarray(metrics["bonus"]), np.asarray(metrics["learning_rate"])
    assert np.all(bonus[:2] == 0) and np.all(bonus[2:] > 0)
    assert rate[0] > 0 and np.all(rate[1:] == 0)
    # With no learning rate the policy that comes out is the one that went in.
    np.testing.assert_array_equal(metrics["approx_kl"][1:] < 1e-9, True)


def test_an_optax_schedule_is_the_factor():
    halved = optax.piecewise_constant_schedule(1.0, {2 * 2048: 0.5})
    algorithm = gasil_jax.algorithm(
        alpha_schedule=halved,
        clip_epsilon_schedule=optax.linear_schedule(1.0, 0.0, 4 * 2048),
    )
    env = gasil_jax.make_env("point_mass")
    gasil_jax.make_train(env, algorithm)  # is accepted
    before = algorithm.hyperparameters
    at = jax.jit(lambda x: algorithm.at(before, x).hyperparameters)
    for iteration in range(6):
        now = at(jnp.int32(iteration))
        expected = before["alpha"] * (1.0 if iteration < 2 else 0.5)
        np.testing.assert_allclose(now["alpha"], expected, rtol=1e-6)
        expected = before["clip_epsilon"] * max(0.0, 1 - iteration / 4)
        np.testing.assert_allclose(now["clip_epsilon"], expected, rtol=1e-6)

"""GAE and the PPO loss against plain NumPy."""

import types

import jax.numpy as jnp
import numpy as np

from gasil_jax import learner, ppo
from gasil_jax.config import Config
from gasil_jax.distributions import GAUSSIAN


def test_gae_equals_a_plain_loop():
    rng = np.random.default_rng(0)
    shape, gamma, lam = (9, 3), 0.97, 0.9
    reward, value, next_value = rng.normal(size=(3, *shape)).astype(np.float32)
    terminated = rng.random(shape) < 0.2
    truncated = ~terminated & (rng.random(shape) < 0.2)
    ended = terminated | truncated
    expected = np.zeros(shape)
    for env in range(shape[1]):
        for start in range(shape[0]):
            weight = 1.0
            for t in range(start, shape[0]):
                future = 0.0 if terminated[t, env] else gamma * next_value[t, env]
                delta = reward[t, env] + future - value[t, env]
                expected[start, env] += weight * delta
                weight *= gamma * lam
                if ended[t, env]:
                    break
    ends = {"terminated": terminated, "ended": ended}
    result = ppo.generalized_advantage_estimation(
        reward, value, next_value, **ends, gamma=gamma, gae_lambda=lam
    )
    np.testing.assert_allclose(result, expected, rtol=1e-5, atol=1e-5)


def test_loss_equals_numpy():
    rng = np.random.default_rng(1)
    n, size = 16, 3
    action, mean = rng.normal(size=(2, n, size))
    log_std = rng.normal(size=size) * 0.3
    value, advantage, return_ = rng.normal(size=(3, n))
    one = lambda a, m, s: (
        -0.5 * ((a - m) / np.exp(s)) ** 2 - s - 0.5 * np.log(2 * np.pi)
    )
    log_prob = np.array([sum(map(one, *x, log_std)) for x in zip(action, mean)])
    old = log_prob + rng.normal(size=n) * 0.3
    config = Config(clip_epsilon=0.2, entropy_coefficient=0.01)
    surrogate = []
    for ratio, adv in zip(np.exp(log_prob - old), advantage, strict=True):
        surrogate.append(min(ratio * adv, min(max(ratio, 0.8), 1.2) * adv))
    entropy = sum(s + 0.5 * np.log(2 * np.pi * np.e) for s in log_std)
    squared = np.mean((value - return_) ** 2)
    expected = -np.mean(surrogate) + 0.5 * squared - 0.01 * entropy
    batch = ppo.Batch(
        *(jnp.asarray(x, jnp.float32) for x in (mean, action, old, advantage)),
        returns=jnp.asarray(return_, jnp.float32)[:, None],
    )
    context = types.SimpleNamespace(
        policy=lambda params, observation: (observation, params),
        distribution=GAUSSIAN,
        value=lambda params, observation: jnp.asarray(value, jnp.float32),
        config=config,
    )
    params = {"policy": jnp.asarray(log_std, jnp.float32), "values": (None,)}
    total, metrics = ppo.loss(params, batch, context)
    np.testing.assert_allclose(total, expected, rtol=1e-5)
    kl = np.mean(np.exp(log_prob - old) - 1 - (log_prob - old))
    np.testing.assert_allclose(metrics["approx_kl"], kl, rtol=1e-4)


def test_a_step_clips_the_gradients_norm_and_is_adams():
    params, gradient = {"w": jnp.array([1.0, 2.0])}, {"w": jnp.array([3.0, 4.0])}
    config = Config(max_grad_norm=1.0, learning_rate=0.1)
    network = learner.init(params, ppo.optimizer(config))
    mean, square, expected = np.zeros(2), np.zeros(2), np.array([1.0, 2.0])
    for step in range(1, 4):
        network = ppo.descend_one(network, gradient, config)
        clipped = np.array([3.0, 4.0]) / 5.0
        mean = 0.9 * mean + 0.1 * clipped
        square = 0.999 * square + 0.001 * clipped**2
        corrected = np.sqrt(square / (1 - 0.999**step)) + 1e-5
        expected = expected - 0.1 * mean / (1 - 0.9**step) / corrected
        np.testing.assert_allclose(network.params["w"], expected, rtol=1e-5)


def test_each_stream_is_standardized_for_itself():
    rng = np.random.default_rng(2)
    advantage = rng.normal(size=(7, 3, 2)) * np.array([5.0, 0.1]) + np.array([3.0, -2])
    expected = np.empty_like(advantage)
    for i in range(2):
        stream = advantage[..., i]
        expected[..., i] = (stream - stream.mean()) / (stream.std() + 1e-8)
    result = ppo.standardize(jnp.asarray(advantage, jnp.float32))
    np.testing.assert_allclose(result, expected, rtol=1e-4, atol=1e-5)

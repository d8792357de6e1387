"""Saved policies: in JAX, in NumPy, and what is refused."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_training import drawn_policies

import gasil_jax
from gasil_jax import normalization, numpy_policy, policy
from gasil_jax.host import policy_file
from gasil_jax.networks import GaussianPolicy


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    env = gasil_jax.make_env("point_mass", reward_delay=7)
    algorithm = gasil_jax.algorithm("ppo", hidden_sizes=(16, 8))
    states = drawn_policies(env, algorithm, 3)
    folder = tmp_path_factory.mktemp("run")
    policy_file.save(
        folder / "policy.npz", states, env, [5, 6, 7], np.array([1, 3, np.nan])
    )
    return env, algorithm, states, folder


@pytest.mark.parametrize("seed", [5, 6, 7, None])
def test_it_is_the_networks_gaussian(saved, seed):
    env, algorithm, states, folder = saved
    network = GaussianPolicy(algorithm.config.hidden_sizes, env.action_size)

    @jax.jit
    def expected(params, normalizer, key):
        observation = jax.random.normal(key, (9, env.observation_size))
        # The last one is far beyond the clip.
        observation = (3.0 * observation).at[-1].multiply(1e3)
        normalized = normalization.normalize(normalizer, observation)
        mean, log_std = network.apply(params, normalized)
        noise = jnp.exp(log_std)[None] * jax.random.normal(key, mean.shape)
        means, draws = (jnp.clip(x, -1.0, 1.0) for x in (mean, mean + noise))
        return observation, normalized, means, draws

    index = 1 if seed is None else seed - 5
    params, normalizer = jax.tree.map(
        lambda x: x[index], (states.actor_critic.policy.params, states.normalizer)
    )
    key = jax.random.key(3)
    observation, normalized, means, draws = expected(params, normalizer, key)
    assert np.abs(normalized).max() == numpy_policy.CLIP
    act = gasil_jax.load_policy(folder, seed)
    np.testing.assert_allclose(act(observation), means, atol=1e-5)
    np.testing.assert_allclose(jax.jit(jax.vmap(act))(observation), means, atol=1e-5)
    in_numpy = numpy_policy.load(folder / "policy.npz", seed)(np.asarray(observation))
    assert in_numpy.dtype == np.float32
    np.testing.assert_allclose(in_numpy, means, atol=1e-5)
    np.testing.assert_allclose(act(observation, key), draws, atol=1e-5)


def test_draws_in_numpy_have_the_policys_spread(saved):
    env, _, _, folder = saved
    weights = numpy_policy.read(folder, 5)
    weights["low"], weights["high"] = -100 * np.ones(2), 100 * np.ones(2)
    observation = np.zeros((20_000, env.observation_size), np.float32)
    draws = numpy_policy.make(weights)(observation, np.random.default_rng(0))
    np.testing.assert_allclose(draws.std(axis=0), np.exp(weights["log_std"]), rtol=0.05)


def test_it_needs_no_jax(saved):
    _, _, _, folder = saved
    code = (
        "import sys, numpy as np\n"
        "for name in ('jax', 'jaxlib', 'flax', 'optax', 'mujoco'):\n"
        "    sys.modules[name] = None\n"
        "from gasil_jax import numpy_policy\n"
        "act = numpy_policy.load(sys.argv[1])\n"
        "print(act(np.zeros(numpy_policy.read(sys.argv[1])['mean'].shape)).shape)\n"
    )
    result = subprocess.run(
        [sys.executable, "-c", code, str(folder)], capture_output=True, text=True
    )
    assert result.stdout.strip() == "(2,)", result.stderr


def test_a_seed_or_an_observation_of_another_size_is_refused(saved, tmp_path):
    with pytest.raises(ValueError, match=r"seed is 9: .* has a policy of 5, 6, 7"):
        gasil_jax.load_policy(saved[-1], 9)
    with pytest.raises(ValueError, match="does not exist: it must be a finished run"):
        gasil_jax.load_policy(tmp_path)
    # One number would otherwise be taken as all of them.
    for act in (gasil_jax.load_policy(saved[-1]), numpy_policy.load(saved[-1])):
        for observation in (np.float32(0), np.zeros(1), np.zeros((11, 2))):
            with pytest.raises(ValueError, match=r"it must be \(\.\.\., 11\)"):
                act(observation)


LAYERS = {
    "tanh": np.tanh,
    "relu": lambda x: np.maximum(x, 0.0),
    "swish": lambda x: x / (1.0 + np.exp(-x)),
}


@pytest.mark.parametrize(
    ("activation", "layer_norm"), [("tanh", False), ("relu", True), ("swish", False)]
)
def test_the_layers_are_their_formulas(activation, layer_norm, tmp_path):
    env = gasil_jax.make_env("point_mass")
    algorithm = gasil_jax.algorithm(
        "ppo", activation=activation, layer_norm=layer_norm, hidden_sizes=(8, 5)
    )
    states, rng = drawn_policies(env, algorithm, 2), np.random.default_rng(0)
    policy_file.save(tmp_path / "policy.npz", states, env, [0, 1], np.zeros(2))

    weights = numpy_policy.read(tmp_path, 1)
    weights |= {"low": np.full(2, -99.0), "high": np.full(2, 99.0)}
    observation = rng.normal(size=(7, env.observation_size)).astype(np.float32)
    x = (observation - weights["mean"]) / weights["scale"]
    for i in range(3):
        x = x @ weights[f"kernel_{i}"] + weights[f"bias_{i}"]
        if i < 2 and layer_norm:
            x = (x - x.mean(axis=1, keepdims=True)) / x.std(axis=1, keepdims=True)
            x = x * weights[f"norm_scale_{i}"] + weights[f"norm_bias_{i}"]
        x = LAYERS[activation](x) if i < 2 else x
    np.testing.assert_allclose(numpy_policy.make(weights)(observation), x, rtol=1e-3)
    np.testing.assert_allclose(policy.make(weights)(observation), x, rtol=1e-3)
    # The network that trains is the same.
    network = GaussianPolicy((8, 5), 2, activation, layer_norm)
    params, normalizer = states.actor_critic.policy.params, states.normalizer
    own, normalizer = jax.tree.map(lambda x: x[1], (params, normalizer))
    normalized = normalization.normalize(normalizer, observation)
    mean, _ = jax.jit(network.apply)(own, normalized)
    np.testing.assert_allclose(mean, x, rtol=1e-3)

"""Saved policies: in JAX, in NumPy, and what is refused."""

import subprocess
import sys

import jax
import numpy as np
import pytest
from small_training import drawn_policies
from test_distributions import softmax

import gasil_jax
from gasil_jax import normalization, numpy_policy, policy
from gasil_jax.host import policy_file
from gasil_jax.networks import CategoricalPolicy, GaussianPolicy, MixturePolicy

#: Tasks, and the policies' networks.
KINDS = {
    "gaussian": ("point_mass", GaussianPolicy((16, 8), 2)),
    "mixture": ("point_mass", MixturePolicy((16, 8), 2, components=3)),
    "categorical": ("corridor:Corridor", CategoricalPolicy((16, 8), 3)),
}


def save(folder, kind="gaussian"):
    """Save three policies of a kind; return the environment and their states."""
    env = gasil_jax.make_env(KINDS[kind][0], reward_delay=7)
    components = 3 if kind == "mixture" else 1
    algorithm = gasil_jax.algorithm(
        "ppo", hidden_sizes=(16, 8), policy_components=components
    )
    states, final = drawn_policies(env, algorithm, 3), np.array([1, 3, np.nan])
    policy_file.save(folder / "policy.npz", states, env, [5, 6, 7], final)
    return env, states


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    return *save(folder), folder


def parameters(kind, states, index, observation):
    """What the network gives of one policy, in NumPy, and what it is given."""
    params, normalizer = jax.tree.map(
        lambda x: x[index], (states.actor_critic.policy.params, states.normalizer)
    )
    normalized = normalization.normalize(normalizer, observation)
    given = jax.jit(KINDS[kind][1].apply)(params, normalized)
    return jax.tree.map(lambda x: np.asarray(x, float), given), normalized


@pytest.mark.parametrize("seed", [5, 7, None])
@pytest.mark.parametrize("kind", KINDS)
def test_a_saved_policy_acts_as_its_network(kind, seed, tmp_path):
    """Of no seed it is the best one's."""
    env, states = save(tmp_path, kind)
    observation = 3.0 * jax.random.normal(jax.random.key(3), (9, env.observation_size))
    # The last one is far beyond the clip.
    observation = observation.at[-1].multiply(1e3)
    index = 1 if seed is None else seed - 5
    given, normalized = parameters(kind, states, index, observation)
    assert np.abs(normalized).max() == numpy_policy.CLIP
    if kind == "categorical":
        expected = given.argmax(axis=1)
    else:
        mean, *_, logits = given
        chosen = logits.argmax(axis=1) if kind == "mixture" else ...
        # Or the order of the output is not tested.
        assert chosen is ... or len(set(chosen.tolist())) > 1
        expected = mean if chosen is ... else mean[np.arange(9), chosen]
        expected = np.clip(expected, -1.0, 1.0)
    act = gasil_jax.load_policy(tmp_path, seed)
    in_numpy = numpy_policy.load(tmp_path / "policy.npz", seed)
    actions = act(observation), jax.jit(jax.vmap(act))(observation)
    for action in (*actions, in_numpy(np.asarray(observation))):
        np.testing.assert_allclose(action, expected, atol=1e-5)
        assert action.dtype == (np.int32 if kind == "categorical" else np.float32)
    one = in_numpy(np.asarray(observation[3]))
    np.testing.assert_allclose(one, expected[3], atol=1e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_draws_in_jax_and_in_numpy_are_of_the_policys_distribution(kind, tmp_path):
    env, states = save(tmp_path, kind)
    weights, observation = numpy_policy.read(tmp_path, 5), np.ones(env.observation_size)
    # Here without the clip.
    weights |= {"low": np.full(2, -99.0), "high": np.full(2, 99.0)}
    given, _ = parameters(kind, states, 0, observation)
    if kind == "categorical":
        center, deviation = softmax(given), 0.0
        assert center.max() < 0.9
    else:
        # A Gaussian is a mixture of one.
        mean, log_std, *logits = given
        w = softmax(logits[0])[:, None] if logits else np.ones((1, 1))
        center = np.sum(w * mean, axis=0)
        variance = np.sum(w * (mean - center) ** 2, axis=0) + np.exp(2 * log_std)
        deviation = np.sqrt(variance)
    many = np.tile(observation, (20_000, 1))
    for drawn in (
        numpy_policy.make(weights)(many, np.random.default_rng(0)),
        policy.make(weights)(many, jax.random.key(0)),
    ):
        if kind == "categorical":
            drawn = np.eye(3)[drawn]
        else:
            np.testing.assert_allclose(drawn.std(axis=0), deviation, rtol=0.03)
        most = 4 * (np.max(deviation) + 0.5) / 20_000**0.5
        np.testing.assert_allclose(drawn.mean(axis=0), center, atol=most)


def test_it_needs_no_jax(saved):
    *_, folder = saved
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

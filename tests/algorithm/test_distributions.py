"""The distributions of actions against NumPy; saved policies: test_policy.py."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_training import SETTINGS

import gasil_jax
from gasil_jax.distributions import CATEGORICAL, GAUSSIAN, MIXTURE


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


def draw(seed=0, batch=5, components=4, size=3, spread=1.0):
    """Return means, log standard deviation and logits, in NumPy."""
    rng = np.random.default_rng(seed)
    mean = spread * rng.normal(size=(batch, components, size))
    return mean, 0.5 * rng.normal(size=size), rng.normal(size=(batch, components))


def given(parameters):
    return tuple(jnp.asarray(x, jnp.float32) for x in parameters)


def log_density(parameters, action):
    """Return the logarithm of the weighted sum of the components' densities."""
    mean, log_std, logits = parameters
    z = (action[:, None] - mean) / np.exp(log_std)
    each = np.exp(-0.5 * z**2) / (np.exp(log_std) * np.sqrt(2 * np.pi))
    return np.log(np.sum(softmax(logits) * each.prod(axis=-1), axis=-1))


def entropy_bound(parameters):
    """Return the bound by loops over pairs of components."""
    mean, log_std, logits = parameters
    bounds, weights = [], softmax(logits)
    for means, own in zip(mean, weights, strict=True):
        bound = np.sum(0.5 * np.log(2 * np.pi * np.e * np.exp(2 * log_std)))
        for one, w in zip(means, own, strict=True):
            z = ((one - means) / np.exp(log_std)) ** 2
            bound -= w * np.log(np.sum(own * np.exp(-z.sum(axis=1) / 8)))
        bounds.append(bound)
    return np.array(bounds)


def test_the_density_and_the_bound_are_their_formulas():
    parameters = draw()
    action = np.random.default_rng(1).normal(size=(5, 3))

    @jax.jit
    def ours(parameters, action):
        log_prob = MIXTURE.log_prob(parameters, action)
        return log_prob, MIXTURE.entropy(parameters), MIXTURE.mode(parameters)

    log_prob, bound, mode = ours(given(parameters), jnp.asarray(action, jnp.float32))
    np.testing.assert_allclose(log_prob, log_density(parameters, action), rtol=1e-5)
    np.testing.assert_allclose(bound, entropy_bound(parameters), rtol=1e-5)
    mean, _, logits = parameters
    np.testing.assert_allclose(mode, mean[np.arange(5), logits.argmax(axis=1)])


@pytest.mark.parametrize("spread", [0.0, 1.0, 100.0])
def test_the_bound_is_below_the_entropy_of_draws(spread):
    mean, log_std, logits = draw(batch=1, spread=spread)
    count = 50_000
    parameters = mean.repeat(count, 0), log_std, logits.repeat(count, 0)
    drawn = MIXTURE.sample(jax.random.key(0), given(parameters))
    entropy = -log_density(parameters, np.asarray(drawn, float)).mean()
    bound = entropy_bound((mean, log_std, logits))[0]
    assert bound < entropy + 0.02
    if spread in (0.0, 100.0):
        assert bound == pytest.approx(entropy, abs=0.02)
    # It is never below a single component's.
    assert bound > GAUSSIAN.entropy(given((mean, log_std))) - 1e-4


def test_an_untrained_policy_has_the_initial_std_and_components_apart():
    components = 5
    network = MIXTURE.network((64, 64), 2, components=components)
    observation = jax.random.normal(jax.random.key(1), (9, 11))
    params = network.init(jax.random.key(0), observation)
    parameters = network.apply(MIXTURE.explore(params, 0.25), observation)
    mean, log_std, logits = parameters
    np.testing.assert_allclose(np.exp(log_std), 0.25 * 0.5**0.5, rtol=1e-5)
    np.testing.assert_allclose(mean.std(axis=1), 0.25 * 0.5**0.5, rtol=0.2)
    np.testing.assert_allclose(mean.mean(axis=1), 0.0, atol=0.02)
    np.testing.assert_allclose(jax.nn.softmax(logits), 1 / components, atol=0.02)
    tiled = (x[:1].repeat(20_000, axis=0) for x in (mean, logits))
    drawn = MIXTURE.sample(jax.random.key(0), (next(tiled), log_std, next(tiled)))
    np.testing.assert_allclose(drawn.std(axis=0), 0.25, rtol=0.1)


# The other agents use nothing of a policy that this one does not.
def test_replays_train_it():
    env, algorithm = gasil_jax.make_env("point_mass"), gasil_jax.algorithm("ppo+sil")
    algorithm = algorithm.replace(
        **SETTINGS, policy_components=3, entropy_coefficient=0.01
    )
    state, metrics = jax.jit(gasil_jax.make_train(env, algorithm))(jax.random.key(0))
    assert np.isfinite(metrics["entropy"]).all()
    assert (metrics["skipped_updates"] == 0).all()
    layers = state.actor_critic.policy.params["params"]["MLP_0"]
    assert layers["Dense_1"]["bias"].shape == (3 * (2 + 1),)


def test_a_component_is_drawn_by_its_weight():
    mean = np.array([[-50.0, 5.0], [50.0, 5.0], [0.0, -80.0]])
    log_std, logits = np.log([0.5, 2.0]), np.log([0.5, 0.3, 0.2])
    tiled = np.tile(mean, (20_000, 1, 1)), log_std, np.tile(logits, (20_000, 1))
    drawn = np.asarray(MIXTURE.sample(jax.random.key(0), given(tiled)))
    nearest = np.abs(drawn[:, None] - mean).sum(axis=-1).argmin(axis=1)
    share = np.bincount(nearest, minlength=3) / 20_000
    np.testing.assert_allclose(share, [0.5, 0.3, 0.2], atol=0.015)
    within = (drawn - mean[nearest]).std(axis=0)
    np.testing.assert_allclose(within, [0.5, 2.0], rtol=0.03)


def test_far_from_all_components_the_density_is_finite():
    parameters = given(draw())
    distant = jnp.full((5, 3), 1e3)
    log_prob = lambda x: MIXTURE.log_prob(x, distant).sum()
    value, gradient = jax.jit(jax.value_and_grad(log_prob))(parameters)
    for x in (value, *gradient):
        assert np.isfinite(x).all()

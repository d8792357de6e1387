"""Networks of one's own, as an agent's functions return them."""

import jax
import numpy as np
import pytest
from corridor import Corridor
from flax import linen as nn

import gasil_jax
from gasil_envs import wrappers
from gasil_jax import numpy_policy, policy

SMALL = {"total_steps": 256, "batch_steps": 128, "num_envs": 4, "num_epochs": 1}


class Head(nn.Module):
    """One layer, and no axis at the end if its width is 0."""

    width: int = 0

    @nn.compact
    def __call__(self, *inputs):
        """(..., input), ... -> (..., width) or (...)."""
        x = nn.Dense(max(self.width, 1))(jax.numpy.concatenate(inputs, axis=-1))
        return x if self.width else x[..., 0]


class Own(gasil_jax.PPOGASIL):
    """All three networks are one layer."""

    def policy_network(self, sizes):
        """Return the layers of the policy."""
        return Head(sizes.action)

    def value_network(self, sizes):
        """Return the network of values."""
        return Head()

    def discriminator_network(self):
        """Return the network of the logit."""
        return Head()


def assert_it_acts(env, state):
    """The saved policy of a state is its network, which needs JAX."""
    observation = np.ones((3, env.observation_size), np.float32)
    act = policy.from_state(state, env)
    learned = state.actor_critic.policy
    with jax.numpy_rank_promotion("allow"):
        inputs = numpy_policy.inputs(policy.weights(state, env), observation)
        parameters = learned.network.apply(learned.params, inputs)
    if hasattr(env, "num_actions"):
        np.testing.assert_array_equal(act(observation), parameters.argmax(axis=-1))
    else:
        expected = np.clip(parameters[0], *wrappers.action_range(env))
        np.testing.assert_allclose(act(observation), expected, rtol=1e-5)
    with pytest.raises(ValueError, match="a Flax module of your own, which needs JAX"):
        numpy_policy.make(policy.weights(state, env))(observation)


def test_networks_of_ones_own_are_trained_and_act():
    env = gasil_jax.make_env("point_mass")
    algorithm = gasil_jax.Algorithm(Own()).replace(buffer_steps=64, **SMALL)
    init = lambda key: gasil_jax.init(env, algorithm, key)
    before = state = jax.jit(init)(jax.random.key(0))
    step = jax.jit(lambda state: gasil_jax.train_step(env, algorithm, state))
    for _ in range(2):
        state, metrics = step(state)
        assert np.isfinite(metrics["value_loss"])

    def networks(state):
        learned = state.actor_critic
        learners = learned.policy, learned.values[0], state.agent.discriminator
        return [learner.params for learner in learners]

    changed = jax.tree.map(
        lambda x, y: bool((x != y).any()), networks(state), networks(before)
    )
    assert all(jax.tree.leaves(changed))
    assert_it_acts(env, state)


def test_a_network_of_ones_own_acts_in_discrete_actions():
    algorithm = gasil_jax.Algorithm(Own()).replace(**SMALL)
    init = jax.jit(lambda key: gasil_jax.init(Corridor(), algorithm, key))
    assert_it_acts(Corridor(), init(jax.random.key(0)))


class WithState(nn.Module):
    """It has more than parameters."""

    @nn.compact
    def __call__(self, x):
        """(..., obs) -> (...)."""
        return nn.BatchNorm(use_running_average=False)(x)[..., 0]


@pytest.mark.parametrize(
    ("function", "network", "message"),
    [
        ("policy_network", Head(3), r"returns float32\[2, 3\] for 2 steps.*\[2, 2\]$"),
        ("value_network", Head(1), r"returns float32\[2, 1\] .* be float32\[2\]$"),
        ("value_network", WithState(), "has batch_stats, params: it must have par"),
        ("value_network", 3, "fails: AttributeError: 'int' object has no"),
        ("discriminator_network", Head(2), r"float32\[2, 2\] for 2 steps: it must"),
    ],
)
def test_a_network_that_does_not_fit_is_refused_in_a_line(function, network, message):
    kind = type("Wrong", (gasil_jax.PPOGASIL,), {function: lambda *_: network})
    with pytest.raises(ValueError, match=f"{function} of agent .* {message}") as told:
        gasil_jax.make_train(
            gasil_jax.make_env("point_mass"), gasil_jax.Algorithm(kind())
        )
    assert "\n" not in str(told.value)

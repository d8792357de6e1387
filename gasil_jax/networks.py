"""The networks, in Flax linen."""

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from flax import linen as nn

#: The functions that may follow a hidden layer.
ACTIVATIONS: Mapping[str, Callable[[jax.Array], jax.Array]] = {
    "tanh": nn.tanh,
    "relu": nn.relu,
    "swish": nn.swish,
}
#: The name of an `MLP` in a policy's parameters, which says its activation.
POLICY_LAYERS: Mapping[str, str] = {
    "tanh": "MLP_0",
    "relu": "MLP_relu",
    "swish": "MLP_swish",
}


def orthogonal(scale: float) -> nn.initializers.Initializer:
    """Return Flax's orthogonal initializer, made sequential under `jax.vmap`.

    Several batched QR factorizations in one program can deadlock jaxlib 0.10.1 on a
    CPU. A loop over single ones can't.
    """

    def init(key: jax.Array, shape: Sequence[int], dtype: Any = jnp.float32) -> Any:
        return _orthogonal(jax.random.key_data(key), scale, tuple(shape), dtype)

    return init


# Flax traces the initializer wherever a network is applied; jitted, it is traced once.
@functools.partial(jax.jit, static_argnums=(1, 2, 3))
def _orthogonal(
    data: jax.Array, scale: float, shape: tuple[int, ...], dtype: Any
) -> jax.Array:
    initializer = nn.initializers.orthogonal(scale)

    @jax.custom_batching.sequential_vmap
    def one(data: jax.Array) -> jax.Array:
        return initializer(jax.random.wrap_key_data(data), shape, dtype)

    return one(data)


class MLP(nn.Module):
    """Hidden layers and a linear output layer, orthogonally initialized."""

    hidden_sizes: Sequence[int]
    output_size: int
    output_scale: float = 1.0  # of the output layer's initial weights
    activation: str = "tanh"  # a key of `ACTIVATIONS`
    layer_norm: bool = False  # before each activation (Ba, Kiros, Hinton 2016)
    output_bias: nn.initializers.Initializer = nn.initializers.zeros

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """(..., input) -> (..., output)."""
        for size in self.hidden_sizes:
            kernel_init = orthogonal(2.0**0.5)
            x = nn.Dense(size, kernel_init=kernel_init)(x)
            x = nn.LayerNorm()(x) if self.layer_norm else x
            x = ACTIVATIONS[self.activation](x)
        kernel_init, bias_init = orthogonal(self.output_scale), self.output_bias
        last = nn.Dense(self.output_size, kernel_init=kernel_init, bias_init=bias_init)
        return last(x)


class _Policy(nn.Module):
    """The layers of a policy, or the module `own` instead of them.

    The initial weights of the last layer have scale 0.01, so that the initial policy is
    nearly the same in every state (OpenAI baselines, ppo1).
    """

    hidden_sizes: Sequence[int]
    action_size: int
    activation: str = "tanh"
    layer_norm: bool = False
    own: nn.Module | None = None
    components: int = 1

    def layers(self, observation: jax.Array, **output: Any) -> jax.Array:
        """(..., obs) -> (..., action), or the output of an `MLP` with these fields."""
        if self.own is not None:
            return self.own(observation)
        output = {"output_size": self.action_size, **output}
        return MLP(
            self.hidden_sizes,
            output_scale=0.01,
            activation=self.activation,
            layer_norm=self.layer_norm,
            name=POLICY_LAYERS[self.activation],
            **output,
        )(observation)


class GaussianPolicy(_Policy):
    """A Gaussian policy whose log standard deviation does not depend on the state."""

    @nn.compact
    def __call__(self, observation: jax.Array) -> tuple[jax.Array, jax.Array]:
        """(..., obs) -> mean (..., action), log standard deviation (action,)."""
        mean = self.layers(observation)
        log_std = self.param("log_std", nn.initializers.zeros, (self.action_size,))
        return mean, log_std


class MixturePolicy(_Policy):
    """A mixture of Gaussians with one log standard deviation, the same in all states.

    Components with the same mean would get the same gradients and stay together. So
    their first means, which are biases, are drawn at random. Half of the variance of an
    untrained policy's actions is within the components, and half between them: two
    components are then two of their deviations apart, so that an action is ascribed to
    one of them. The whole mixture has mean 0 and standard deviation 1, as a Gaussian
    has, and its components are nearly equally probable.
    """

    @nn.compact
    def __call__(
        self, observation: jax.Array
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Return the parameters of the mixture, (..., obs) -> three arrays.

        They are the means (..., component, action), the log standard deviation
        (action,) and the logits of the components (..., component).
        """
        count, size = self.components, self.action_size

        def apart(key: jax.Array, shape: Sequence[int], dtype: Any) -> jax.Array:
            drawn = jax.random.normal(key, (count, size), dtype)
            mean = 0.5**0.5 * nn.standardize(drawn, axis=0)
            return jnp.append(mean, jnp.zeros(count, dtype))

        output = self.layers(
            observation, output_size=count * (size + 1), output_bias=apart
        )
        within = nn.initializers.constant(-0.5 * math.log(2.0))
        log_std = self.param("log_std", within, (size,))
        mean, logits = output[..., :-count], output[..., -count:]
        return mean.reshape(*mean.shape[:-1], count, size), log_std, logits


class CategoricalPolicy(_Policy):
    """A policy of discrete actions, which are nearly equally probable at first."""

    @nn.compact
    def __call__(self, observation: jax.Array) -> jax.Array:
        """(..., obs) -> logits (..., action)."""
        return self.layers(observation)


class Value(nn.Module):
    """The value of a state."""

    hidden_sizes: Sequence[int]
    activation: str = "tanh"
    layer_norm: bool = False

    @nn.compact
    def __call__(self, observation: jax.Array) -> jax.Array:
        """(..., obs) -> (...)."""
        layers = MLP(self.hidden_sizes, 1, 1.0, self.activation, self.layer_norm)
        return layers(observation)[..., 0]


class Discriminator(nn.Module):
    """The logit of D(s, a), the probability that the pair comes from the policy."""

    hidden_sizes: Sequence[int]

    @nn.compact
    def __call__(self, observation: jax.Array, action: jax.Array) -> jax.Array:
        """(..., obs), (..., action) -> (...)."""
        x = jnp.concatenate([observation, action], axis=-1)
        return MLP(self.hidden_sizes, 1)(x)[..., 0]


class StepReward(nn.Module):
    """The reward of a step, for `rewards.decomposition`; near 0 before training."""

    hidden_sizes: Sequence[int]

    @nn.compact
    def __call__(self, *step: jax.Array) -> jax.Array:
        """Return the rewards, (...), of steps' inputs, (..., size) each."""
        x = jnp.concatenate(step, axis=-1)
        return MLP(self.hidden_sizes, 1, 0.01)(x)[..., 0]

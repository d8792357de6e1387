"""The networks, in Flax linen."""

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
    initializer = nn.initializers.orthogonal(scale)

    def init(key: jax.Array, shape: Sequence[int], dtype: Any = jnp.float32) -> Any:
        one = jax.custom_batching.sequential_vmap(
            lambda data: initializer(jax.random.wrap_key_data(data), shape, dtype)
        )
        return one(jax.random.key_data(key))

    return init


class MLP(nn.Module):
    """Hidden layers and a linear output layer, orthogonally initialized.

    Attributes:
      hidden_sizes: widths of the hidden layers.
      output_size: width of the output.
      output_scale: scale of the output layer's initial weights.
      activation: a key of `ACTIVATIONS`.
      layer_norm: whether what a hidden layer computes is normalized before the
        activation (Ba, Kiros, Hinton 2016).
    """

    hidden_sizes: Sequence[int]
    output_size: int
    output_scale: float = 1.0
    activation: str = "tanh"
    layer_norm: bool = False

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """(..., input) -> (..., output)."""
        for size in self.hidden_sizes:
            kernel_init = orthogonal(2.0**0.5)
            x = nn.Dense(size, kernel_init=kernel_init)(x)
            x = nn.LayerNorm()(x) if self.layer_norm else x
            x = ACTIVATIONS[self.activation](x)
        kernel_init = orthogonal(self.output_scale)
        return nn.Dense(self.output_size, kernel_init=kernel_init)(x)


class _Policy(nn.Module):
    """The layers of a policy, or a module in their place; the last starts at 0.01.

    So the initial policy is nearly the same in every state (OpenAI baselines, ppo1).
    """

    hidden_sizes: Sequence[int]
    action_size: int
    activation: str = "tanh"
    layer_norm: bool = False
    own: nn.Module | None = None

    def layers(self, observation: jax.Array) -> jax.Array:
        """(..., obs) -> (..., action)."""
        if self.own is not None:
            return self.own(observation)
        return MLP(
            self.hidden_sizes,
            self.action_size,
            0.01,
            self.activation,
            self.layer_norm,
            name=POLICY_LAYERS[self.activation],
        )(observation)


class GaussianPolicy(_Policy):
    """A Gaussian policy whose log standard deviation does not depend on the state."""

    @nn.compact
    def __call__(self, observation: jax.Array) -> tuple[jax.Array, jax.Array]:
        """(..., obs) -> mean (..., action), log standard deviation (action,)."""
        mean = self.layers(observation)
        log_std = self.param("log_std", nn.initializers.zeros, (self.action_size,))
        return mean, log_std


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
        """What is seen of a step, (..., size) each -> (...)."""
        x = jnp.concatenate(step, axis=-1)
        return MLP(self.hidden_sizes, 1, 0.01)(x)[..., 0]

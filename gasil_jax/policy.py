"""Turn training states and saved policies into JAX functions."""

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from gasil_envs import wrappers
from gasil_envs.precision import full_precision
from gasil_jax import normalization, numpy_policy
from gasil_jax.config import validate_key, validate_state
from gasil_jax.distributions import CATEGORICAL, GAUSSIAN, MIXTURE
from gasil_jax.networks import POLICY_LAYERS


class Network(struct.PyTreeNode):
    """A policy's network that is none of the package's, in place of its arrays."""

    params: Any
    module: Any = struct.field(pytree_node=False)


def weights(state: Any, env: Any) -> dict[str, Any]:
    """Return a `TrainState`'s policy as the arrays that `numpy_policy` describes.

    From a batch of states every array but those in `numpy_policy.SHARED` is
    (seeds, ...).
    """
    learner = state.actor_critic.policy
    params = learner.params["params"]
    mean, scale = jax.jit(normalization.moments)(state.normalizer)
    arrays: dict[str, Any] = {"mean": mean, "scale": scale}
    if wrappers.is_discrete(env):
        arrays["num_actions"] = np.int32(env.num_actions)
    else:
        low, high = wrappers.action_range(env)

        def wide(x: Any) -> np.ndarray:
            return np.broadcast_to(np.asarray(x, np.float32), (env.action_size,))

        arrays |= {"log_std": params["log_std"], "low": wide(low), "high": wide(high)}
    if learner.network is not None:
        return arrays | {"network": Network(learner.params, learner.network)}
    (activation,) = (x for x, name in POLICY_LAYERS.items() if name in params)
    layers = params[POLICY_LAYERS[activation]]
    if activation != "tanh":
        arrays[f"activation_{activation}"] = np.int32(1)
    for name, own in layers.items():
        kind, _, i = name.partition("_")
        prefix = "norm_" if kind == "LayerNorm" else ""
        arrays |= {f"{prefix}{x}_{i}": array for x, array in own.items()}
    # A mixture has a mean and a logit for each component.
    last = sum(name.startswith("kernel_") for name in arrays) - 1
    each = wrappers.action_size(env) + 1
    if components := arrays[f"bias_{last}"].shape[-1] // each:
        arrays["policy_components"] = np.int32(components)
    return arrays


def from_state(state: Any, env: Any) -> Callable[..., jax.Array]:
    """Return the policy of a single `TrainState`, as `saved.load_policy` does."""
    validate_state(state)
    return make(weights(state, env))


def make(weights: Mapping[str, Any]) -> Callable[..., jax.Array]:
    """Return the policy with these arrays, as `saved.load_policy` does."""

    def float32(x: Any) -> jax.Array:
        return jnp.asarray(x, jnp.float32)

    arrays = jax.tree.map(float32, dict(weights))
    network, log_std = arrays.pop("network", None), arrays.get("log_std")
    discrete = numpy_policy.is_discrete(arrays)
    mixture = numpy_policy.is_mixture(arrays)
    distribution = CATEGORICAL if discrete else MIXTURE if mixture else GAUSSIAN

    @full_precision
    def policy(observation: jax.Array, key: jax.Array | None = None) -> jax.Array:
        # The functions for NumPy, and bounds of actions, broadcast as NumPy does.
        with jax.numpy_rank_promotion("allow"):
            if network is not None:
                inputs = numpy_policy.inputs(arrays, float32(observation), jnp)
                parameters = network.module.apply(network.params, inputs)
            else:
                parameters = numpy_policy.output(arrays, float32(observation), jnp)
                if mixture:
                    mean, logits = numpy_policy.components(parameters, len(log_std))
                    parameters = mean, log_std, logits
                elif not discrete:
                    parameters = parameters, log_std
            if key is None:
                action = distribution.mode(parameters)
            else:
                validate_key(key)
                action = distribution.sample(key, parameters)
            return distribution.executed(action, arrays.get("low"), arrays.get("high"))

    return policy

"""Run a saved policy with NumPy alone; this module does not import JAX.

    act = gasil_jax.numpy_policy.load("runs/hopper")
    action = act(observation)

"zoo:NAME" names one of the trained policies that come with the package. The file is an
``.npz`` of plain arrays, which docs/data.md lists; nothing is unpickled.

An observation is normalized, (x - mean) / scale, and clipped to +-10; every layer but
the last is followed by tanh, or another activation; the output is the mean of a
Gaussian, the means and logits of a mixture, or the logits of discrete actions.
"""

import json
import pathlib
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from gasil_jax import npz
from gasil_jax.errors import refusal, shown, unknown

#: Folder of the trained policies that come with the package, and how they are named.
ZOO, ZOO_PREFIX = pathlib.Path(__file__).with_name("zoo"), "zoo:"
#: Normalized observations are clipped to plus and minus this number.
CLIP = 10.0
#: The arrays that are the same for all seeds of a file.
SHARED = (
    *("low", "high", "num_actions", "policy_components"),
    *("activation_relu", "activation_swish"),
)
OWN_NETWORK = "the policy's network is a Flax module of your own, which needs JAX"


def zoo() -> tuple[str, ...]:
    """Return the names of the trained policies that come with the package."""
    return tuple(sorted(path.stem for path in ZOO.glob("*.npz")))


def _file(path: str | pathlib.Path) -> pathlib.Path:
    """Return the file of a saved policy."""
    if not isinstance(path, str | pathlib.PurePath):
        raise refusal("path", path, "a string or a pathlib.Path")
    if str(path).startswith(ZOO_PREFIX):
        name = str(path).removeprefix(ZOO_PREFIX)
        if name not in zoo():
            raise ValueError(unknown("policy of the zoo", name, zoo()))
        return ZOO / f"{name}.npz"
    path = pathlib.Path(path)
    return path / "policy.npz" if path.is_dir() else path


def about(name: str) -> dict[str, Any]:
    """Return how a policy of the zoo was trained, and its score.

    Args:
      name: one of `zoo()`, as "zoo:NAME".

    Returns:
      "env", "reward_delay", "agent", "decompose_rewards", "seed" and "env_steps" of its
      training; "mean", "deviation" and "episodes" of its returns in Gymnasium.

    Raises:
      ValueError: if there is no such policy.
    """
    if not isinstance(name, str) or not name.startswith(ZOO_PREFIX):
        raise refusal("name", name, f"zoo:NAME, with NAME one of {', '.join(zoo())}")
    # Older files do not say whether rewards were decomposed: they were not.
    stored = json.loads(str(npz.read(_file(name))["about"]))
    return {"decompose_rewards": False, **stored}


def read(path: str | pathlib.Path, seed: int | None = None) -> dict[str, np.ndarray]:
    """Return the arrays of one seed's policy, float32.

    Args:
      path: the file ``policy.npz``, the folder of a finished run, or "zoo:NAME".
      seed: number of the seed; default the one with the highest final return.

    Raises:
      ValueError: if it is not a saved policy, or has no such seed.
    """
    path = _file(path)
    name = " ".join(str(path).splitlines())
    if not path.exists():
        raise ValueError(
            f"{name} does not exist: it must be a finished run's folder or its "
            f"policy.npz, or {ZOO_PREFIX}NAME"
        )
    try:
        arrays = npz.read(path)
        for required in ("seeds", "final_return", "mean", "scale", "kernel_0"):
            if required not in arrays:
                raise ValueError(f"{required} is missing")
    except ValueError as error:
        raise ValueError(f"{name} is not a saved policy ({error})") from None
    arrays.pop("about", None)
    seeds = arrays.pop("seeds").tolist()
    returns = np.nan_to_num(arrays.pop("final_return"), nan=-np.inf)
    shared = {name: arrays.pop(name) for name in SHARED if name in arrays}
    if seed is None:
        seed = seeds[int(np.argmax(returns))]
    if seed not in seeds:
        listed = ", ".join(map(str, seeds))
        raise ValueError(f"seed is {shown(seed)}: {name} has a policy of {listed}")
    index = seeds.index(seed)
    weights = {name: value[index] for name, value in arrays.items()} | shared
    # JAX takes no numbers of another byte order.
    return {name: value.astype(np.float32) for name, value in weights.items()}


def is_discrete(weights: Mapping[str, Any]) -> bool:
    """Return whether a policy's actions are discrete."""
    return "num_actions" in weights


def is_mixture(weights: Mapping[str, Any]) -> bool:
    """Return whether a policy is a mixture of Gaussians."""
    return "policy_components" in weights and not is_discrete(weights)


def components(output: Any, action_size: int) -> tuple[Any, Any]:
    """Split a mixture's output, (..., component * (action + 1)).

    Returns the means, (..., component, action), and the logits, (..., component).
    """
    shape, count = output.shape[:-1], output.shape[-1] // (action_size + 1)
    mean, logits = output[..., :-count], output[..., -count:]
    return mean.reshape(*shape, count, action_size), logits


def inputs(weights: Mapping[str, Any], observation: Any, xp: Any = np) -> Any:
    """Return normalized observations, (..., obs), as `output` describes."""
    size = weights["mean"].shape[-1]
    if (shape := np.shape(observation))[-1:] != (size,):
        raise ValueError(f"observation has shape {shape}: it must be (..., {size})")
    x = (observation - weights["mean"]) / weights["scale"]
    return xp.clip(x, -CLIP, CLIP)


def output(weights: Mapping[str, Any], observation: Any, xp: Any = np) -> Any:
    """Return the output of the policy's network, by numpy or jax.numpy (`xp`).

    It is the mean of the actions, or the logits of discrete ones, (..., action); for a
    mixture see `components`. Observations, (..., obs), are not normalized.
    """
    if "network" in weights:
        raise ValueError(OWN_NETWORK)
    x = inputs(weights, observation, xp)
    last = sum(name.startswith("kernel_") for name in weights) - 1
    for i in range(last + 1):
        x = x @ weights[f"kernel_{i}"] + weights[f"bias_{i}"]
        if i < last:
            x = _activate(weights, x, i, xp)
    return x


def _activate(weights: Mapping[str, Any], x: Any, layer: int, xp: Any) -> Any:
    """Return what follows a hidden layer's linear part, (..., width)."""
    if "norm_scale_0" in weights:
        x = x - x.mean(axis=-1, keepdims=True)
        x = x / xp.sqrt((x**2).mean(axis=-1, keepdims=True) + 1e-6)
        x = x * weights[f"norm_scale_{layer}"] + weights[f"norm_bias_{layer}"]
    if "activation_relu" in weights:
        return xp.maximum(x, 0.0)
    if "activation_swish" in weights:
        # The sigmoid, which does not overflow in this form.
        return x * 0.5 * (1.0 + xp.tanh(0.5 * x))
    return xp.tanh(x)


def load(
    path: str | pathlib.Path, seed: int | None = None
) -> Callable[..., np.ndarray]:
    """Return a saved policy as a function of observations.

    The function is ``act(observation, generator=None)``, (..., obs) -> (..., action).
    It clips actions to their range. With a `numpy.random.Generator` the action is drawn
    from the policy; without one it is the policy's mean, or that of a mixture's most
    probable Gaussian. Discrete actions are int32 (...), without a generator the most
    probable ones.

    Raises:
      ValueError: as in `read`.
    """
    return make(read(path, seed))


def make(weights: Mapping[str, np.ndarray]) -> Callable[..., np.ndarray]:
    """Return the policy with these arrays, as `load` does for a file."""

    def act(
        observation: np.ndarray, generator: np.random.Generator | None = None
    ) -> np.ndarray:
        action = output(weights, observation)
        if is_discrete(weights):
            if generator is not None:
                # The largest of logits with Gumbel noise is drawn by probability.
                action = action + generator.gumbel(size=action.shape)
            return np.asarray(action.argmax(axis=-1), np.int32)
        if is_mixture(weights):
            mean, logits = components(action, weights["log_std"].shape[-1])
            if generator is not None:
                logits = logits + generator.gumbel(size=logits.shape)
            chosen = logits.argmax(axis=-1)[..., None, None]
            action = np.take_along_axis(mean, chosen, axis=-2)[..., 0, :]
        if generator is not None:
            noise = generator.standard_normal(action.shape)
            action = action + np.exp(weights["log_std"]) * noise
        action = np.clip(action, weights["low"], weights["high"])
        return np.asarray(action, np.float32)

    return act

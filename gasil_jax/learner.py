"""A trainable network: its parameters and its optimizer's state."""

from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct


class Learner(struct.PyTreeNode):
    """A network's parameters and its optimizer's state, one pytree.

    Attributes:
      params: the parameters.
      optimizer_state: the optimizer's state.
      network: the Flax module, if it is none of the package's.
    """

    params: Any
    optimizer_state: Any
    network: Any = struct.field(pytree_node=False, default=None)


def init(params: Any, transform: optax.GradientTransformation) -> Learner:
    """Return a learner with a fresh optimizer state."""
    return Learner(params, transform.init(params))


def adam() -> optax.GradientTransformation:
    """Return Adam without a step size.

    It treats all parameters as one vector, which is faster (see `ppo.optimizer`).
    """
    return optax.flatten(optax.scale_by_adam())


def descend(
    learner: Learner,
    gradient: Any,
    transform: optax.GradientTransformation,
    *,
    step_size: jax.Array | float,
) -> Learner:
    """Take one gradient step.

    Args:
      learner: the learner before the step.
      gradient: gradient of the loss, with the parameters' structure.
      transform: the optimizer without a step size.
      step_size: (), factor of the transformed gradient; it may be traced.
    """
    updates, optimizer_state = transform.update(gradient, learner.optimizer_state)
    params = jax.tree.map(lambda p, u: p - step_size * u, learner.params, updates)
    return learner.replace(params=params, optimizer_state=optimizer_state)


def select(condition: jax.Array, new: Any, old: Any) -> Any:
    """Return the pytree `new` where the condition, bool (), holds, else `old`."""
    return jax.tree.map(lambda x, y: jnp.where(condition, x, y), new, old)


def keep_if_finite(new: Any, old: Any) -> tuple[jax.Array, Any]:
    """Undo an update that is not finite.

    Args:
      new: a pytree after the update.
      old: the same pytree before the update.

    Returns:
      Whether every number in `new` is finite, bool (), and `new` if so, else `old`.
    """
    finite = [jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(new)]
    healthy = jnp.all(jnp.stack(finite))
    return healthy, select(healthy, new, old)

"""A trainable network: its parameters and its optimizer's state."""

from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct


class Learner(struct.PyTreeNode):
    """A network's parameters and its optimizer's state, one pytree."""

    params: Any
    optimizer_state: Any
    #: The Flax module, if it is none of the package's.
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
    """Take one gradient step: the transformed gradient times a step size, ()."""
    updates, optimizer_state = transform.update(gradient, learner.optimizer_state)
    params = jax.tree.map(lambda p, u: p - step_size * u, learner.params, updates)
    return learner.replace(params=params, optimizer_state=optimizer_state)


def select(condition: jax.Array, new: Any, old: Any) -> Any:
    """Return the pytree `new` where the condition, bool (), holds, else `old`.

    Leaves that are the same array in both, such as a buffer, are not copied.
    """

    def either(x: Any, y: Any) -> Any:
        return x if x is y else jnp.where(condition, x, y)

    return jax.tree.map(either, new, old)


def keep_if_finite(new: Any, old: Any) -> tuple[jax.Array, Any]:
    """Undo an update from `old` to `new` if any number that it made is not finite.

    Returns whether all are finite, bool (), and the result. Leaves that the update did
    not touch are neither read nor copied.
    """
    pairs = zip(jax.tree.leaves(new), jax.tree.leaves(old), strict=True)
    made = [x for x, y in pairs if x is not y]
    # One vector is checked by a tenth of the operations of many arrays.
    floats = [x for x in made if jnp.issubdtype(jnp.result_type(x), jnp.inexact)]
    numbers = [jnp.ravel(x) for x in floats]
    healthy = jnp.all(jnp.isfinite(jnp.concatenate([jnp.zeros(1), *numbers])))
    return healthy, select(healthy, new, old)

"""A network that learns: its parameters with its optimizer's state."""

from typing import Any

import jax
import optax
from flax import struct


class Learner(struct.PyTreeNode):
    """A network's parameters and its optimizer's state, one pytree."""

    params: Any
    optimizer_state: Any


def init(params: Any, transform: optax.GradientTransformation) -> Learner:
    """A learner that has taken no step."""
    return Learner(params, transform.init(params))


def descend(
    learner: Learner,
    gradient: Any,
    transform: optax.GradientTransformation,
    step_size: jax.Array | float,
) -> Learner:
    """One gradient step.

    Args:
      learner: before it.
      gradient: of what is minimized, the parameters' structure.
      transform: without a step size, so that the step size may be traced.
      step_size: what the transformed gradient is multiplied by, ().
    """
    updates, optimizer_state = transform.update(gradient, learner.optimizer_state)
    params = jax.tree.map(lambda p, u: p - step_size * u, learner.params, updates)
    return Learner(params, optimizer_state)

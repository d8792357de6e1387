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
    """Return a learner with a fresh optimizer state."""
    return Learner(params, transform.init(params))


def adam() -> optax.GradientTransformation:
    """Return Adam without a step size.

    It treats the parameters as one vector, which is faster, see `ppo.optimizer`.
    """
    return optax.flatten(optax.scale_by_adam())


def descend(
    learner: Learner,
    gradient: Any,
    transform: optax.GradientTransformation,
    step_size: jax.Array | float,
) -> Learner:
    """Take one gradient step.

    Args:
      learner: the learner before the step.
      gradient: gradient of the loss, with the parameters' structure.
      transform: the optimizer without a step size, so that the latter may be traced.
      step_size: (), factor of the transformed gradient.
    """
    updates, optimizer_state = transform.update(gradient, learner.optimizer_state)
    params = jax.tree.map(lambda p, u: p - step_size * u, learner.params, updates)
    return Learner(params, optimizer_state)

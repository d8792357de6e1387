"""The environments of ``brax.envs`` by name, as brax:NAME."""

import contextlib
import io
from typing import Any

import jax
import jax.numpy as jnp

# MJX, which Brax imports, prints that its optional Warp backend is absent.
with contextlib.redirect_stdout(io.StringIO()):
    import brax.envs

from gasil_envs.base import Wrapper


class _OfBrax(Wrapper):
    """An environment of Brax that keeps the size of its observations.

    Brax runs a reset, operation by operation, each time that it is asked for the size.
    """

    def __init__(self, env: Any, observation_size: int):
        super().__init__(env)
        self._observation_size = observation_size

    @property
    def observation_size(self) -> int:
        """The number of numbers in an observation."""
        return self._observation_size


def names() -> tuple[str, ...]:
    """Return the names of Brax's environments."""
    return tuple(brax.envs._envs)


def build(name: str) -> Any:
    """Build an environment of Brax, and trace a step without running it."""
    env = brax.envs.get_environment(name)
    state = jax.eval_shape(env.reset, jax.random.key(0))
    jax.eval_shape(env.step, state, jnp.zeros(env.action_size))
    return _OfBrax(env, state.obs.shape[-1])

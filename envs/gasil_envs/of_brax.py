"""The environments of ``brax.envs`` by name, as brax:NAME."""

import contextlib
import functools
import io
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

# MJX, which Brax imports, prints that its optional Warp backend is absent.
with contextlib.redirect_stdout(io.StringIO()):
    import brax.envs

from gasil_envs.base import Wrapper


def names() -> tuple[str, ...]:
    """Return the names of Brax's environments."""
    return tuple(brax.envs._envs)


def build(name: str) -> Any:
    """Build an environment of Brax, and trace a step without running it."""
    env: Any = brax.envs.get_environment(name)
    # "fast" has no robot.
    if getattr(env, "sys", None) is not None:
        env.draw = functools.partial(_draw, env.sys)
    state = jax.eval_shape(env.reset, jax.random.key(0))
    jax.eval_shape(env.step, state, jnp.zeros(env.action_size))
    env = Wrapper(env)
    # Brax runs a reset, operation by operation, each time that it is asked for this.
    env.observation_size = state.obs.shape[-1]
    return env


def _draw(system: Any, state: Any, size: tuple[int, int]) -> np.ndarray:
    """Return Brax's own picture of a state, which MuJoCo draws."""
    from brax.io import image

    return image.render_array(system, state, height=size[1], width=size[0])

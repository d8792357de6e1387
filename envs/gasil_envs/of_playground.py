"""The control tasks of MuJoCo Playground by name, as playground:NAME.

Its other tasks download models of robots, and are refused.
"""

import contextlib
import io
from typing import Any

import jax
import numpy as np

# It prints that its optional Warp backend is absent.
with contextlib.redirect_stdout(io.StringIO()):
    from mujoco_playground import dm_control_suite, registry

from gasil_envs.worlds import Unfit, World


def names() -> tuple[str, ...]:
    """Return the names of Playground's tasks."""
    return tuple(registry.ALL_ENVS)


def build(name: str) -> World:
    """Build NAME, or NAME:PART if observations have several parts; MJX steps it."""
    bare, _, part = name.partition(":")
    if bare not in dm_control_suite.ALL_ENVS:
        raise Unfit(
            "downloads a robot's model when it is built, which is not supported: only "
            "tasks of DeepMind's control suite do not"
        )
    config = registry.get_default_config(bare)
    if "impl" in config:
        config.impl = "jax"
    env = registry.load(bare, config=config)

    def begin(key: jax.Array) -> tuple[Any, Any]:
        state = env.reset(key)
        return state, state.obs

    def advance(key: jax.Array, state: Any, action: jax.Array) -> Any:
        state = env.step(state, action)
        return state, state.obs, state.reward, state.done

    limit = np.ones(env.action_size, np.float32)
    return World(
        begin,
        advance,
        actions=(-limit, limit),
        # A step of the task is one action.
        episode_length=int(config.episode_length),
        part=part or None,
    )

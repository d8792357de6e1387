"""The environments of navix, MiniGrid's grids in JAX, by name, as navix:NAME."""

from typing import Any

import jax
import jax.numpy as jnp
import navix
import numpy as np
from PIL import Image

from gasil_envs.worlds import World


def names() -> tuple[str, ...]:
    """Return the names of navix' environments."""
    return tuple(navix.registry())


def build(name: str) -> World:
    """Build one of `names`, with its default observation of the whole grid."""
    bare, _, part = name.partition(":")
    env = navix.make(bare)

    def begin(key: jax.Array) -> tuple[Any, Any]:
        timestep = env.reset(key)
        return timestep, timestep.observation

    def advance(key: jax.Array, timestep: Any, action: jax.Array) -> Any:
        # `env.step` would start the next episode.
        timestep = env._step(timestep, action)
        terminated = timestep.is_termination()
        return timestep, timestep.observation, timestep.reward, terminated

    world = World(
        begin,
        advance,
        actions=len(env.action_set),
        episode_length=int(env.max_steps),
        part=part or None,
    )
    world.draw = _draw
    return world


def _draw(state: Any, size: tuple[int, int]) -> np.ndarray:
    """Return navix' own picture of the whole grid."""
    grid = navix.observations.rgb(jax.tree.map(jnp.asarray, state[0].state))
    return np.asarray(Image.fromarray(np.asarray(grid)).resize(size))

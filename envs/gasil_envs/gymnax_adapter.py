"""The package's environments with gymnax 1.0's interface; all functions are pure.

    env = GymnaxEnv("walker2d", reward_delay=20)
    observation, state = env.reset(key, env.default_params)

When an episode ends, the next one begins within the same step. Only the spaces need the
package gymnax.
"""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from gasil_envs import registry, wrappers
from gasil_envs.base import State

Transition = tuple[jax.Array, State, jax.Array, jax.Array, jax.Array, dict[str, Any]]


class Params(struct.PyTreeNode):
    """Empty parameters: all settings are given when the environment is made."""


class GymnaxEnv:
    """One of `gasil_envs.names()`; use `jax.vmap` on its functions for many.

    `settings` are arguments of `gasil_envs.make`.
    """

    default_params = Params()

    def __init__(self, name: str, **settings: Any):
        self.name = name
        self._env = wrappers.FaultyStepEnds(registry.make(name, **settings))

    def reset(self, key: jax.Array, params: Any = None) -> tuple[jax.Array, State]:
        """Return the first observation, float32 (obs,), and the state."""
        state = self._env.reset(key)
        return state.obs, state

    def step(
        self, key: jax.Array, state: State, action: jax.Array, params: Any = None
    ) -> Transition:
        """Take a step; if the episode ends, start the next one, with `key`.

        Returns observation, state, reward, terminated, truncated (never both) and info.
        The observation, float32 (obs,), is the next episode's if this one ended, whose
        last one is ``info["final_observation"]``. ``info["true_reward"]`` is the reward
        without delay.
        """
        stepped, fresh = self._env.step(state, action), self._env.reset(key)
        ended = stepped.done > 0
        truncated = wrappers.truncated(stepped)
        state = jax.tree.map(lambda a, b: jnp.where(ended, a, b), fresh, stepped)
        info = {
            "final_observation": stepped.obs,
            "true_reward": stepped.info.get("true_reward", stepped.reward),
        }
        terminated = ended & ~truncated
        return state.obs, state, stepped.reward, terminated, truncated, info

    def observation_space(self, params: Params | None = None) -> Any:
        """Return an unbounded ``gymnax.environments.spaces.Box`` of shape (obs,)."""
        return _box(-jnp.inf, jnp.inf, self._env.observation_size)

    @property
    def num_actions(self) -> int:
        """The number of discrete actions, or the dimension of an action."""
        return wrappers.action_size(self._env)

    def action_space(self, params: Params | None = None) -> Any:
        """Return gymnax' ``Box`` of shape (action,), or its ``Discrete``."""
        if wrappers.is_discrete(self._env):
            return _spaces().Discrete(self._env.num_actions)
        low, high = wrappers.action_range(self._env)
        return _box(low, high, self._env.action_size)


def _spaces() -> Any:
    try:
        from gymnax.environments import spaces
    except ImportError:
        raise ImportError(
            'a gymnax space needs the package gymnax (pip install "gasil_jax[gymnax]")'
        ) from None
    return spaces


def _box(low: Any, high: Any, size: int) -> Any:
    low, high = (jnp.broadcast_to(jnp.float32(x), (size,)) for x in (low, high))
    return _spaces().Box(low, high, (size,), jnp.float32)

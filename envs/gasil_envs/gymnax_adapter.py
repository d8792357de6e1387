"""Our environments under the interface of gymnax 1.0, pure functions throughout.

    env = GymnaxEnv("walker2d", reward_delay=20)
    observation, state = env.reset(key, env.default_params)

An episode that ended begins anew within the same step. The spaces need the package
gymnax; what trains without looking at them does not.
"""

from typing import Any

import jax
import jax.numpy as jnp
from brax.envs import State
from flax import struct

from gasil_envs import registry, wrappers

Transition = tuple[jax.Array, State, jax.Array, jax.Array, jax.Array, dict[str, Any]]


class Params(struct.PyTreeNode):
    """Nothing: what can vary is given when the environment is made."""


class GymnaxEnv:
    """One environment; `jax.vmap` its functions for many.

    Args:
      name: one of `gasil_envs.names()`.
      **settings: fields of `gasil_envs.registry.Settings`.
    """

    default_params = Params()

    def __init__(self, name: str, **settings: Any):
        self.name = name
        self._env = registry.make(name, **settings)

    def reset(
        self, key: jax.Array, params: Params | None = None
    ) -> tuple[jax.Array, State]:
        """The first observation, float32 (obs,), and the state. Consumes the key."""
        state = self._env.reset(key)
        return state.obs, state

    def step(
        self,
        key: jax.Array,
        state: State,
        action: jax.Array,
        params: Params | None = None,
    ) -> Transition:
        """Observation, state, reward, terminated, truncated and info.

        Args:
          key: of the start of the next episode, where this one ends; consumed.
          state: of the step before.
          action: float32 (action,).
          params: of gymnax' interface; not looked at.

        Returns:
          Observation float32 (obs,), of the next episode where this one ended, whose
          own last one is ``info["final_observation"]``; reward float32 ();
          terminated and truncated bool (), not both. ``info["true_reward"]`` is
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
        """A ``gymnax.environments.spaces.Box``; of (obs,), without bounds."""
        return _box(-jnp.inf, jnp.inf, self._env.observation_size)

    def action_space(self, params: Params | None = None) -> Any:
        """A ``gymnax.environments.spaces.Box``; of (action,)."""
        low, high = getattr(self._env, "action_range", (-1.0, 1.0))
        return _box(low, high, self._env.action_size)


def _box(low: Any, high: Any, size: int) -> Any:
    try:
        from gymnax.environments import spaces
    except ImportError:
        raise ImportError(
            'a gymnax space needs the package gymnax (pip install "gasil_jax[gymnax]")'
        ) from None
    wide = lambda x: jnp.broadcast_to(jnp.asarray(x, jnp.float32), (size,))
    return spaces.Box(wide(low), wide(high), (size,), jnp.float32)

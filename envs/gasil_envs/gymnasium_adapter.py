"""Our environments with Gymnasium's interface, single or as a batch.

    import gasil_envs.gymnasium_adapter  # registers the names

    gymnasium.make("gasil_envs/walker2d", reward_delay=20)
    gymnasium.make_vec("gasil_envs/walker2d", num_envs=64)

Physics runs under `jax.jit`; the batch is one `jax.vmap`.
"""

from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from brax.envs import Env
from gymnasium.vector import AutoresetMode

from gasil_envs import registry, wrappers

_NAMESPACE = "gasil_envs"


def _spaces(env: Env) -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Box]:
    """Return the spaces of observations and actions."""
    low, high = getattr(env, "action_range", (-1.0, 1.0))
    shape = (env.action_size,)
    wide = lambda x: np.broadcast_to(np.asarray(x, np.float32), shape).copy()
    return (
        gymnasium.spaces.Box(-np.inf, np.inf, (env.observation_size,), np.float32),
        gymnasium.spaces.Box(wide(low), wide(high), shape, np.float32),
    )


def _key(generator: np.random.Generator) -> jax.Array:
    return jax.random.key(int(generator.integers(2**32)))


class GymnasiumEnv(gymnasium.Env):
    """A single environment with Gymnasium's interface.

    Args:
      name: one of `gasil_envs.names()`.
      **settings: fields of `gasil_envs.registry.Settings`.

    The environment has its own step limit; an episode that reaches it is truncated.
    """

    metadata = {"render_modes": []}  # noqa: RUF012

    def __init__(self, name: str, render_mode: None = None, **settings: Any):
        self._env = env = registry.make(name, **settings)
        self.observation_space, self.action_space = _spaces(env)
        self.render_mode = render_mode
        self._reset, self._step = jax.jit(env.reset), jax.jit(env.step)
        self._state: Any = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode and return its first observation, (obs,) float32."""
        super().reset(seed=seed)
        self._state = self._reset(_key(self.np_random))
        return np.asarray(self._state.obs), {}

    def step(
        self, action: np.ndarray
    ) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Return observation, reward, terminated, truncated and info.

        ``info["true_reward"]`` is the reward without delay.
        """
        self._state = state = self._step(self._state, jnp.asarray(action, jnp.float32))
        truncated = bool(wrappers.truncated(state))
        terminated = bool(state.done > 0) and not truncated
        info = {"true_reward": float(state.info.get("true_reward", state.reward))}
        return np.asarray(state.obs), float(state.reward), terminated, truncated, info


class GymnasiumVectorEnv(gymnasium.vector.VectorEnv):
    """A batch of environments; the step after an episode's end starts the next one.

    Args:
      name: one of `gasil_envs.names()`.
      num_envs: number of environments.
      **settings: fields of `gasil_envs.registry.Settings`.
    """

    metadata = {  # noqa: RUF012
        "render_modes": [],
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(self, name: str, num_envs: int = 1, **settings: Any):
        self._env = env = registry.make(name, **settings)
        self.num_envs = num_envs
        self.single_observation_space, self.single_action_space = _spaces(env)
        batch = gymnasium.vector.utils.batch_space
        self.observation_space = batch(self.single_observation_space, num_envs)
        self.action_space = batch(self.single_action_space, num_envs)
        self.render_mode = None
        self._state: Any = None
        resets = jax.vmap(env.reset)

        def step(state: Any, action: jax.Array, key: jax.Array) -> Any:
            over = state.done > 0
            fresh = resets(jax.random.split(key, num_envs))
            stepped = jax.vmap(env.step)(state, action)

            def choose(new: jax.Array, old: jax.Array) -> jax.Array:
                at = over.reshape((-1,) + (1,) * (old.ndim - 1))
                return jnp.where(at, new, old).astype(old.dtype)

            return jax.tree.map(choose, fresh, stepped)

        self._reset = jax.jit(lambda key: resets(jax.random.split(key, num_envs)))
        self._step = jax.jit(step)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode in each and return the observations, (num_envs, obs)."""
        super().reset(seed=seed)
        self._state = self._reset(_key(self.np_random))
        return np.array(self._state.obs), {}

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Return observation (num_envs, obs), reward, terminated, truncated and info.

        Reward, terminated, truncated and the true reward in info are (num_envs,) each.
        """
        given = jnp.asarray(actions, jnp.float32)
        self._state = state = self._step(self._state, given, _key(self.np_random))
        truncated = np.array(wrappers.truncated(state))
        terminated = np.array(state.done > 0) & ~truncated
        reward = np.array(state.reward, np.float64)
        true_reward = np.array(state.info.get("true_reward", state.reward))
        info = {
            "true_reward": true_reward,
            "_true_reward": np.ones(self.num_envs, bool),
        }
        return np.array(state.obs), reward, terminated, truncated, info


def register() -> None:
    """Register our environments with Gymnasium."""
    for name in registry.names():
        gymnasium.register(
            id=f"{_NAMESPACE}/{name}",
            entry_point=f"{__name__}:GymnasiumEnv",
            vector_entry_point=f"{__name__}:GymnasiumVectorEnv",
            kwargs={"name": name},
        )


# As an entry point of the installed package this would make every program that imports
# Gymnasium load JAX.
register()

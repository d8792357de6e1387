"""The package's environments with Gymnasium's interface, single or as a batch.

    import gasil_envs.gymnasium_adapter  # registers the names

    gymnasium.make("gasil_envs/walker2d", reward_delay=20)
    gymnasium.make_vec("gasil_envs/walker2d", num_envs=64)

Physics runs under `jax.jit`; a batch is one `jax.vmap`. With a delayed reward, an
episode that ``max_episode_steps`` truncates gets the rest of its reward in its last
step.
"""

import inspect
import multiprocessing
import os
from collections.abc import Iterator
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers import TimeLimit

from gasil_envs import errors, pictures, registry, wrappers
from gasil_envs.base import Env

_NAMESPACE = "gasil_envs"
_NO_FORK = (
    "JAX does not work in a process that was forked from one in which it runs: take "
    'vectorization_mode="vector_entry_point", or vector_kwargs={"context": "spawn"} '
    "for processes"
)
#: Id of the process that first used these environments; None before that.
_process: int | None = None


def _spaces(env: Env) -> tuple[gymnasium.Space[Any], gymnasium.Space[Any]]:
    """Return the spaces of observations and actions."""
    box, size = gymnasium.spaces.Box, env.observation_size
    observations = box(-np.inf, np.inf, (size,), np.float32)
    if wrappers.is_discrete(env):
        return observations, gymnasium.spaces.Discrete(env.num_actions)
    low, high = wrappers.action_range(env)
    shape = (env.action_size,)

    def wide(x: Any) -> np.ndarray:
        return np.broadcast_to(np.asarray(x, np.float32), shape).copy()

    return observations, box(wide(low), wide(high), shape, np.float32)


def _callers() -> Iterator[Any]:
    """Yield the `self` of each function on the call stack, the innermost first."""
    frame = inspect.currentframe()
    while frame is not None:
        yield frame.f_locals.get("self")
        frame = frame.f_back


def _refuse_fork() -> None:
    """Raise `RuntimeError` in a process forked from one that has used JAX.

    JAX would hang there.
    """
    global _process
    _process = _process or os.getpid()
    if os.getpid() != _process:
        raise RuntimeError(_NO_FORK)


def _refuse_forking_caller() -> None:
    """Raise `RuntimeError` if Gymnasium makes an environment before it forks.

    Its `AsyncVectorEnv` makes one in the parent to see the spaces. What is raised in
    its processes while they make theirs is lost.
    """
    for caller in _callers():
        if isinstance(caller, gymnasium.vector.AsyncVectorEnv):
            context = multiprocessing.get_context(caller.context)
            if context.get_start_method() == "fork":
                raise RuntimeError(_NO_FORK)


def _checked_action(action: Any, state: Any, space: gymnasium.Space[Any]) -> jax.Array:
    """Return an action, or a batch of them, that a state and a space allow."""
    if state is None:
        raise gymnasium.error.ResetNeeded("step needs a reset before it")
    given = np.asarray(action)
    if given.shape != space.shape:
        raise ValueError(f"action has shape {given.shape}: it must have {space.shape}")
    if isinstance(space, gymnasium.spaces.Box):
        return jnp.asarray(given, jnp.float32)
    if not space.contains(given.astype(np.int64)) or (given % 1).any():
        raise ValueError(f"action is {given}: it must be in {space}")
    return jnp.asarray(given, jnp.int32)


def _key(generator: np.random.Generator) -> jax.Array:
    return jax.random.key(int(generator.integers(2**32)))


def _where(mask: jax.Array, new: Any, old: Any) -> Any:
    """Return the states of a batch, new where the mask (batch,) is True."""

    def choose(new: jax.Array, old: jax.Array) -> jax.Array:
        at = mask.reshape((-1,) + (1,) * (old.ndim - 1))
        return jnp.where(at, new, old).astype(old.dtype)

    return jax.tree.map(choose, new, old)


class GymnasiumEnv(gymnasium.Env):
    """One of `gasil_envs.names()` with Gymnasium's interface.

    With `render_mode` "rgb_array", `render` draws pictures of so many pixels; the
    environment variable MUJOCO_GL chooses MuJoCo's OpenGL: egl needs no display.
    `settings` are arguments of `gasil_envs.make`. An episode is truncated when it
    reaches the environment's own step limit, or that of a
    `gymnasium.wrappers.TimeLimit` around it.
    """

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012

    def __init__(
        self,
        name: str,
        render_mode: str | None = None,
        width: int = 480,
        height: int = 360,
        **settings: Any,
    ):
        _refuse_fork()
        _refuse_forking_caller()
        self._env = env = wrappers.FaultyStepEnds(registry.make(name, **settings))
        self.observation_space, self.action_space = _spaces(env)
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"render_mode is {render_mode!r}: it must be 'rgb_array'")
        self.render_mode = render_mode
        self._painter = None
        if render_mode is not None:
            self._painter = pictures.painter(env, (width, height))
            fps = round(1.0 / self._painter.seconds_per_step)
            self.metadata = {**self.metadata, "render_fps": fps}
        self._reset, self._step = jax.jit(env.reset), jax.jit(env.step)
        self._state: Any = None
        # Typed as Any because an elapsed number of steps is None before the reset.
        self._limits: list[Any] = []
        # The physics states since the episode's start, for `render`.
        self._episode: list[Any] = []

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode and return its first observation, (obs,) float32."""
        _refuse_fork()
        super().reset(seed=seed)
        self._limits = self._time_limits()
        for limit in self._limits:
            if limit._max_episode_steps > self._env.episode_length:
                raise ValueError(
                    f"max_episode_steps is {limit._max_episode_steps}: the "
                    f"environment's own limit is {self._env.episode_length}"
                )
        self._state = self._reset(_key(self.np_random))
        self._episode = []
        self._record()
        return np.array(self._state.obs), self._info()

    def step(
        self, action: np.ndarray
    ) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Return observation, reward, terminated, truncated and info.

        ``info["true_reward"]`` is the reward without delay, 0 after a reset.
        """
        _refuse_fork()
        given = _checked_action(action, self._state, self.action_space)
        self._state = state = self._step(self._state, given)
        self._record()
        truncated = bool(wrappers.truncated(state))
        terminated = bool(state.done > 0) and not truncated
        reward, info = float(state.reward), self._info()
        held = state.info.get("held_reward")
        last = any(x._elapsed_steps + 1 >= x._max_episode_steps for x in self._limits)
        if last and not terminated and held is not None:
            # The limit ends the episode after this step, so the held reward is given
            # now. It is then 0, in case a wrapper that repeats actions goes on.
            reward += float(held)
            paid = {**state.info, "held_reward": jnp.zeros_like(held)}
            self._state = state.replace(info=paid)
        return np.array(state.obs), reward, terminated, truncated, info

    def render(self) -> np.ndarray | None:
        """Return a picture, uint8 (height, width, 3); None without a render mode."""
        return None if self._painter is None else self._painter.draw(self._episode)

    def close(self) -> None:
        """Free the resources of rendering."""
        if self._painter is not None:
            self._painter.close()

    def _info(self) -> dict[str, Any]:
        """Return info; its keys are the same after a reset and after a step."""
        state = self._state
        return {"true_reward": float(state.info.get("true_reward", state.reward))}

    def _record(self) -> None:
        if self._painter is not None:
            self._episode.append(self._state.pipeline_state)

    def _time_limits(self) -> list[Any]:
        """Return the `TimeLimit` wrappers around this environment, from the call stack.

        `gymnasium.make` does not pass max_episode_steps on but wraps the environment in
        a `TimeLimit`. An environment has no reference to its wrappers, but their
        `reset` has called this one, so each is the `self` of a caller's frame.
        """
        return [
            caller
            for caller in _callers()
            if isinstance(caller, TimeLimit) and caller.unwrapped is self
        ]


class GymnasiumVectorEnv(gymnasium.vector.VectorEnv):
    """A batch of environments; the step after an episode's end starts the next one.

    `settings` are arguments of `gasil_envs.make`.
    """

    metadata = {  # noqa: RUF012
        "render_modes": [],
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self,
        name: str,
        num_envs: int = 1,
        render_mode: str | None = None,
        **settings: Any,
    ):
        if render_mode is not None:
            raise ValueError(
                f"render_mode is {render_mode!r}: it must be None, as only a single "
                "environment can be drawn"
            )
        _refuse_fork()
        self._env = env = wrappers.FaultyStepEnds(registry.make(name, **settings))
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

            return _where(over, fresh, stepped)

        self._where = jax.jit(_where)
        self._reset = jax.jit(lambda key: resets(jax.random.split(key, num_envs)))
        self._step = jax.jit(step)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode in each and return the observations, (num_envs, obs).

        With ``options={"reset_mask": mask}``, bool (num_envs,), the others go on.
        """
        _refuse_fork()
        mask = None if options is None else options.get("reset_mask")
        if mask is not None:
            mask = np.asarray(mask)
            if mask.shape != (self.num_envs,) or mask.dtype != bool or not mask.any():
                raise ValueError(
                    f"reset_mask is {errors.shown(mask)}: it must be "
                    f"{self.num_envs} bools, one or more of them True"
                )
            if self._state is None:
                raise gymnasium.error.ResetNeeded("reset_mask needs a reset before it")
        super().reset(seed=seed)
        fresh = self._reset(_key(self.np_random))
        self._state = fresh if mask is None else self._where(mask, fresh, self._state)
        return np.array(self._state.obs), self._info()

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Return observation (num_envs, obs), reward, terminated, truncated and info.

        Reward, terminated, truncated and the true reward in info are (num_envs,) each.
        """
        _refuse_fork()
        given = _checked_action(actions, self._state, self.action_space)
        self._state = state = self._step(self._state, given, _key(self.np_random))
        truncated = np.array(wrappers.truncated(state))
        terminated = np.array(state.done > 0) & ~truncated
        reward = np.array(state.reward, np.float64)
        return np.array(state.obs), reward, terminated, truncated, self._info()

    def _info(self) -> dict[str, Any]:
        """Return info; its keys are the same after a reset and after a step."""
        state = self._state
        return {
            "true_reward": np.array(state.info.get("true_reward", state.reward)),
            "_true_reward": np.ones(self.num_envs, bool),
        }


def register() -> None:
    """Register the package's environments with Gymnasium."""
    for name in registry.names():
        gymnasium.register(
            id=f"{_NAMESPACE}/{name}",
            entry_point=f"{__name__}:GymnasiumEnv",
            vector_entry_point=f"{__name__}:GymnasiumVectorEnv",
            kwargs={"name": name},
        )


# Not an entry point of the package: every program that imports Gymnasium would then
# load JAX.
register()

"""Environments of other packages by name, such as gymnax:CartPole-v1.

Each family is a module with two functions: `names`, the names of its environments, and
`build`, which makes one with Brax's interface. A world keeps its own time limit, as
`episode_length`, and never resets itself. Its package is only imported where one of its
environments is named.
"""

import importlib
import importlib.metadata
import warnings
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gasil_envs import user_environment
from gasil_envs.base import Env, State

#: The module of each family, and the package that it needs, by the prefix of names.
FAMILIES: Mapping[str, tuple[str, str]] = {
    "brax": ("gasil_envs.of_brax", "Brax"),
    "gymnax": ("gasil_envs.of_gymnax", "gymnax"),
    "navix": ("gasil_envs.of_navix", "navix"),
    "playground": ("gasil_envs.of_playground", "playground"),
    "sparse": ("gasil_envs.mazes", "gasil_jax"),  # This package's own.
}
#: Families whose observations are arrays already, so that no name ends with a part.
WITHOUT_PARTS = ("brax", "sparse")


def forms() -> tuple[str, ...]:
    """Return the forms of the names of all families, such as brax:NAME."""
    return tuple(f"{family}:NAME" for family in FAMILIES)


def names(family: str) -> tuple[str, ...]:
    """Return the names of a family's environments, with its prefix."""
    module, package = FAMILIES[family]
    try:
        with warnings.catch_warnings():
            # Such packages warn of others that are absent.
            warnings.simplefilter("ignore")
            bare = importlib.import_module(module).names()
    except ImportError as error:
        raise ValueError(
            f"env {family}:NAME needs the package {package}: {error} (pip install "
            f'"gasil_jax[{family}]")'
        ) from None
    return tuple(f"{family}:{name}" for name in bare)


def build(name: str) -> Env:
    """Build one of `names`, and trace its functions without running them."""
    family, bare = name.split(":", 1)
    module, package = FAMILIES[family]
    try:
        with warnings.catch_warnings():
            # Brax warns that its physics is not maintained.
            warnings.simplefilter("ignore", UserWarning)
            env = importlib.import_module(module).build(bare)
    except Unfit as error:
        raise ValueError(f"env {name!r} {error}") from None
    except Exception as error:
        version = importlib.metadata.version(package)
        why = f"{type(error).__name__}: {error}".partition("\n")[0]
        raise ValueError(
            f"env {name!r} fails within {package} {version} itself: {why}"
        ) from None
    if isinstance(env, World):
        user_environment.check(name, env, env)
    return env


class Unfit(Exception):
    """An environment can't be trained on; the message goes on from its name."""


class World:
    """An environment of another package with Brax's interface.

    Observations become one float32 vector, whatever their axes and dtypes. The random
    key of later steps is kept beside the state.

    Args:
      begin: key -> state and observation at the start of an episode.
      advance: (key, state, action) -> state, observation, reward, and whether the
        episode has terminated.
      actions: number of discrete actions, or the lowest and the highest action, whose
        shape is that of an action.
      episode_length: number of steps after which an episode is truncated.
      part: name of the part of the observation that is used, if that is a dict.
    """

    #: Draws a state, where the other package can (see `pictures`).
    draw: Callable[[Any, tuple[int, int]], np.ndarray]

    def __init__(
        self,
        begin: Callable[[jax.Array], tuple[Any, Any]],
        advance: Callable[[jax.Array, Any, jax.Array], tuple[Any, Any, Any, Any]],
        *,
        actions: int | tuple[Any, Any],
        episode_length: int,
        part: str | None = None,
    ):
        self._begin, self._advance, self._part = begin, advance, part
        self.episode_length = episode_length
        key = jax.random.key(0)
        first, observation = jax.eval_shape(begin, key)
        self.observation_size = jax.eval_shape(self._vector, observation).shape[0]
        if isinstance(actions, int):
            self.num_actions = actions
            self._as_given: Callable[[jax.Array], jax.Array] = lambda action: action
            action: Any = jnp.int32(0)
        else:
            low, high = np.broadcast_arrays(*(np.float32(x) for x in actions))
            self.action_size = max(1, low.size)
            self.action_range = (low.ravel(), high.ravel())
            self._as_given = lambda action: action.reshape(low.shape)
            action = jnp.zeros(low.shape)
        # A start may have Python's numbers, where a step has arrays.
        self._state = jax.eval_shape(advance, key, first, action)[0]

    def reset(self, rng: jax.Array) -> State:
        """Start an episode; `rng` also draws what is random in its steps."""
        start_key, key = jax.random.split(rng)
        state, observation = self._begin(start_key)
        zero = jnp.float32(0)
        return State((self._cast(state), key), self._vector(observation), zero, zero)

    def step(self, state: State, action: jax.Array) -> State:
        """Take a step; an episode that has ended does not start again."""
        inner, key = state.pipeline_state
        key, step_key = jax.random.split(key)
        inner, observation, reward, terminated = self._advance(
            step_key, inner, self._as_given(action)
        )

        def number(x: Any) -> jax.Array:
            return jnp.asarray(x).astype(jnp.float32).reshape(())

        return state.replace(
            pipeline_state=(self._cast(inner), key),
            obs=self._vector(observation),
            reward=number(reward),
            done=number(terminated),
        )

    def _cast(self, state: Any) -> Any:
        def cast(x: Any, like: Any) -> Any:
            x = jnp.asarray(x)
            return x if x.dtype == like.dtype else x.astype(like.dtype)

        return jax.tree.map(cast, state, self._state)

    def _vector(self, observation: Any) -> jax.Array:
        """Return an observation as one vector, float32 (obs,)."""
        parts = observation if isinstance(observation, Mapping) else None
        if parts is not None and self._part not in parts:
            listed = ", ".join(sorted(map(str, parts)))
            given = "" if self._part is None else f", and none is {self._part!r}"
            raise Unfit(
                f"has observations of several parts{given}: choose one of {listed}, as "
                "FAMILY:NAME:PART"
            )
        if parts is None and self._part is not None:
            raise Unfit(f"has observations without a part {self._part!r}")
        x = observation if parts is None else parts[self._part]
        if not hasattr(x, "shape"):
            raise Unfit(
                f"has observations of type {type(x).__name__}: they must be arrays"
            )
        return jnp.ravel(x).astype(jnp.float32)

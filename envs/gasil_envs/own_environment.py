"""An environment of the user's own, MODULE:NAME: found, built, and looked over.

What would stop training in the middle of a trace is said in one line before it.
"""

import importlib
import inspect
import numbers
import pathlib
import traceback
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from brax.envs import Env

from gasil_envs import wrappers


def find(name: str) -> Callable[[], Env]:
    """What MODULE:NAME names: a class, or a function that builds an environment.

    Raises:
      ValueError: it can't be imported, or needs arguments.
    """
    module, attribute = name.split(":", 1)
    try:
        found = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(f"env {name!r} can't be imported: {error}") from None
    except Exception as error:
        why = _in_a_line(error)
        raise ValueError(f"env {name!r} can't be imported: {why}") from None
    try:
        inspect.signature(found).bind()
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"env {name!r} must build an environment without arguments: {error}"
        ) from None
    return found


def build(name: str) -> Env:
    """The environment that MODULE:NAME names; nothing of it is computed.

    Raises:
      ValueError: it can't be built, or is not of Brax's interface.
    """
    made = find(name)
    try:
        env = made()
    except Exception as error:
        raise ValueError(f"env {name!r} can't be built: {_in_a_line(error)}") from None
    for needed in ("reset", "step", "observation_size", "action_size"):
        if not hasattr(env, needed):
            raise ValueError(f"env {name!r} is no environment: it has no {needed}")
    for counted in ("observation_size", "action_size"):
        _check_count(name, counted, getattr(env, counted))
    if hasattr(env, "episode_length"):
        _check_count(name, "episode_length", env.episode_length)
    _check_states(name, env)
    return env


def _check_count(name: str, what: str, count: Any) -> None:
    if not isinstance(count, numbers.Integral) or count < 1:
        raise ValueError(
            f"env {name!r} has {what} {count!r}: it must be a whole number, 1 or more"
        )


def _check_states(name: str, env: Env) -> None:
    """Refuse states that `jax.lax.scan` can't carry, or of other sizes than it says."""
    # The wrapper that it is trained under adds to a state what need not be alike.
    limited = wrappers.EpisodeLimit(env, 1)
    action = jnp.zeros(env.action_size)
    try:
        first = jax.eval_shape(limited.reset, jax.random.key(0))
        then = jax.eval_shape(limited.step, first, action)
    except Exception as error:
        raise ValueError(f"env {name!r} can't be traced: {_in_a_line(error)}") from None
    for state, where in ((first, "reset"), (then, "step")):
        wanted = {"obs": (env.observation_size,), "reward": (), "done": ()}
        for field, shape in wanted.items():
            value = getattr(state, field)
            given = getattr(value, "shape", type(value).__name__)
            if given != shape:
                raise ValueError(
                    f"env {name!r}: the {field} of its {where} has the shape {given}, "
                    f"must have {shape}"
                )
    flat = [
        {jax.tree_util.keystr(path): leaf for path, leaf in leaves}
        for leaves in map(jax.tree_util.tree_leaves_with_path, (first, then))
    ]
    for path in flat[0] | flat[1]:
        before, after = (_described(leaves.get(path)) for leaves in flat)
        if before != after:
            raise ValueError(
                f"env {name!r}: state{path} is {before} in its reset and {after} in "
                "its step, must be alike"
            )


def _described(leaf: Any) -> str:
    return "missing" if leaf is None else f"{leaf.dtype}{list(leaf.shape)}"


def _in_a_line(error: Exception) -> str:
    """What an error of the user's own code says, and where it was raised."""
    said = f"{type(error).__name__}: {error}".partition("\n")[0]
    if isinstance(error, SyntaxError):
        return said  # With its place.
    frames = reversed(traceback.extract_tb(error.__traceback__))
    theirs = (x for x in frames if not x.filename.startswith((_JAX, __file__)))
    place = next(theirs, None)
    return said if place is None else f"{said} ({place.filename}, line {place.lineno})"


_JAX = str(pathlib.Path(jax.__file__).parent)

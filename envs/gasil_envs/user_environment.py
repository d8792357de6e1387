"""Import, build and check a user's environment.

Mistakes that would stop training with a long trace are reported in one line before it.
"""

import inspect
import logging
import numbers
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gasil_envs import user_code, wrappers
from gasil_envs.base import Env
from gasil_envs.errors import shown

_LOGGER = logging.getLogger(__name__)

#: The attributes of Brax's interface that training uses.
INTERFACE = ("reset", "step", "observation_size")


def missing(env: Any) -> str | None:
    """Return what an object lacks of Brax's interface, in words; None if nothing."""
    for name in INTERFACE:
        if not hasattr(env, name):
            return name
    if not (hasattr(env, "action_size") or hasattr(env, "num_actions")):
        return "action_size (or num_actions, if its actions are discrete)"
    return None


def find(name: str) -> Callable[[], Env]:
    """Return the class or function that MODULE:NAME names."""
    constructor = user_code.find("env", name)
    try:
        inspect.signature(constructor).bind()
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"env {name!r} must build an environment without arguments: {error}"
        ) from None
    return constructor


def build(name: str) -> Env:
    """Build and check the environment that MODULE:NAME names, without running it.

    If its actions are far from -1 to 1, it gets them in these units.
    """
    constructor = find(name)
    with user_code.refused(f"env {name!r} can't be built"):
        env = constructor()
        # An attribute may be a property, which is the user's code too.
        lacking = missing(env)
    if lacking is not None:
        raise ValueError(f"env {name!r} is no environment: it has no {lacking}")
    # `registry.make` wraps it in an `EpisodeLimit`, which adds fields to its states.
    check(name, env, wrappers.EpisodeLimit(env, 1))
    return env if _is_scaled(env) else wrappers.UnitActions(env)


def _is_scaled(env: Env) -> bool:
    """Whether noise of deviation 1 on actions near 0 explores their range."""
    if wrappers.is_discrete(env):
        return True
    low, high = (np.asarray(x, np.float32) for x in wrappers.action_range(env))
    half = 0.5 * (high - low)
    return bool(np.all((half <= 10) & (half >= 0.1) & (low <= 0) & (high >= 0)))


def check(name: str, env: Any, trained: Any) -> None:
    """Refuse an environment with wrong sizes, or states of wrong structure or dtype.

    Nothing is run. `trained` is what training steps: `env`, or a wrapper of it.
    """
    size = "num_actions" if wrappers.is_discrete(env) else "action_size"
    if wrappers.is_discrete(env) and hasattr(env, "action_size"):
        raise ValueError(
            f"env {name!r} has action_size and num_actions: it must have one of them, "
            "num_actions if actions are discrete"
        )
    for attribute in ("observation_size", size):
        _check_count(name, attribute, getattr(env, attribute))
    for function in ("reset", "step"):
        if not callable(given := getattr(env, function)):
            raise ValueError(
                f"env {name!r} has {function} {shown(given)}: it must be a function"
            )
    if hasattr(env, "episode_length"):
        _check_count(name, "episode_length", env.episode_length)
    _check_action_range(name, env)
    if trained is env and not _is_scaled(env):
        _LOGGER.warning(
            "env %r has actions far from -1 to 1, which an untrained policy's are: "
            "wrap it in gasil_envs.wrappers.UnitActions",
            name,
        )
    _check_states(name, env, trained)


def _check_count(name: str, what: str, count: Any) -> None:
    if not isinstance(count, numbers.Integral) or count < 1:
        raise ValueError(
            f"env {name!r} has {what} {count!r}: it must be a whole number, 1 or more"
        )


def _check_action_range(name: str, env: Env) -> None:
    given = wrappers.action_range(env)
    try:
        low, high = (np.asarray(x, np.float32) for x in given)
        wide = np.broadcast_to(low < high, (wrappers.action_size(env),))
        below = bool(wide.all())
    except (TypeError, ValueError):
        below = False
    if not below:
        raise ValueError(
            f"env {name!r} has action_range {given!r}: it must be the lowest and the "
            "highest action, each a number or one for each dimension"
        )


def _traced(name: str, env: Env, function: str, *arguments: Any) -> Any:
    """Return the shapes of the state that an environment's function returns."""

    def called(*arguments: Any) -> Any:
        state = getattr(env, function)(*arguments)
        if not all(hasattr(state, x) for x in ("obs", "reward", "done", "info")):
            raise ValueError(
                f"its {function} returns a {type(state).__name__}: it must return a "
                "brax.envs.State"
            )
        for field in ("obs", "reward", "done"):
            value = getattr(state, field)
            try:
                jax.eval_shape(lambda value=value: value)
            except TypeError:
                raise ValueError(
                    f"the {field} of its {function} is {shown(value)}: it "
                    "must be an array"
                ) from None
        if not isinstance(state.info, Mapping):
            raise ValueError(
                f"the info of its {function} is {shown(state.info)}: it must be a dict"
            )
        return state

    with user_code.refused(f"env {name!r} can't be traced"):
        return jax.eval_shape(called, *arguments)


def _check_states(name: str, env: Env, trained: Env) -> None:
    """Check that states have the declared sizes and fit a carry of `jax.lax.scan`."""
    key, action = jax.random.key(0), wrappers.zero_action(env)
    size = env.observation_size  # Once: Brax runs a reset for it.
    bare = _traced(name, env, "reset", key)
    stepped = _traced(name, env, "step", bare, action)
    for state, where in ((bare, "reset"), (stepped, "step")):
        fields = {"obs": state.obs, "reward": state.reward, "done": state.done}
        names = {"truncation", "true_reward"} & {*state.info}
        of_info = {f"info[{x!r}]": state.info[x] for x in sorted(names)}
        for field, value in (fields | of_info).items():
            is_obs = field == "obs"
            shape = (size,) if is_obs else ()
            why = f", as observation_size is {size}" if is_obs else ""
            is_array = hasattr(value, "shape")
            if not is_array or value.shape != shape:
                kind = type(value).__name__
                given = f"has shape {value.shape}" if is_array else f"is a {kind}"
                raise ValueError(
                    f"env {name!r}: the {field} of its {where} {given}: it must have "
                    f"shape {shape}{why}"
                )
            # A truncation may be a bool too.
            if field in fields and value.dtype != jnp.float32:
                raise ValueError(
                    f"env {name!r}: the {field} of its {where} is {value.dtype}: it "
                    "must be float32"
                )
    first, then = bare, stepped
    if trained is not env:
        first = _traced(name, trained, "reset", key)
        then = _traced(name, trained, "step", first, action)
    if change := user_code.first_change(first, then):
        path, before, after = change
        raise ValueError(
            f"env {name!r}: state{path} is {before} after its reset and {after} after "
            "its step: both must be the same"
        )

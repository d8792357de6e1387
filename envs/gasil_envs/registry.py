"""Build environments by name; check names and settings."""

import dataclasses
import importlib.util
import numbers
from collections.abc import Callable, Iterable
from typing import Any

import jax
import numpy as np

# `gasil_envs.locomotion` is imported when it is first used: MuJoCo takes a while.
import gasil_envs
from gasil_envs import point_mass, user_environment, worlds, wrappers
from gasil_envs.base import Env
from gasil_envs.errors import InputError, nearest, refusal, unknown
from gasil_envs.physics import batching, host_threads


@dataclasses.dataclass(frozen=True)
class Settings:
    """The settings of an environment.

    Attributes:
      reward_delay: number of steps after which the accumulated reward is given; it is
        also given when the episode ends (paper, section 5.4). 1 means no delay.
      obs_noise: standard deviation of Gaussian noise on the observations (paper,
        section 5.3); 0 means no noise.
      action_noise: standard deviation of Gaussian noise on the actions, in units of
        half their range; for discrete actions, the probability that an action is
        replaced by a random one. 0 means no noise.
      physics: physics engine of locomotion: jax, our own in pure JAX; mjx, MuJoCo's
        MJX as shipped, which is slower; or mujoco, in C on the host's cores.
      integrator: integrator of locomotion: model, the same as Gymnasium's, or euler,
        which is faster but changes the task.
      terminal_limits: whether an episode that reaches the step limit counts as
        terminated, without a future value, as in code of the paper's time. Otherwise it
        is truncated, and the value of its last observation is bootstrapped.
      max_episode_steps: number of steps after which an episode is truncated; None takes
        the environment's own limit, or 1000 if it has none.
      observe_phase: whether the observation also says which share of the reward delay
        has passed since the last payout.
    """

    reward_delay: int = 1
    obs_noise: float = 0.0
    action_noise: float = 0.0
    physics: str = "jax"
    integrator: str = "model"
    terminal_limits: bool = False
    max_episode_steps: int | None = None
    observe_phase: bool = False


_EPISODE_LENGTH = 1000


def _refuse_unknown(
    kind: str, name: Any, allowed: Iterable[str], *, forms: Iterable[str] = ()
) -> None:
    """Raise `ValueError` for a name that is not among the allowed ones."""
    allowed = tuple(allowed)
    if not isinstance(name, str) or name not in allowed:
        raise InputError(unknown(kind, name, allowed, forms=tuple(forms)))


def names() -> tuple[str, ...]:
    """Return the names of this package's environments."""
    return ("point_mass", *gasil_envs.locomotion.TASKS)


def _constructor(name: str) -> Callable[[Settings], Env]:
    """Return the function that builds an environment from its settings.

    Raises:
      ValueError: if the name is unknown.
    """
    if isinstance(name, str) and ":" in name:
        family = name.partition(":")[0]
        if family in worlds.FAMILIES:
            # Other packages may start JAX when they are imported, before its devices
            # are chosen, so their names are not looked up here.
            return lambda settings: _build_of_others(name)
        _refuse_unknown_family(name, family)
        user_environment.find(name)
        return lambda settings: user_environment.build(name)
    _refuse_unknown("env", name, names(), forms=(*worlds.forms(), "MODULE:NAME"))
    return lambda settings: _build_ours(name, settings)


def _refuse_unknown_family(name: str, family: str) -> None:
    """Raise `ValueError` if a family's name is misspelled and is no module."""
    near = nearest(family, worlds.FAMILIES)
    if near is not None and not _is_module(family):
        meant = f"{near}:{name.partition(':')[2]}"
        listed = ", ".join((*worlds.forms(), "MODULE:NAME"))
        raise ValueError(
            f"env {name!r} is of an unknown family: did you mean {meant!r}? (one of "
            f"{listed})"
        )


def _is_module(name: str) -> bool:
    # A name with dots imports the packages above it, whose errors are told later.
    return "." in name or importlib.util.find_spec(name) is not None


def _build_of_others(name: str) -> Env:
    family, bare, *_ = name.split(":")
    whole = name if family in worlds.WITHOUT_PARTS else f"{family}:{bare}"
    _refuse_unknown("env", whole, worlds.names(family))
    return worlds.build(name)


def _build_ours(name: str, settings: Settings) -> Env:
    if name == "point_mass":
        return point_mass.PointMass()
    return gasil_envs.locomotion.Locomotion(
        name, physics=settings.physics, integrator=settings.integrator
    )


def _is_whole(value: Any, low: int, high: int) -> bool:
    """Return whether a value is a whole number from `low` to `high`; a bool is not."""
    return _is_number(value, numbers.Integral) and low <= value <= high


def _is_number(value: Any, kind: type) -> bool:
    # NumPy's integers are not `int`, but `bool` is, and NumPy's durations are integers.
    return isinstance(value, kind) and not isinstance(value, bool | np.timedelta64)


def check(name: str, settings: Settings) -> None:
    """Raise `ValueError` if `make` would refuse the arguments; builds nothing.

    Of other packages' environments only the family is checked.
    """
    if jax.config.read("jax_enable_x64"):
        raise ValueError(
            "jax_enable_x64 is True: environments are in float32, unset it"
        )
    _constructor(name)
    if ":" in name:
        for field in ("physics", "integrator"):
            value = getattr(settings, field)
            if value != getattr(Settings, field):
                raise ValueError(
                    f"{field} is {value!r}: leave it out, {name} has its own physics"
                )
    _refuse_unknown("physics", settings.physics, gasil_envs.locomotion.PHYSICS)
    _refuse_unknown(
        "integrator", settings.integrator, gasil_envs.locomotion.INTEGRATORS
    )
    for field in ("terminal_limits", "observe_phase"):
        if not isinstance(value := getattr(settings, field), bool):
            raise refusal(field, value, "True or False")
    if settings.observe_phase and settings.reward_delay == 1:
        raise ValueError("observe_phase is True: it needs a reward_delay above 1")
    delay = settings.reward_delay
    # Steps are counted in int32.
    if not _is_whole(delay, 1, 2**31 - 1):
        raise refusal("reward_delay", delay, f"a whole number, from 1 to {2**31 - 1}")
    for field in ("obs_noise", "action_noise"):
        noise = getattr(settings, field)
        # NumPy would convert the limit to the number's own type, such as float16.
        noise = noise.item() if isinstance(noise, np.generic) else noise
        # Numbers are float32.
        if not (_is_number(noise, numbers.Real) and 0.0 <= noise <= 3.4e38):
            raise refusal(field, getattr(settings, field), "finite and 0 or more")
    if settings.action_noise and name.startswith("sparse:") and "_noisy" in name:
        raise refusal("action_noise", settings.action_noise, f"0: {name} has its own")


def without_effect(name: str, settings: Settings) -> list[str]:
    """Return the names of settings that are not the defaults but have no effect.

    Args:
      name: one of `names()`, or another name that `check` accepts.
      settings: settings that `check` accepts.
    """
    if ":" in name or name in gasil_envs.locomotion.TASKS:
        return []
    of_physics = ("physics", "integrator")
    return [x for x in of_physics if getattr(settings, x) != getattr(Settings, x)]


def prepare(settings: Settings, num_devices: int) -> None:
    """Prepare the process for `num_devices` CPU devices; call it before JAX starts."""
    batching.keep_loops(settings.physics)
    if settings.physics == "mujoco":
        host_threads.reserve(num_devices)


def make(name: str, **settings: Any) -> Env:
    """Build an environment with its step limit and the paper's task variations.

    Args:
      name: one of `names()`; one of another package, as FAMILY:NAME (see `worlds`); or
        MODULE:NAME of your own class or function that builds an environment with Brax's
        interface.
      **settings: fields of `Settings`: reward_delay, obs_noise, action_noise, physics,
        integrator, terminal_limits, max_episode_steps, observe_phase.

    Raises:
      ValueError: if a name is unknown or a value is out of range.
    """
    allowed = [field.name for field in dataclasses.fields(Settings)]
    for setting in settings:
        _refuse_unknown("setting", setting, allowed)
    chosen = Settings(**settings)
    check(name, chosen)
    batching.keep_loops(chosen.physics)
    env: Any = _constructor(name)(chosen)
    limit = int(getattr(env, "episode_length", _EPISODE_LENGTH))
    if chosen.max_episode_steps is not None:
        if not _is_whole(chosen.max_episode_steps, 1, limit):
            own_limit = f"a whole number from 1 to {limit}, the environment's own limit"
            raise refusal("max_episode_steps", chosen.max_episode_steps, own_limit)
        limit = int(chosen.max_episode_steps)
    if chosen.action_noise > 0:
        if wrappers.is_discrete(env) and chosen.action_noise > 1:
            raise refusal(
                "action_noise", chosen.action_noise, f"at most 1, a share, for {name}"
            )
        env = wrappers.ActionNoise(env, float(chosen.action_noise))
    env = wrappers.EpisodeLimit(env, limit, terminal=chosen.terminal_limits)
    if chosen.reward_delay > 1:
        env = wrappers.RewardDelay(env, int(chosen.reward_delay))
        env = wrappers.DelayPhase(env) if chosen.observe_phase else env
    if chosen.obs_noise > 0:
        env = wrappers.ObservationNoise(env, float(chosen.obs_noise))
    env._made_with = (name, chosen)
    return env


def made_with(env: Any) -> tuple[str, Settings] | None:
    """Return the name and the settings with which `make` built an environment.

    The result is None for any other environment, also for a wrapper around one of
    `make`.
    """
    # A wrapper has the attributes of what it wraps; only its own ones count here.
    return getattr(env, "__dict__", {}).get("_made_with")

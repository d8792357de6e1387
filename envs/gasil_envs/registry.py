"""Environment names and the one function that builds an environment."""

import difflib
from collections.abc import Callable

from brax.envs import Env

from gasil_envs import locomotion, point_mass, wrappers
from gasil_envs.physics.mjx import SOLVERS


def _constructors() -> dict[str, Callable[[str], Env]]:
    constructors = {"point_mass": lambda solver: point_mass.PointMass()}
    for name in locomotion.TASKS:
        constructors[name] = lambda solver, name=name: locomotion.Locomotion(
            name, solver=solver
        )
    return constructors


def _unknown(kind: str, name: str, allowed: tuple[str, ...]) -> str:
    nearest = difflib.get_close_matches(name, allowed, n=1, cutoff=0.0)[0]
    return (
        f"{kind} {name!r} is unknown: did you mean {nearest!r}? "
        f"(one of {', '.join(allowed)})"
    )


def names() -> tuple[str, ...]:
    """The names that `make` takes."""
    return tuple(_constructors())


def check(
    name: str, *, reward_delay: int = 1, obs_noise: float = 0.0, solver: str = "small"
) -> None:
    """Raise `ValueError` for arguments that `make` would refuse; builds nothing."""
    if name not in names():
        raise ValueError(_unknown("env", name, names()))
    if solver not in SOLVERS:
        raise ValueError(_unknown("solver", solver, SOLVERS))
    if reward_delay < 1:
        raise ValueError(f"reward_delay is {reward_delay}: it must be 1 or more")
    if not 0.0 <= obs_noise < float("inf"):
        raise ValueError(f"obs_noise is {obs_noise}: it must be finite and 0 or more")


def make(
    name: str, *, reward_delay: int = 1, obs_noise: float = 0.0, solver: str = "small"
) -> Env:
    """Build an environment with its step limit and the paper's task variations.

    Args:
      name: one of `names()`.
      reward_delay: the reward is given, accumulated, every `reward_delay` steps
        and when the episode ends (paper, section 5.4); 1 leaves it as it is.
      obs_noise: standard deviation of the Gaussian noise that is added to each
        observation (paper, section 5.3); 0 leaves it as it is.
      solver: of the locomotion tasks' constraints, "small" (ours, faster) or "mjx".

    Raises:
      ValueError: an unknown name or a value out of range.
    """
    check(name, reward_delay=reward_delay, obs_noise=obs_noise, solver=solver)
    env = _constructors()[name](solver)
    env = wrappers.EpisodeLimit(env, env.episode_length)
    if reward_delay > 1:
        env = wrappers.RewardDelay(env, reward_delay)
    if obs_noise > 0:
        env = wrappers.ObservationNoise(env, obs_noise)
    return env

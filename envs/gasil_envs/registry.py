"""Environment names and the one function that builds an environment."""

import difflib
from collections.abc import Callable

from brax.envs import Env

from gasil_envs import locomotion, point_mass, wrappers


def _constructors() -> dict[str, Callable[[], Env]]:
    constructors = {"point_mass": point_mass.PointMass}
    for name in locomotion.TASKS:
        constructors[name] = lambda name=name: locomotion.Locomotion(name)
    return constructors


def names() -> tuple[str, ...]:
    """The names that `make` takes."""
    return tuple(_constructors())


def check(name: str, *, reward_delay: int = 1, obs_noise: float = 0.0) -> None:
    """Raise `ValueError` for arguments that `make` would refuse; builds nothing."""
    if name not in names():
        nearest = difflib.get_close_matches(name, names(), n=1, cutoff=0.0)[0]
        raise ValueError(
            f"env {name!r} is unknown: did you mean {nearest!r}? "
            f"(one of {', '.join(names())})"
        )
    if reward_delay < 1:
        raise ValueError(f"reward_delay is {reward_delay}: it must be 1 or more")
    if not 0.0 <= obs_noise < float("inf"):
        raise ValueError(f"obs_noise is {obs_noise}: it must be finite and 0 or more")


def make(name: str, *, reward_delay: int = 1, obs_noise: float = 0.0) -> Env:
    """Build an environment with its step limit and the paper's task variations.

    Args:
      name: one of `names()`.
      reward_delay: the reward is given, accumulated, every `reward_delay` steps
        and when the episode ends (paper, section 5.4); 1 leaves it as it is.
      obs_noise: standard deviation of the Gaussian noise that is added to each
        observation (paper, section 5.3); 0 leaves it as it is.

    Raises:
      ValueError: an unknown name or a value out of range.
    """
    check(name, reward_delay=reward_delay, obs_noise=obs_noise)
    env = _constructors()[name]()
    env = wrappers.EpisodeLimit(env, env.episode_length)
    if reward_delay > 1:
        env = wrappers.RewardDelay(env, reward_delay)
    if obs_noise > 0:
        env = wrappers.ObservationNoise(env, obs_noise)
    return env

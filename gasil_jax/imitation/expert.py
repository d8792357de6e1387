"""Load expert trajectories from a file or a Minari data set, for GAIL (paper, 3.2)."""

import contextlib
import functools
import importlib
import pathlib
from typing import Any

import numpy as np

from gasil_jax import npz

_MINARI = "minari:"


def load(source: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the expert's observations (steps, obs) and actions (steps, action).

    Both are float32 and read-only.

    Args:
      source: the path of an ``.npz`` file with arrays "observation" and "action", or
        "minari:" and the name of a local data set; Minari must then be installed.

    Raises:
      ValueError: if it can't be read, or its arrays have wrong names, shapes or values.
    """
    return _load(source, _version(source))


def _version(source: str) -> Any:
    """Return names, modification times and sizes of an expert's files.

    It is None if they can't be read.
    """
    paths = [pathlib.Path(source)]
    if source.startswith(_MINARI):
        try:
            from minari.storage import get_dataset_path
        except ImportError:
            return None
        folder = pathlib.Path(get_dataset_path(source.removeprefix(_MINARI)))
        paths = sorted(folder.rglob("*"))
    with contextlib.suppress(OSError):
        return tuple((x.name, x.stat().st_mtime_ns, x.stat().st_size) for x in paths)
    return None


@functools.lru_cache(maxsize=4)
def _load(source: str, version: Any) -> tuple[np.ndarray, np.ndarray]:
    """Load an expert; `version` makes the cache read a changed file again."""
    if source.startswith(_MINARI):
        observation, action = _load_minari(source.removeprefix(_MINARI))
    else:
        observation, action = _load_file(pathlib.Path(source))
    observation = np.asarray(observation, np.float32)
    action = np.asarray(action, np.float32)
    if observation.ndim != 2 or action.ndim != 2 or len(observation) != len(action):
        raise ValueError(
            f"expert {source!r} has observations {observation.shape} and actions "
            f"{action.shape}: they must be (steps, obs) and (steps, action)"
        )
    if not (
        len(action) and np.isfinite(observation).all() and np.isfinite(action).all()
    ):
        raise ValueError(
            f"expert {source!r} is empty or has numbers that aren't finite"
        )
    for array in (observation, action):
        array.setflags(write=False)
    return observation, action


def _load_file(path: pathlib.Path) -> tuple[np.ndarray, np.ndarray]:
    try:
        arrays = npz.read(path)
        if missing := [x for x in ("observation", "action") if x not in arrays]:
            raise ValueError(f"{missing[0]} is missing")
    except ValueError as error:
        raise ValueError(
            f"expert is {str(path)!r}: it must be an .npz file with arrays "
            f"'observation' and 'action' ({error})"
        ) from None
    return arrays["observation"], arrays["action"]


def _first_line(error: Exception) -> str:
    return str(error).partition("\n")[0] or type(error).__name__


def _load_minari(name: str) -> tuple[np.ndarray, np.ndarray]:
    try:
        importlib.import_module("h5py")  # Minari needs it to read a data set.
        import minari
    except ImportError:
        raise ValueError(
            f"expert is 'minari:{name}': it needs the package minari "
            '(pip install "gasil_jax[minari]")'
        ) from None
    try:
        episodes = list(minari.load_dataset(name).iterate_episodes())
        # An episode has one observation more than actions.
        return (
            np.concatenate([e.observations[: len(e.actions)] for e in episodes]),
            np.concatenate([e.actions for e in episodes]),
        )
    # Observations that are dicts or tuples raise a TypeError.
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ValueError(
            f"expert is 'minari:{name}': it must be a local data set with arrays as "
            f"observations and actions ({_first_line(error)})"
        ) from None


def check(source: str | None, observation_size: int, action_size: int) -> None:
    """Check that an expert is given and fits the environment's sizes.

    Raises:
      ValueError: if it is missing, can't be read, or does not fit the sizes.
    """
    if source is None:
        raise ValueError(
            "expert is missing: agent 'gail' needs a file, FILE.npz, or a data set, "
            "minari:NAME"
        )
    observation, action = load(source)
    sizes = (observation.shape[1], action.shape[1])
    if sizes != (observation_size, action_size):
        raise ValueError(
            f"expert {source!r} has observations of size {sizes[0]} and actions of "
            f"size {sizes[1]}: the environment's are of size {observation_size} and "
            f"{action_size}"
        )

"""Load expert trajectories from a file or a Minari data set, for GAIL (paper, 3.2)."""

import contextlib
import functools
import importlib
import pathlib
from typing import Any

import jax
import numpy as np

from gasil_jax import npz
from gasil_jax.context import Sizes

_MINARI = "minari:"
_NAMES = ("observation", "action")


def load(source: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the expert's observations (steps, obs) and actions (steps, action).

    Both are float32 and read-only. Discrete actions may also be numbers, (steps,).

    Args:
      source: the path of an ``.npz`` file with arrays "observation" and "action", or
        "minari:" and the name of a local data set; Minari must then be installed.

    Raises:
      ValueError: if it can't be read, or its arrays have wrong names, shapes or values.
    """
    return _load(source, _version(source))


def _version(source: str) -> Any:
    """Return names, times and sizes of an expert's files; None if they are not read."""
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
    is_minari = source.startswith(_MINARI)
    form = "an .npz file with arrays 'observation' and 'action'"
    if is_minari:
        _require_minari(source)
        form = "a local data set with arrays as observations and actions"
    # What is wrong in a data set decides the type of the error.
    try:
        arrays = (
            _read_minari(source.removeprefix(_MINARI))
            if is_minari
            else npz.read(pathlib.Path(source), lambda name: name in _NAMES)
        )
        numbered = np.ndim(arrays.get("action", 0)) == 1
        shapes = (None, None), (None,) if numbered else (None, None)
        observation, action = (
            npz.numbers(arrays, x, shape).astype(np.float32)
            for x, shape in zip(_NAMES, shapes, strict=True)
        )
        if len(observation) != len(action):
            raise ValueError(f"{len(observation)} observations, {len(action)} actions")
    except Exception as error:
        why = str(error).partition("\n")[0] or type(error).__name__
        raise ValueError(f"expert is {source!r}: it must be {form} ({why})") from None
    for array in (observation, action):
        array.setflags(write=False)
    return observation, action


def _require_minari(source: str) -> None:
    """Raise `ValueError` unless Minari and what it needs for data sets is installed."""
    try:
        importlib.import_module("h5py")  # Minari needs it to read a data set.
        importlib.import_module("minari")
    except ImportError:
        raise ValueError(
            f"expert is {source!r}: it needs the package minari "
            '(pip install "gasil_jax[minari]")'
        ) from None


def _read_minari(name: str) -> dict[str, np.ndarray]:
    import minari

    episodes = list(minari.load_dataset(name).iterate_episodes())
    # An episode has one observation more than actions.
    observations = [e.observations[: len(e.actions)] for e in episodes]
    arrays = observations, [e.actions for e in episodes]
    return dict(zip(_NAMES, map(np.concatenate, arrays)))


def vectors(action: jax.Array, size: int) -> jax.Array:
    """Return actions as vectors (steps, size); numbers (steps,) become one-hot."""
    numbered = action.ndim == 1
    return jax.nn.one_hot(action.astype(int), size) if numbered else action


def check(source: str | None, sizes: Sizes) -> None:
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
    numbered = action.ndim == 1
    if numbered and not sizes.discrete:
        raise ValueError(
            f"expert {source!r} has numbers as actions: the environment's are vectors "
            f"of size {sizes.action}"
        )
    if numbered and not np.isin(action, np.arange(sizes.action)).all():
        raise ValueError(
            f"expert {source!r} has actions from {action.min():g} to "
            f"{action.max():g}: the environment's are whole numbers from 0 to "
            f"{sizes.action - 1}"
        )
    given = (observation.shape[1], sizes.action if numbered else action.shape[1])
    if given != (sizes.observation, sizes.action):
        raise ValueError(
            f"expert {source!r} has observations of size {given[0]} and actions of "
            f"size {given[1]}: the environment's are of size {sizes.observation} and "
            f"{sizes.action}"
        )

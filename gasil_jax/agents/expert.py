"""Load expert trajectories from a file or a Minari data set, for GAIL (paper, 3.2)."""

import pathlib
from collections.abc import Mapping

import jax
import numpy as np

from gasil_jax import npz
from gasil_jax.context import Sizes

_MINARI = "minari:"
_NAMES = ("observation", "action")


def load(source: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the expert's observations (steps, obs) and actions (steps, action).

    Both are float32. Discrete actions may also be numbers, (steps,).

    Args:
      source: the path of an ``.npz`` file with arrays "observation" and "action", or
        "minari:" and the name of a local data set; Minari must then be installed.

    Raises:
      ValueError: if it can't be read, or its arrays have wrong names, shapes or values.
    """
    form = "an .npz file with arrays 'observation' and 'action'"
    if source.startswith(_MINARI):
        form = "a local data set of arrays, read with gasil_jax[minari]"
    # What is wrong in a data set decides the type of the error.
    try:
        if source.startswith(_MINARI):
            arrays = _read_minari(source.removeprefix(_MINARI))
        else:
            arrays = npz.read(pathlib.Path(source), _NAMES)
        observation, action = (_numbers(arrays, name) for name in _NAMES)
        dimensions = observation.ndim, action.ndim
        if dimensions not in ((2, 1), (2, 2)) or not observation.size * action.size:
            raise ValueError(f"shapes are {observation.shape} and {action.shape}")
        if len(observation) != len(action):
            raise ValueError(f"{len(observation)} observations, {len(action)} actions")
    except Exception as error:
        why = str(error).partition("\n")[0] or type(error).__name__
        raise ValueError(f"expert is {source!r}: it must be {form} ({why})") from None
    return observation, action


def _numbers(arrays: Mapping[str, np.ndarray], name: str) -> np.ndarray:
    """Return an array as float32; raise `ValueError` unless its numbers are finite."""
    if name not in arrays:
        raise ValueError(f"{name} is missing")
    array = np.asarray(arrays[name])
    if array.dtype.kind not in "iuf":
        raise ValueError(f"{name} holds no numbers, it is {array.dtype}")
    with np.errstate(over="ignore"):
        array = array.astype(np.float32)
    if not np.isfinite(array).all():
        raise ValueError(f"{name} has numbers that aren't finite")
    return array


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
    """Raise `ValueError` unless an expert can be read and fits the environment."""
    if source is None:
        raise ValueError(
            "expert is missing: agent 'gail' needs a file, FILE.npz, or a data set, "
            "minari:NAME"
        )
    observation, action = load(source)
    given = observation.shape[1], sizes.action if action.ndim == 1 else action.shape[1]
    numbered = sizes.discrete and np.isin(action, np.arange(sizes.action)).all()
    if action.ndim == 1 and not numbered:
        kind = f"whole numbers from 0 to {sizes.action - 1}"
        if not sizes.discrete:
            kind = f"vectors of size {sizes.action}"
        raise ValueError(
            f"expert {source!r} has numbers from {action.min():g} to {action.max():g} "
            f"as actions: the environment's are {kind}"
        )
    if given != (sizes.observation, sizes.action):
        raise ValueError(
            f"expert {source!r} has observations of size {given[0]} and actions of "
            f"size {given[1]}: the environment's are of size {sizes.observation} and "
            f"{sizes.action}"
        )

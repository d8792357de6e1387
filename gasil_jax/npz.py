"""Read arrays from an untrusted ``.npz`` file, with NumPy alone."""

import pathlib
import warnings
from collections.abc import Callable, Mapping

import numpy as np


def read(
    path: pathlib.Path, needs: Callable[[str], bool] = lambda name: True
) -> dict[str, np.ndarray]:
    """Return the arrays of a file by their names; nothing is unpickled.

    Args:
      path: the file.
      needs: whether an array with a name is read; default all.

    Raises:
      ValueError: if the file can't be read; the message is one line.
    """
    try:
        # NumPy leaves a file open that it can't read, and warns of an altered header.
        with path.open("rb") as opened, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with np.load(opened, allow_pickle=False) as file:
                return {name: file[name] for name in file.files if needs(name)}
    # What is wrong in a file decides the type of the error, of which there are dozens.
    except Exception as error:
        reason = str(error).partition("\n")[0][:300] or type(error).__name__
        raise ValueError(reason) from None


def numbers(
    arrays: Mapping[str, np.ndarray],
    name: str,
    shape: tuple[int | None, ...],
    *,
    finite: bool = True,
) -> np.ndarray:
    """Return an array of numbers, after checking it.

    Args:
      arrays: the arrays of a file.
      name: name of the array.
      shape: the shape that it must have; None is any size but 0.
      finite: whether all numbers must be finite in float32.

    Raises:
      ValueError: if it is missing, has other values than whole or real numbers, has
        another shape or numbers that are not finite; the message is one line.
    """
    if name not in arrays:
        raise ValueError(f"{name} is missing")
    array = np.asarray(arrays[name])
    if array.dtype.kind not in "iuf":
        raise ValueError(f"{name} holds no numbers, it is {array.dtype}")
    sizes = zip(array.shape, shape)
    fits = all(size == must or (must is None and size) for size, must in sizes)
    if array.ndim != len(shape) or not fits:
        listed = ", ".join("1 or more" if must is None else str(must) for must in shape)
        raise ValueError(f"{name} has the shape {array.shape}: it must be ({listed})")
    with np.errstate(over="ignore"):
        sound = np.isfinite(array.astype(np.float32)).all()
    if finite and not sound:
        raise ValueError(f"{name} has numbers that aren't finite")
    return array

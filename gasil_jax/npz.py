"""Read arrays from an ``.npz`` file of plain arrays, with NumPy alone."""

import pathlib
import warnings
from collections.abc import Collection

import numpy as np


def read(
    path: pathlib.Path, names: Collection[str] | None = None
) -> dict[str, np.ndarray]:
    """Return the arrays of a file by name, all or those that are asked for.

    Nothing is unpickled. The file's own checksums tell whether it is damaged: then a
    `ValueError` says so in a line.
    """
    try:
        # NumPy leaves a file open that it can't read, and warns of an altered header.
        with path.open("rb") as opened, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with np.load(opened, allow_pickle=False) as file:
                kept = file.files if names is None else [*set(file.files) & set(names)]
                return {name: file[name] for name in kept}
    # What is wrong in a file decides the type of the error, of which there are dozens.
    except Exception as error:
        reason = str(error).partition("\n")[0][:300] or type(error).__name__
        raise ValueError(reason) from None

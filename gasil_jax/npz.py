"""Arrays from an ``.npz`` that may be anything; NumPy alone."""

import pathlib
import zipfile
import zlib

import numpy as np


def read(path: pathlib.Path) -> dict[str, np.ndarray]:
    """Every array of the file by its name; nothing is unpickled.

    Raises:
      ValueError: what is wrong with it, in one line.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    # A single array, a file cut off and one with wrong bits raise an error each.
    except (
        *(OSError, ValueError, KeyError, TypeError, AttributeError, EOFError),
        *(zipfile.BadZipFile, zlib.error),
    ) as error:
        reason = str(error).partition("\n")[0] or type(error).__name__
        raise ValueError(reason) from None

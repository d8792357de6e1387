"""Read arrays from an untrusted ``.npz`` file, with NumPy alone."""

import pathlib
import zipfile
import zlib

import numpy as np


def read(path: pathlib.Path) -> dict[str, np.ndarray]:
    """Return all arrays of a file by their names; nothing is unpickled.

    Raises:
      ValueError: if the file can't be read; the message is one line.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    # A single array, a truncated file and a corrupt one raise different errors.
    except (
        OSError,
        ValueError,
        KeyError,
        TypeError,
        AttributeError,
        EOFError,
        zipfile.BadZipFile,
        zlib.error,
    ) as error:
        reason = str(error).partition("\n")[0] or type(error).__name__
        raise ValueError(reason) from None

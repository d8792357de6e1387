"""Archives of arrays in which something is altered, drawn from a seed."""

import io
import zipfile

import numpy as np

_DTYPES = "c16 S3 U2 M8[s] m8 ? O >f4 >i8 f2 g i1 V8 f4,i4".split()
_SHAPES = ((), (0,), (1,), (2, 0), (3, 2), (2, 3, 4), (1, 1, 1, 1))
_NUMBERS = (np.nan, np.inf, -np.inf, 1e300, 0.0, -1.0)
_EXTRA = ("bias_9.npy", "kernel_x.npy", "kernel_2")


def _members(arrays):
    for name, array in arrays.items():
        file = io.BytesIO()
        np.save(file, array)
        yield f"{name}.npy", bytearray(file.getvalue())


def _archive(members):
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name, content in members:
            archive.writestr(name, bytes(content))
    return bytearray(file.getvalue())


def altered(arrays, count):
    """Yield the bytes of `count` archives, each of these arrays altered in one way."""
    draw = np.random.default_rng(0)
    for number in range(count):
        name = draw.choice(list(arrays))
        array, changed = arrays[name], dict(arrays)
        kind = number % 7
        if kind == 0:
            changed[name] = np.ones(array.shape).astype(draw.choice(_DTYPES))
        if kind == 1:
            changed[name] = np.zeros(_SHAPES[draw.integers(len(_SHAPES))], array.dtype)
        if kind == 2 and array.dtype.kind in "iuf" and array.size:
            changed[name] = array.astype(float)
            changed[name].flat[draw.integers(array.size)] = draw.choice(_NUMBERS)
        members = dict(_members(changed))
        header = members[f"{name}.npy"]
        if kind == 3:  # Its text, not its sums, which the archive would tell.
            header[draw.integers(header.index(b"\n"))] = draw.integers(32, 127)
        if kind == 4:
            members[draw.choice(_EXTRA)] = b"x"
        archive = _archive(members.items())
        if kind == 5:
            for position in draw.integers(len(archive), size=4):
                archive[position] = draw.integers(256)
        yield bytes(archive[: draw.integers(len(archive))] if kind == 6 else archive)

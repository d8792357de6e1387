"""Python values of every kind, drawn from a seed, and what of them is a number."""

import decimal
import enum
import fractions
import math
import numbers
import pathlib

import jax
import jax.numpy as jnp
import numpy as np


class Bad:
    """An object of which nothing can be asked."""

    def _refuse(self, *_):
        raise RuntimeError("of me nothing\ncan be asked")

    __repr__ = __bool__ = __len__ = __float__ = __index__ = __array__ = _refuse
    __eq__ = __hash__ = __iter__ = __contains__ = __fspath__ = __call__ = _refuse


class Lines:
    """An object whose representation has several lines."""

    def __repr__(self):
        return "first\nsecond"


class Word(str):
    """A string of a class of its own."""


class Colour(enum.Enum):
    """A name for a number."""

    RED = 1


def _circular():
    value = [1]
    value.append(value)
    return value


#: By kind, so that each kind is drawn as often, however many values it has.
_KINDS = (
    lambda: [True, False, np.True_, np.False_, np.array(True), jnp.array(False)],
    lambda: [0, 1, 2, 3, 20, 64, -1, -(10**400), 10**400, 10**5000],
    lambda: [2**31 - 1, 2**31, 2**32, 2**63, 2**64, 2**2000],
    lambda: [0.0, -0.0, 0.5, 1.0, 3.0, 0.1, -0.5, 1e-60, 1e-40, 5e-324, 1e300, 1e39],
    lambda: [math.nan, math.inf, -math.inf, np.float32("nan"), np.float64("inf")],
    lambda: [np.int64(3), np.uint8(2), np.int8(-1), np.float16(0.5), np.float32(0.25)],
    lambda: [np.float64(0.5), np.longdouble(0.5), np.longdouble("1e4000"), np.int32(1)],
    lambda: [
        np.datetime64("2020-01-01"),
        np.str_("3"),
        np.void(b""),
    ],
    lambda: [
        "",
        "3",
        "0.5",
        "nan",
        "true",
        "ppo",
        "a\nb",
        "\x00",
        "\udcff",
        "x" * 9999,
    ],
    lambda: [
        "hopper",
        "point_mass",
        "gasill",
        "brax:",
        ":",
        "a:b",
        "zoo:",
        "zoo:x",
        "é",
    ],
    lambda: [Word("3"), Word("ppo"), Colour.RED, Colour, pathlib.Path("a\nb")],
    lambda: [b"", b"3", bytearray(b"ppo"), memoryview(b"3")],
    lambda: [[], [1], [0.5], [[]], _circular(), ["a"], [None], [1, [2, {"a": ()}]]],
    lambda: [(), (1,), (0.5, 2), ("a",), (None,), (2**62,), ((0, 1), (9, 0.5))],
    lambda: [{}, {"a": 1}, {1: 2}, set(), {1}, frozenset({2}), range(3), iter([1])],
    lambda: [None, ..., NotImplemented, 1j, 0j, complex(math.nan), np.complex64(1)],
    lambda: [decimal.Decimal("0.5"), fractions.Fraction(1, 3), fractions.Fraction(3)],
    lambda: [object(), Bad(), Lines(), Bad, len, lambda: 1, lambda x: x, math],
    lambda: [ValueError("a\nb"), type, int, float, slice(3), (x for x in ())],
    lambda: [np.array(3), np.array(0.5), np.array("3"), np.array(None, object)],
    lambda: [np.array([1]), np.array([]), np.zeros((2, 2)), np.array([len], object)],
    lambda: [jnp.array(3), jnp.float32(0.5), jnp.zeros(2), jnp.zeros((0, 3))],
    lambda: [
        jax.random.key(0),
        jax.random.PRNGKey(0),
        jax.random.split(jax.random.key(0)),
    ],
    lambda: [np.ma.masked, np.ma.array([1], mask=[1]), np.rec.array([(1, 2.0)])],
)


def drawn(count, seed=0):
    """Yield `count` values."""
    draw = np.random.default_rng(seed)
    for _ in range(count):
        kind = _KINDS[draw.integers(len(_KINDS))]()
        yield kind[draw.integers(len(kind))]


def as_number(value):
    """Return a value as a Python number, or None if it is not a single real number."""
    if isinstance(value, np.ndarray | jax.Array):
        kind = jnp.issubdtype
        plain = kind(value.dtype, np.number)
        value = value.item() if value.shape == () and plain else None
    if isinstance(value, bool | np.bool_):
        return None
    if isinstance(value, np.floating):
        return float(value)
    return value if isinstance(value, numbers.Real) else None


def is_whole(value, low=1, high=2**31 - 1, *, in_array=False):
    """Return whether a value is one whole number in a range, maybe in an array."""
    if isinstance(value, np.ndarray | jax.Array) and not in_array:
        return False
    number = as_number(value)
    return isinstance(number, numbers.Integral) and low <= number <= high


def is_real(value, low=0.0, high=3.4e38, excludes_low=False, *, in_array=False):
    """Return whether a value is one real number in a range, maybe in an array."""
    if isinstance(value, np.ndarray | jax.Array) and not in_array:
        return False
    number = as_number(value)
    if number is None or not low <= number <= high:
        return False
    return not excludes_low or bool(np.float32(number) - low >= 2**-126)

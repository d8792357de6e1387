"""Write JSON files, and read them with their content checked against a type."""

import contextlib
import dataclasses
import json
import math
import pathlib
import types
import typing
from collections.abc import Iterator, Mapping
from typing import Any, get_args, get_origin, get_type_hints

import jax
import numpy as np

from gasil_jax.errors import InputError, NotImportable, shown
from gasil_jax.host import output_file


def write(path: pathlib.Path, content: Mapping[str, Any]) -> None:
    """Write a JSON file atomically."""
    with output_file.atomic(path) as partial:
        partial.write_text(to_json(content) + "\n")


def to_json(content: Mapping[str, Any]) -> str:
    """Return what `write` writes; raise `TypeError` if a value has no JSON form."""
    return json.dumps(content, indent=2, default=_to_json, allow_nan=False)


def _to_json(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return dataclasses.asdict(value)
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        return np.asarray(value).tolist()
    if isinstance(value, pathlib.PurePath):
        return str(value)
    raise TypeError(f"{type(value).__name__} has no JSON form")


@contextlib.contextmanager
def blamed(path: pathlib.Path) -> Iterator[None]:
    """Turn an error about a file's content into an `InputError` that names the file.

    `NotImportable` is not changed: on another machine the file may be usable.
    """
    try:
        yield
    except NotImportable:
        raise
    # Deeply nested brackets cause a RecursionError.
    except (ValueError, RecursionError, LookupError, TypeError) as error:
        raise InputError(f"{path} is damaged: {error}") from None


def read(path: pathlib.Path, kind: Any) -> Any:
    """Return the content of a JSON file, checked against a type."""
    with blamed(path):
        return as_type(kind, json.loads(path.read_text()), "")


def as_type(kind: Any, value: Any, name: str) -> Any:
    """Return a value of a JSON file as a type; see `read`."""
    origin, arguments = get_origin(kind), get_args(kind)
    if kind is Any:
        return _with_tuples(value)
    if origin in (typing.Union, types.UnionType):
        for option in arguments:
            with contextlib.suppress(InputError):
                return as_type(option, value, name)
    elif origin is dict and isinstance(value, dict):
        return {key: as_type(arguments[1], x, key) for key, x in value.items()}
    elif origin is tuple and isinstance(value, list | tuple):
        kinds = arguments
        if len(arguments) == 2 and arguments[1] is ...:
            kinds = arguments[:1] * len(value)
        if len(value) == len(kinds):
            return tuple(as_type(one, x, name) for one, x in zip(kinds, value))
    elif isinstance(value, dict) and dataclasses.is_dataclass(kind):
        return kind(**_fields(kind, value))  # type: ignore[operator]
    elif isinstance(value, dict) and typing.is_typeddict(kind):
        for missing in sorted(kind.__required_keys__ - set(value)):
            raise InputError(f"{missing} is missing")
        return _fields(kind, value)
    elif _is_plain(kind, value):
        return value
    raise InputError(f"{name or 'its content'} is {shown(value)}")


def _fields(kind: Any, value: Mapping[str, Any]) -> dict[str, Any]:
    hints = get_type_hints(kind)
    return {key: as_type(hints.get(key, Any), x, key) for key, x in value.items()}


def _is_plain(kind: Any, value: Any) -> bool:
    if kind is float:
        number = isinstance(value, int | float) and not isinstance(value, bool)
        # A whole number may be too large for `isfinite`.
        return number and abs(value) < math.inf and value == value
    if kind is int:
        return type(value) is int and value >= 0
    return type(value) is kind


def _with_tuples(value: Any) -> Any:
    # JSON has no tuples, but a config must be hashable.
    return tuple(map(_with_tuples, value)) if isinstance(value, list) else value

"""Read the JSON files of a run folder, and check their content against a type."""

import contextlib
import dataclasses
import hashlib
import json
import math
import pathlib
import types
import typing
from collections.abc import Callable, Iterator
from typing import Any, get_args, get_origin, get_type_hints

from gasil_jax.errors import InputError, NotImportable

_DESCRIPTIONS = {
    str: "a string",
    int: "a whole number, 0 or more",
    float: "a finite number",
    bool: "true or false",
    types.NoneType: "null",
}

#: The field that `metrics_files.write_json` adds, with the hash of the others.
HASH = "sha256"


def digest(content: Any) -> str:
    """Return the SHA-256 of the content of a JSON file, however it is laid out."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


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
        raise InputError(
            f"{path} is damaged, or another program wrote it: {error}"
        ) from None


def read(path: pathlib.Path, kind: Any) -> Any:
    """Return the content of a JSON file, checked against a type and its own hash.

    Args:
      path: the file.
      kind: the type: a dataclass, of which an instance is returned; a `TypedDict`,
        whose undeclared fields are returned unchecked; str, int (0 or more), float
        (finite), bool or None; a tuple, which is a list in the file; a dict; a union of
        these; or `Any`, which is not checked, but whose lists become tuples.

    Raises:
      InputError: if the content has another type, which the message names, or if it
        has changed since it was written.
      NotImportable: if it names an agent that can't be imported here.
      OSError: if there is no such file.
    """
    with blamed(path):
        content = json.loads(path.read_text())
        written = content.pop(HASH, None) if isinstance(content, dict) else None
        value = as_type(kind, content, "")
        if written not in (None, digest(content)):
            raise ValueError(f"it was changed: to use it as it is, delete its {HASH}")
        return value


def as_type(kind: Any, value: Any, name: str) -> Any:
    """Return a value of a JSON file as a type; see `read`.

    Args:
      kind: the type.
      value: the value.
      name: name of the field that holds it, such as "config.alpha".

    Raises:
      InputError: if the value has another type.
    """
    origin, arguments = get_origin(kind), get_args(kind)
    if kind is Any:
        return _with_tuples(value)
    if origin in (typing.Union, types.UnionType):
        for option in arguments:
            try:
                return as_type(option, value, name)
            except InputError:
                if isinstance(value, list | dict):
                    raise
    elif origin is dict and isinstance(value, dict):
        return {
            key: as_type(arguments[1], x, _join(name, key)) for key, x in value.items()
        }
    elif origin is tuple and isinstance(value, list | tuple):
        kinds = arguments
        if len(arguments) == 2 and arguments[1] is ...:
            kinds = arguments[:1] * len(value)
        if len(value) == len(kinds):
            return tuple(as_type(one, x, name) for one, x in zip(kinds, value))
    elif isinstance(value, dict):
        if dataclasses.is_dataclass(kind):
            return _with_fields(kind, value, name)
        if typing.is_typeddict(kind):
            hints = get_type_hints(kind)
            if missing := sorted(kind.__required_keys__ - set(value)):
                raise InputError(f"{_join(name, missing[0])} is missing")

            def of(key: str) -> Any:
                return hints.get(key, Any)

            return {
                key: as_type(of(key), x, _join(name, key)) for key, x in value.items()
            }
    elif kind in _DESCRIPTIONS and _is_plain(kind, value):
        return value
    raise InputError(f"{name or 'it'} is {value!r}: it must be {_describe(kind)}")


def _with_fields(kind: Any, value: dict[str, Any], name: str) -> Any:
    """Return an instance of a dataclass; fields that are missing have their default."""
    hints = get_type_hints(kind)
    for key in value:
        if key not in hints:
            raise InputError(f"{_join(name, key)} is unknown")
    return kind(**{key: as_type(hints[key], x, key) for key, x in value.items()})


def _is_plain(kind: Any, value: Any) -> bool:
    if kind is float:
        number = isinstance(value, int | float) and not isinstance(value, bool)
        # A whole number may be too large for `isfinite`.
        return number and abs(value) < math.inf and value == value
    if kind is int:
        return type(value) is int and value >= 0
    return type(value) is kind


def _describe(kind: Any) -> str:
    arguments = get_args(kind)
    if get_origin(kind) in (typing.Union, types.UnionType):
        return " or ".join(
            _describe(one) for one in arguments if get_origin(one) is not Callable
        )
    if get_origin(kind) is tuple:
        return "a list"
    return _DESCRIPTIONS.get(kind, "an object")


def _join(name: str, key: str) -> str:
    return f"{name}.{key}" if name else key


def _with_tuples(value: Any) -> Any:
    # JSON has no tuples, but a config must be hashable.
    return tuple(map(_with_tuples, value)) if isinstance(value, list) else value

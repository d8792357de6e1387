"""Make options of the fields of dataclasses, and read them from a command line.

A field's name, type, default and text in the class's docstring are its option: the
declarations of settings serve Python and the command line alike.
"""

import argparse
import contextlib
import dataclasses
import importlib
import inspect
import math
import pathlib
import re
import sys
import types
import typing
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import Any, NoReturn, TypeVar, get_args, get_origin, get_type_hints

from gasil_jax.cli.reporting import HelpShown
from gasil_jax.config import Schedule
from gasil_jax.errors import InputError, nearest
from gasil_jax.host.points import whole_number

T = TypeVar("T")

#: The metadata of a field that is an argument of the command instead of an option.
POSITIONAL = {"positional": True}


class Parser(argparse.ArgumentParser):
    """A parser whose errors are `InputError`; `--help` shows the options `shown`."""

    def __init__(
        self,
        program: str,
        usage: str,
        kind: Any,
        shown: Collection[str] | None = None,
    ):
        super().__init__(
            prog=f"python -m {program}",
            usage=f"python -m {program} {usage}",
            description=(inspect.getdoc(kind) or "").partition("\n\nAttributes:")[0],
            epilog=None if shown is None else "--help-all shows all options.",
            add_help=False,
            allow_abbrev=False,
        )
        self._shown = shown
        self._names: list[str] = []
        self._hidden: list[argparse.Action] = []
        self._of: dict[str, list[str]] = {}

    def error(self, message: str) -> NoReturn:
        """Raise the `InputError` for an error of argparse."""
        if match := re.match(r"argument (?:--)?([\w-]+)(?:/\S+)?: (.*)", message):
            name, why = match[1].replace("-", "_"), match[2]
            message = f"{name} {why}" if why.startswith("is ") else f"{name}: {why}"
        if match := re.match(r"the following arguments are required: (\S+)", message):
            message = f"{match[1].strip(',')} is missing: see --help"
        raise InputError(message.replace("\n", " "))

    def add_fields(
        self,
        kind: Any,
        title: str,
        default: Any = None,
        *,
        all_shown: bool = False,
        shared: Collection[str] = (),
    ) -> None:
        """Add an option for each field of a dataclass, as a group of the help.

        Those that are `shared` with others have an option already.
        """
        group = self.add_argument_group(title)
        texts, hints = _texts(kind), get_type_hints(kind)
        own = self._of[title] = []
        for field in dataclasses.fields(kind):
            value = _default(field) if default is None else getattr(default, field.name)
            text = texts.get(field.name, "").replace("%", "%%")
            shown = all_shown or self._shown is None or field.name in self._shown
            if field.name in shared:
                continue
            if field.name in self._names:
                raise InputError(
                    f"{title} has a setting {field.name!r}, a name that is taken by an "
                    "option: it must be a new one"
                )
            own.append(field.name)
            if field.metadata.get("positional"):
                of_type = _of_type(hints[field.name]) | {"metavar": field.name.upper()}
                group.add_argument(field.name, help=text, **of_type)
                continue
            self._names.append(field.name)
            required = value is dataclasses.MISSING
            if not required and value is not None and value not in ((), ""):
                text = f"{text.removesuffix('.')} (default: {_as_text(value)})"
            action = group.add_argument(
                f"--{field.name.replace('_', '-')}",
                default=None if required else value,
                required=required,
                help=text,
                **_of_type(hints[field.name]),
            )
            if not shown:
                self._hidden.append(action)

    def read(
        self,
        given: Sequence[str],
        why_not: Callable[[str], str] = lambda name: "",
    ) -> argparse.Namespace:
        """Return the values of the words of a command line."""
        if "--version" in given:
            print(importlib.import_module("gasil_jax").__version__)
            raise HelpShown(0)
        if {"-h", "--help", "--help-all"} & set(given):
            for action in () if "--help-all" in given else self._hidden:
                action.help = argparse.SUPPRESS
            print(self.format_help())
            raise HelpShown(0)
        values, others = self.parse_known_args(given)
        for word in others:
            flag = word.partition("=")[0]
            name = flag.removeprefix("--").replace("-", "_")
            if not flag.startswith("--"):
                raise InputError(f"{word!r} is not an option or its value: see --help")
            # Of another agent.
            if " is a setting of " in (why := why_not(name.removeprefix("no_"))):
                raise InputError(f"option {flag} is unknown: {why}")
            near = nearest(name.removeprefix("no_"), self._names)
            meant = f"did you mean --{near.replace('_', '-')}?" if near else ""
            raise InputError(f"option {flag} is unknown: {meant or 'see --help'}")
        return values

    def given(self, words: Sequence[str]) -> list[str]:
        """Return the names of the options that a command line has."""
        flags = (word.partition("=")[0] for word in words)
        bare = {x.removeprefix("--").replace("-", "_") for x in flags if x[:2] == "--"}
        return [x for x in self._names if x in bare or f"no_{x}" in bare]

    def fields(self, values: argparse.Namespace, title: str) -> dict[str, Any]:
        """Return the values of a group's fields by name."""
        own = {name: getattr(values, name) for name in self._of[title]}
        return {x: tuple(y) if isinstance(y, list) else y for x, y in own.items()}


def words(arguments: Sequence[str] | None) -> list[str]:
    """Return a command line, by default this process's, with hyphens in its flags."""

    def hyphened(word: str) -> str:
        flag, equals, value = word.partition("=")
        return f"{flag.replace('_', '-')}{equals}{value}" if flag[:2] == "--" else word

    return list(map(hyphened, sys.argv[1:] if arguments is None else arguments))


def read(kind: type[T], arguments: Sequence[str] | None, program: str) -> T:
    """Return the options of a command line as an instance of their dataclass."""
    fields = dataclasses.fields(kind)  # type: ignore[arg-type]
    positional = [x.name.upper() for x in fields if x.metadata.get("positional")]
    parser = Parser(program, f"{' '.join(positional)} [options]", kind)
    parser.add_fields(kind, "options")
    return kind(**parser.fields(parser.read(words(arguments)), "options"))


def _default(field: Any) -> Any:
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return field.default


def _as_text(value: Any) -> str:
    if isinstance(value, bool):
        return "on" if value else "off"
    if isinstance(value, tuple):
        return " ".join(map(_as_text, value))
    return f"{value:g}" if isinstance(value, float) else str(value)


def _texts(kind: Any) -> Mapping[str, str]:
    """Return what the docstrings of a class and its bases say of each attribute."""
    texts: dict[str, str] = {}
    for each in reversed(kind.__mro__):
        *_, listed = (inspect.cleandoc(each.__doc__ or "")).partition("Attributes:\n")
        for entry in re.split(r"\n(?=  \w)", f"\n{listed}"):
            name, colon, text = entry.strip().partition(": ")
            if colon and name.isidentifier():
                texts[name] = " ".join(text.split())
    return texts


def _of_type(hint: Any) -> dict[str, Any]:
    """Return the arguments of `add_argument` for a field's type."""
    optional = [x for x in get_args(hint) if x is not types.NoneType]
    if hint == Schedule:
        return {"nargs": "*", "metavar": "STEPS FACTOR", "action": _Schedule}
    if get_origin(hint) in (typing.Union, types.UnionType) and len(optional) == 1:
        return _of_type(optional[0])
    if get_origin(hint) is tuple:
        one = _of_type(get_args(hint)[0])
        if get_args(hint)[0] is int:
            one["type"] = _number(whole_number, "whole numbers, separated by spaces")
        return {**one, "nargs": "*", "action": _Once}
    if get_origin(hint) is typing.Literal:
        names = {name: name for name in get_args(hint)}
        named = _number(names.__getitem__, f"one of {', '.join(names)}")
        return {"type": named, "metavar": "|".join(names)}
    if hint is bool:
        return {"action": argparse.BooleanOptionalAction}
    if hint is int:
        return {"type": _number(whole_number, "a whole number"), "metavar": "INT"}
    if hint is float:
        return {"type": _number(float, "a number"), "metavar": "NUMBER"}
    if hint is pathlib.Path:
        return {"type": pathlib.Path, "metavar": "PATH"}
    return {"metavar": "NAME"}


def _number(kind: Callable[[str], Any], what: str) -> Callable[[str], Any]:
    def number(text: str) -> Any:
        with contextlib.suppress(LookupError, ValueError, OverflowError):
            return kind(text)
        raise argparse.ArgumentTypeError(f"is {text!r}: it must be {what}")

    return number


class _Once(argparse.Action):
    """Stores a list, and refuses a second one, which would replace the first."""

    def __call__(
        self, parser: Any, namespace: Any, values: Any, option: str | None = None
    ) -> None:
        if option is not None and getattr(namespace, self.dest) is not self.default:
            raise InputError(
                f"{self.dest} is given twice: put all values after one {option}"
            )
        setattr(namespace, self.dest, tuple(values))


class _Schedule(_Once):
    """Stores pairs of numbers."""

    def __call__(
        self, parser: Any, namespace: Any, values: Any, option: str | None = None
    ) -> None:
        try:
            numbers = [float(word) for word in values]
            if len(numbers) % 2 or not all(map(math.isfinite, numbers)):
                raise ValueError
        except ValueError:
            raise InputError(
                f"{self.dest} is {' '.join(values)!r}: it must be STEPS FACTOR pairs, "
                "separated by spaces"
            ) from None
        pairs = tuple(zip(numbers[::2], numbers[1::2]))
        super().__call__(parser, namespace, pairs, option)


@contextlib.contextmanager
def input_checked() -> Iterator[None]:
    """Turn every `ValueError` raised inside the `with` block into an `InputError`."""
    try:
        yield
    except ValueError as error:
        raise InputError(str(error)) from None


def check_minimum(options: Any, **minimum: int) -> None:
    """Check that fields are from their lowest allowed values to 2**63 - 1, or None."""
    for name, low in minimum.items():
        value = getattr(options, name)
        if value is not None and not low <= value < 2**63:
            raise InputError(f"{name} is {value}: it must be from {low} to {2**63 - 1}")

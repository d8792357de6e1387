"""Parse command lines into dataclasses; turn errors into messages and exit statuses."""

import contextlib
import dataclasses
import difflib
import errno
import functools
import importlib
import io
import itertools
import os
import re
import signal
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, ParamSpec, TypeVar, get_origin, get_type_hints

import tyro
from tyro.constructors import (
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    PrimitiveTypeInfo,
)

from gasil_envs.user_code import in_a_line
from gasil_jax.config import Schedule
from gasil_jax.errors import InputError
from gasil_jax.host.interruption import Interrupted, allow_interrupts

P = ParamSpec("P")
T = TypeVar("T")

_REGISTRY = ConstructorRegistry()


class HelpShown(SystemExit):
    """Ends a command that has printed its help or its version."""


@contextlib.contextmanager
def input_checked() -> Iterator[None]:
    """Turn every `ValueError` raised inside the `with` block into an `InputError`."""
    try:
        yield
    except ValueError as error:
        raise InputError(str(error)) from None


@_REGISTRY.primitive_rule
def _schedule(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | None:
    # On a command line a schedule is a list of points; only Python takes a function.
    if info.type != Schedule:
        return None

    def from_words(words: list[str]) -> Schedule:
        pairs = "STEPS FACTOR pairs, separated by spaces"
        try:
            numbers = [float(word) for word in words]
        except ValueError:
            raise ValueError(f"{' '.join(words)!r}: it must be {pairs}") from None
        if len(numbers) % 2:
            raise ValueError(f"{len(words)} numbers: it must be {pairs}")
        return tuple(zip(numbers[::2], numbers[1::2]))

    return PrimitiveConstructorSpec(
        nargs="*",
        metavar="STEPS FACTOR ...",
        instance_from_str=from_words,
        is_instance=lambda value: isinstance(value, tuple),
        str_from_instance=lambda points: [str(x) for point in points for x in point],
    )


def whole_number(text: str) -> int:
    """Return the whole number in a text, which may be written as 1e6.

    Raises:
      ValueError: if the text is not a whole number.
    """
    try:
        return int(text)
    except ValueError:
        with contextlib.suppress(ValueError):
            if (number := float(text)).is_integer():
                return int(number)
        raise


@_REGISTRY.primitive_rule
def _whole_number(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | None:
    if info.type is not int:
        return None

    def from_words(words: list[str]) -> int:
        (word,) = words
        return whole_number(word)

    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="INT",
        instance_from_str=from_words,
        is_instance=lambda value: isinstance(value, int),
        str_from_instance=lambda number: [str(number)],
    )


def parse(
    options: type[T],
    arguments: Sequence[str] | None,
    program: str,
    default: T | None = None,
    *,
    why_not: Callable[[str], str] | None = None,
) -> T:
    """Return the options of a command line.

    Args:
      options: the dataclass of the options.
      arguments: the command line; default that of this process.
      program: name of the module that was started.
      default: the values of options that are not given; default the dataclass's own.
      why_not: returns why there is no option of a name, for an error message.

    Raises:
      HelpShown: with --help or --version, once that is printed.
      InputError: if tyro rejects the command line; the message is one line.
    """
    given = sys.argv[1:] if arguments is None else arguments
    if "--version" in given:
        print(importlib.import_module("gasil_jax").__version__)
        raise HelpShown(0)
    _check_flags(dict(_flags(options, default)), given, why_not)
    printed = io.StringIO()
    try:
        with contextlib.redirect_stderr(printed), _REGISTRY:
            return tyro.cli(
                options,
                args=arguments,
                prog=f"python -m {program}",
                config=(tyro.conf.OmitArgPrefixes,),
                default=tyro.MISSING_NONPROP if default is None else default,
            )
    except SystemExit as exit_:
        if exit_.code in (0, None):
            raise HelpShown(0) from None
        if (short := [shortened(word) for word in given]) != [*given]:
            # tyro would break the word into lines, whose beginnings nobody knows.
            parse(options, short, program, default, why_not=why_not)
        raise InputError(_in_one_line(printed.getvalue())) from None


def _check_flags(
    kinds: Mapping[str, Any],
    arguments: Sequence[str],
    why_not: Callable[[str], str] | None,
) -> None:
    """Check for mistakes that tyro accepts or reports with an unclear message.

    Args:
      kinds: the types of all options, by name.
      arguments: the command line.
      why_not: see `parse`.

    Raises:
      InputError: if an option is unknown, is an on/off option with a value, or is a
        list option that is given twice.
    """
    given = set()
    for argument, following in itertools.zip_longest(arguments, arguments[1:]):
        flag, equals, value = argument.partition("=")
        if not flag.startswith("--"):
            continue
        name = flag.removeprefix("--").replace("-", "_")
        if name not in ("help", "", *kinds) and name.removeprefix("no_") not in kinds:
            own = why_not(name.removeprefix("no_")) if why_not else ""
            if " is a setting of " in own:
                raise InputError(f"option {flag} is unknown: {own}")
            near = [f"--{x.replace('_', '-')}" for x in _similar(name, tuple(kinds))]
            what = f"did you mean {' or '.join(near)}?" if near else "see --help"
            raise InputError(f"option {flag} is unknown: {what}")
        if equals and kinds.get(name.removeprefix("no_")) is bool:
            raise InputError(f"{name} is {value!r}: it takes no value")
        if kinds.get(name) is bool and str(following).lower() in ("true", "false"):
            raise InputError(
                f"{name} is {following!r}: it takes no value, {flag} turns it on and "
                f"--no-{flag.removeprefix('--')} off"
            )
        # tyro would use only the last list.
        if get_origin(kinds.get(name)) is tuple and name in given:
            raise InputError(f"{name} is given twice: put all values after one {flag}")
        given.add(name)


def _similar(name: str, names: Sequence[str]) -> list[str]:
    """Return up to three names that contain, abbreviate to or resemble a word."""

    def singular(word: str) -> str:
        return word.removesuffix("s")

    same = [
        x
        for x in names
        if singular(name) in map(singular, x.split("_"))
        or name == "".join(word[:1] for word in x.split("_"))
    ]
    return (same or difflib.get_close_matches(name, names, n=3, cutoff=0.7))[:3]


def _flags(kind: Any, default: Any = None) -> Iterator[tuple[str, Any]]:
    """Yield the names and types of a dataclass's fields, including nested ones.

    Args:
      kind: the dataclass.
      default: an instance, or None. The class of a nested dataclass is taken from it,
        because it may be derived from the declared one.
    """
    for name, hint in get_type_hints(kind).items():
        if dataclasses.is_dataclass(hint):
            nested = getattr(default, name, None)
            actual = type(nested) if dataclasses.is_dataclass(nested) else hint
            yield from _flags(actual, nested)
        else:
            yield name, hint


def _in_one_line(printed: str) -> str:
    """Return tyro's error message in one line, without its frame, title and hints."""
    text = re.sub(r"\x1b\[[0-9;]*m", "", printed)
    # The terminal's encoding decides whether the frame is of lines, ASCII or blanks.
    lines = [line.strip(" │╭╮╰╯─|+") for line in text.splitlines()]
    _title, *rest = [line for line in lines if line.strip("-")]
    message = " ".join(" ".join(rest).split())
    message = re.split(r" (?:Argument helptext|For full helptext)", message)[0]
    if missing := re.match(
        r"Missing from python -m [\w.]+(?: \w+)?: (--[\w-]+|[A-Z]+)", message
    ):
        kind = "option " if missing[1].startswith("--") else ""
        return f"{kind}{missing[1]} is missing: see --help"
    if extra := re.match(r"Unrecognized options: (.*)", message):
        return f"{extra[1]!r} is not an option or its value: see --help"
    if choice := re.match(
        r"invalid choice '(.*)' for argument '--([\w-]+)'. Expected one of \((.*)\)",
        message,
    ):
        value, name, allowed = choice.groups()
        name, allowed = name.replace("-", "_"), allowed.replace("'", "")
        return f"{name} is {value!r}: it must be one of {allowed}"
    if unparsed := re.match(
        r"Error parsing --([\w-]+): Could not find valid parse .*\['(.*)'\]", message
    ):
        # In a narrow frame tyro breaks a line after a comma.
        name, value = unparsed[1].replace("-", "_"), unparsed[2].replace(", ", ",")
        return f"{name} is {value!r}: it must be whole numbers, separated by spaces"
    number = re.match(
        r"Error parsing --([\w-]+): (?:.*invalid literal for (int)|could not convert"
        r"|no type matching \{None\}\|FLOAT).*: '(.*)'$",
        message,
    )
    if number is None:

        def underscored(match: re.Match[str]) -> str:
            return f"{match[1].replace('-', '_')} is "

        return re.sub(r"^Error parsing --([\w-]+): ", underscored, message)
    name, whole, value = number.groups()
    kind = "a whole number" if whole else "a number"
    return f"{name.replace('-', '_')} is {value!r}: it must be {kind}"


def shortened(text: str) -> str:
    """Return a text without the middle of words that are longer than most paths."""
    return re.sub(r"(\S{40})\S{900,}(\S{20})", r"\1...\2", text)


def note(text: str) -> None:
    """Print a line to stderr about something that is allowed but may be a mistake."""
    print(f"note: {text}", file=sys.stderr)


def check_minimum(options: Any, **minimum: int) -> None:
    """Check that fields are from their lowest allowed values to 2**63 - 1, or None.

    Args:
      options: a dataclass.
      **minimum: the lowest allowed value of each field to check, by name.

    Raises:
      InputError: if a number is out of range.
    """
    for name, low in minimum.items():
        value = getattr(options, name)
        if value is not None and value < low:
            raise InputError(f"{name} is {value}: it must be {low} or more")
        if value is not None and value >= 2**63:
            raise InputError(f"{name} is {value}: it must be at most {2**63 - 1}")


def check_key(key: int) -> None:
    """Raise `InputError` unless both JAX and Gymnasium accept the number as a seed."""
    if not 0 <= key < 2**32:
        raise InputError(f"key is {key}: it must be from 0 to {2**32 - 1}")


def reports_errors(main: Callable[P, int]) -> Callable[P, int]:
    """Decorate a command's `main`: print its errors and return their exit status.

    The status is 1 if a folder or file can't be read or written, or if a program that
    it started failed; 2 for bad input, which includes a file name that is too long; and
    128 plus the signal's number if it was interrupted, or if nobody reads its output to
    the end. Without an error it is what `main` returns. If the user's own code, such as
    an environment or an agent, calls `sys.exit`, that counts as bad input.
    """

    @functools.wraps(main)
    def reporting(*args: P.args, **kwargs: P.kwargs) -> int:
        out = sys.stdout
        if isinstance(out, io.TextIOWrapper) and out.errors == "strict":
            # A name that the terminal can't show must not fail a finished command.
            out.reconfigure(errors="backslashreplace")
        try:
            allow_interrupts()
            return main(*args, **kwargs)
        except BrokenPipeError:
            # `head` reads a few lines only. Python would still try to write the rest.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 128 + signal.SIGPIPE
        except (InputError, OSError) as error:
            # A name may hold a line break.
            told = r"\n".join(f"error: {shortened(str(error))}".splitlines())
            print(told, file=sys.stderr)
            too_long = isinstance(error, OSError) and error.errno == errno.ENAMETOOLONG
            return 2 if too_long or isinstance(error, InputError) else 1
        except HelpShown:
            raise
        except SystemExit as exit_:
            why = f"your own code ended the program: {in_a_line(exit_)}"
            print(f"error: {why}", file=sys.stderr)
            return 2
        except Interrupted as interrupted:
            print(interrupted, *interrupted.__notes__, sep="\n", file=sys.stderr)
            return 128 + interrupted.signal
        # Ctrl-C outside of training, or for the second time during it.
        except KeyboardInterrupt:
            print("interrupted", file=sys.stderr, flush=True)
            if main.__module__ == "__main__":
                # Python's own end would wait for threads, of which one may compile.
                with contextlib.suppress(OSError):
                    sys.stdout.flush()
                os._exit(128 + signal.SIGINT)
            return 128 + signal.SIGINT

    return reporting

"""Readers of command lines: a mistake is an `InputError`, which is told in one line."""

import argparse
import pathlib
from collections.abc import Callable
from typing import Any, NoReturn

from experiments.store import RESULTS
from gasil_jax.cli.reporting import HelpShown
from gasil_jax.errors import InputError


class Parser(argparse.ArgumentParser):
    """A reader whose options have no short forms, and whose help has the defaults."""

    def __init__(self, name: str, about: str):
        super().__init__(
            prog=f"python -m experiments {name}",
            description=about,
            allow_abbrev=False,
            formatter_class=argparse.ArgumentDefaultsHelpFormatter,
        )

    def exit(self, status: int = 0, message: str | None = None) -> NoReturn:
        """End the command, which has printed its help."""
        raise HelpShown(status)

    def error(self, message: str) -> NoReturn:
        """Raise an `InputError`."""
        raise InputError(message)

    def add_results(self, help: str) -> None:
        """Add the option of a folder of results."""
        self.add_argument("--results", type=pathlib.Path, default=RESULTS, help=help)

    def add_page(self) -> None:
        """Add the option to write a table into docs/performance.md."""
        words = "write it into docs/performance.md too, below the same command"
        self.add_argument("--page", action="store_true", help=words)


def at_least(least: int) -> Callable[[str], int]:
    """Return the type of an option that is a whole number of `least` or more."""

    def read(text: str) -> int:
        number = int(text)
        if number < least:
            raise argparse.ArgumentTypeError(f"{text}: it must be {least} or more")
        return number

    read.__name__ = "int"
    return read


def shard(text: str) -> tuple[int, int]:
    """Return the number of a shard, from 1 on, and their count, of text like "3/8"."""
    number, count = map(int, text.split("/"))
    if not 1 <= number <= count:
        raise ValueError
    return number, count


Options: Any = argparse.Namespace

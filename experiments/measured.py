"""The tables of docs/performance.md, which the commands above them write.

A command with the option `page` puts what it has measured below the same command in the
page, between ``<!-- begin -->`` and ``<!-- end -->``.
"""

import pathlib
import re
import shlex
from collections.abc import Iterable, Sequence
from typing import Any

import jax

from experiments import engine
from experiments.tables import markdown_table
from gasil_jax.cli import parsing
from gasil_jax.errors import InputError
from gasil_jax.host import environments, output_file

PAGE = pathlib.Path(__file__).parent.parent / "docs/performance.md"
_TABLE = re.compile(
    r"\$ (?:taskset -c 0 )?python -m experiments (\w+)([^\n]*)\n```\n\n"
    r"<!-- begin -->\n(.*?)<!-- end -->",
    re.DOTALL,
)


def machine() -> str:
    """Return the devices and the cores of this process as text."""
    devices, cores = jax.devices(), environments.available_cores()
    return f"{len(devices)} x {devices[0].device_kind}, cores: {cores}"


def find(name: str, options: Any) -> re.Match[str]:
    """Return the part of the page that a command with these options writes.

    Raises:
      InputError: if the page does not have the command.
    """
    for part in _TABLE.finditer(PAGE.read_text()):
        if part[1] == name:
            arguments = [*shlex.split(part[2]), "--page"]
            if parsing.read(type(options), arguments, name) == options:
                return part
    raise InputError(f"page is set, but {PAGE} has no command with these options")


def write(
    name: str, options: Any, head: Sequence[str], rows: Iterable[Sequence[str]]
) -> None:
    """Write a table, and what it was measured with, below its command in the page."""
    part, commit = find(name, options), engine.source(None)["commit"]
    (begin, end), page = part.span(3), part.string
    table = f"{markdown_table(head, rows)}\n\n"
    table += f"{machine()}, jax {jax.__version__}, commit {commit}.\n\n"
    with output_file.atomic(PAGE) as partial:
        partial.write_text(page[:begin] + table + page[end:])

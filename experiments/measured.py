"""The tables of docs/performance.md, which the commands above them write.

A command with the option `page` puts what it has measured below the same command in the
page, between ``<!-- begin -->`` and ``<!-- end -->``.
"""

import pathlib
import re
import shlex
from collections.abc import Sequence
from typing import Any

import jax

from experiments import engine
from experiments.tables import markdown_table
from gasil_jax.cli.parsing import read
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


def find(command: str, options: Any) -> re.Match[str]:
    """Return the part of the page that a command with these options writes."""
    for part in _TABLE.finditer(PAGE.read_text()):
        words = [*shlex.split(part[2]), "--page"]
        if command == part[1] and read(type(options), words, "") == options:
            return part
    raise InputError(f"page is set, but {PAGE} has no command with these options")


def write(part: re.Match[str], head: Sequence[str], rows: Any) -> None:
    """Write a table, and what it was measured with, into a part of the page."""
    (begin, end), page = part.span(3), part.string
    table = f"{markdown_table(head, rows)}\n\n{machine()}, jax {jax.__version__}, "
    table += f"commit {engine.source(None)['commit']}.\n\n"
    with output_file.atomic(PAGE) as partial:
        partial.write_text(page[:begin] + table + page[end:])

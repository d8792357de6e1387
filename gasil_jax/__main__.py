"""List the commands of the package: ``python -m gasil_jax``."""

import ast
import pathlib
import sys
from collections.abc import Sequence

import gasil_jax
from gasil_jax.errors import nearest

#: The modules that have a command line.
COMMANDS = ("run", "sweep", "evaluate", "render", "plot")


def _first_line(documentation: str | None) -> str:
    return (documentation or "").partition("\n")[0]


def _summary(command: str) -> str:
    """Return the first line of a command's module, without importing it."""
    path = pathlib.Path(__file__).with_name("cli") / f"{command}.py"
    documentation = ast.get_docstring(ast.parse(path.read_text()))
    return _first_line(documentation).partition(":")[0].rstrip(".")


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the commands or, with --version, the version; return the exit status."""
    given = sys.argv[1:] if arguments is None else arguments
    if list(given) == ["--version"]:
        print(gasil_jax.__version__)
    elif not given or list(given) in (["-h"], ["--help"]):
        print(f"gasil_jax {gasil_jax.__version__}: {_first_line(gasil_jax.__doc__)}")
        print("\nCommands, each with --help:")
        for command in COMMANDS:
            print(f"  python -m gasil_jax.{command:14} {_summary(command)}")
    else:
        close = nearest(given[0], [*COMMANDS, "--version"])
        meant = ""
        if close is not None:
            end = f" {close}" if close == "--version" else f".{close}"
            meant = f": did you mean python -m gasil_jax{end}?"
        print(
            f"error: {given[0]!r} is unknown{meant} (without an argument all commands "
            "are listed)",
            file=sys.stderr,
        )
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())

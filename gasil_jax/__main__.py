"""List the commands of the package: ``python -m gasil_jax``."""

import ast
import pathlib
import sys
from collections.abc import Sequence

import gasil_jax
from gasil_jax.errors import unknown

#: The modules that have a command line.
COMMANDS = ("run", "sweep", "evaluate", "render", "plot")


def _summary(command: str) -> str:
    """Return the first line of a command's module, without importing it."""
    path = pathlib.Path(__file__).with_name("cli") / f"{command}.py"
    documentation = ast.get_docstring(ast.parse(path.read_text())) or ""
    return documentation.partition("\n")[0].partition(":")[0].rstrip(".")


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the commands or, with --version, the version; return the exit status."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    if given == ["--version"]:
        print(gasil_jax.__version__)
    elif given in ([], ["-h"], ["--help"]):
        about = (gasil_jax.__doc__ or "").partition("\n")[0]
        print(f"gasil_jax {gasil_jax.__version__}: {about}")
        print("\nCommands, each with --help:")
        for command in COMMANDS:
            print(f"  python -m gasil_jax.{command:14} {_summary(command)}")
    else:
        print("error:", unknown("command", given[0], COMMANDS), file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())

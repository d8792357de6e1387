"""List the commands of the package: ``python -m gasil_jax``."""

import sys
from collections.abc import Sequence

import gasil_jax
from gasil_jax.errors import unknown

#: The modules that have a command line, with what they do.
COMMANDS = {
    "run": "Train an agent",
    "sweep": "Train a sweep",
    "evaluate": "Evaluate the policies of a run",
    "render": "Make a film of a run's policy",
    "plot": "Plot one or several runs",
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the commands or, with --version, the version; return the exit status."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    if given == ["--version"]:
        print(gasil_jax.__version__)
    elif given in ([], ["-h"], ["--help"]):
        about = (gasil_jax.__doc__ or "").partition("\n")[0]
        print(f"gasil_jax {gasil_jax.__version__}: {about}")
        print("\nCommands, each with --help:")
        for command, summary in COMMANDS.items():
            print(f"  python -m gasil_jax.{command:14} {summary}")
    else:
        print("error:", unknown("command", given[0], [*COMMANDS]), file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())

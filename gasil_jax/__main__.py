"""List the commands of the package: ``python -m gasil_jax``."""

import gasil_jax

#: The modules that have a command line, with what they do.
COMMANDS = {
    "run": "Train an agent",
    "sweep": "Train a sweep",
    "evaluate": "Evaluate the policies of a run",
    "render": "Make a film of a run's policy",
    "plot": "Plot one or several runs",
}

if __name__ == "__main__":
    print(f"gasil_jax {gasil_jax.__version__}: commands, each with --help:")
    for command, summary in COMMANDS.items():
        print(f"  python -m gasil_jax.{command:14} {summary}")

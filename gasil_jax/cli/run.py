"""Train an agent: ``python -m gasil_jax.run --env walker2d --seeds 10``."""

from collections.abc import Sequence

from gasil_jax.cli import options, train
from gasil_jax.cli.options import Options
from gasil_jax.cli.reporting import reports_errors


@reports_errors
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status."""
    given, requested = options.read(Options, arguments, "gasil_jax.run")
    train.train(given, requested, "gasil_jax.run")
    return 0

"""Train an agent: ``python -m gasil_jax.run --env walker2d --seeds 10``."""

import shlex
from collections.abc import Sequence

from gasil_jax import statistics
from gasil_jax.cli import options as options_
from gasil_jax.cli import train
from gasil_jax.cli.options import Options
from gasil_jax.cli.reporting import reports_errors
from gasil_jax.host import environments
from gasil_jax.host.results import speed_in_words


@reports_errors
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status."""
    options, requested = options_.read(Options, arguments, "gasil_jax.run")
    folder, results, env = train.train(options, requested, "gasil_jax.run")
    assert results is not None
    if len(requested.points) > 1:
        train.tell(folder, results)
        return 0
    scores = {
        name.replace("_", " "): results.finals[name][0]
        for name in ("final_return", "final_evaluation")
        if name in results.finals
    }
    speed = speed_in_words(results.trainings)
    print(f"{statistics.in_words(scores)}, {speed}, in {folder}")
    quoted = shlex.quote(str(folder))
    commands = [f"evaluate {quoted}", f"plot {quoted}"]
    if environments.can_be_drawn(env):
        commands.append(f"render {quoted} --out episode.gif")
    print("next:", "; ".join(f"python -m gasil_jax.{x}" for x in commands))
    return 0

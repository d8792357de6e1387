"""Train a sweep: ``python -m gasil_jax.sweep --env hopper --grid alpha=0.02,0.1``.

A run that is there is never trained again. So --resume continues a sweep, and may add
points and seeds to it.
"""

import argparse
from collections.abc import Sequence
from typing import cast

from gasil_jax.cli import options as options_
from gasil_jax.cli import parsing, run
from gasil_jax.cli.options import SweepOptions
from gasil_jax.cli.reporting import reports_errors
from gasil_jax.errors import InputError
from gasil_jax.host import folders, ray_launcher, training
from gasil_jax.host.interruption import noted
from gasil_jax.host.sweep import Sweep, parse_shard

_PROGRAM = "gasil_jax.sweep"


@reports_errors
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status."""
    read, requested = options_.read(SweepOptions, arguments, _PROGRAM)
    options = cast(SweepOptions, read)
    if options.launcher is not None:
        _launch(options, requested, arguments)
        return 0
    if options.shards is not None:
        raise InputError(
            f"shards is {options.shards}: it needs --launcher (one part is --shard)"
        )
    shard, program = (1, 1), _PROGRAM
    if options.shard is not None:
        shard, program = (
            parse_shard(options.shard),
            f"{_PROGRAM} --shard {options.shard}",
        )
        if options.out is None:
            raise InputError("shard needs --out and the folder of the whole sweep")
    run.train(options, requested, program, shard=shard)
    return 0


def _launch(
    options: SweepOptions, requested: Sweep, arguments: Sequence[str] | None
) -> None:
    """Train all shards with a launcher, one command for each."""
    count = options.shards
    if options.shard is not None:
        raise InputError(f"shard is {options.shard}: --launcher trains all of them")
    if count is None or count < 1:
        raise InputError(f"shards is {count}: --launcher needs --shards, 1 or more")
    if options.out is None:
        raise InputError("launcher needs --out and a folder that all hosts share")
    requested.part(count, count)  # Refuses more shards than runs.
    # The rest of the command line is that of each shard. With --resume a job that is
    # run again continues from its checkpoint.
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--resume", action="store_true")
    for name in ("--shard", "--launcher", "--shards", "--out"):
        parser.add_argument(name, nargs="?")
    others = parser.parse_known_args(parsing.words(arguments))[1]
    others += ["--resume", "--out", str(options.out.absolute()), "--shard"]
    every = [f"{number}/{count}" for number in range(1, count + 1)]
    jobs = {f"shard {shard}": [*others, shard] for shard in every}
    with noted("continue with the same command and --resume"):
        ray_launcher.run_on_ray(_PROGRAM, jobs, options.devices)
    requested = requested.continued_from(options.out)
    with folders.lock(options.out, seconds=60.0):
        trained, env = requested.trained(options.out), training.make_env(requested)
        results = run.write(options.out, requested, env, trained)
    run.tell(options.out, results, env)

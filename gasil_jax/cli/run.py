"""Train an agent: ``python -m gasil_jax.run --env walker2d --seeds 10``."""

import pathlib
import shlex
import sys
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from gasil_jax import statistics
from gasil_jax.cli import options as options_
from gasil_jax.cli.options import Options
from gasil_jax.cli.parsing import input_checked
from gasil_jax.cli.reporting import reports_errors
from gasil_jax.errors import InputError
from gasil_jax.host import environments, folders, results, saved, start, training
from gasil_jax.host.driver import Outcome
from gasil_jax.host.interruption import Interruption, noted
from gasil_jax.host.output_file import WriteError, note
from gasil_jax.host.programs import NOWHERE, Program
from gasil_jax.host.progress import announced
from gasil_jax.host.results import Results, speed_in_words
from gasil_jax.host.sweep import Sweep


@reports_errors
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status."""
    options, requested = options_.read(Options, arguments, "gasil_jax.run")
    train(options, requested, "gasil_jax.run")
    return 0


def train(
    options: Options, requested: Sweep, program: str, *, shard: tuple[int, int] = (1, 1)
) -> None:
    """Train the runs of a shard that the folder lacks; if it lacks none then, tell."""
    runs = requested.part(*shard)
    needed = requested.unfinished(options.out or NOWHERE, runs)
    with input_checked():
        env = training.prepare(requested, needed, num_devices=options.devices)
        policy = requested.start and start.load(requested.start, env, needed)
    options_.note_if_untuned(options, requested, env)
    folder = options_.make_folder(options)
    # Another shard may have begun, or added points, since.
    requested = requested.begun_in(folder, resume=options.resume or shard[1] > 1)
    how = (
        f"continue with: python -m {program} --resume --out {shlex.quote(str(folder))}"
    )
    try:
        with noted(how), Interruption() as interruption:
            needed = requested.unfinished(folder, runs)
            if policy is not None:
                start.begin(policy, env, needed)
            outcomes = training.train_programs(
                env,
                needed,
                requested.recording,
                title=f"{requested.env} {requested.agent}",
                interruption=interruption,
            )
        trained = requested.trained(folder)
        if shard[1] > 1:
            print(f"shard {shard[0]}/{shard[1]} is done, in {folder}")
        if missing := requested.missing(trained):
            total = len(requested.runs)
            print(f"{len(missing)} of {total} runs of the sweep are missing")
            return
        with folders.lock(folder, seconds=60.0):
            told = write(folder, requested, env, trained, zip(needed, outcomes))
        for outcome in outcomes:
            if outcome.unsaved is not None:
                raise outcome.unsaved
    except WriteError as error:
        raise WriteError(f"{error}; {how}") from error
    tell(folder, told, env)


def write(
    folder: pathlib.Path,
    requested: Sweep,
    env: Any,
    trained: Sequence[Program],
    outcomes: Iterable[tuple[Program, Outcome]] = (),
) -> Results:
    """Write the results of a sweep whose runs are all trained, and return them."""
    with announced(requested.env, "writing the results"):
        told = results.read(requested, trained)
        best = results.write(folder, told)["best_by_mean"] or 0
        try:
            states = saved.states_of(folder, requested, env, best, list(outcomes))
        except InputError as error:
            note(f"policy.npz is not written: {error}")
        else:
            results.write_policies(folder, told, states, env)
    faults = np.any([x > 0 for x in told.faults.values()], axis=(0, 1))
    if faults.any():
        seeds = [seed for seed, bad in zip(requested.seeds, faults, strict=True) if bad]
        print(
            f"warning: numbers that were not finite in seeds {seeds}: see faulty_steps "
            f"(simulation) and skipped_updates (learning) in {folder / 'results.csv'}",
            file=sys.stderr,
        )
    return told


def tell(folder: pathlib.Path, told: Results, env: Any) -> None:
    """Print the scores, the speed, and commands to go on with."""
    if len(told.sweep.points) > 1:
        print(results.best_in_words(told))
        scores = ""
    else:
        names = [x for x in ("final_return", "final_evaluation") if x in told.finals]
        every = {name.replace("_", " "): told.finals[name][0] for name in names}
        scores = f"{statistics.in_words(every)}, "
    print(f"{scores}{speed_in_words(told.trainings)}, in {folder}")
    quoted = shlex.quote(str(folder))
    commands = [f"evaluate {quoted}", f"plot {quoted}"]
    if environments.can_be_drawn(env):
        commands.append(f"render {quoted} --out episode.gif")
    print("next:", "; ".join(f"python -m gasil_jax.{x}" for x in commands))

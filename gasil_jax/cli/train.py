"""Train what is missing in a folder, and write its results."""

import pathlib
import shlex
import sys
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from gasil_jax.cli import options as options_
from gasil_jax.cli.options import Options
from gasil_jax.cli.parsing import input_checked
from gasil_jax.errors import InputError
from gasil_jax.host import folders, results, saved, training
from gasil_jax.host.driver import Outcome
from gasil_jax.host.interruption import Interruption, noted
from gasil_jax.host.output_file import WriteError, note
from gasil_jax.host.programs import NOWHERE, Program
from gasil_jax.host.progress import announced
from gasil_jax.host.results import Results, speed_in_words
from gasil_jax.host.sweep import Sweep


def train(
    options: Options, requested: Sweep, program: str, *, shard: tuple[int, int] = (1, 1)
) -> tuple[pathlib.Path, Results | None, Any]:
    """Train the runs of a shard that are missing in the folder of the options.

    Returns:
      The folder; the results, written to it, None while runs of other shards are
      missing; and the environment.
    """
    runs = requested.part(*shard)
    needed = requested.unfinished(options.out or NOWHERE, runs)
    with input_checked():
        env = training.prepare(
            requested,
            needed,
            options.out or pathlib.Path("runs"),
            num_devices=options.devices,
        )
        start = requested.start and saved.load_start(requested.start, env, needed)
    options_.note_if_untuned(options, requested, env)
    folder = options_.make_folder(options)
    with folders.lock(folder, seconds=60.0):
        if not (options.resume or shard[1] > 1) or not folders.has_config(folder):
            folders.refuse_used(folder)
        # Another shard may have begun, or added points, since.
        requested = requested.continued_from(folder)
        requested.write(folder)
    how = (
        f"continue with: python -m {program} --resume --out {shlex.quote(str(folder))}"
    )
    try:
        with noted(how), Interruption() as interruption:
            needed = requested.unfinished(folder, runs)
            if start is not None:
                saved.begin(start, env, needed)
            outcomes = training.train_programs(
                env,
                needed,
                requested.recording,
                title=f"{requested.env} {requested.agent}",
                interruption=interruption,
            )
        trained = requested.trained(folder)
        if requested.missing(trained):
            return folder, None, env
        with folders.lock(folder, seconds=60.0):
            told = write(folder, requested, env, trained, zip(needed, outcomes))
        for outcome in outcomes:
            if outcome.unsaved is not None:
                raise outcome.unsaved
    except WriteError as error:
        raise WriteError(f"{error}; {how}") from error
    return folder, told, env


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


def tell(folder: pathlib.Path, told: Results) -> None:
    """Print the best points of a sweep, its speed, and commands to go on with."""
    print(*results.best_in_words(told), sep="\n")
    print(f"{speed_in_words(told.trainings)}, in {folder}")
    quoted = shlex.quote(str(folder))
    print(
        f"next: python -m gasil_jax.evaluate {quoted}; "
        f"python -m gasil_jax.plot {quoted}"
    )

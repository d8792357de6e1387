"""Train a sweep: ``python -m gasil_jax.sweep --env hopper --grid alpha=0.02,0.1``.

Points that differ only in traced numbers run in one compiled program, with seeds x
points vmapped and sharded. Points that differ in a count (such as buffer size or
discriminator updates) are grouped, and each group compiles once.

The sweep's folder holds config.json, results.csv (a row for each point and seed),
curves.npz (every metric, (points, seeds, iterations)), summary.json, sweep.png (the
final returns of each point) and hyperparameters.png (the same over each hyperparameter
that varies). Each program has a folder under programs/ with its metrics.csv and
checkpoints. With --evaluate-every there is an evaluations.csv beside each metrics.csv,
and curves.npz also holds its columns, (points, seeds, evaluations), as evaluation_mean
and so on.

With --shard 3/8 an eighth of all points and seeds is trained in the folder
shards/3-of-8, without tables. `gasil_jax.merge` makes the tables from all shards.
"""

import argparse
import dataclasses
import pathlib
import sys
from collections.abc import Sequence
from typing import Any

from gasil_jax import algorithms
from gasil_jax.errors import InputError
from gasil_jax.host import command_line, run_folder, run_options
from gasil_jax.host.driver import Outcome
from gasil_jax.host.interruption import Interrupted
from gasil_jax.host.members import Members
from gasil_jax.host.run_folder import StoredRun
from gasil_jax.sweeps import assembly, launch, merging, shards, tables, trained_programs
from gasil_jax.sweeps.points import Point, check_saved, make_points
from gasil_jax.sweeps.shards import Program

_PROGRAM = "gasil_jax.sweep"


@dataclasses.dataclass(frozen=True)
class Options(run_options.Options):
    """Train every point of a grid, or random points, with many seeds each.

    Attributes:
      out: folder of the sweep, created if it is missing; default
        runs/ENV-AGENT-TIME.
      grid: NAME=VALUE,VALUE,... for each hyperparameter or count that varies.
      random: number of points to draw from the grid or, without a grid, from the
        ranges of the paper's appendix. The draw's seed is first_seed.
      points_file: a JSON file with a list of points, {"NAME": VALUE, ...} each,
        instead of grid and random.
      shard: train only this part of all points and seeds, NUMBER/COUNT with numbers
        from 1 on, in a folder below `out`. With --resume it continues. See
        gasil_jax.merge.
      launcher: train all shards and merge them: local, in one process after another,
        or ray, on a Ray cluster. With --resume it continues them.
      shards: number of shards that the launcher makes.
    """

    grid: tuple[str, ...] = ()
    random: int | None = None
    points_file: str | None = None
    shard: str | None = None
    launcher: str | None = None
    shards: int | None = None


def train(
    options: Options,
    env: Any,
    points: Sequence[Point],
    programs: Sequence[Program],
    folder: pathlib.Path,
) -> None:
    """Train, log and save the unfinished programs, one after the other.

    Raises:
      Interrupted: if a signal was received.
      OSError: if the folder can no longer be written.
      ValueError: if the sweep to continue does not fit the options.
    """
    write = lambda: run_options.write_config(options, folder, points=points)
    # A sweep that is continued keeps its config.json until its checkpoint is restored.
    if not run_folder.has_run(folder):
        write()

    def on_finished(job: assembly.Job, members: Members, outcome: Outcome) -> None:
        if outcome.unsaved is not None:
            # Its policies are nowhere else, so it is not finished.
            raise outcome.unsaved
        trained_programs.write_training(
            folder,
            job.program,
            env_steps=outcome.new_steps,
            compile_seconds=outcome.compile_seconds,
            train_seconds=outcome.train_seconds,
            evaluation_seconds=outcome.evaluation_seconds,
            device=members.device_kind,
            device_count=len(members.devices),
        )

    shard = None if options.shard is None else shards.parse(options.shard)
    name = shards.name(folder, shard)
    jobs = [
        assembly.Job(
            program,
            program.folder(folder),
            dict(zip(trained_programs.LABELS, zip(*program.members))),
            name=f"{name}-{program.number}",
            finished=trained_programs.read_training(folder, program) is not None,
        )
        for program in programs
    ]
    title = f"{options.env} {options.agent} sweep"
    assembly.train(
        options, env, jobs, title=title, on_finished=on_finished, on_restored=write
    )


@command_line.reports_errors
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status."""
    given, others = _process_options(arguments)
    if given.launcher is not None:
        options = run_options.parse(Options, arguments, _PROGRAM)
        _launch(options, given.launcher, others)
        return 0
    if given.shard is not None:
        shard = shards.parse(given.shard)
        folder = _shard_folder(shard, given.out)
        resumed = None
        if given.resume and run_folder.has_run(folder):
            resumed = StoredRun(folder, run_folder.read(folder))
        _train_shard(arguments, shard, folder, resumed=resumed)
        return 0
    resumed = run_options.resumed_run(arguments)
    if resumed is not None and (text := resumed.description.get("shard")):
        _train_shard(arguments, shards.parse(text), resumed.folder, resumed=resumed)
    else:
        options = run_options.parse(Options, arguments, _PROGRAM, resumed)
        _train_whole(options, resumed)
    return 0


def _process_options(
    arguments: Sequence[str] | None,
) -> tuple[argparse.Namespace, list[str]]:
    """Return the options that decide which process trains what, and other arguments.

    The parser of all options reports a wrong or a missing value.
    """
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--resume", nargs="?", const=True, default=False)
    for name in ("--shard", "--launcher", "--shards", "--out"):
        parser.add_argument(name, nargs="?")
    return parser.parse_known_args(arguments)


def _points(options: Options, stored: Sequence[StoredRun]) -> list[dict[str, Any]]:
    """Return the points of a sweep.

    If the file that listed them is gone, they are read from a config.json.

    Args:
      options: the options.
      stored: the sweep, or those of its shards that exist.
    """
    file = options.points_file
    if file is not None and not pathlib.Path(file).exists():
        for folder, description in stored:
            if description.get("points_file") == file:
                points = list(description["points"])
                check_saved(points, description["algorithm"], folder / "config.json")
                return points
    return make_points(
        options.grid,
        options.random,
        file,
        seed=options.first_seed,
        algorithm=options.algorithm,
    )


def plan(
    options: Options, stored: Sequence[StoredRun] = ()
) -> tuple[list[dict[str, Any]], list[Program]]:
    """Return all points and programs of a sweep, checked.

    Args:
      options: the options.
      stored: the sweep, or those of its shards that exist.

    Raises:
      InputError: if a value is not allowed; the message names the value and the range.
    """
    run_options.check(options)
    points = _points(options, stored)
    algorithm = options.algorithm
    without_effect = run_options.without_effect(algorithm)
    with command_line.input_checked():
        for point in points:
            for name in without_effect.keys() & point.keys():
                raise InputError(f"{name} can't vary: {without_effect[name]}")
            algorithms.check(algorithm.replace(**point))
    programs = shards.programs(algorithm, points, run_options.seeds_of(options))
    return points, programs


def _untrained(options: Options, programs: Sequence[Program]) -> list[Program]:
    """Return the programs that are not yet trained to their end in the folder `out`."""
    if options.out is None:
        return list(programs)
    return trained_programs.TrainedPrograms(options.out, programs).unfinished()


def _refuse_other_points(points: Sequence[Point], resumed: StoredRun) -> None:
    """Raise `InputError` if a sweep is continued with other points."""
    if list(resumed.description["points"]) != list(points):
        raise InputError(
            f"out is {resumed.folder}, where a sweep of other points has begun: name "
            "the same points or another folder"
        )


def _plan_here(
    options: Options, resumed: StoredRun | None, others: Sequence[StoredRun] = ()
) -> tuple[list[dict[str, Any]], list[Program]]:
    """Return what `plan` returns, for a sweep or a shard in this process.

    Args:
      options: the options of the sweep or shard.
      resumed: the sweep or shard to continue, if any.
      others: the other shards of the sweep that exist.
    """
    points, programs = plan(options, [resumed, *others] if resumed else others)
    if resumed is not None:
        _refuse_other_points(points, resumed)
    if options.shards is not None:
        raise InputError(
            f"shards is {options.shards}: it needs --launcher (one part is --shard)"
        )
    return points, programs


def _train_whole(options: Options, resumed: StoredRun | None) -> None:
    points, programs = _plan_here(options, resumed)
    if options.out is not None and options.resume:
        shards.refuse_sharded(options.out)
    run_options.check_out(options)
    env = assembly.prepare(options, programs, _untrained(options, programs))
    with run_options.open_folder(options, _PROGRAM) as folder:
        train(options, env, points, programs, folder)
        trained = trained_programs.TrainedPrograms(folder, programs)
        results = tables.read(points, run_options.seeds_of(options), [trained])
        summary = tables.write(folder, results)
    print(*tables.report(points, summary), f"in {folder}", sep="\n")


def _shard_folder(shard: shards.Shard, out: str | None) -> pathlib.Path:
    """Return the folder of a shard of the sweep in `out`.

    Raises:
      InputError: if `out` is missing, or holds another kind of sweep.
    """
    if out is None:
        raise InputError("shard needs --out and the folder of the whole sweep")
    shards.refuse_unsharded(pathlib.Path(out))
    shards.refuse_other_count(pathlib.Path(out), shard)
    return shard.folder(pathlib.Path(out))


def _refuse_other_sweep(
    options: Options,
    shard_folder: pathlib.Path,
    *,
    points: Sequence[Point],
    others: Sequence[StoredRun],
) -> None:
    """Raise `InputError` if other shards are of another sweep.

    Args:
      options: options of this shard.
      shard_folder: folder of this shard.
      points: points of the sweep.
      others: the other shards of the sweep that exist.
    """
    if not others:
        return
    now = {**run_options.description(options), "points": tuple(points)}
    for folder, description in others:
        # Shards are continued to more total_steps one after another.
        steps = options.config.total_steps
        algorithm = description["algorithm"].replace(total_steps=steps)
        merging.refuse_different(
            StoredRun(folder, {**description, "algorithm": algorithm}),
            StoredRun(shard_folder, now),
        )


def _train_shard(
    arguments: Sequence[str] | None,
    shard: shards.Shard,
    shard_folder: pathlib.Path,
    *,
    resumed: StoredRun | None,
) -> None:
    """Train a shard in its own folder, or continue it if it is stored there."""
    options = run_options.parse(Options, arguments, _PROGRAM, resumed)
    options = dataclasses.replace(options, out=shard_folder)
    every = merging.stored_shards(shard_folder.parent)
    others = [other for other in every if other.folder != shard_folder]
    points, programs = _plan_here(options, resumed, others)
    _refuse_other_sweep(options, shard_folder, points=points, others=others)
    programs = shards.cut_evenly(programs, shard)
    trained = trained_programs.TrainedPrograms(shard_folder, programs)
    if resumed is not None and not trained.unfinished():
        print(f"shard {shard} is done, in {shard_folder}")
        return
    run_options.check_out(options)
    env = assembly.prepare(options, programs, _untrained(options, programs))
    with run_options.open_folder(options, _PROGRAM) as folder:
        train(options, env, points, programs, folder)
    speed = tables.speed(trained.trainings())
    print(
        f"shard {shard} is done, {speed['env_steps_per_second']:,.0f} steps/s "
        f"on {speed['device']}, in {folder}"
    )


def _launch(options: Options, launcher: str, others: Sequence[str]) -> None:
    """Train all shards with a launcher, one command for each, then merge them."""
    launch.check(launcher)
    if options.shard is not None:
        raise InputError(f"shard is {options.shard}: --launcher trains all of them")
    if options.shards is None or options.shards < 1:
        given = f"shards is {options.shards}: "
        raise InputError(f"{given}--launcher needs --shards, 1 or more")
    if options.out is None:
        raise InputError("launcher needs --out and a folder that all hosts share")
    points, programs = plan(options, merging.stored_shards(shards.root(options.out)))
    last = shards.Shard(options.shards, options.shards)
    shards.cut_evenly(programs, last)  # Refuses more shards than members.
    shards.refuse_unsharded(options.out)
    shards.refuse_other_count(options.out, last)
    shards.refuse_used(options.out, options.resume)
    every = [shards.Shard(number, last.count) for number in range(1, last.count + 1)]
    # With --resume a job that is run again continues from its checkpoint.
    resumed = ["--resume", "--out", str(options.out.absolute())]
    jobs = {
        f"shard {shard}": [*others, *resumed, "--shard", str(shard)] for shard in every
    }
    try:
        launch.LAUNCHERS[launcher](_PROGRAM, jobs, options.devices)
    except Interrupted as interrupted:
        interrupted.add_note("continue with the same command and --resume")
        raise
    summary = merging.merge([options.out], options.out)
    print(*tables.report(points, summary), f"in {options.out}", sep="\n")


if __name__ == "__main__":
    sys.exit(main())

"""Sweeps: ``python -m gasil_jax.sweep --env hopper --seeds 5 --grid alpha=0.02,0.1``.

Points that differ only in `Hyperparameters` run in one compiled program, seeds x
points vmapped and sharded; those that differ in a field of `Config` (buffer size,
discriminator updates) are grouped, and each group compiles once. With --share-counts
these two don't divide the points: all run in the program of the largest.

The sweep's folder holds config.json, results.csv (a row for each point and seed),
curves.npz (every metric, (points, seeds, iterations)), summary.json and sweep.png, and
for each program a folder under programs/ with its metrics.csv and checkpoints. With
--evaluate-every there is an evaluations.csv beside each metrics.csv, and curves.npz has
its columns, (points, seeds, evaluations), as evaluation_mean and so on. With
--shard 3/8 an eighth of all points and seeds is trained in a folder of its own,
shards/3-of-8, without the tables, which gasil_jax.merge makes of all shards.
"""

import argparse
import dataclasses
import pathlib
import sys
from collections.abc import Sequence
from typing import Any

from gasil_jax import (
    command_line,
    launch,
    merge,
    run,
    run_folder,
    shards,
    sweep_tables,
    trackers,
)
from gasil_jax.command_line import InputError
from gasil_jax.interruption import Interrupted, Interruption
from gasil_jax.points import Point, make_points
from gasil_jax.shards import Program

_PROGRAM = "gasil_jax.sweep"


@dataclasses.dataclass(frozen=True)
class PointOptions(run.Options):
    """What is trained at every point.

    Attributes:
      grid: NAME=VALUE,VALUE,... for each hyperparameter or count that varies.
      random: draw so many points, from the grid's values or, without one, from the
        ranges of the paper's appendix; first_seed is the draw's seed, too.
      points_file: a JSON file with a list of points, {"NAME": VALUE, ...} each, in
        place of grid and random.
      share_counts: points that differ in buffer_steps or discriminator_updates share
        a program too, which compiles once and has for each point the cost of the
        largest: best on a GPU.
    """

    grid: tuple[str, ...] = ()
    random: int | None = None
    points_file: str | None = None
    share_counts: bool = False


@dataclasses.dataclass(frozen=True)
class Options(PointOptions):
    """Train every point of a grid, or random points, with many seeds each.

    Attributes:
      shard: train this part of all points and seeds alone, NUMBER/COUNT from 1/COUNT
        on, in a folder below out; the same command again goes on with it. See
        gasil_jax.merge.
      launcher: train all shards and merge them: local, one process after another, or
        ray, on its cluster.
      shards: how many the launcher makes.
    """

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
    """Train the programs one by one, log and save; those that are trained are left.

    Raises:
      Interrupted: by a signal.
      OSError: the folder can't be written any more.
      ValueError: what is there to go on with does not fit.
    """
    from gasil_jax import batch, driver
    from gasil_jax.progress import Progress

    run.write_config(options, folder, points=points)
    steps_of = lambda program: (
        program.config.num_iterations
        * program.config.batch_steps
        * len(program.members)
    )
    schedule = driver.CheckpointSchedule(
        options.checkpoint_every, options.keep_checkpoints
    )
    steps_before = 0
    title = f"{options.env} {options.config.agent} sweep"
    with (
        Interruption() as interruption,
        Progress(title, sum(map(steps_of, programs))) as progress,
    ):
        for program in programs:
            if sweep_tables.read_training(folder, program) is None:
                indices, seeds = zip(*program.members)
                runs = batch.make_batch(
                    env, program.config, seeds, program.hyperparameters
                )
                place = program.folder(folder)
                place.mkdir(parents=True, exist_ok=True)
                outcome = driver.drive(
                    runs,
                    place,
                    dict(zip(sweep_tables.LABELS, (indices, seeds))),
                    schedule=schedule,
                    evaluation_schedule=run.evaluation_schedule(options),
                    progress=progress,
                    interruption=interruption,
                    steps_before=steps_before,
                    trackers=trackers.make(
                        options.log, place, run_folder.flat(vars(options))
                    ),
                )
                sweep_tables.write_training(
                    folder,
                    program,
                    env_steps=outcome.new_steps,
                    compile_seconds=outcome.compile_seconds,
                    train_seconds=outcome.train_seconds,
                    evaluation_seconds=outcome.evaluation_seconds,
                    device=runs.device_kind,
                    device_count=len(runs.devices),
                )
            steps_before += steps_of(program)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    return command_line.exit_status(lambda: _main(arguments))


def _main(arguments: Sequence[str] | None) -> None:
    given, others = _placement(arguments)
    if given.launcher is not None:
        options = run.parse(Options, arguments, _PROGRAM)
        _launch(options, given.launcher, others)
    elif given.shard is not None:
        _train_shard(arguments, shards.parse(given.shard), given.out)
    else:
        began = run.begun_run(arguments)
        _train_whole(run.parse(Options, arguments, _PROGRAM, began), began)


def _placement(
    arguments: Sequence[str] | None,
) -> tuple[argparse.Namespace, list[str]]:
    """The options that say where training happens, and all other arguments."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    for name in ("--shard", "--launcher", "--shards", "--out"):
        # Without its value it is refused where everything is parsed.
        parser.add_argument(name, nargs="?")
    return parser.parse_known_args(arguments)


def plan(options: PointOptions) -> tuple[list[dict[str, Any]], list[Program]]:
    """All points and programs, checked.

    Raises:
      InputError: the value and what is allowed.
    """
    run.check(options)
    points = make_points(
        options.grid,
        options.random,
        options.points_file,
        options.first_seed,
        options.config.agent,
    )
    for point in points:
        config = options.config.replace(**point)
        run.check(dataclasses.replace(options, config=config))
    programs = shards.programs(
        options.config, points, seeds_of(options), options.share_counts
    )
    return points, programs


def seeds_of(options: PointOptions) -> range:
    """Absolute numbers of the seeds of each point."""
    return range(options.first_seed, options.first_seed + options.seeds)


def prepare(
    options: PointOptions, programs: Sequence[Program], saved: Sequence[Program]
) -> Any:
    """What must be done before anything compiles; returns the environment.

    Args:
      options: of the sweep.
      programs: with the members that are trained at once.
      saved: those whose checkpoints are still to be written.

    Raises:
      InputError: they don't fit the devices or the disk.
    """
    run.use_devices(options, sum(len(program.members) for program in programs))
    env = run.make_env(options)
    members = lambda programs: [(x.config, len(x.members)) for x in programs]
    run.check_resources(options, env, members(programs), members(saved))
    return env


def _untrained(options: Options, programs: Sequence[Program]) -> list[Program]:
    """The programs that are not trained to their end in the folder that is named."""
    if options.out is None:
        return list(programs)
    left = sweep_tables.Trained(options.out, programs).unfinished()
    return [program for program in programs if program.number in left]


def check_points(points: Sequence[Point], began: pathlib.Path | None) -> None:
    """Raise `InputError` if a sweep that has begun in a folder has other points."""
    if began is not None and list(run_folder.read(began)["points"]) != list(points):
        raise InputError(
            f"out is {began}, where a sweep of other points has begun: go on with the "
            "same ones, or name another folder"
        )


def _plan_here(
    options: Options, began: pathlib.Path | None
) -> tuple[list[dict[str, Any]], list[Program]]:
    points, programs = plan(options)
    check_points(points, began)
    if options.shards is not None:
        raise InputError(f"shards is {options.shards}: it is of --launcher")
    return points, programs


def _train_whole(options: Options, began: pathlib.Path | None) -> None:
    points, programs = _plan_here(options, began)
    if options.out is not None and options.resume:
        shards.refuse_sharded(options.out)
    run.check_out(options)
    env = prepare(options, programs, _untrained(options, programs))
    with run.open_folder(options, _PROGRAM) as folder:
        train(options, env, points, programs, folder)
        trained = sweep_tables.Trained(folder, programs)
        summary = sweep_tables.write(folder, points, seeds_of(options), [trained])
    print(*sweep_tables.report(points, summary), f"in {folder}", sep="\n")


def _train_shard(
    arguments: Sequence[str] | None, shard: shards.Shard, out: str | None
) -> None:
    """Train a shard of the sweep in `out`, or go on with it."""
    if out is None:
        raise InputError("shard needs --out and the folder of the whole sweep")
    whole = pathlib.Path(out)
    shards.refuse_whole(whole)
    shards.refuse_recut(whole, shard)
    place = shard.folder(whole)
    began = place if run_folder.is_described(place) else None
    options = run.parse(Options, arguments, _PROGRAM, began)
    options = dataclasses.replace(options, out=place, resume=True)
    points, programs = _plan_here(options, began)
    programs = shards.share(programs, shard)
    trained = sweep_tables.Trained(place, programs)
    if not trained.unfinished():
        print(f"shard {shard} is done, in {place}")
        return
    run.check_out(options)
    env = prepare(options, programs, _untrained(options, programs))
    with run.open_folder(options, _PROGRAM) as folder:
        train(options, env, points, programs, folder)
    speed = sweep_tables.speed(trained.trainings())
    print(
        f"shard {shard} is done, {speed['env_steps_per_second']:,.0f} steps/s "
        f"on {speed['device']}, in {folder}"
    )


def _launch(options: Options, launcher: str, others: Sequence[str]) -> None:
    """Have the launcher run a command for each shard, and merge."""
    launch.check(launcher)
    if options.shard is not None:
        raise InputError(f"shard is {options.shard}: --launcher trains all of them")
    if options.shards is None or options.shards < 1:
        raise InputError(f"shards is {options.shards}: --launcher needs 1 or more")
    if options.out is None:
        raise InputError("launcher needs --out and a folder that all hosts share")
    points, programs = plan(options)
    every = [
        shards.Shard(number, options.shards) for number in range(1, options.shards + 1)
    ]
    shards.share(programs, every[-1])
    shards.refuse_whole(options.out)
    shards.refuse_recut(options.out, every[-1])
    where = ["--out", str(options.out.absolute())]
    jobs = {
        f"shard {shard}": [*others, *where, "--shard", str(shard)] for shard in every
    }
    try:
        launch.LAUNCHERS[launcher](_PROGRAM, jobs, options.devices)
    except Interrupted as interrupted:
        interrupted.add_note("go on with the same command")
        raise
    summary = merge.merge([options.out], options.out)
    print(*sweep_tables.report(points, summary), f"in {options.out}", sep="\n")


if __name__ == "__main__":
    sys.exit(main())

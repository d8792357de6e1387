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

A run that is there is never trained again. So --resume continues a sweep, and may add
points and seeds to it. With --shard 3/8 an eighth of all points and seeds is trained in
the same folder; the tables are written once no run is missing.
"""

import argparse
import dataclasses
import pathlib
import sys
from collections.abc import Callable, Sequence
from typing import Any, Literal

from gasil_jax import algorithms
from gasil_jax.errors import InputError
from gasil_jax.host import command_line, run_folder, run_options
from gasil_jax.host.interruption import Interrupted
from gasil_jax.host.run_folder import StoredRun
from gasil_jax.sweeps import assembly, launch, programs, run_results, shards, tables
from gasil_jax.sweeps.plan import Plan
from gasil_jax.sweeps.points import Point, check_saved, make_points
from gasil_jax.sweeps.runs import Run
from gasil_jax.sweeps.shards import Shard

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
        from 1 on. Other processes train the others in the same folder, or in others
        that gasil_jax.merge unites. With --resume it continues.
      launcher: train all shards on a cluster: ray. With --resume it continues them.
      shards: number of shards that the launcher makes.
    """

    grid: tuple[str, ...] = ()
    random: int | None = None
    points_file: str | None = None
    shard: str | None = None
    launcher: Literal["ray"] | None = None
    shards: int | None = None


@command_line.reports_errors
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status."""
    stored = run_options.resumed_run(arguments)
    options = run_options.parse(Options, arguments, _PROGRAM, stored)
    run_options.check(options)
    shard = None if options.shard is None else shards.parse(options.shard)
    if options.launcher is not None:
        _launch(options, arguments, stored=stored)
        return 0
    if options.shards is not None:
        raise InputError(
            f"shards is {options.shards}: it needs --launcher (one part is --shard)"
        )
    if shard is None:
        _train_whole(options, make_plan(options, stored))
    else:
        if options.out is None:
            raise InputError("shard needs --out and the folder of the whole sweep")
        stored = stored or _joined(options, options.out)
        _train_shard(options, make_plan(options, stored), shard, folder=options.out)
    return 0


def make_plan(options: Options, stored: StoredRun | None = None) -> Plan:
    """Return the plan of a sweep, checked.

    Args:
      options: the options, which `run_options.check` accepts.
      stored: the sweep that is continued, whose points come first.

    Raises:
      InputError: if a value is not allowed; the message names the value and the range.
    """
    algorithm, points = options.algorithm, _points(options, stored)
    without_effect = run_options.without_effect(algorithm)
    with command_line.input_checked():
        for point in points:
            for name in without_effect.keys() & point.keys():
                raise InputError(f"{name} can't vary: {without_effect[name]}")
            algorithms.check(algorithm.replace(**point))
    seeds = run_options.seeds_of(options)
    return Plan(options.env, options.settings, algorithm, points, seeds)


def _points(options: Options, stored: StoredRun | None) -> list[Point]:
    """Return the points of a stored sweep, then those that the options add."""
    earlier: list[Point] = []
    file = options.points_file
    if stored is not None:
        folder, description = stored
        earlier += description["points"]
        check_saved(earlier, description["algorithm"], folder / run_folder.CONFIG)
        if file is not None and not pathlib.Path(file).exists():
            if description["points_file"] == file:
                return earlier
    named = make_points(
        options.grid,
        options.random,
        file,
        seed=options.first_seed,
        algorithm=options.algorithm,
    )
    return [*earlier, *(point for point in named if point not in earlier)]


def _joined(options: Options, folder: pathlib.Path) -> StoredRun | None:
    """Return the sweep that a new shard belongs to, if another one has begun it.

    Raises:
      InputError: if the folder holds another run or sweep.
    """
    if not run_folder.has_run(folder):
        return None
    stored = StoredRun(folder, run_folder.read(folder))
    run_options.refuse_changes(options, stored)
    return stored


def _prepare(options: Options, plan: Plan, requested: Sequence[Run]) -> Any:
    """Return the environment, once it is checked that what is missing can be trained.

    The environment is None if no run is missing.
    """
    if options.out is None:
        return assembly.prepare(options, programs.group(requested))
    unfinished = plan.unfinished(options.out, requested)
    for each in unfinished:
        run_folder.refuse_without_checkpoints(each.path)
    if not unfinished:
        return None
    folders = [x.path for x in unfinished]
    return assembly.prepare(options, [x.program for x in unfinished], folders)


def _train(
    options: Options,
    plan: Plan,
    requested: Sequence[Run],
    *,
    env: Any,
    folder: pathlib.Path,
    on_restored: Callable[[], None] = lambda: None,
) -> None:
    """Train, log and save what is missing of the requested runs.

    Raises:
      Interrupted: if a signal was received.
      OSError: if the folder can no longer be written.
      ValueError: if the sweep to continue does not fit the options.
    """
    name = folder.absolute().name
    jobs = [
        assembly.Job(each, f"{name}-{each.program.name}")
        for each in plan.unfinished(folder, requested)
    ]
    if jobs:
        title = f"{options.env} {options.agent} sweep"
        assembly.train_in_folders(
            options, env, jobs, title=title, on_restored=on_restored
        )


def _write_config(options: Options, plan: Plan, folder: pathlib.Path) -> None:
    """Write config.json, which does not say how the sweep is divided."""
    whole = dataclasses.replace(options, shard=None, launcher=None, shards=None)
    run_options.write_config(whole, folder, points=plan.points)


def _train_whole(options: Options, plan: Plan) -> None:
    """Train what is missing of a sweep, and write its tables."""
    run_options.check_out(options)
    requested = list(plan.runs.values())
    env = _prepare(options, plan, requested)
    with run_options.open_folder(options, _PROGRAM) as folder:

        def write() -> None:
            _write_config(options, plan, folder)

        # A sweep keeps its config.json until a checkpoint is restored.
        if env is None or not run_folder.has_run(folder):
            write()
        _train(options, plan, requested, env=env, folder=folder, on_restored=write)
        summary = tables.write(folder, tables.read(plan, plan.trained(folder)))
    print(*tables.report(plan.points, summary), f"in {folder}", sep="\n")


def _train_shard(
    options: Options, plan: Plan, shard: Shard, *, folder: pathlib.Path
) -> None:
    """Train what is missing of a shard, and write the tables if no run is missing."""

    def part(plan: Plan) -> list[Run]:
        return shards.cut_evenly(list(plan.runs.values()), shard)

    begun = [x for x in plan.unfinished(folder, part(plan)) if x.path.exists()]
    if begun and not options.resume:
        raise InputError(
            f"shard is {shard}, whose training has begun in {begun[0].path}: continue "
            "it with --resume"
        )
    env = _prepare(options, plan, part(plan))
    with run_folder.wait_for_lock(run_folder.create(folder)):
        if stored := _joined(options, folder):
            # Another shard may have begun, or added points, since.
            plan = make_plan(options, stored)
        else:
            run_folder.refuse_used(folder)
        _write_config(options, plan, folder)
    command = f"{_PROGRAM} --shard {shard}"
    with run_options.told_how_to_continue(folder, command):
        _train(options, plan, part(plan), env=env, folder=folder)
    trained, own = plan.trained(folder), set(part(plan))
    speed = tables.speed(
        [x.training for x in trained if not own.isdisjoint(x.program.runs)]
    )
    print(f"shard {shard} is done, {run_results.speed_in_words(speed)}, in {folder}")
    if missing := plan.missing(trained):
        print(f"{len(missing)} of {len(plan.runs)} runs of the sweep are missing")
        return
    with run_folder.wait_for_lock(folder):
        summary = tables.write(folder, tables.read(plan, trained))
    print(*tables.report(plan.points, summary), sep="\n")


def _launch(
    options: Options,
    arguments: Sequence[str] | None,
    *,
    stored: StoredRun | None,
) -> None:
    """Train all shards with a launcher, one command for each."""
    if options.shard is not None:
        raise InputError(f"shard is {options.shard}: --launcher trains all of them")
    if options.shards is None or options.shards < 1:
        given = f"shards is {options.shards}: "
        raise InputError(f"{given}--launcher needs --shards, 1 or more")
    if options.out is None:
        raise InputError("launcher needs --out and a folder that all hosts share")
    plan = make_plan(options, stored)
    runs, last = list(plan.runs.values()), Shard(options.shards, options.shards)
    shards.cut_evenly(runs, last)  # Refuses more shards than runs.
    run_options.check_out(options)
    # With --resume a job that is run again continues from its checkpoint.
    resumed = ["--resume", "--out", str(options.out.absolute())]
    every = [Shard(number, last.count) for number in range(1, last.count + 1)]
    others = _without_process_options(arguments)
    jobs = {
        f"shard {shard}": [*others, *resumed, "--shard", str(shard)] for shard in every
    }
    try:
        launch.run_on_ray(_PROGRAM, jobs, options.devices)
    except Interrupted as interrupted:
        interrupted.add_note("continue with the same command and --resume")
        raise
    results = tables.read(plan, plan.trained(options.out))
    with run_folder.wait_for_lock(options.out):
        summary = tables.write(options.out, results)
    print(*tables.report(plan.points, summary), f"in {options.out}", sep="\n")


def _without_process_options(arguments: Sequence[str] | None) -> list[str]:
    """Return a command line without the options that decide who trains what."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--resume", action="store_true")
    for name in ("--shard", "--launcher", "--shards", "--out"):
        parser.add_argument(name, nargs="?")
    return parser.parse_known_args(arguments)[1]


if __name__ == "__main__":
    sys.exit(main())

"""Train a sweep: ``python -m gasil_jax.sweep --env hopper --grid alpha=0.02,0.1``.

Points that differ only in traced numbers run in one compiled program, with seeds x
points vmapped and sharded. Points that differ in a count (such as buffer size or
discriminator updates) are grouped, and each group compiles once: it is a program, with
a folder under programs/ for its metrics.csv, evaluations.csv and checkpoints. The
sweep's tables and plots are made of these.

A run that is there is never trained again. So --resume continues a sweep, and may add
points and seeds to it. With --shard 3/8 an eighth of all points and seeds is trained in
the same folder; the tables are written once no run is missing.
"""

import argparse
import dataclasses
import pathlib
import sys
from collections.abc import Mapping, Sequence
from typing import Any, Literal

from gasil_jax.errors import InputError
from gasil_jax.host import command_line, interruption, run_folder, run_options
from gasil_jax.sweeps import assembly, launch, points, run_results, shards, tables
from gasil_jax.sweeps.plan import Plan, stored_plan
from gasil_jax.sweeps.programs import NOWHERE

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
    if stored is not None:
        options = _with_new_source(options, stored)
    run_options.check(options)
    shard = shards.parse("1/1" if options.shard is None else options.shard)
    if options.launcher is not None:
        _launch(options, make_plan(options, stored), arguments)
        return 0
    if options.shards is not None:
        raise InputError(
            f"shards is {options.shards}: it needs --launcher (one part is --shard)"
        )
    if options.shard is None:
        run_options.check_out(options)
    elif options.out is None:
        raise InputError("shard needs --out and the folder of the whole sweep")
    else:
        stored = stored or run_options.begun(options, options.out)
    _train(options, make_plan(options, stored), shard)
    return 0


def _with_new_source(options: Options, stored: Mapping[str, Any]) -> Options:
    """Return the options of a continued sweep without stored sources of points.

    A grid, a number of random points or a file that the command line adds replaces the
    stored ones, whose points the sweep keeps. Only random points are still drawn from
    the stored grid if those before were.
    """
    sources = {x: getattr(options, x) for x in ("grid", "random", "points_file")}
    before = {**sources, **stored, "grid": tuple(stored.get("grid") or ())}
    new = {name for name, value in sources.items() if value != before[name]}
    if not new:
        return options
    if new == {"random"} and before["random"] is not None:
        new.add("grid")
    return dataclasses.replace(
        options,
        grid=options.grid if "grid" in new else (),
        random=options.random if "random" in new else None,
        points_file=options.points_file if "points_file" in new else None,
    )


def make_plan(options: Options, stored: Mapping[str, Any] | None = None) -> Plan:
    """Return the plan of a sweep, checked, from options that are.

    If a sweep is continued, `stored` is its config.json, whose points come first.

    Raises:
      InputError: if a value is not allowed; the message names the value and the range.
    """
    algorithm, file = options.algorithm, options.points_file
    every = [] if stored is None else [*stored_plan(stored).points]
    # A sweep that has begun has its points in config.json; their file may be gone.
    own_file = stored is not None and file == stored.get("points_file")
    if file is None or not own_file or pathlib.Path(file).exists():
        named = points.make_points(
            options.grid,
            options.random,
            file,
            seed=options.first_seed,
            algorithm=algorithm,
        )
        every += [point for point in named if point not in every]
    points.check(every, algorithm)
    seeds = run_folder.seeds_of(vars(options))
    return Plan(options.env, options.settings, algorithm, every, seeds)


def _train(options: Options, plan: Plan, shard: tuple[int, int]) -> None:
    """Train what is missing of a shard; the whole sweep is shard 1 of 1.

    The tables are written if no run of the sweep is missing at the end.
    """
    name = options.shard
    jobs = plan.unfinished(options.out or NOWHERE, plan.part(*shard))
    for job in jobs:
        if job.path.exists() and not options.resume:
            raise InputError(
                f"shard is {name}, whose training has begun in {job.path}: continue "
                "it with --resume"
            )
        run_folder.refuse_without_checkpoints(job.path)
    env = assembly.prepare(options, jobs) if jobs else None
    folder = run_options.make_folder(options)
    with run_folder.wait_for_lock(folder):
        if (options.resume or name) and (stored := run_options.begun(options, folder)):
            # Another shard may have begun, or added points, since.
            plan = make_plan(options, stored)
        else:
            run_folder.refuse_used(folder)
        # It does not say how the sweep is divided.
        whole = dataclasses.replace(options, shard=None)
        run_options.write_config(whole, folder, points=plan.points)
    command = _PROGRAM if name is None else f"{_PROGRAM} --shard {name}"
    with run_options.told_how_to_continue(folder, command):
        requested = plan.part(*shard)
        if jobs := plan.unfinished(folder, requested):
            title = f"{options.env} {options.agent} sweep"
            env = env or assembly.prepare(options, jobs)
            assembly.train(options, env, jobs, title=title)
        trained = plan.trained(folder)
        missing = plan.missing(trained)
        if name is not None:
            own = [x for x in trained if not set(requested).isdisjoint(x.runs)]
            speed = run_results.speed([x.training for x in own])
            told = run_results.speed_in_words(speed)
            print(f"shard {name} is done, {told}, in {folder}")
            if missing:
                total = len(plan.runs)
                print(f"{len(missing)} of {total} runs of the sweep are missing")
                return
        tables.finish(folder, tables.read(plan, trained))


def _launch(options: Options, plan: Plan, arguments: Sequence[str] | None) -> None:
    """Train all shards with a launcher, one command for each."""
    count = options.shards
    if options.shard is not None:
        raise InputError(f"shard is {options.shard}: --launcher trains all of them")
    if count is None or count < 1:
        raise InputError(f"shards is {count}: --launcher needs --shards, 1 or more")
    if options.out is None:
        raise InputError("launcher needs --out and a folder that all hosts share")
    plan.part(count, count)  # Refuses more shards than runs.
    run_options.check_out(options)
    # The rest of the command line is that of each shard. With --resume a job that is
    # run again continues from its checkpoint.
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--resume", action="store_true")
    for name in ("--shard", "--launcher", "--shards", "--out"):
        parser.add_argument(name, nargs="?")
    others = parser.parse_known_args(arguments)[1]
    others += ["--resume", "--out", str(options.out.absolute()), "--shard"]
    every = [f"{number}/{count}" for number in range(1, count + 1)]
    jobs = {f"shard {shard}": [*others, shard] for shard in every}
    with interruption.noted("continue with the same command and --resume"):
        launch.run_on_ray(_PROGRAM, jobs, options.devices)
    tables.finish(options.out, tables.read(plan, plan.trained(options.out)))


if __name__ == "__main__":
    sys.exit(main())

"""Command line: ``python -m gasil_jax.run --env walker2d --seeds 10``.

Parses, drives the training loop in chunks, logs and saves. No algorithm is here.
"""

import argparse
import contextlib
import dataclasses
import hashlib
import json
import os
import pathlib
import platform
import shlex
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import jax
import jaxlib
import numpy as np
import tyro

from gasil_jax import command_line, environments, presets, run_folder, trackers
from gasil_jax import train as training
from gasil_jax.command_line import InputError
from gasil_jax.config import Config, validate
from gasil_jax.environments import Settings
from gasil_jax.imitation import AGENTS
from gasil_jax.interruption import Interrupted, Interruption
from gasil_jax.progress import Progress, announced

if TYPE_CHECKING:
    from gasil_jax import batch, driver
    from gasil_jax.periodic_evaluation import EvaluationSchedule


@dataclasses.dataclass(frozen=True)
class Options:
    """Train an agent on an environment, many seeds at once.

    Attributes:
      env: environment: point_mass, hopper, walker2d, halfcheetah, swimmer, ant,
        humanoid, brax: and the name of one of Brax's, brax:inverted_pendulum, or
        MODULE:NAME of your own.
      seeds: how many seeds.
      first_seed: number of the first seed; a seed's result depends on its number
        alone.
      out: run folder, created here; default runs/ENV-AGENT-TIME.
      resume: go on with the run in the folder out from its last checkpoint, with its
        settings; total_steps alone may grow. Where no run has begun, begin one.
      checkpoint_every: environment steps of a seed between two checkpoints; default
        ten minutes.
      keep_checkpoints: how many of the newest checkpoints are kept, besides the one
        with the best evaluation or, without evaluate_every, the best returns.
      evaluate_every: environment steps of a seed between two evaluations of the
        policy's mean action in fresh environments, rounded up to whole iterations;
        default none. Scores, of the undelayed return, are in evaluations.csv.
      evaluate_episodes: of each evaluation and seed; default 10.
      log: also to these, besides metrics.csv: tensorboard, wandb.
      preset: where the hyperparameters start from: tuned, by environment and agent,
        or paper, with the paper's one environment a seed, which is several times
        slower; flags override it.
      devices: host devices that the seeds are sharded over; default the cores.
      settings: of the environment.
      config: the algorithm.
    """

    env: str
    seeds: int = 1
    first_seed: int = 0
    out: pathlib.Path | None = None
    resume: bool = False
    checkpoint_every: int | None = None
    keep_checkpoints: int = 2
    evaluate_every: int | None = None
    evaluate_episodes: int | None = None
    log: tuple[str, ...] = ()
    preset: str = "tuned"
    devices: int | None = None
    settings: Annotated[Settings, tyro.conf.arg(name="")] = dataclasses.field(
        default_factory=Settings
    )
    config: Annotated[Config, tyro.conf.arg(name="")] = dataclasses.field(
        default_factory=Config
    )


T = TypeVar("T", bound=Options)


def parse(
    kind: type[T],
    arguments: Sequence[str] | None,
    program: str,
    began: pathlib.Path | None = None,
) -> T:
    """Options from the command line, on top of the preset that they name.

    Args:
      kind: what the options are.
      arguments: default what the program was started with.
      program: the module that was started.
      began: folder of a run that is to go on; the options are on top of its own.

    Raises:
      InputError: a flag or value that is unknown, or that the run does not have.
    """
    if began is not None:
        described = run_folder.read(began)
        fields = [f for f in dataclasses.fields(kind) if f.name != "out"]
        # One that is None or False by default may be newer than the run.
        newer = {
            f.name: f.default for f in fields if f.default is None or f.default is False
        }
        names = {f.name for f in fields}
        missing = names - set(newer) - set(described)
        if missing or set(described) - names - {"out", "points"}:
            raise InputError(f"out is {began}, which another program has written")
        known = newer | described
        values: dict[str, Any] = {f.name: known[f.name] for f in fields}
        before = kind(**values)
        options = command_line.parse(kind, arguments, program, before)
        changed = run_folder.differences(vars(before), vars(options))
        if changed:
            raise InputError(
                f"resume goes on with {began}, where {'; '.join(changed)}: only "
                "total_steps may differ, and grow"
            )
        return options
    given = command_line.parse(kind, arguments, program)
    with command_line.input_checked():
        config = presets.preset(
            given.env, given.config.agent, given.preset, given.settings.reward_delay
        )
    default = kind(env=given.env, config=config)
    return command_line.parse(kind, arguments, program, default)


def begun_run(arguments: Sequence[str] | None) -> pathlib.Path | None:
    """The folder of the run that --resume goes on with, if one has begun.

    Raises:
      InputError: --resume without --out.
    """
    given = _folder_arguments(arguments)
    if given is None or not given.resume:
        return None
    if given.out is None:
        raise InputError("resume needs --out and the folder of the run to go on with")
    return given.out if run_folder.is_described(given.out) else None


def out_of(arguments: Sequence[str] | None) -> pathlib.Path | None:
    """The folder that --out names, if it is given."""
    given = _folder_arguments(arguments)
    return None if given is None else given.out


def _folder_arguments(arguments: Sequence[str] | None) -> argparse.Namespace | None:
    """--resume and --out; None if they are refused where everything is parsed."""
    parser = argparse.ArgumentParser(
        add_help=False, allow_abbrev=False, exit_on_error=False
    )
    parser.add_argument("--resume", action="store_true")
    parser.add_argument("--out", type=pathlib.Path, nargs="?")
    try:
        return parser.parse_known_args(arguments)[0]
    except argparse.ArgumentError:
        return None


def check(options: Options) -> None:
    """Refuse bad input before anything is built or compiled.

    Raises:
      InputError: the value and what is allowed.
    """
    with command_line.input_checked():
        environments.check(options.env, options.settings)
        validate(options.config, tuple(AGENTS))
        trackers.check(options.log)
    command_line.check_least(
        options,
        seeds=1,
        devices=1,
        checkpoint_every=1,
        keep_checkpoints=1,
        evaluate_every=1,
        evaluate_episodes=1,
    )
    if options.evaluate_episodes is not None and options.evaluate_every is None:
        raise InputError(
            f"evaluate_episodes is {options.evaluate_episodes}: it needs evaluate_every"
        )
    last = 2**32 - options.seeds
    if last < 0:
        raise InputError(f"seeds is {options.seeds}: it must be from 1 to {2**32}")
    if not 0 <= options.first_seed <= last:
        raise InputError(
            f"first_seed is {options.first_seed}: it must be from 0 to {last}"
        )


def evaluation_schedule(options: Options) -> "EvaluationSchedule | None":
    """When policies are evaluated on the way; None if they are not."""
    from gasil_jax.periodic_evaluation import EvaluationSchedule

    if options.evaluate_every is None:
        return None
    return EvaluationSchedule(options.evaluate_every, options.evaluate_episodes or 10)


def check_out(options: Options) -> None:
    """Refuse a folder that can't be used before anything is built for it.

    Raises:
      InputError: why.
    """
    if options.out is not None:
        run_folder.check(options.out, options.resume)


def check_resources(
    options: Options,
    env: Any,
    at_once: Sequence[tuple[Config, int]],
    saved: Sequence[tuple[Config, int]],
) -> None:
    """Refuse what does not fit the devices or the disk.

    Args:
      options: say where to, and how many checkpoints are kept.
      env: one environment.
      at_once: a configuration and how many members train with it at once, for each.
      saved: the same of all whose checkpoints are still to be written.

    Raises:
      InputError: the numbers.
    """
    from gasil_jax import resources

    schedule = evaluation_schedule(options)
    with announced(options.env, "starting the devices"):
        devices = jax.devices()
    with command_line.input_checked():
        for config, num_members in at_once:
            resources.check_memory(env, config, num_members, devices)
            if schedule is not None:
                resources.check_episodes(
                    env,
                    schedule.num_episodes,
                    num_members,
                    devices,
                    option="evaluate_episodes",
                )
        folder = options.out or pathlib.Path("runs")
        # The best one too.
        resources.check_disk(env, saved, folder, options.keep_checkpoints + 1)


@contextlib.contextmanager
def open_folder(options: Options, program: str) -> Iterator[pathlib.Path]:
    """The run's folder, made where it is missing, locked while this is entered.

    An `Interrupted` that passes is told how `program` goes on.

    Raises:
      InputError: it is used, in use, or can't be written.
    """
    stamp = time.strftime("%Y%m%d-%H%M%S")
    name = f"{options.env}-{options.config.agent}-{stamp}".replace(":", "-")
    folder = run_folder.create(options.out, name)
    with run_folder.lock(folder):
        if not (options.resume and run_folder.is_described(folder)):
            run_folder.refuse_used(folder)
        try:
            yield folder
        except Interrupted as interrupted:
            where = shlex.quote(str(folder))
            interrupted.add_note(
                f"go on with: python -m {program} --resume --out {where}"
            )
            raise


def use_devices(options: Options, num_members: int) -> None:
    """Settings that must stand before JAX starts."""
    count = min(options.devices or environments.available_cores(), num_members)
    environments.prepare(options.settings, count)
    # In a program that has used JAX already, its devices stay as they are.
    with contextlib.suppress(RuntimeError):
        jax.config.update("jax_num_cpu_devices", count)
    _keep_compiled_programs()
    # Everywhere, not only where `full_precision` says so.
    jax.config.update("jax_default_matmul_precision", "highest")


def _keep_compiled_programs() -> None:
    """Have JAX keep them in the user's cache, unless its own variable says where.

    By the version of jaxlib and the processor: a program for another one may crash.
    """
    # Before 0.12 XLA calls every program that it loads one for another processor.
    quiet = jaxlib.version.__version_info__ >= (0, 12)
    config: Any = jax.config  # Its options are attributes that its type does not have.
    if config.jax_compilation_cache_dir is not None or not quiet:
        return
    with contextlib.suppress(OSError):
        described = pathlib.Path("/proc/cpuinfo")
        lines = described.read_text().splitlines() if described.exists() else []
        features = {
            x for x in lines if x.startswith(("flags", "Features", "model name"))
        }
        processor = "".join([platform.node(), platform.machine(), *sorted(features)])
        key = hashlib.sha256(processor.encode()).hexdigest()[:16]
        home = os.environ.get("XDG_CACHE_HOME") or pathlib.Path.home() / ".cache"
        folder = pathlib.Path(home, "gasil_jax", f"jaxlib-{jaxlib.__version__}-{key}")
        folder.mkdir(parents=True, exist_ok=True)
        jax.config.update("jax_compilation_cache_dir", str(folder))


def write_config(options: Options, folder: pathlib.Path, **more: Any) -> None:
    """Write config.json: every option, the config's fields under "config"."""
    described = {f.name: getattr(options, f.name) for f in dataclasses.fields(options)}
    run_folder.describe(folder, described | {"out": str(folder)} | more)


def make_env(options: Options) -> Any:
    """The environment that the options ask for.

    Raises:
      InputError: it can't be built, or the agent can't run in it.
    """
    settings = dataclasses.asdict(options.settings)
    with command_line.input_checked():
        with announced(options.env, "building the environment"):
            env = environments.make_env(options.env, **settings)
        training.check(env, options.config)
    return env


def train(options: Options, env: Any, folder: pathlib.Path) -> dict[str, Any]:
    """Train, log and save; returns the summary.

    Raises:
      Interrupted: by a signal.
      OSError: the folder can't be written any more.
      ValueError: what is there to go on with does not fit.
    """
    from gasil_jax import batch, driver

    config = options.config
    seeds = range(options.first_seed, options.first_seed + options.seeds)
    write_config(options, folder)
    total_steps = config.num_iterations * config.batch_steps * options.seeds
    title = f"{options.env} {config.agent}"
    with Interruption() as interruption, Progress(title, total_steps) as progress:
        with progress.aside("starting the trackers"):
            described = run_folder.flat(vars(options))
            following = trackers.make(options.log, folder, described)
        runs = batch.make_batch(env, config, seeds)
        outcome = driver.drive(
            runs,
            folder,
            {"seed": seeds},
            schedule=driver.CheckpointSchedule(
                options.checkpoint_every, options.keep_checkpoints
            ),
            evaluation_schedule=evaluation_schedule(options),
            progress=progress,
            interruption=interruption,
            trackers=following,
        )
    with announced(title, "writing the curve, the policies and the summary"):
        return _write_results(options, env, folder, runs, outcome)


def _write_results(
    options: Options,
    env: Any,
    folder: pathlib.Path,
    runs: "batch.Batch",
    outcome: "driver.Outcome",
) -> dict[str, Any]:
    """What a run leaves beside metrics and checkpoints; returns the summary."""
    from gasil_jax import logging, plotting, policy

    config = options.config
    seeds = range(options.first_seed, options.first_seed + options.seeds)
    metrics = logging.read_metrics(folder / "metrics.csv", ("seed",), options.seeds)
    returns, steps = metrics["episode_return"], metrics["env_steps"][0]
    evaluations = None
    if options.evaluate_every is not None:
        path = folder / "evaluations.csv"
        evaluations = logging.read_metrics(path, ("seed",), options.seeds)
    plotting.learning_curve(
        folder / "learning_curve.png",
        steps,
        returns,
        f"{options.env}, {config.agent}",
        evaluations=evaluations,
    )
    final = final_returns(returns)
    policy.save(folder / "policy.npz", outcome.states, env, seeds, final)
    faulty = np.nansum(metrics["faulty_steps"], axis=1)
    skipped = np.nansum(metrics["skipped_updates"], axis=1)
    by_seed = lambda values, kind: {
        str(seed): kind(value)
        for seed, value in zip(seeds, values, strict=True)
        if np.isfinite(value)
    }
    trained = {
        "compile_seconds": outcome.compile_seconds,
        "train_seconds": outcome.train_seconds,
        "env_steps_per_second": outcome.new_steps / max(outcome.train_seconds, 1e-9),
        "device": runs.device_kind,
        "device_count": len(runs.devices),
        "versions": logging.versions(),
    }
    lengths = final_returns(metrics["episode_length"])
    finals = {"final_return": final, "final_length": lengths}
    if evaluations is not None:
        finals["final_evaluation"] = evaluations["mean"][:, -1]
        trained["evaluation_seconds"] = outcome.evaluation_seconds
    if not outcome.new_steps:
        trained = _on_record(folder / "summary.json", trained)
    summary = {
        "env": options.env,
        "agent": config.agent,
        "env_steps_per_seed": int(steps[-1]),
        **_by_seed_and_mean(seeds, finals),
        "faulty_steps": by_seed(faulty, int),
        "skipped_updates": by_seed(skipped, int),
        "unhealthy_seeds": [
            seed for seed, bad in zip(seeds, (faulty > 0) | (skipped > 0)) if bad
        ],
        **trained,
    }
    logging.write_json(folder / "summary.json", summary)
    return summary


def _by_seed_and_mean(
    seeds: Sequence[int], quantities: Mapping[str, np.ndarray]
) -> dict[str, Any]:
    """Each quantity, (seeds,), by seed and, as NAME_mean, its mean; NaN is None."""
    fields: dict[str, Any] = {}
    for name, values in quantities.items():
        finite = np.isfinite(values)
        fields[name] = {
            str(seed): float(value) if is_finite else None
            for seed, value, is_finite in zip(seeds, values, finite, strict=True)
        }
        mean = float(values[finite].mean()) if finite.any() else None
        fields[f"{name}_mean"] = mean
    return fields


def _on_record(path: pathlib.Path, trained: dict[str, Any]) -> dict[str, Any]:
    """The same fields from the summary that is there, if it has them."""
    try:
        before = json.loads(path.read_text())
        return {name: before[name] for name in trained}
    except (OSError, ValueError, KeyError, TypeError):
        return trained


def final_returns(returns: np.ndarray) -> np.ndarray:
    """Each seed's mean return over the last tenth of iterations, (seeds,).

    The same of another metric of episodes: their length. Where no episode ended in that
    time, of the last iteration in which one did, for in some tasks all last as long;
    NaN where none has.
    """
    last = returns[:, -max(1, returns.shape[1] // 10) :]
    count = np.isfinite(last).sum(axis=1)
    mean = np.nansum(last, axis=1) / np.maximum(count, 1)
    ended = np.isfinite(returns)
    place = returns.shape[1] - 1 - ended[:, ::-1].argmax(axis=1)
    newest = np.take_along_axis(returns, place[:, None], axis=1)[:, 0]
    newest = np.where(ended.any(axis=1), newest, np.nan)
    return np.where(count > 0, mean, newest)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    return command_line.exit_status(lambda: _main(arguments))


def _main(arguments: Sequence[str] | None) -> None:
    options = parse(Options, arguments, "gasil_jax.run", begun_run(arguments))
    check(options)
    check_out(options)
    use_devices(options, options.seeds)
    env = make_env(options)
    members = [(options.config, options.seeds)]
    check_resources(options, env, members, members)
    with open_folder(options, "gasil_jax.run") as folder:
        summary = train(options, env, folder)
    mean = summary["final_return_mean"]
    evaluated = ""
    if options.evaluate_every is not None:
        evaluated = (
            f"final evaluation {summary['final_evaluation_mean']:.1f} "
            f"({summary['evaluation_seconds']:,.0f} s of evaluations), "
        )
    print(
        f"final return {'none ended' if mean is None else format(mean, '.1f')} "
        f"(mean over {options.seeds} seeds), {evaluated}"
        f"{summary['env_steps_per_second']:,.0f} steps/s on {summary['device']}, "
        f"in {folder}"
    )
    if summary["unhealthy_seeds"]:
        print(
            f"warning: numbers that were not finite in seeds "
            f"{summary['unhealthy_seeds']}: see faulty_steps (simulation) and "
            f"skipped_updates (learning) in {folder / 'summary.json'}",
            file=sys.stderr,
        )


if __name__ == "__main__":
    sys.exit(main())

"""The options of a run: parsed on a preset, checked, and written to its folder."""

import argparse
import contextlib
import dataclasses
import pathlib
import shlex
import time
from collections.abc import Iterator, Sequence
from typing import Annotated, Any, TypeVar

import tyro

from gasil_jax import presets
from gasil_jax import train as training
from gasil_jax.config import Config, validate
from gasil_jax.errors import InputError
from gasil_jax.host import command_line, environments, run_folder, trackers
from gasil_jax.host.environments import Settings
from gasil_jax.host.interruption import Interrupted
from gasil_jax.host.periodic_evaluation import EvaluationSchedule
from gasil_jax.host.progress import announced
from gasil_jax.imitation import AGENTS


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


def seeds_of(options: Options) -> range:
    """Absolute numbers of the seeds, of each point in a sweep."""
    return range(options.first_seed, options.first_seed + options.seeds)


def evaluation_schedule(options: Options) -> EvaluationSchedule | None:
    """When policies are evaluated on the way; None if they are not."""
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

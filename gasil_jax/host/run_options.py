"""The options of a run: parse them with a preset, check them, write config.json."""

import argparse
import contextlib
import dataclasses
import pathlib
import shlex
import time
from collections.abc import Iterator, Sequence
from typing import Annotated, Any, TypeVar

import jax
import tyro

from gasil_envs import own_code
from gasil_jax import checks, presets
from gasil_jax import train as training
from gasil_jax.config import Config, own_names, validate
from gasil_jax.errors import InputError
from gasil_jax.host import (
    command_line,
    environments,
    output_file,
    run_folder,
    trackers,
)
from gasil_jax.host.environments import Settings
from gasil_jax.host.interruption import Interrupted
from gasil_jax.host.periodic_evaluation import EvaluationSchedule
from gasil_jax.host.progress import announced
from gasil_jax.host.run_folder import StoredRun
from gasil_jax.imitation import find_agent, unused


@dataclasses.dataclass(frozen=True)
class Options:
    """Train an agent on an environment, many seeds at once.

    Attributes:
      env: the environment: point_mass, hopper, walker2d, halfcheetah, swimmer, ant or
        humanoid; one of Brax's as brax:NAME, for example brax:inverted_pendulum; or
        your own as MODULE:NAME.
      seeds: number of seeds to train.
      first_seed: number of the first seed. A seed's random numbers depend only on
        its number.
      out: run folder, created if it is missing; default runs/ENV-AGENT-TIME.
      resume: continue the run in the folder `out` from its last checkpoint, with its
        settings. total_steps may grow; checkpoint_every, keep_checkpoints, devices and
        log may differ. If the folder holds no run yet, a new one begins.
      checkpoint_every: environment steps per seed between two checkpoints; by
        default a checkpoint is written every ten minutes.
      keep_checkpoints: number of newest checkpoints to keep. One more is kept: the one
        with the best evaluation or, without evaluate_every, with the best returns.
      evaluate_every: environment steps per seed between two evaluations of the
        policy's mean action in fresh environments, rounded up to whole iterations;
        by default none. The scores are undelayed returns, in evaluations.csv.
      evaluate_episodes: episodes per seed in each evaluation; default 10.
      log: trackers to log to besides metrics.csv: tensorboard, wandb.
      preset: the settings to start from: tuned, searched for each environment and
        agent; decomposed, searched for PPO on decomposed delayed rewards; scaled, one
        rule of PPO for all locomotion tasks; or paper, the paper's own protocol, with
        one environment per seed. Options override them. The defaults that this help
        shows are those without a preset.
      devices: number of CPU devices that share the seeds; default one for each core.
        All visible GPUs are used in any case.
      settings: settings of the environment.
      config: settings of the algorithm.
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
    preset: str = presets.DEFAULT
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
    resumed: StoredRun | None = None,
) -> T:
    """Return the options of a command line; its preset decides what is not given.

    Args:
      kind: the class of the options.
      arguments: the command line; default that of this process.
      program: name of the module that was started.
      resumed: the run to continue. Its options are then the defaults, and the preset is
        not used.

    Raises:
      InputError: if a flag or a value is unknown, or differs from the run's.
    """
    if resumed is not None:
        stored = _stored_options(kind, resumed)
        options = command_line.parse(kind, arguments, program, stored)
        _refuse_changes(options, stored, resumed)
        return options
    default = _defaults_of_agent(kind, arguments)
    given = command_line.parse(kind, arguments, program, default)
    with command_line.input_checked():
        config = presets.preset(
            given.env,
            given.config.agent,
            given.preset,
            reward_delay=given.settings.reward_delay,
        )
    default = kind(env=given.env, config=config)
    return command_line.parse(kind, arguments, program, default)


def _stored_options(kind: type[T], run: StoredRun) -> T:
    """Return the options that a stored run was started with.

    Raises:
      InputError: if its config.json was written by another program.
    """
    folder, description = run
    fields = [f for f in dataclasses.fields(kind) if f.name != "out"]
    # An older version may have written the run, without options that exist now.
    newer = {
        f.name: f.default for f in fields if f.default is None or f.default is False
    }
    names = {f.name for f in fields}
    missing = names - set(newer) - set(description)
    others = {"out", "points", run_folder.EXPERT_HASH}
    if ("points" in description) != ("grid" in names):
        command = "sweep" if "points" in description else "run"
        raise InputError(
            f"out is {folder}, a {command}: continue it with python -m "
            f"gasil_jax.{command}"
        )
    if missing or set(description) - names - others:
        raise InputError(f"out is {folder}, which another program has written")
    stored = {**newer, **description}
    values: dict[str, Any] = {f.name: stored[f.name] for f in fields}
    return kind(**values)


def _refuse_changes(options: Options, stored: Options, run: StoredRun) -> None:
    """Raise `InputError` if the options to continue a run with differ from its own.

    Args:
      options: the options to continue with.
      stored: the options that the run was started with.
      run: the run.
    """
    if changed := run_folder.differences(vars(stored), vars(options)):
        raise InputError(
            f"resume continues the run in {run.folder}, where {'; '.join(changed)}: "
            "only total_steps may change, and grow, and checkpoint_every, "
            "keep_checkpoints, devices and log"
        )
    with command_line.input_checked():
        expert = run_folder.expert_hash(options.config)
    now = {"expert": options.config.expert, **expert}
    run_folder.refuse_other_expert(run.description, now, run.folder)


def _defaults_of_agent(kind: type[T], arguments: Sequence[str] | None) -> T:
    """Return default options with the agent that the command line names.

    The agent's own hyperparameters are then options, too.

    Raises:
      InputError: if there is no such agent, or if one of its hyperparameters has the
        name of another option.
    """
    first = _first_arguments(arguments)
    agent = Config.agent if first is None or first.agent is None else first.agent
    with command_line.input_checked():
        own = own_names(agent)
    taken = {
        f.name for options in (kind, Settings) for f in dataclasses.fields(options)
    }
    for name in own:
        if name in taken:
            raise InputError(
                f"agent {agent!r} has a hyperparameter {name!r}, a name that is "
                "taken by an option: it must be a new one"
            )
    return kind(env=tyro.MISSING, config=Config(agent=agent))


def resumed_run(arguments: Sequence[str] | None) -> StoredRun | None:
    """Return the run that --resume continues, or None if there is none.

    Raises:
      InputError: if --resume is given without --out, if it is given without --env and
        the folder holds no run, or if the run's config.json is damaged.
    """
    given = _first_arguments(arguments)
    if given is None or not given.resume:
        return None
    if given.out is None:
        raise InputError("resume needs --out and the folder of the run to continue")
    if run_folder.has_run(given.out):
        return StoredRun(given.out, run_folder.read(given.out))
    if given.env is None:
        raise InputError(
            f"out is {given.out}, which holds no run to continue: to begin one there, "
            "give --env"
        )
    return None


def _first_arguments(arguments: Sequence[str] | None) -> argparse.Namespace | None:
    """Return the options that decide the defaults of others, or None after an error.

    The parser of all options reports the error.
    """
    parser = argparse.ArgumentParser(
        add_help=False, allow_abbrev=False, exit_on_error=False
    )
    parser.add_argument("--resume", action="store_true")
    parser.add_argument("--out", type=pathlib.Path, nargs="?")
    parser.add_argument("--agent", nargs="?")
    parser.add_argument("--env", nargs="?")
    try:
        return parser.parse_known_args(arguments)[0]
    except argparse.ArgumentError:
        return None


def check(options: Options) -> None:
    """Check the options before anything is built or compiled.

    Raises:
      InputError: if a value is not allowed; the message names the value and the range.
    """
    with command_line.input_checked():
        environments.check(options.env, options.settings)
        presets.check(options.preset)
        validate(options.config)
        trackers.check(options.log)
    command_line.check_minimum(
        options,
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
    run_folder.check_seeds(options.seeds, options.first_seed)


def unused_fields(config: Config) -> dict[str, str]:
    """Return the names of the fields that have no effect, each with the reason."""
    reason = f"agent {config.agent!r} does not use it"
    fields = dict.fromkeys(unused(config.agent), reason)
    if not config.normalize_rewards:
        fields["reward_clip"] = "normalize_rewards is off"
    names = [x for x in run_folder.flat(vars(config)) if x.startswith("decomposition_")]
    if not find_agent(config.agent).uses_reward:
        names += ["normalize_rewards", "reward_clip", "decompose_rewards"]
        reason = f"agent {config.agent!r} does not use the environment's reward"
        fields |= dict.fromkeys(names, reason)
    elif not config.decompose_rewards:
        fields |= dict.fromkeys(names, "decompose_rewards is off")
    return fields


def note_options_without_effect(options: Options, num_members: int) -> None:
    """Print a note for each option that was changed but has no effect.

    Args:
      options: options that `check` accepts.
      num_members: number of seeds, over all points of a sweep.
    """
    config, settings = options.config, options.settings
    for name in environments.without_effect(options.env, settings):
        value = getattr(settings, name)
        command_line.note(
            f"{name} is {value}, which has no effect: {options.env} has none"
        )
    default = presets.preset(
        options.env,
        config.agent,
        options.preset,
        reward_delay=settings.reward_delay,
    )
    now, before = run_folder.flat(vars(config)), run_folder.flat(vars(default))
    for name, reason in sorted(unused_fields(config).items()):
        if now[name] != before[name]:
            command_line.note(f"{name} is {now[name]}, which has no effect: {reason}")
    if options.devices is not None and options.devices > num_members:
        command_line.note(
            f"devices is {options.devices}, of which {num_members} are used, one for "
            "each seed"
        )


def note_if_untuned(options: Options) -> None:
    """Print a note if the preset has no values for the agent on the task."""
    agent, delay = options.config.agent, options.settings.reward_delay
    lacking = presets.describe_lack(options.env, agent, options.preset, delay)
    if lacking is not None:
        command_line.note(f"{lacking}: options that are not given have their defaults")


def seeds_of(options: Options) -> range:
    """Return the seeds' absolute numbers, the same for every point of a sweep."""
    return run_folder.seeds_of(vars(options))


def evaluation_schedule(options: Options) -> EvaluationSchedule | None:
    """Return the times of evaluations during training; None without evaluations."""
    if options.evaluate_every is None:
        return None
    return EvaluationSchedule(options.evaluate_every, options.evaluate_episodes or 10)


def check_out(options: Options) -> None:
    """Raise `InputError` if the run folder can't be used. Builds nothing."""
    if options.out is not None:
        run_folder.check(options.out, options.resume)


@contextlib.contextmanager
def open_folder(options: Options, program: str) -> Iterator[pathlib.Path]:
    """Create the run's folder if it is missing, and lock it inside the `with` block.

    A `WriteError` or `Interrupted` that is raised inside tells the command that
    continues the run.

    Raises:
      InputError: if another run is in the folder or uses it now, if the run to be
        continued has other settings, or if the folder can't be written.
      output_file.WriteError: if the folder can no longer be written.
    """
    stamp = time.strftime("%Y%m%d-%H%M%S")
    name = f"{options.env}-{options.config.agent}-{stamp}".replace(":", "-")
    out = options.out
    folder = run_folder.create_new(name) if out is None else run_folder.create(out)
    with run_folder.lock(folder):
        if options.resume and run_folder.has_run(folder):
            # Another process may have written to it since the options were parsed.
            run = StoredRun(folder, run_folder.read(folder))
            _refuse_changes(options, _stored_options(type(options), run), run)
        else:
            run_folder.refuse_used(folder)
        quoted = shlex.quote(str(folder))
        how = f"continue with: python -m {program} --resume --out {quoted}"
        try:
            yield folder
        except Interrupted as interrupted:
            interrupted.add_note(how)
            raise
        except output_file.WriteError as error:
            # A run that has results may be without checkpoints.
            if not run_folder.has_run(folder) or run_folder.has_results(folder):
                raise
            raise output_file.WriteError(f"{error}; {how}") from error


def write_config(options: Options, folder: pathlib.Path, **more: Any) -> None:
    """Write config.json: every option, and further fields that are given."""
    description = {
        f.name: getattr(options, f.name) for f in dataclasses.fields(options)
    }
    description |= run_folder.expert_hash(options.config)
    run_folder.write_description(folder, description | {"out": str(folder)} | more)


def make_env(options: Options) -> Any:
    """Build the environment that the options name.

    Raises:
      InputError: if it can't be built, or if the agent can't run in it.
    """
    settings = dataclasses.asdict(options.settings)
    with command_line.input_checked():
        with announced(options.env, "building the environment"):
            env = environments.make_env(options.env, **settings)
        checks.check(env, options.config)
        if ":" in options.config.agent:
            with announced(options.env, "tracing the agent"):
                _trace(env, options.config)
    return env


def _trace(env: Any, config: Config) -> None:
    """Trace the first state and one iteration of a custom agent, without running them.

    Raises:
      InputError: if that raises an error.
    """

    def begin() -> Any:
        state = training.init(env, config, jax.random.key(0))
        return training.iterate(env, config, state)

    package = pathlib.Path(training.__file__).parent
    what = f"agent {config.agent!r} can't be traced"
    with command_line.input_checked(), own_code.refused(what, package):
        jax.eval_shape(begin)

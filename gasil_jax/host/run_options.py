"""The options of a run: parse them with a preset, check them, write config.json."""

import argparse
import contextlib
import dataclasses
import pathlib
import shlex
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any, TypeVar

import jax
import tyro

from gasil_envs import user_code
from gasil_jax import algorithms, checks, presets
from gasil_jax import train as training
from gasil_jax.agents import PPOGASIL, Agent
from gasil_jax.algorithms import Algorithm
from gasil_jax.config import Config, names, validate
from gasil_jax.errors import InputError
from gasil_jax.host import (
    command_line,
    descriptions,
    devices,
    environments,
    interruption,
    output_file,
    run_folder,
    trackers,
)
from gasil_jax.host.environments import Settings
from gasil_jax.host.periodic_evaluation import EvaluationSchedule
from gasil_jax.host.progress import announced
from gasil_jax.rewards import REWARD_MODELS, Decompose, Normalize, RewardModel

# Each is a group of the help; its fields are options without a prefix.
_Environment = Annotated[Settings, tyro.conf.arg(name="environment")]
_Training = Annotated[Config, tyro.conf.arg(name="training")]
_Agent = Annotated[Agent, tyro.conf.arg(name="agent")]
_Decompose = Annotated[Decompose, tyro.conf.arg(name="decompose-rewards")]
_Normalize = Annotated[Normalize, tyro.conf.arg(name="normalize-rewards")]

#: Episodes per seed in each evaluation during training, if no number is given.
EVALUATE_EPISODES = 10


@dataclasses.dataclass(frozen=True)
class Options:
    """Train an agent on an environment, many seeds at once.

    Attributes:
      env: the environment: point_mass, hopper, walker2d, halfcheetah, swimmer, ant,
        humanoid or another of Gymnasium's MuJoCo tasks; one of another package as
        brax:NAME, gymnax:NAME, navix:NAME or playground:NAME, for example
        gymnax:CartPole-v1; a sparse task as sparse:NAME; or your own as MODULE:NAME.
      agent: the agent: ppo, ppo+bc, ppo+sil, gasil, ppo+gasil,
        ppo+gasil-adaptive, ppo+novelty, ppo+bc+novelty, gail, or your own as
        MODULE:CLASS. Each has its own settings: this help shows those of the one that
        is named beside it.
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
        by default none. The untrained policy is evaluated too. The scores are undelayed
        returns, in evaluations.csv.
      evaluate_episodes: episodes per seed in each evaluation; default 10.
      log: trackers to log to besides metrics.csv: tensorboard, wandb.
      preset: the settings to start from: tuned, searched for each environment and
        agent; scaled, one rule of PPO for all locomotion tasks; gymnax, one setting for
        discrete actions; or paper, the paper's own protocol, with one environment per
        seed. Options override them. The defaults that this help shows are the preset's
        if --env is named beside --help.
      devices: number of CPU devices that share the seeds; default one for each core.
        All visible GPUs are used in any case.
      decompose_rewards: whether PPO learns from a reward for each step, which a network
        learns from the delayed sums, instead of from the delayed reward itself.
      normalize_rewards: whether to divide PPO's rewards by the standard deviation of
        their running discounted sum (as in OpenAI baselines' ppo2). Alpha is then in
        that unit, not in the environment's. It has no effect on the agents gasil and
        gail, which do not use the environment's reward.
      settings: settings of the environment.
      config: settings of the training loop and of PPO.
      own: settings of the agent.
      decompose: settings of the decomposition of rewards.
      normalize: settings of the normalization of rewards.
    """

    env: str
    agent: str = PPOGASIL.name
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
    decompose_rewards: bool = False
    normalize_rewards: bool = False
    settings: _Environment = dataclasses.field(default_factory=Settings)
    config: _Training = dataclasses.field(default_factory=Config)
    own: _Agent = dataclasses.field(default_factory=PPOGASIL)
    decompose: _Decompose = dataclasses.field(default_factory=Decompose)
    normalize: _Normalize = dataclasses.field(default_factory=Normalize)

    @property
    def algorithm(self) -> Algorithm:
        """The algorithm that the options describe."""
        rewards: list[RewardModel] = [self.decompose] if self.decompose_rewards else []
        rewards += [self.normalize] if self.normalize_rewards else []
        return Algorithm(self.own, tuple(rewards), self.config)


def algorithm_options(algorithm: Algorithm) -> dict[str, Any]:
    """Return the fields of `Options` that describe an algorithm."""
    models = {type(model): model for model in algorithm.rewards}
    return {
        "agent": algorithm.agent.name,
        "config": algorithm.config,
        "own": algorithm.agent,
        Decompose.switch: Decompose in models,
        "decompose": models.get(Decompose, Decompose()),
        Normalize.switch: Normalize in models,
        "normalize": models.get(Normalize, Normalize()),
    }


def description(options: Options) -> dict[str, Any]:
    """Return options as config.json has them: the algorithm, and all other fields."""
    algorithm = options.algorithm
    of_algorithm = algorithm_options(algorithm)
    fields = [f.name for f in dataclasses.fields(options) if f.name not in of_algorithm]
    with command_line.input_checked():
        return {
            **{name: getattr(options, name) for name in fields},
            "algorithm": algorithm,
            **run_folder.expert_hash(algorithm),
        }


T = TypeVar("T", bound=Options)


def parse(
    kind: type[T],
    arguments: Sequence[str] | None,
    program: str,
    resumed: Mapping[str, Any] | None = None,
) -> T:
    """Return the options of a command line; its preset decides what is not given.

    Args:
      kind: the class of the options.
      arguments: the command line; default that of this process.
      program: name of the module that was started.
      resumed: the config.json of the run to continue, from `run_folder.read`. Its
        options are then the defaults, and the preset is not used.

    Raises:
      InputError: if a flag or a value is unknown, or differs from the run's.
    """
    if resumed is not None:
        default = _stored_options(kind, resumed)
    else:
        default = _preset_options(kind, arguments)
    options = command_line.parse(
        kind, arguments, program, default, why_not=default.algorithm.why_not
    )
    if resumed is not None:
        refuse_changes(options, resumed)
    elif options.agent != default.agent or options.preset != default.preset:
        # A value of a list, such as --grid, looks like a flag to the first reading.
        raise InputError("agent and preset must be given as --agent and --preset")
    return options


def _stored_options(kind: type[T], stored: Mapping[str, Any]) -> T:
    """Return the options that a stored run was started with.

    Raises:
      InputError: if its config.json was written by another program.
    """
    folder = stored["out"]
    of_algorithm = algorithm_options(stored["algorithm"])
    fields = [
        f
        for f in dataclasses.fields(kind)
        if f.name != "out" and f.name not in of_algorithm
    ]
    # An older version may have written the run, without options that exist now.
    newer = {
        f.name: f.default for f in fields if f.default is None or f.default is False
    }
    names = {f.name for f in fields}
    missing = names - set(newer) - set(stored)
    others = {"out", "points", "algorithm", run_folder.EXPERT_HASH}
    if ("points" in stored) != ("grid" in names):
        command = "sweep" if "points" in stored else "run"
        raise InputError(
            f"out is {folder}, a {command}: continue it with python -m "
            f"gasil_jax.{command}"
        )
    if missing or set(stored) - names - others:
        raise InputError(f"out is {folder}, which another program has written")
    values = {**newer, **stored}
    return kind(**{name: values[name] for name in names}, **of_algorithm)


def refuse_changes(options: Options, stored: Mapping[str, Any]) -> None:
    """Raise `InputError` if a run is continued with other options than it has.

    Args:
      options: the options of the continuation.
      stored: the config.json of the run or sweep, from `run_folder.read`.
    """
    before = run_folder.flat(vars(_stored_options(type(options), stored)))
    grows = ("total_steps", *(("seeds",) if "points" in stored else ()))
    if changed := run_folder.differences(before, run_folder.flat(vars(options)), grows):
        raise InputError(
            f"resume continues {stored['out']}, where {'; '.join(changed)}: only "
            f"{' and '.join(grows)} may grow, and only checkpoint_every, "
            "keep_checkpoints, devices and log may differ"
        )
    now = run_folder.flat(description(options))
    run_folder.refuse_other_expert(stored, now, stored["out"])


def _preset_options(kind: type[T], arguments: Sequence[str] | None) -> T:
    """Return the options of the preset that a command line names.

    Raises:
      InputError: if there is no such agent, environment or preset, or if one of the
        agent's settings has the name of another option.
    """
    given = _first_arguments(arguments)
    with command_line.input_checked():
        agent = descriptions.find_agent(given.agent)
        taken = {
            f.name for options in (kind, Settings) for f in dataclasses.fields(options)
        }
        for name in names(agent):
            if name in taken:
                raise InputError(
                    f"agent {given.agent!r} has a setting {name!r}, a name that is "
                    "taken by an option: it must be a new one"
                )
        algorithm = Algorithm(agent())
        if given.env is not None:
            algorithm = presets.preset(
                given.env,
                agent,
                given.preset,
                reward_delay=given.reward_delay,
                action_size=_action_size(given.env, given.preset),
            )
    env = tyro.MISSING if given.env is None else given.env
    fields = {**algorithm_options(algorithm), "agent": given.agent}
    return kind(env=env, preset=given.preset, **fields)


def _action_size(env: str, preset: str) -> int | None:
    """Return the dimension of an action, if a preset needs it for an environment."""
    if preset != "scaled" or env in presets.ACTION_SIZES:
        return None
    # The environment's arrays start JAX.
    devices.use_devices(Settings(), None, environments.available_cores())
    with announced(env, "building the environment"):
        built = environments.make_env(env)
    if environments.is_discrete(built):
        raise InputError(
            "preset is 'scaled', a rule for the dimension of an action: those of "
            f"{env} are discrete, it must be another preset, such as 'gymnax'"
        )
    return int(built.action_size)


def resumed_run(arguments: Sequence[str] | None) -> dict[str, Any] | None:
    """Return the config.json of the run that --resume continues, None without one.

    Raises:
      InputError: if --resume is given without --out, if it is given without --env and
        the folder holds no run that options describe, or if config.json is damaged.
    """
    if "--resume" not in _words(arguments):
        return None
    given = _first_arguments(arguments)
    if given.out is None:
        raise InputError("resume needs --out and the folder of the run to continue")
    if run_folder.has_run(given.out) or (given.out / run_folder.FIT).is_file():
        return run_folder.read(given.out)
    if given.env is None:
        raise InputError(
            f"out is {given.out}, which holds no run to continue: to begin one there, "
            "give --env"
        )
    return None


def _words(arguments: Sequence[str] | None) -> Sequence[str]:
    """Return the words of a command line, by default of this process."""
    return sys.argv[1:] if arguments is None else arguments


def _first_arguments(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Return the options that decide which others there are, and their defaults.

    The parser of all options reports what is wrong with their values.
    """

    def delay(text: str) -> int:
        with contextlib.suppress(ValueError):
            return max(1, command_line.whole_number(text))
        return 1

    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--out", type=pathlib.Path, nargs="?")
    parser.add_argument("--agent", nargs="?", default=Options.agent)
    parser.add_argument("--env", nargs="?")
    parser.add_argument("--preset", nargs="?", default=presets.DEFAULT)
    # As in the parser of all options, a name may have underscores.
    names = "--reward-delay", "--reward_delay"
    parser.add_argument(*names, nargs="?", type=delay, default=1)
    given = parser.parse_known_args(_words(arguments))[0]
    given.agent = given.agent or Options.agent
    given.preset = given.preset or presets.DEFAULT
    given.reward_delay = given.reward_delay or 1
    return given


def check(options: Options) -> None:
    """Check the options before anything is built or compiled.

    Raises:
      InputError: if a value is not allowed; the message names the value and the range.
    """
    with command_line.input_checked():
        environments.check(options.env, options.settings)
        presets.check(options.preset)
        algorithms.check(options.algorithm)
        # The algorithm has no model that is off.
        for model in (options.decompose, options.normalize):
            validate(model, options.config.total_steps)
        trackers.check(options.log)
    command_line.check_minimum(
        options,
        devices=1,
        checkpoint_every=1,
        keep_checkpoints=1,
        evaluate_every=1,
        evaluate_episodes=1,
    )
    # The environment, which is not built yet, has its own limit too.
    command_line.check_minimum(options.settings, max_episode_steps=1)
    if options.evaluate_episodes is not None and options.evaluate_every is None:
        raise InputError(
            f"evaluate_episodes is {options.evaluate_episodes}: it needs evaluate_every"
        )
    run_folder.check_seeds(options.seeds, options.first_seed)


def without_effect(algorithm: Algorithm) -> dict[str, str]:
    """Return the names of settings that have no effect, each with the reason."""
    if algorithm.agent.uses_reward:
        return {}
    reason = f"agent {algorithm.agent.name!r} does not use the environment's reward"
    every = [x for model in REWARD_MODELS for x in (model.switch, *names(model))]
    return dict.fromkeys(every, reason)


def note_options_without_effect(
    options: Options, num_members: int, *, discrete: bool = False
) -> None:
    """Print a note for each option that was changed but has no effect.

    Args:
      options: options that `check` accepts.
      num_members: number of seeds, over all points of a sweep.
      discrete: whether the environment's actions are discrete.
    """
    algorithm, settings = options.algorithm, options.settings
    for name in environments.without_effect(options.env, settings):
        value = getattr(settings, name)
        command_line.note(
            f"{name} is {value}, which has no effect: {options.env} has none"
        )
    default = presets.preset(
        options.env,
        type(options.own),
        options.preset,
        reward_delay=settings.reward_delay,
        action_size=1,  # It decides no setting that is compared here.
    )
    now = run_folder.flat(vars(options))
    before = run_folder.flat(algorithm_options(default))
    reasons = {
        name: f"{model.switch} is off"
        for model in REWARD_MODELS
        if not now[model.switch]
        for name in names(model)
    }
    reasons |= without_effect(algorithm)
    if discrete:
        reasons["initial_std"] = f"the actions of {options.env} are discrete"
    for name, reason in sorted(reasons.items()):
        if now[name] != before[name]:
            command_line.note(f"{name} is {now[name]}, which has no effect: {reason}")
    if options.devices is not None and options.devices > num_members:
        command_line.note(
            f"devices is {options.devices}, of which {num_members} are used, one for "
            "each seed"
        )


def note_if_untuned(options: Options) -> None:
    """Print a note if the preset has no values for the agent on the task."""
    agent, delay = options.own.name, options.settings.reward_delay
    # Other presets refuse an agent or a task that they have nothing for.
    lacking = presets.describe_lack(
        options.env, agent, presets.DEFAULT, reward_delay=delay
    )
    if options.preset == presets.DEFAULT and lacking is not None:
        command_line.note(f"{lacking}: options that are not given have their defaults")


def evaluation_schedule(options: Options) -> EvaluationSchedule | None:
    """Return the times of evaluations during training; None without evaluations."""
    if options.evaluate_every is None:
        return None
    episodes = options.evaluate_episodes or EVALUATE_EPISODES
    return EvaluationSchedule(options.evaluate_every, episodes)


def check_out(options: Options) -> None:
    """Raise `InputError` if the run folder can't be used. Builds nothing."""
    if options.out is not None:
        run_folder.check(options.out, options.resume)


def make_folder(options: Options) -> pathlib.Path:
    """Create the run's folder if it is missing, and return it.

    Raises:
      InputError: if it can't be written.
    """
    if options.out is not None:
        return run_folder.create(options.out)
    stamp = time.strftime("%Y%m%d-%H%M%S")
    name = f"{options.env}-{options.agent}-{stamp}".replace(":", "-")
    return run_folder.create_new(name)


def begun(options: Options, folder: pathlib.Path) -> dict[str, Any] | None:
    """Return the config.json of the run or sweep in a folder, None if none has begun.

    Raises:
      InputError: if it is not that of the options.
    """
    if not run_folder.has_run(folder):
        return None
    stored = run_folder.read(folder)
    refuse_changes(options, stored)
    return stored


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
    folder = make_folder(options)
    with run_folder.lock(folder):
        # Another process may have written to it since the options were parsed.
        if not (options.resume and begun(options, folder)):
            run_folder.refuse_used(folder)
        with told_how_to_continue(folder, program):
            yield folder


@contextlib.contextmanager
def told_how_to_continue(folder: pathlib.Path, program: str) -> Iterator[None]:
    """Add to a `WriteError` or `Interrupted` the command that continues a run.

    Args:
      folder: the run's folder.
      program: name of the module that was started, and options if it needs any.
    """
    quoted = shlex.quote(str(folder))
    how = f"continue with: python -m {program} --resume --out {quoted}"
    try:
        with interruption.noted(how):
            yield
    except output_file.WriteError as error:
        # A run that has results may be without checkpoints.
        if not run_folder.has_run(folder) or run_folder.has_results(folder):
            raise
        raise output_file.WriteError(f"{error}; {how}") from error


def write_config(options: Options, folder: pathlib.Path, **more: Any) -> None:
    """Write config.json: every option, and further fields that are given."""
    run_folder.write_description(folder, description(options) | more)


def make_env(options: Options) -> Any:
    """Build the environment that the options name.

    Raises:
      InputError: if it can't be built, or if the agent can't run in it.
    """
    settings = dataclasses.asdict(options.settings)
    with command_line.input_checked():
        with announced(options.env, "building the environment"):
            env = environments.make_env(options.env, **settings)
        checks.check(env, options.algorithm)
        if ":" in options.agent:
            with announced(options.env, "tracing the agent"):
                _trace(env, options.algorithm)
    return env


def _trace(env: Any, algorithm: Algorithm) -> None:
    """Trace the first state and one iteration of a custom agent, without running them.

    Raises:
      InputError: if that raises an error.
    """

    def begin() -> Any:
        state = training.init(env, algorithm, jax.random.key(0))
        return training.train_step(env, algorithm, state)

    package = pathlib.Path(training.__file__).parent
    what = f"agent {algorithm.agent.name!r} can't be traced"
    with command_line.input_checked(), user_code.refused(what, package):
        jax.eval_shape(begin)

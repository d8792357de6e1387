"""The options of `run` and `sweep`: read them with a preset, check them."""

import argparse
import dataclasses
import importlib
import pathlib
import time
from collections.abc import Mapping, Sequence
from typing import Any, Literal

from gasil_jax import algorithms, presets
from gasil_jax.agents import PPOGASIL
from gasil_jax.algorithms import Algorithm
from gasil_jax.cli import parsing
from gasil_jax.cli.parsing import Parser, check_minimum, input_checked
from gasil_jax.cli.reporting import HelpShown
from gasil_jax.config import Config, names, validate
from gasil_jax.errors import InputError
from gasil_jax.host import (
    descriptions,
    devices,
    environments,
    folders,
    points,
    start,
    sweep,
)
from gasil_jax.host.environments import Settings
from gasil_jax.host.output_file import note
from gasil_jax.host.sweep import Recording, Sweep
from gasil_jax.rewards import REWARD_MODELS

#: The options that `--help` shows; `--help-all` shows all.
COMMON = frozenset(
    "env agent preset seeds out resume evaluate_every video_every log grid random "
    "reward_delay obs_noise action_noise physics total_steps num_envs batch_steps "
    "minibatch_size num_epochs hidden_sizes learning_rate gamma gae_lambda "
    "entropy_coefficient initial_std decompose_rewards alpha discriminator_updates "
    "discriminator_learning_rate buffer_steps behavior_cloning_coefficient "
    "sil_coefficient novelty_coefficient imitation_weight expert".split()
)


@dataclasses.dataclass(frozen=True)
class Options:
    """Train an agent on an environment, many seeds at once.

    In a checkout, python -m experiments trains the figures of the documentation.

    Attributes:
      env: the environment: point_mass, hopper, walker2d, halfcheetah, swimmer, ant,
        humanoid or another of Gymnasium's MuJoCo tasks; one of another package as
        brax:NAME, gymnax:NAME, navix:NAME or playground:NAME, for example
        gymnax:CartPole-v1; a sparse task as sparse:NAME; or your own as MODULE:NAME.
        --list-envs prints all names.
      agent: the agent: ppo, ppo+bc, ppo+sil, gasil, ppo+gasil, ppo+gasil-adaptive,
        ppo+novelty, ppo+bc+novelty, ppo+gasil+novelty, gail, or your own as
        MODULE:CLASS. Each has its own settings: this help shows those of the one that
        is named beside it. Several, separated by commas, are trained side by side, each
        from its own preset: the points of a sweep.
      preset: the settings to start from: tuned, searched for each environment and
        agent; scaled, one rule for all tasks; gymnax, one setting for
        discrete actions; or paper, the paper's own protocol, with one environment per
        seed. Options override them. The defaults that this help shows are the preset's
        if --env is named beside --help.
      seeds: number of seeds to train.
      first_seed: number of the first seed. A seed's random numbers depend only on
        its number.
      out: folder, created if it is missing; default runs/ENV-AGENT-TIME.
      resume: train what is missing in the folder `out`, with its settings. total_steps
        and seeds may grow; checkpoint_every, keep_checkpoints, video_every, devices and
        log may differ. If the folder holds nothing yet, training begins.
      config: the config.json of another run: what it holds is used for all options that
        are not given.
      init_from: folder of a run, whose best seed's policy, values and normalizer of
        observations training starts from, instead of new ones.
      devices: number of CPU devices that share the seeds; default one for each core.
        All visible GPUs are used in any case.
      decompose_rewards: whether PPO learns from a reward for each step, which a network
        learns from the delayed sums, instead of from the delayed reward itself.
      rewards: your own models of rewards, as MODULE:CLASS; each gets the rewards that
        the one before it has made, and the package's come after them.
      normalize_rewards: whether to divide PPO's rewards by the standard deviation of
        their running discounted sum (as in OpenAI baselines' ppo2). Alpha is then in
        that unit, not in the environment's. It has no effect on the agents gasil and
        gail, which do not use the environment's reward.
    """

    env: str
    agent: str = PPOGASIL.name
    preset: str = presets.DEFAULT
    seeds: int = 1
    first_seed: int = 0
    out: pathlib.Path | None = None
    resume: bool = False
    config: pathlib.Path | None = None
    init_from: pathlib.Path | None = None
    devices: int | None = None
    rewards: tuple[str, ...] = ()
    decompose_rewards: bool = False
    normalize_rewards: bool = False


@dataclasses.dataclass(frozen=True)
class SweepOptions(Options):
    """Train every point of a grid, or random points, with many seeds each.

    Attributes:
      grid: NAME=VALUE,VALUE,... for each hyperparameter or count that varies.
      random: number of points to draw from the grid or, without a grid, from the
        ranges of the paper's appendix. The draw's seed is first_seed.
      points_file: a JSON file with a list of points, {"NAME": VALUE, ...} each,
        instead of grid and random.
      shard: train only this part of all points and seeds, NUMBER/COUNT with numbers
        from 1 on. Other processes train the others in the same folder. With --resume it
        continues.
      launcher: train all shards on a cluster: ray. With --resume it continues them.
      shards: number of shards that the launcher makes.
    """

    grid: tuple[str, ...] = ()
    random: int | None = None
    points_file: pathlib.Path | None = None
    shard: str | None = None
    launcher: Literal["ray"] | None = None
    shards: int | None = None


def read(
    kind: type[Options], arguments: Sequence[str] | None, program: str
) -> tuple[Options, Sweep]:
    """Return the options of a command line, and what they train.

    With --resume, options that are not given are those of the sweep in the folder,
    whose points come first; with --config those of a file; otherwise the preset's.
    """
    words = parsing.words(arguments)
    if "--list-envs" in words:
        print(*environments.names(), sep="\n")
        raise HelpShown(0)
    first, stored = _first_options(kind, words), None
    if first.resume:
        if first.out is None:
            raise InputError("resume needs --out and the folder to continue")
        if folders.has_config(first.out):
            stored = sweep.read(first.out)
        elif first.env is None and first.config is None:
            raise InputError(
                f"out is {first.out}, which holds no run to continue: to begin one "
                "there, give --env"
            )
    is_begun, origin = stored is not None, f"out is {first.out}"
    if first.config is not None and stored is None:
        origin = f"config is {first.config}"
        if not first.config.is_file():
            raise InputError(f"{origin}: it must be the config.json of a run")
        stored = sweep.read(first.config)
    defaults: dict[str, Any] = {"env": dataclasses.MISSING, "preset": first.preset}
    if stored is None:
        agents = (first.agent or Options.agent).split(",")
        for name in agents:
            if agents.count(name) > 1:
                raise InputError(f"agent has {name!r} twice: name it once")
        with input_checked():
            every = [_default(name, first) for name in agents]
    else:
        _refuse_others(first, stored, origin)
        every, seeds = [*stored.algorithms], stored.seeds
        defaults = {"env": stored.env, "preset": stored.preset, "seeds": len(seeds)}
        defaults["first_seed"] = seeds[0]
    defaults["agent"] = ",".join(x.agent.name for x in every)
    defaults["preset"] = defaults["preset"] or presets.DEFAULT
    defaults["rewards"] = tuple(x.name for x in every[0].own_models)
    defaults |= _switches(every[0])
    parser = Parser(program, "--env NAME [options]", kind, COMMON)
    parser.add_fields(kind, "run", kind(**defaults))
    parser.add_fields(Recording, "recording", stored and stored.recording)
    parser.add_fields(Settings, "environment", stored and stored.settings)
    _add_algorithms(parser, every)
    values = parser.read(words, every[0].why_not)
    options = kind(**parser.fields(values, "run"))
    given = {name: getattr(values, name) for name in parser.given(words)}
    with input_checked():
        algorithm, *others = (_changed(each, given) for each in every)
    requested = Sweep(
        options.env,
        algorithm,
        _seeds(options, stored),
        others=tuple(others),
        settings=Settings(**parser.fields(values, "environment")),
        recording=Recording(**parser.fields(values, "recording")),
        preset=options.preset if stored is None else stored.preset,
        start=None if stored is None else stored.start,
    )
    if options.init_from is not None:
        requested = dataclasses.replace(requested, start=start.find(options.init_from))
    _check(options, requested)
    if "evaluate_episodes" in given and requested.recording.evaluate_every is None:
        raise InputError(
            f"evaluate_episodes is {values.evaluate_episodes}: it needs evaluate_every"
        )
    requested = _with_points(options, requested, stored)
    if is_begun and options.out is not None:
        requested = requested.continued_from(options.out)
    _note_without_effect(given, requested)
    return options, requested


def _changed(algorithm: Algorithm, given: Mapping[str, Any]) -> Algorithm:
    """Return an algorithm with those of the given values that it has."""
    # A model of rewards that is off has options too.
    switches = {x: given[x] for x in _switches(algorithm) if x in given}
    algorithm = algorithm.replace(**switches)
    own = {x: value for x, value in given.items() if x in algorithm.settings}
    return algorithm.replace(**own)


def _add_algorithms(parser: Parser, every: Sequence[Algorithm]) -> None:
    """Add an option for each setting; those of several agents have one."""
    algorithm, *others = every
    agent, own = algorithm.agent, {type(model): model for model in algorithm.rewards}
    parser.add_fields(Config, "training", algorithm.config)
    parser.add_fields(type(agent), "agent", agent, all_shown=":" in agent.name)
    for model in REWARD_MODELS:
        parser.add_fields(model, model.switch, own.get(model, model()))
    for each in algorithm.own_models:
        parser.add_fields(type(each), each.name, each, all_shown=True)
    shared = {*names(agent)}
    for other in (x.agent for x in others):
        parser.add_fields(type(other), other.name, other, shared=shared)
        shared |= {*names(other)}


def _first_options(kind: type[Options], words: Sequence[str]) -> argparse.Namespace:
    """Return the options that decide which others there are, and their defaults."""
    parser = Parser("gasil_jax", "", kind)
    # None tells that they are not given.
    deciding = ("env", "agent", "preset", "rewards")
    parser.add_fields(kind, "run", kind(**dict.fromkeys(deciding)))  # type: ignore[arg-type]
    parser.add_fields(Settings, "environment")
    return parser.parse_known_args(words)[0]


def _refuse_others(first: argparse.Namespace, stored: Sweep, origin: str) -> None:
    """Raise `InputError` if a command line names another agent than a folder has."""
    own_models = tuple(x.name for x in stored.algorithm.own_models)
    for name, given, own in (
        ("agent", first.agent, stored.agent),
        ("preset", first.preset, stored.preset),
        ("rewards", first.rewards, own_models),
    ):
        if given not in (None, own):
            raise InputError(
                f"{origin}, where {name} was {own}, is {given}: leave it out or name "
                "another one"
            )


def _default(name: str, first: argparse.Namespace) -> Algorithm:
    """Return the algorithm from which an agent starts."""
    agent, preset = descriptions.find_agent(name), first.preset or presets.DEFAULT
    algorithm = Algorithm(agent())
    if first.env is not None:
        algorithm = presets.preset(
            first.env,
            agent,
            preset,
            reward_delay=first.reward_delay,
            action_size=_action_size(first.env, agent.name, preset),
        )
    models = tuple(descriptions.find_model(each)() for each in first.rewards or ())
    algorithm = dataclasses.replace(algorithm, rewards=(*models, *algorithm.rewards))
    algorithms.check(algorithm)
    return algorithm


def _switches(algorithm: Algorithm) -> dict[str, Any]:
    """Return which models of rewards an algorithm has, by their switches."""
    return {x.switch: algorithm.settings[x.switch] for x in REWARD_MODELS}


def _action_size(env: str, agent: str, preset: str) -> int | None:
    """Return the dimension of an action, if a preset needs it for an environment."""
    if not presets.is_ruled(agent, preset) or env in presets.ACTION_SIZES:
        return None
    # The environment's arrays start JAX.
    devices.use_devices(Settings(), None, environments.available_cores())
    built = environments.make_env(env)
    if environments.is_discrete(built):
        return presets.DISCRETE_SIZE
    return int(built.action_size)


def _seeds(options: Options, stored: Sweep | None) -> Sequence[int]:
    if not 1 <= options.seeds <= sweep.MOST_SEEDS:
        raise InputError(
            f"seeds is {options.seeds}: it must be from 1 to {sweep.MOST_SEEDS:,}"
        )
    if not 0 <= options.first_seed <= (most := 2**32 - options.seeds):
        raise InputError(
            f"first_seed is {options.first_seed}: it must be from 0 to {most}"
        )
    if stored is not None:
        if (options.seeds, options.first_seed) == (len(stored.seeds), stored.seeds[0]):
            return stored.seeds
    return range(options.first_seed, options.first_seed + options.seeds)


def _with_points(options: Options, requested: Sweep, stored: Sweep | None) -> Sweep:
    """Return the sweep with the points that the options name."""
    named: Sequence[points.Point] | None = None
    if isinstance(options, SweepOptions):
        if options.points_file is not None:
            if options.grid or options.random is not None:
                raise InputError("points_file can't be combined with grid or random")
            named = points.read(options.points_file)
        elif options.grid or options.random is not None:
            named = points.make_points(
                options.grid,
                options.random,
                seed=options.first_seed,
                algorithms=requested.algorithms,
            )
        elif stored is None and not requested.others:
            raise InputError(
                "grid is empty: it must be NAME=VALUE,..., or use --random, "
                "--points-file or several agents"
            )
    if named is None and stored is not None:
        return dataclasses.replace(requested, points=stored.points)
    named = named or [{}]
    if requested.others:
        agents = [each.agent.name for each in requested.algorithms]
        named = [{"agent": agent, **point} for agent in agents for point in named]
    points.check(named, *requested.algorithms)
    every = points.completed(named, *requested.algorithms)
    return dataclasses.replace(requested, points=every)


def _check(options: Options, requested: Sweep) -> None:
    """Raise `InputError` if a value is not allowed. Nothing is built or compiled."""
    if requested.recording.video_every is not None:
        # What follows imports MuJoCo; this says before with what it is to draw.
        importlib.import_module("gasil_jax.host.video")
    with input_checked():
        environments.check(options.env, requested.settings)
        presets.check(options.preset)
        for each in requested.algorithms:
            algorithms.check(each)
        validate(requested.recording)
    check_minimum(options, devices=1)
    check_minimum(requested.settings, max_episode_steps=1)
    if options.out is not None:
        folders.check_writable(options.out)
        if not options.resume and getattr(options, "shard", None) is None:
            folders.refuse_used(options.out)


def _note_without_effect(given: Mapping[str, Any], requested: Sweep) -> None:
    """Print a note for each option that is given but has no effect."""
    algorithm, env = requested.algorithm, requested.env
    unused = environments.without_effect(env, requested.settings)
    reasons = dict.fromkeys(unused, f"{env} has none")
    for model in REWARD_MODELS:
        if not algorithm.settings[model.switch]:
            reasons |= dict.fromkeys(names(model), f"{model.switch} is off")
    reasons |= points.without_effect(algorithm)
    for name, value in given.items():
        if name in reasons and value is not False:
            note(f"{name} is {value}, which has no effect: {reasons[name]}")


def note_if_untuned(options: Options, requested: Sweep, env: Any) -> None:
    """Print a note if the default preset has nothing for the agent and the task."""
    default = options.preset == presets.DEFAULT
    default &= not options.resume and options.config is None
    for each in requested.algorithms if default else ():
        lacking = presets.describe_lack(
            options.env,
            each.agent.name,
            presets.DEFAULT,
            reward_delay=requested.settings.reward_delay,
        )
        more = ""
        if environments.is_discrete(env):
            more = " (--preset gymnax has one setting for discrete actions)"
        if lacking is not None:
            note(f"{lacking}: options that are not given have their defaults{more}")


def make_folder(options: Options) -> pathlib.Path:
    """Create the folder if it is missing, and return it."""
    if options.out is not None:
        return folders.create(options.out)
    stamp = time.strftime("%Y%m%d-%H%M%S")
    name = f"{options.env}-{options.agent}-{stamp}".replace(":", "-")
    return folders.create_new(name)

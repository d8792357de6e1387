"""Find and load the training states and policies that a run or a sweep has saved."""

import contextlib
import dataclasses
import functools
import math
import pathlib
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, TypedDict

import jax
import jax.numpy as jnp
import numpy as np

from gasil_envs import wrappers
from gasil_envs.precision import full_precision
from gasil_jax import numpy_policy, policy, train
from gasil_jax.agents.adversarial import AdversarialAgent
from gasil_jax.algorithms import Algorithm
from gasil_jax.config import Range
from gasil_jax.errors import InputError, refusal
from gasil_jax.host import (
    checkpoint,
    command_line,
    environments,
    json_reader,
    run_folder,
)
from gasil_jax.host.members import member
from gasil_jax.sweeps import programs
from gasil_jax.sweeps.plan import stored_plan
from gasil_jax.sweeps.programs import Program


class _Summary(TypedDict):
    """The field of a sweep's summary.json that is read here."""

    best_by_mean: int | None


def find(
    description: Mapping[str, Any], point: int | None
) -> list[tuple[Program, list[int]]]:
    """Return the programs of a run, or of a sweep's point, with its members in each.

    The run or sweep is described by `run_folder.read`; the point is as in `load`.

    Raises:
      InputError: if the folder has no such point.
    """
    folder = description["out"]
    if "points" not in description:
        if point is not None:
            raise InputError(
                f"point is {point}: {folder} is a run, which has no points"
            )
        run = programs.of_run(description, description["algorithm"])
        return [(run, list(range(len(run.runs))))]
    plan = stored_plan(description)
    last = len(plan.points) - 1
    if point is None:
        with contextlib.suppress(FileNotFoundError):
            point = json_reader.read(folder / "summary.json", _Summary)["best_by_mean"]
        if point is None:
            raise InputError(
                f"run is {folder}, a sweep without a best point: name one, --point 0 "
                f"to {last}"
            )
    if not 0 <= point <= last:
        raise InputError(f"point is {point}: {folder} has points 0 to {last}")
    requested, saved = {plan.runs[point, seed] for seed in plan.seeds}, []
    for each in plan.stored(folder):
        if indices := [i for i, run in enumerate(each.runs) if run in requested]:
            saved.append((each, indices))
    if not saved:
        raise InputError(f"point is {point}: none of its seeds is in {folder} yet")
    return saved


def load(
    folder: pathlib.Path,
    which: str = "last",
    point: int | None = None,
    *,
    seed: int | None = None,
) -> tuple[Any, Algorithm, list[int], Any]:
    """Return environment, algorithm, seed numbers and states (seed, ...) of a run.

    Args:
      folder: folder of the run or sweep, which need not be finished.
      which: the checkpoint to load: "last", or "best", which has the best evaluation
        or, without evaluations, the highest returns in training.
      point: number of a sweep's point; default the best by mean.
      seed: number of the seed; default all seeds.

    Raises:
      InputError: if it is not the folder of a run, if it has no such checkpoint or
        seed, or if "best" is requested of a point that shares its checkpoints with
        other points.
    """
    for name, number in (("point", point), ("seed", seed)):
        if number is not None and number not in Range(-math.inf, whole=True):
            raise refusal(name, number, "a whole number")
    if not isinstance(which, str) or which not in ("last", "best"):
        raise refusal("which", which, "'last' or 'best'")
    description = run_folder.read(folder)
    every = find(description, point)
    settings = dataclasses.asdict(description["settings"])
    with command_line.input_checked():
        env = environments.make_env(description["env"], **settings)
    states: dict[int, train.TrainState] = {}
    for program, indices in every:
        if which == "best" and len(indices) < len(program.runs):
            raise InputError(
                "checkpoint is 'best': this point was trained with others, and "
                "checkpoints are scored over all of them: it must be 'last'"
            )
        root = program.path / "checkpoints"
        chosen, errors = checkpoint.latest(root)
        for error in errors:
            print(f"warning: {error}", file=sys.stderr)
        if which == "best":
            chosen = checkpoint.best(root)
        if chosen is None:
            scored = " with a score" if which == "best" else ""
            raise InputError(f"run is {folder}: it has no whole checkpoint{scored}")
        init = functools.partial(train.first_state, env, program.algorithm)
        keys = jax.random.split(jax.random.key(0), len(program.runs))
        with command_line.input_checked():
            # The leaves of all members have the same shapes.
            restored = chosen.restore(jax.eval_shape(jax.vmap(init), keys))
        states |= {program.seeds[i]: member(restored, i) for i in indices}
    seeds = sorted(states)
    if seed is not None:
        if seed not in seeds:
            raise InputError(f"seed is {seed}: the run has {seeds[0]} to {seeds[-1]}")
        seeds = [seed]

    # JAX would compile a program for each shape, but only it can stack random keys.
    def stack(*leaves: Any) -> jax.Array:
        library = jnp if isinstance(leaves[0], jax.Array) else np
        return jax.device_put(library.stack(leaves))

    stacked = jax.tree.map(stack, *(states[x] for x in seeds))
    first, (index, *_) = every[0]
    return env, first.runs[index].algorithm, seeds, stacked


class Policies(NamedTuple):
    """Saved policies.

    Attributes:
      env: the environment that they were trained in.
      num_steps: steps after which an episode is truncated, at the latest.
      seeds: numbers of their seeds.
      weights: the arrays of each, which `numpy_policy` describes.
    """

    env: Any
    num_steps: int
    seeds: Sequence[int]
    weights: Sequence[Mapping[str, np.ndarray]]


def load_policies(
    folder: str | pathlib.Path,
    which: str = "last",
    point: int | None = None,
    *,
    seed: int | None = None,
) -> Policies:
    """Return the policies of a run, or one that comes with the package.

    Args:
      folder: folder of the run or sweep, or zoo:NAME, which has no points and no
        checkpoints.
      which: see `load`.
      point: see `load`.
      seed: see `load`.

    Raises:
      InputError: as `load` does, or if the zoo has no such policy.
    """
    if not str(folder).startswith(numpy_policy.ZOO_PREFIX):
        env, _, seeds, states = load(pathlib.Path(folder), which, point, seed=seed)
        every = jax.device_get(policy.weights(states, env))
        names = [name for name in numpy_policy.SHARED if name in every]
        shared = {name: every.pop(name) for name in names}
        weights = [member(every, i) | shared for i in range(len(seeds))]
        return Policies(env, train.max_episode_steps(env), seeds, weights)
    if point is not None or which != "last":
        raise InputError(f"run is {folder}: it has no points and no checkpoints")
    with command_line.input_checked():
        arrays = numpy_policy.read(folder, seed)
        about = numpy_policy.about(str(folder))
        env = environments.make_env(about["env"], reward_delay=about["reward_delay"])
    return Policies(env, int(env.episode_length), [about["seed"]], [arrays])


def load_reward(
    folder: str | pathlib.Path,
    seed: int | None = None,
    *,
    which: str = "last",
    point: int | None = None,
) -> Callable[[Any, Any], jax.Array]:
    """Return the reward that a run's discriminator has learned, as a pure function.

    The function is ``reward(observation, action)``, (..., obs), (..., action) -> (...),
    in float32: the bonus without alpha. Discrete actions are int, (...).

    Args:
      folder: folder of the run or sweep.
      seed: number of the seed; default the run's first.
      which: see `load`.
      point: see `load`.

    Raises:
      ValueError: as `load` does, or if the run's agent has no discriminator, or a bonus
        that depends on the batch that a step is in.
    """
    if not isinstance(folder, str | pathlib.PurePath):
        raise refusal("folder", folder, "a string or a pathlib.Path")
    env, algorithm, _, states = load(pathlib.Path(folder), which, point, seed=seed)
    agent, state = algorithm.agent, member(states, 0)
    if not isinstance(agent, AdversarialAgent):
        raise InputError(
            f"run is {folder}, of agent {agent.name!r}: it has no discriminator"
        )
    learned = agent.reward(state.agent, state.normalizer)
    discrete, size = wrappers.is_discrete(env), wrappers.action_size(env)

    @full_precision
    def reward(observation: Any, action: Any) -> jax.Array:
        action = jnp.asarray(action)
        if discrete:
            action = jax.nn.one_hot(action, size)
        sizes = {"observation": env.observation_size, "action": size}
        given = {"observation": jnp.asarray(observation), "action": action}
        for name, array in given.items():
            if array.shape[-1:] != (sizes[name],):
                raise ValueError(
                    f"{name} has shape {array.shape}: it must be (..., {sizes[name]})"
                )
        return learned(*(array.astype(jnp.float32) for array in given.values()))

    return reward

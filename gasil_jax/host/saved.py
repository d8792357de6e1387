"""Load the training states and policies that a folder holds."""

import contextlib
import functools
import math
import operator
import pathlib
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gasil_envs import wrappers
from gasil_envs.precision import full_precision
from gasil_jax import numpy_policy, policy, rollout, train
from gasil_jax.agents.adversarial import AdversarialAgent
from gasil_jax.algorithms import Algorithm
from gasil_jax.config import Range
from gasil_jax.errors import InputError, refusal
from gasil_jax.host import (
    checkpoint,
    environments,
    folders,
    programs,
    results,
    sweep,
    tables,
    training,
)
from gasil_jax.host.driver import Outcome
from gasil_jax.host.members import member
from gasil_jax.host.output_file import note
from gasil_jax.host.points import in_words
from gasil_jax.host.programs import Program
from gasil_jax.host.sweep import Sweep


def find(folder: pathlib.Path, point: int | None) -> tuple[str, str, list[Program]]:
    """Return the environment's and the agent's name, and the programs of a point."""
    stored = sweep.described(folder)
    chosen = _choose_point(folder, stored["points"], point)
    agent = stored["points"][chosen].get("agent", stored["algorithm"].get("agent"))
    if stored["only_python"] is None:
        every = programs_of(folder, sweep.made(folder, stored), chosen)
    else:
        every = programs.labelled(folder / "programs", chosen)
    return stored["env"], str(agent), every


def _best_seed(every: Sequence[Program]) -> int | None:
    """Return the seed with the highest final return of programs; None if unknown."""
    scores = {}
    for each in every:
        table = each.table("metrics.csv", ("episode_return",))
        for i, columns in zip(each.indices, table, strict=True):
            if columns:
                final = tables.final_returns(columns["episode_return"])
                scores[each.labels["seed"][i]] = float(
                    np.nan_to_num(final, nan=-np.inf)
                )
    return max(scores, key=scores.__getitem__) if scores else None


def best_of(folder: pathlib.Path, point: int | None) -> tuple[int, int | None]:
    """Return a point, by default the best, and its seed with the highest return."""
    point = _choose_point(folder, sweep.described(folder)["points"], point)
    return point, _best_seed(find(folder, point)[2])


def _choose_point(
    folder: pathlib.Path, points: Sequence[Mapping[str, Any]], point: int | None
) -> int:
    """Return the number of the requested point; by default the best by mean."""
    last = len(points) - 1
    if point is None and last > 0:
        if (point := results.best_points(folder)[0]) is None:
            raise InputError(
                f"run is {folder}, a sweep without a best point: name one, --point 0 "
                f"to {last}"
            )
        if point <= last:
            note(
                f"{folder}: point {point}, the best by mean ({in_words(points[point])})"
            )
    point = point or 0
    if not 0 <= point <= last:
        raise InputError(f"point is {point}: {folder} has points 0 to {last}")
    return point


def programs_of(folder: pathlib.Path, stored: Sweep, point: int) -> list[Program]:
    """Return the programs that hold a point's runs, with no other runs."""
    left = {stored.runs[point, seed] for seed in stored.seeds}
    of_point = []
    # Two may hold the same run, if one was copied from another folder.
    for each in sorted(stored.stored(folder), key=lambda x: not x.is_finished):
        if kept := [i for i, run in enumerate(each.runs) if run in left]:
            left -= {each.runs[i] for i in kept}
            of_point.append(each.only(kept))
    if not of_point:
        raise InputError(f"run is {folder}: none of its seeds has begun")
    return of_point


def load(
    folder: pathlib.Path,
    which: str = "last",
    point: int | None = None,
    *,
    seed: int | None = None,
    env: Any = None,
    algorithm: Algorithm | None = None,
) -> tuple[Any, Algorithm, list[int], Any]:
    """Return environment, algorithm, seeds and states of a point; see `load_policy`."""
    for name, number in (("point", point), ("seed", seed)):
        if number is not None and number not in Range(-math.inf, whole=True):
            raise refusal(name, number, "a whole number")
    if not isinstance(which, str) or which not in ("last", "best"):
        raise refusal("which", which, "'last' or 'best'")
    stored = sweep.read(folder, algorithm)
    point = _choose_point(folder, stored.points, point)
    if env is None:
        with _named(folder):
            env = training.make_env(stored)
    return env, *restore(folder, stored, env, point=point, which=which, seed=seed)


@contextlib.contextmanager
def _named(folder: pathlib.Path) -> Any:
    try:
        yield
    except ValueError as error:
        raise InputError(f"run is {folder}: {error}") from None


def restore(
    folder: pathlib.Path,
    stored: Sweep,
    env: Any,
    *,
    point: int,
    which: str = "last",
    seed: int | None = None,
) -> tuple[Algorithm, list[int], Any]:
    """Return algorithm, seed numbers and states (seed, ...) of a point; see `load`."""
    states: dict[int, train.TrainState] = {}
    every = programs_of(folder, stored, point)
    for each in every:
        if which == "best" and len(each.runs) < each.num_members:
            raise InputError(
                "checkpoint is 'best': this point was trained with others, and "
                "checkpoints are scored over all of them: it must be 'last'"
            )
        init = functools.partial(train.first_state, env, each.algorithm)
        keys = jax.random.split(jax.random.key(0), each.num_members)
        with _named(folder):
            # The leaves of all members have the same shapes.
            like = jax.eval_shape(jax.vmap(init), keys)
            restored = _read_checkpoint(each.path / "checkpoints", which, like)
        own = zip(each.seeds, each.indices, strict=True)
        states |= {number: member(restored, i) for number, i in own}
    seeds = [x for x in stored.seeds if x in states]
    if seed is not None:
        if seed not in seeds:
            listed = ", ".join(map(str, seeds))
            raise InputError(f"seed is {seed}: the run has {listed}")
        seeds = [seed]

    # JAX would compile a program for each shape, but only it can stack random keys.
    def stack(*leaves: Any) -> jax.Array:
        library = jnp if isinstance(leaves[0], jax.Array) else np
        return jax.device_put(library.stack(leaves))

    stacked = jax.tree.map(stack, *(states[x] for x in seeds))
    return every[0].algorithm, seeds, stacked


def _read_checkpoint(root: pathlib.Path, which: str, like: Any) -> Any:
    """Return the states in a checkpoint."""
    errors: list[str] = []
    if which == "best":
        chosen = checkpoint.best(root)
    else:
        chosen, errors = checkpoint.latest(root)
    if chosen is None:
        scored = " with a score" if which == "best" else ""
        raise ValueError(f"it has no whole checkpoint{scored}")
    for error in errors:
        print(f"warning: {error}", file=sys.stderr)
    return chosen.restore(like)


def states_of(
    folder: pathlib.Path,
    stored: Sweep,
    env: Any,
    point: int,
    trained: Sequence[tuple[Program, Outcome]],
) -> train.TrainState:
    """Return the states of a point, (seeds, ...), just trained or from its folder."""
    runs = [stored.runs[point, seed] for seed in stored.seeds]
    for program, outcome in trained:
        if set(runs) <= set(program.runs):
            places = np.array([program.runs.index(run) for run in runs])
            if np.array_equal(places, range(len(program.runs))):
                return outcome.states
            return jax.tree.map(operator.itemgetter(places), outcome.states)
    return restore(folder, stored, env, point=point)[2]


class Policies(NamedTuple):
    """Saved policies."""

    env: Any  # the environment that they were trained in
    num_steps: int  # steps after which an episode is truncated, at the latest
    seeds: Sequence[int]  # numbers of their seeds
    # The arrays of each, which `numpy_policy` describes.
    weights: Sequence[Mapping[str, np.ndarray]]


def load_policies(
    folder: str | pathlib.Path,
    which: str = "last",
    point: int | None = None,
    *,
    seed: int | None = None,
) -> Policies:
    """Return the policies of a run, as `load` does, or one of the package's own."""
    if not str(folder).startswith(numpy_policy.ZOO_PREFIX):
        env, _, seeds, states = load(pathlib.Path(folder), which, point, seed=seed)
        every = jax.device_get(policy.weights(states, env))
        names = [name for name in numpy_policy.SHARED if name in every]
        shared = {name: every.pop(name) for name in names}
        weights = [member(every, i) | shared for i in range(len(seeds))]
        return Policies(env, rollout.max_episode_steps(env), seeds, weights)
    if point is not None or which != "last":
        raise InputError(f"run is {folder}: it has no points and no checkpoints")
    arrays = numpy_policy.read(folder, seed)
    about = numpy_policy.about(str(folder))
    env = environments.make_env(about["env"], reward_delay=about["reward_delay"])
    return Policies(env, int(env.episode_length), [about["seed"]], [arrays])


def load_policy(
    path: str | pathlib.Path,
    seed: int | None = None,
    *,
    which: str = "last",
    point: int | None = None,
    env: Any = None,
    algorithm: Algorithm | None = None,
) -> Callable[..., jax.Array]:
    """Return a saved policy as a pure function for `jax.jit` and `jax.vmap`.

    The function is ``policy(observation, key=None)``, (..., obs) -> (..., action), in
    float32. It clips actions to their range. Without a key the action is the policy's
    mean, or that of a mixture's most probable Gaussian; with a key it is drawn from the
    policy. The key is consumed. Discrete actions are int32 (...), without a key the
    most probable ones.

    Args:
      path: the folder of a run or a sweep; a file ``policy.npz``; or "zoo:NAME", one of
        the policies that come with the package. In a folder policy.npz is read if it
        has what is asked for, and a checkpoint otherwise.
      seed: number of the seed; default the one with the highest final return.
      which: "last", or "best", the checkpoint with the best evaluation or, without
        evaluations, the highest returns in training.
      point: number of a sweep's point; default the best by mean.
      env: the environment of a checkpoint, if it was made in Python.
      algorithm: the algorithm of a checkpoint, if it was made in Python.

    Raises:
      ValueError: if it is not a saved policy, if it has no such seed, point or
        checkpoint, if that is damaged, or if "best" is asked of a point that shares its
        checkpoints with others.
    """
    if not isinstance(path, str | pathlib.PurePath):
        raise refusal("path", path, "a string or a pathlib.Path")
    folder = pathlib.Path(path)
    has_file = not folders.has_config(folder) or (folder / "policy.npz").exists()
    if has_file and which == "last" and point is None:
        return policy.make(numpy_policy.read(path, seed))
    if seed is None:
        point, seed = best_of(folder, point)
    env, _, _, states = load(
        folder, which, point, seed=seed, env=env, algorithm=algorithm
    )
    return policy.from_state(member(states, 0), env)


def load_reward(
    folder: str | pathlib.Path,
    seed: int | None = None,
    *,
    which: str = "last",
    point: int | None = None,
    env: Any = None,
    algorithm: Algorithm | None = None,
) -> Callable[[Any, Any], jax.Array]:
    """Return the reward that a run's discriminator has learned, as a pure function.

    The function is ``reward(observation, action)``, (..., obs), (..., action) -> (...),
    in float32: the bonus without alpha. Discrete actions are int, (...).

    Args:
      folder: folder of the run or sweep.
      seed: number of the seed; default the run's first.
      which: see `load_policy`.
      point: see `load_policy`.
      env: see `load_policy`.
      algorithm: see `load_policy`.

    Raises:
      ValueError: as `load_policy` does, or if the run's agent has no discriminator, or
        a bonus that depends on the batch that a step is in.
    """
    if not isinstance(folder, str | pathlib.PurePath):
        raise refusal("folder", folder, "a string or a pathlib.Path")
    env, algorithm, _, states = load(
        pathlib.Path(folder), which, point, seed=seed, env=env, algorithm=algorithm
    )
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

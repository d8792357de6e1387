"""Train from Python as the command line does: `gasil_jax.fit`."""

import contextlib
import dataclasses
import json
import pathlib
import tempfile
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from gasil_jax import checks
from gasil_jax.algorithms import Algorithm, check_numbers
from gasil_jax.config import Range, validate, validate_switch
from gasil_jax.errors import refusal
from gasil_jax.host import (
    descriptions,
    environments,
    folders,
    json_files,
    results,
    saved,
    training,
)
from gasil_jax.host.driver import Callback, FitProgress
from gasil_jax.host.interruption import Interruption, noted
from gasil_jax.host.points import completed
from gasil_jax.host.sweep import Recording, Sweep, check_seeds
from gasil_jax.train import TrainState

__all__ = ["FitProgress", "FitResult", "fit"]

_COUNT = Range(1, whole=True)


class FitResult(NamedTuple):
    """The result of `fit`.

    Attributes:
      states: the training states after the last iteration, (seeds, ...). They are NumPy
        arrays and random keys where the seeds can't be divided equally by the devices.
        With points all arrays here have one more axis in front, (points, seeds, ...).
      metrics: every metric from the first iteration on, (seeds, iterations) each.
      evaluations: columns of evaluations.csv ("env_steps", and "mean", "min", "max" of
        the returns, and "length"), (seeds, evaluations) each; empty without any.
    """

    states: TrainState
    metrics: dict[str, np.ndarray]
    evaluations: dict[str, np.ndarray]


def fit(
    env: Any,
    algorithm: Algorithm,
    *,
    seeds: int | Sequence[int] | np.ndarray | jax.Array = 1,
    points: Sequence[Mapping[str, float]] | None = None,
    folder: str | pathlib.Path | None = None,
    resume: bool = False,
    checkpoint_every: int | None = None,
    evaluate_every: int | None = None,
    evaluate_episodes: int = 10,
    callback: Callback | None = None,
) -> FitResult:
    """Train seeds side by side over all devices, in chunks, as the command line does.

    A chunk is a compiled call of at most a fiftieth of all iterations, and takes about
    five seconds at most. A seed's numbers are those of ``python -m gasil_jax.run``.

    Args:
      env: one environment.
      algorithm: the algorithm that the seeds share.
      seeds: number of seeds, counted from seed 0; or the seeds' own numbers.
      points: values of hyperparameters, one mapping from names to values per point.
        Each point is trained with all seeds, in the same program, and equal points
        once. The points that a folder has come first, and are the default. The arrays
        that a callback gets are then (points x seeds, ...), all seeds of the first
        point first.
      folder: folder for the files of a run or a sweep, created if it is missing; None
        keeps nothing. All commands can read it, if a command line can name what was
        trained: an environment from `gasil_jax.make_env`, an agent and models of
        rewards that can be imported, your own before the package's, and schedules of
        points. Otherwise config.json says why not in "only_python", and
        `gasil_jax.load_policy` and `gasil_jax.load_reward`, with their arguments `env`
        and `algorithm`, and ``python -m gasil_jax.plot`` can read it.
      resume: train what is missing in the folder. The algorithm and evaluations must be
        the same, but `total_steps` may be larger, and there may be more seeds and
        points. An environment from `gasil_jax.make_env` is compared by its name and
        settings, another one by the name of its class. Schedules that are functions are
        not compared. If the folder holds no training yet, it begins.
      checkpoint_every: environment steps per seed between two checkpoints, rounded up
        to whole iterations; default a checkpoint every ten minutes and at the end.
      evaluate_every: environment steps per seed between two evaluations of the policy's
        mean action, rounded up to whole iterations; the untrained and the last policy
        are evaluated too. Default none.
      evaluate_episodes: number of episodes of each seed in an evaluation.
      callback: gets a `FitProgress` after each chunk, on the host. Training ends there
        if it returns true; a checkpoint is written, from which it can be resumed.

    Raises:
      Interrupted: if a folder is given and SIGINT or SIGTERM was received; a checkpoint
        was written first.
      OSError: if the folder can't be written. If that is seen only after training,
        policy.npz is written nevertheless where it can be.
      ValueError: if a value is not allowed, or if the folder holds other files.
    """
    checks.check_environment(env)
    checks.check(env, algorithm)
    numbers = _numbers(seeds)
    recording = Recording(
        checkpoint_every=checkpoint_every,
        evaluate_every=evaluate_every,
        evaluate_episodes=evaluate_episodes,
    )
    validate(recording)
    validate_switch("resume", resume)
    if not isinstance(folder, str | pathlib.PurePath | None):
        raise refusal("folder", folder, "a string or a pathlib.Path")
    if callback is not None and not callable(callback):
        raise refusal("callback", callback, "a function")
    if folder is None and (resume or checkpoint_every is not None):
        name = "resume" if resume else "checkpoint_every"
        raise ValueError(f"{name} is {resume or checkpoint_every}: it needs a folder")
    every: Any = [{}] if points is None else points
    listed = isinstance(every, list | tuple) and len(every) > 0
    if not listed or not all(isinstance(point, Mapping) for point in every):
        allowed = "a list of at least one dict of numbers by name"
        raise refusal("points", points, allowed)
    for point in every:
        check_numbers(algorithm, point)
    if folder is None:
        recording = dataclasses.replace(recording, keep_checkpoints=0)
    requested = _describe(env, _plain(algorithm), numbers, recording)
    every = completed(every, requested.algorithm)
    requested = dataclasses.replace(requested, points=every)
    interruption = Interruption()
    with contextlib.ExitStack() as stack:
        if folder is None:
            # Ctrl-C ends training at once, because there is nothing to save.
            path = pathlib.Path(stack.enter_context(tempfile.TemporaryDirectory()))
        else:
            path = folders.create(pathlib.Path(folder), option="folder")
            how_to_continue = "continue with the same arguments and resume=True"
            stack.enter_context(noted(how_to_continue))
            stack.enter_context(interruption)
            if points is None and folders.has_config(path):
                # Those of the folder.
                requested = dataclasses.replace(requested, points=())
            requested = requested.begun_in(path, resume=resume, option="folder")
        missing = requested.unfinished(path)
        outcomes = training.train_programs(
            env,
            missing,
            recording,
            title="fit",
            interruption=interruption,
            callback=callback,
            shown=False,
        )
        trained = [x for x in requested.stored(path) if x.training is not None]
        told = results.read(requested, trained)
        own = list(zip(missing, outcomes))
        states = [
            saved.states_of(path, requested, env, point, own)
            for point in range(len(requested.points))
        ]
        if folder is not None:
            best = results.write(path, told)["best_by_mean"] or 0
            results.write_policies(path, told, states[best], env)
        for outcome in outcomes:
            if outcome.unsaved is not None:
                raise outcome.unsaved
    if points is None and len(states) == 1:
        metrics, evaluations = (
            {name: x[0] for name, x in columns.items()}
            for columns in (told.metrics, told.evaluations)
        )
        return FitResult(states[0], metrics, evaluations)
    stacked = jax.tree.map(lambda *x: jax.numpy.stack(x), *states)
    return FitResult(stacked, told.metrics, told.evaluations)


def _plain(algorithm: Algorithm) -> Algorithm:
    """Return an algorithm whose numbers are Python's, and not arrays."""
    numbers = {
        name: x.item()
        for name, x in algorithm.settings.items()
        if isinstance(x, np.ndarray | np.generic | jax.Array)
    }
    return algorithm.replace(**numbers)


def _numbers(seeds: int | Sequence[int] | np.ndarray | jax.Array) -> Sequence[int]:
    """Return the numbers of the seeds, which may also be an array of integers."""
    # A random key's dtype has no kind, and NumPy's durations are integers.
    if getattr(getattr(seeds, "dtype", None), "kind", "") in ("i", "u"):
        seeds = np.asarray(seeds).tolist()
    allowed = Range(0, 2**32 - 1, whole=True)
    if isinstance(seeds, list | tuple | range):
        if all(x in allowed for x in seeds):
            numbers = tuple(int(seed) for seed in seeds)
            check_seeds(numbers)
            return numbers
    elif seeds in _COUNT:
        check_seeds(range(int(seeds)))
        return range(int(seeds))
    each = f"different whole numbers from 0 to {2**32 - 1}"
    raise refusal("seeds", seeds, f"a number of seeds, or {each}")


def _describe(
    env: Any, algorithm: Algorithm, seeds: Sequence[int], recording: Recording
) -> Sweep:
    """Return the sweep of one point that is trained."""
    made_with = environments.made_with(env)
    why = None if made_with else "an environment that is not from gasil_jax.make_env"
    try:
        stored = json_files.to_json(descriptions.describe(algorithm))
        if descriptions.read(json.loads(stored)) != algorithm:
            why = why or "an agent or models of rewards that a command can't name"
    except ValueError as error:
        why = why or str(error)
    kind = type(getattr(env, "unwrapped", env)).__name__
    name, settings = made_with or (kind, environments.Settings())
    own: dict[str, Any] = {
        "settings": settings,
        "recording": recording,
        "only_python": why,
    }
    return Sweep(name, algorithm, seeds, **own)

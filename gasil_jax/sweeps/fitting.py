"""Train from Python as the command line does: `gasil_jax.fit`."""

import contextlib
import json
import pathlib
import tempfile
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from gasil_jax import checks
from gasil_jax.algorithms import Algorithm
from gasil_jax.config import Range, validate_switch
from gasil_jax.errors import refusal
from gasil_jax.host import (
    descriptions,
    driver,
    environments,
    metrics_files,
    run_folder,
    run_options,
)
from gasil_jax.host.driver import Callback, FitProgress
from gasil_jax.host.interruption import Interruption, noted
from gasil_jax.host.members import Members, make_members
from gasil_jax.host.periodic_checkpoints import CheckpointSchedule
from gasil_jax.host.periodic_evaluation import EvaluationSchedule
from gasil_jax.host.progress import Progress
from gasil_jax.sweeps import run_results
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
    evaluate_episodes: int = run_options.EVALUATE_EPISODES,
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
        Each point is trained with all seeds, in the same program. The arrays that a
        callback gets are then (points x seeds, ...), all seeds of the first point
        first. Not with a folder, which holds one point: ``python -m gasil_jax.sweep``
        keeps several.
      folder: folder for the files of a run, created if it is missing; None keeps
        nothing. All commands can read it like the folder of a run, if their options can
        describe the training. They can't if the environment is not from
        `gasil_jax.make_env`, if the seeds are not consecutive numbers, if a schedule is
        a function, if the agent can't be imported by its name, or if a reward model is
        not one of the package's. Then the folder has a fit.json instead of a
        config.json, and only `gasil_jax.load_policy` and ``python -m gasil_jax.plot``
        can read it.
      resume: continue the training in the folder from its newest checkpoint. Seeds,
        algorithm and evaluations must be the same, but `total_steps` may be larger. An
        environment from `gasil_jax.make_env` is compared by its name and settings,
        another one by the name of its class. Schedules that are functions are not
        compared. If the folder holds no training yet, a new one begins.
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
    numbers = _numbers(seeds)
    for name, value in (
        ("checkpoint_every", checkpoint_every),
        ("evaluate_every", evaluate_every),
        ("evaluate_episodes", evaluate_episodes),
    ):
        default = value is None and name != "evaluate_episodes"
        if value not in _COUNT and not default:
            raise refusal(name, value, _COUNT)
    validate_switch("resume", resume)
    if not isinstance(folder, str | pathlib.PurePath | None):
        raise refusal("folder", folder, "a string or a pathlib.Path")
    if callback is not None and not callable(callback):
        raise refusal("callback", callback, "a function")
    if folder is None and (resume or checkpoint_every is not None):
        name = "resume" if resume else "checkpoint_every"
        raise ValueError(f"{name} is {resume or checkpoint_every}: it needs a folder")
    if points is not None and folder is not None:
        raise ValueError(
            f"folder is {folder}: a folder holds one point, leave out points or folder "
            "(python -m gasil_jax.sweep keeps several points)"
        )
    every = [{}] if points is None else points
    listed = isinstance(every, list | tuple) and len(every) > 0
    if not listed or not all(isinstance(point, Mapping) for point in every):
        allowed = "a list of at least one dict of numbers by name"
        raise refusal("points", points, allowed)
    members = make_members(
        env,
        algorithm,
        [seed for _ in every for seed in numbers],
        [point for point in every for _ in numbers],
    )
    evaluation_schedule = None
    if evaluate_every is not None:
        evaluation_schedule = EvaluationSchedule(evaluate_every, evaluate_episodes)
    interruption, described = Interruption(), None

    def write() -> None:
        if described is not None:
            run_folder.write_description(path, *described)

    with contextlib.ExitStack() as stack:
        if folder is None:
            # Ctrl-C ends training at once, because there is nothing to save.
            path = pathlib.Path(stack.enter_context(tempfile.TemporaryDirectory()))
        else:
            path = pathlib.Path(folder)
            described = _describe(
                members,
                checkpoint_every=checkpoint_every,
                evaluate_every=evaluate_every,
                evaluate_episodes=evaluate_episodes if evaluate_every else None,
            )
            run_folder.create(path, option="folder")
            stack.enter_context(run_folder.lock(path, option="folder"))
            _begin(path, *described, resume=resume)
            how_to_continue = "continue with the same arguments and resume=True"
            stack.enter_context(noted(how_to_continue))
            stack.enter_context(interruption)
        outcome = driver.drive(
            members,
            path,
            {"seed": members.seeds},
            schedule=CheckpointSchedule(
                checkpoint_every, keep=0 if described is None else 2
            ),
            progress=Progress("fit", algorithm.config.total_steps, shown=False),
            interruption=interruption,
            evaluation_schedule=evaluation_schedule,
            callback=callback,
            on_restored=write,
        )
        if described is None:
            tables = run_results.read(path, members)
        else:
            env_name = described[0]["env"]
            tables, _ = run_results.finish(path, env_name, members, outcome)
        result = FitResult(outcome.states, *tables)
        if points is None:
            return result
        shape = (len(points), len(numbers))
        return jax.tree.map(lambda x: x.reshape(*shape, *x.shape[1:]), result)


def _numbers(seeds: int | Sequence[int] | np.ndarray | jax.Array) -> Sequence[int]:
    """Return the numbers of the seeds, which may also be an array of integers.

    Raises:
      ValueError: if they are none, not different or out of range.
    """
    # A random key's dtype has no kind, and NumPy's durations are integers.
    if getattr(getattr(seeds, "dtype", None), "kind", "") in ("i", "u"):
        seeds = np.asarray(seeds).tolist()
    allowed = Range(0, 2**32 - 1, whole=True)
    if isinstance(seeds, Sequence):
        if all(x in allowed for x in seeds) and len(set(seeds)) == len(seeds) > 0:
            return tuple(int(seed) for seed in seeds)
    elif not isinstance(seeds, bool) and isinstance(seeds, int):
        run_folder.check_seeds(seeds, 0)
        return range(seeds)
    each = f"different whole numbers from 0 to {2**32 - 1}"
    raise refusal("seeds", seeds, f"a number of seeds, or {each}")


def _describe(members: Members, **arguments: Any) -> tuple[dict[str, Any], str]:
    """Return what a folder says of training in it, and the name of the file.

    The file is config.json if a command can train the same, and fit.json otherwise. The
    options of a run that are arguments of `fit` are `arguments`.

    Raises:
      ValueError: if the expert's data can't be read.
    """
    env, algorithm, seeds = members.env, members.algorithm, list(members.seeds)
    try:
        made_with = environments.made_with(env)
        if made_with is None:
            raise ValueError(
                "the environment is not one that gasil_jax.make_env returned"
            )
        if seeds != list(range(seeds[0], seeds[0] + len(seeds))):
            raise ValueError("the seeds do not follow one another")
        stored = metrics_files.to_json(descriptions.describe(algorithm))
        if descriptions.read(json.loads(stored)) != algorithm:
            raise ValueError("options can't name the agent or the models of rewards")
    # A function has no JSON form.
    except (ValueError, TypeError) as error:
        described = {
            "why_no_run": str(error),
            "env": type(getattr(env, "unwrapped", env)).__name__,
            "seeds": tuple(seeds),
            **arguments,
            **descriptions.describe(algorithm),
            **run_folder.expert_hash(algorithm),
        }
        plain = {x: "a function" if callable(y) else y for x, y in described.items()}
        return plain, run_folder.FIT
    name, settings = made_with
    options = run_options.Options(
        env=name,
        settings=settings,
        seeds=len(seeds),
        first_seed=seeds[0],
        **arguments,
        **run_options.algorithm_options(algorithm),
    )
    return run_options.description(options), run_folder.CONFIG


def _like_stored(
    description: dict[str, Any], folder: pathlib.Path
) -> Mapping[str, Any]:
    """Return a run's config.json, and make a description have its preset.

    If the run evaluates the default number of episodes, the description says so in the
    same way.

    Raises:
      ValueError: if the folder is a sweep's.
    """
    stored = run_folder.read(folder)
    if "points" in stored:
        raise ValueError(
            f"folder is {folder}, a sweep: continue it with python -m gasil_jax.sweep"
        )
    description["preset"] = stored["preset"]
    if stored["evaluate_episodes"] is None and stored["evaluate_every"] is not None:
        if description["evaluate_episodes"] == run_options.EVALUATE_EPISODES:
            description["evaluate_episodes"] = None
    return stored


def _begin(
    folder: pathlib.Path, description: dict[str, Any], name: str, *, resume: bool
) -> None:
    """Write what is trained to a new folder, or compare it with what the folder says.

    Raises:
      ValueError: if the folder holds other files, or training that is not the same.
    """
    if not (folder / name).is_file():
        run_folder.refuse_used(folder, option="folder")
        run_folder.write_description(folder, description, name)
    elif not resume:
        raise ValueError(
            f"folder is {folder}, where training has begun: give resume=True or "
            "another folder"
        )
    else:
        before: Mapping[str, Any]
        if name == run_folder.FIT:
            before = run_folder.read_fit(folder)
        else:
            before = _like_stored(description, folder)
        if changes := run_folder.differences(before, description):
            raise ValueError(
                f"resume continues with {folder}, where {'; '.join(changes)}: "
                "only total_steps may differ, and grow"
            )
        run_folder.refuse_other_expert(before, run_folder.flat(description), folder)

"""Train from Python as the command line does: `gasil_jax.fit`."""

import contextlib
import os
import pathlib
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from gasil_jax import checks
from gasil_jax.algorithms import Algorithm
from gasil_jax.config import Range
from gasil_jax.host import (
    descriptions,
    driver,
    json_reader,
    metrics_files,
    policy_file,
    run_folder,
)
from gasil_jax.host.driver import Callback, FitProgress
from gasil_jax.host.interruption import Interrupted, Interruption
from gasil_jax.host.members import make_members
from gasil_jax.host.periodic_checkpoints import CheckpointSchedule
from gasil_jax.host.periodic_evaluation import EvaluationSchedule
from gasil_jax.host.progress import Progress
from gasil_jax.train import TrainState

__all__ = ["FitProgress", "FitResult", "fit"]

_DESCRIPTION = "fit.json"
_COUNT = Range(1, whole=True)


class FitResult(NamedTuple):
    """The result of `fit`.

    Attributes:
      states: the training states after the last iteration, (seeds, ...). They are NumPy
        arrays and random keys where the seeds can't be divided equally by the devices.
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
    folder: str | os.PathLike[str] | None = None,
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
      folder: folder of metrics.csv, evaluations.csv, checkpoints/ and, at the end,
        policy.npz for `gasil_jax.load_policy`. It is created if it is missing; None
        keeps nothing.
      resume: continue the training in the folder from its newest checkpoint. Of the
        seeds, the algorithm and the evaluations only `total_steps` may differ, and only
        grow. The environment, and schedules that are functions, are not compared. If
        the folder holds no training yet, a new one begins.
      checkpoint_every: environment steps per seed between two checkpoints, rounded up
        to whole iterations; default a checkpoint every ten minutes and at the end.
      evaluate_every: environment steps per seed between two evaluations of the policy's
        mean action, rounded up to whole iterations; default none.
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
    members = make_members(env, algorithm, _numbers(seeds))
    for name, value in (
        ("checkpoint_every", checkpoint_every),
        ("evaluate_every", evaluate_every),
        ("evaluate_episodes", evaluate_episodes),
    ):
        if value is not None and value not in _COUNT:
            raise ValueError(f"{name} is {value!r}: it must be {_COUNT}")
    if folder is None and (resume or checkpoint_every is not None):
        name = "resume" if resume else "checkpoint_every"
        raise ValueError(f"{name} is {resume or checkpoint_every}: it needs a folder")
    schedule = CheckpointSchedule(checkpoint_every, keep=0 if folder is None else 2)
    evaluation_schedule = None
    if evaluate_every is not None:
        evaluation_schedule = EvaluationSchedule(evaluate_every, evaluate_episodes)
    interruption = Interruption()
    write_description: Callable[[], None] = lambda: None
    with contextlib.ExitStack() as stack:
        if folder is None:
            # Ctrl-C ends training at once, because there is nothing to save.
            path = pathlib.Path(stack.enter_context(tempfile.TemporaryDirectory()))
        else:
            description = {
                "seeds": tuple(members.seeds),
                "evaluate_every": evaluate_every,
                "evaluate_episodes": evaluate_episodes if evaluate_every else None,
                **descriptions.describe(algorithm),
                **run_folder.expert_hash(algorithm),
            }
            path = pathlib.Path(folder)
            write_description = stack.enter_context(_opened(path, description, resume))
            stack.enter_context(interruption)
        outcome = driver.drive(
            members,
            path,
            {"seed": members.seeds},
            schedule=schedule,
            progress=Progress("fit", algorithm.config.total_steps, shown=False),
            interruption=interruption,
            evaluation_schedule=evaluation_schedule,
            callback=callback,
            on_restored=write_description,
        )
        metrics = _table(path / "metrics.csv", members.num_members)
        if folder is not None:
            final = metrics_files.final_returns(metrics["episode_return"])
            policy_file.save(
                path / "policy.npz", outcome.states, env, members.seeds, final
            )
        if outcome.unsaved is not None:
            raise outcome.unsaved
        return FitResult(
            outcome.states,
            metrics,
            _table(path / "evaluations.csv", members.num_members),
        )


def _numbers(seeds: int | Sequence[int] | np.ndarray | jax.Array) -> Sequence[int]:
    """Return the numbers of the seeds, which may also be an array of integers.

    Raises:
      ValueError: if they are none, not different or out of range.
    """
    if jax.dtypes.issubdtype(getattr(seeds, "dtype", object), np.integer):
        seeds = np.asarray(seeds).tolist()
    allowed = Range(0, 2**32 - 1, whole=True)
    if isinstance(seeds, Sequence):
        if all(x in allowed for x in seeds) and len(set(seeds)) == len(seeds) > 0:
            return tuple(int(seed) for seed in seeds)
    elif not isinstance(seeds, bool) and isinstance(seeds, int):
        run_folder.check_seeds(seeds, 0)
        return range(seeds)
    raise ValueError(
        f"seeds is {seeds!r}: it must be a number of seeds, or different whole numbers "
        f"from 0 to {2**32 - 1}"
    )


@contextlib.contextmanager
def _opened(
    folder: pathlib.Path, description: Mapping[str, Any], resume: bool
) -> Iterator[Callable[[], None]]:
    """Create and lock a folder of `fit`, and write fit.json if training begins.

    Yields a function that writes fit.json, to call when training continues.

    Raises:
      ValueError: if the folder can't be written, is in use, or holds other files.
    """
    path = folder / _DESCRIPTION
    with contextlib.ExitStack() as stack:
        run_folder.create(folder, option="folder")
        stack.enter_context(run_folder.lock(folder, option="folder"))
        # JSON has no functions.
        now = {x: "a function" if callable(y) else y for x, y in description.items()}
        write = lambda: metrics_files.write_json(path, now)
        if not path.is_file():
            run_folder.refuse_used(folder, option="folder")
            write()
        elif not resume:
            raise ValueError(
                f"folder is {folder}, where training has begun: give resume=True or "
                "another folder"
            )
        else:
            before = _read_description(path)
            if changes := run_folder.differences(before, now):
                raise ValueError(
                    f"resume continues with {folder}, where {'; '.join(changes)}: "
                    "only total_steps may differ, and grow"
                )
            run_folder.refuse_other_expert(before, now, folder)
        try:
            yield write
        except Interrupted as interrupted:
            interrupted.add_note("continue with the same arguments and resume=True")
            raise


def _read_description(path: pathlib.Path) -> dict[str, Any]:
    """Return the content of fit.json.

    Raises:
      ValueError: if it is damaged, or does not say how the policies were evaluated.
    """
    description = json_reader.read(path, dict[str, Any])
    # Older versions did not write these two, even if they evaluated policies.
    names = ("evaluate_every", "evaluate_episodes")
    missing = [name for name in names if name not in description]
    if missing and path.with_name("evaluations.csv").exists():
        raise ValueError(
            f"{path} is of an older version: add {' and '.join(missing)}, the numbers "
            "that its policies were evaluated with"
        )
    return dict.fromkeys(missing) | description


def _table(path: pathlib.Path, num_members: int) -> dict[str, np.ndarray]:
    """Return the columns of a table, (seeds, rows) each; empty if it has no rows."""
    if not path.exists() or not path.stat().st_size:
        return {}
    return metrics_files.read_metrics(path, ("seed",), num_members)

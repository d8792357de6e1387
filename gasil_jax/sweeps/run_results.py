"""Read the tables of a run, and write its policies, learning curve and summary."""

import pathlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, NotRequired, TypedDict

import numpy as np

from gasil_jax import statistics
from gasil_jax.figures import plotting
from gasil_jax.host import json_reader, metrics_files, output_file, policy_file
from gasil_jax.host.driver import Outcome
from gasil_jax.host.members import Members


class Tables(NamedTuple):
    """The columns of metrics.csv and evaluations.csv, (seeds, rows) each.

    Those of evaluations.csv are none if nothing was evaluated.
    """

    metrics: dict[str, np.ndarray]
    evaluations: dict[str, np.ndarray]


def read(folder: pathlib.Path, num_seeds: int) -> Tables:
    """Return the tables of a run.

    Raises:
      InputError: if a table is damaged.
    """

    def table(path: Any, required: Any) -> Any:
        return metrics_files.read_metrics(path, ("seed",), num_seeds, required)

    required = (*metrics_files.SUMMARIZED, "faulty_steps")
    metrics = table(folder / "metrics.csv", required)
    path = folder / "evaluations.csv"
    evaluated = path.exists() and path.stat().st_size > 0
    return Tables(metrics, table(path, ("mean",)) if evaluated else {})


def write(
    folder: pathlib.Path,
    env_name: str,
    *,
    members: Members,
    outcome: Outcome,
    tables: Tables,
) -> dict[str, Any]:
    """Write policy.npz, learning_curve.png and summary.json; return the summary.

    Args:
      folder: folder of the run.
      env_name: name of the environment.
      members: the run's seeds.
      outcome: the result of their training.
      tables: their tables, from `read`.
    """
    metrics, evaluations = tables
    seeds, agent = members.seeds, members.algorithm.agent.name
    returns, steps = metrics["episode_return"], metrics["env_steps"][0]
    final = metrics_files.final_returns(returns)
    # The policies come first, because a figure or a summary can be made again.
    policy_file.save(folder / "policy.npz", outcome.states, members.env, seeds, final)
    with output_file.atomic(folder / "learning_curve.png") as partial:
        plotting.learning_curve(
            partial,
            steps,
            returns,
            title=f"{env_name}, {agent}",
            evaluations=evaluations or None,
        )
    faulty = np.nansum(metrics["faulty_steps"], axis=1)
    skipped = np.nansum(metrics["skipped_updates"], axis=1)

    def by_seed(values: Any, kind: Any) -> Any:
        return {
            str(seed): kind(value)
            for seed, value in zip(seeds, values, strict=True)
            if np.isfinite(value)
        }

    trained = {
        "compile_seconds": outcome.compile_seconds,
        "train_seconds": outcome.train_seconds,
        "env_steps_per_second": steps_per_second(
            outcome.new_steps, outcome.train_seconds
        ),
        "device": members.device_kind,
        "device_count": len(members.devices),
        "versions": metrics_files.versions(),
    }
    lengths = metrics_files.final_returns(metrics["episode_length"])
    finals = {"final_return": final, "final_length": lengths}
    if evaluations:
        finals["final_evaluation"] = evaluations["mean"][:, -1]
    if outcome.evaluation_seconds is not None:
        trained["evaluation_seconds"] = outcome.evaluation_seconds
    if not outcome.new_steps:
        trained = _recorded(folder / "summary.json", trained)
    summary = {
        "env": env_name,
        "agent": agent,
        "env_steps_per_seed": int(steps[-1]),
        **_by_seed_and_over_seeds(seeds, finals),
        "faulty_steps": by_seed(faulty, int),
        "skipped_updates": by_seed(skipped, int),
        "unhealthy_seeds": [
            seed for seed, bad in zip(seeds, (faulty > 0) | (skipped > 0)) if bad
        ],
        **trained,
    }
    metrics_files.write_json(folder / "summary.json", summary)
    return summary


def steps_per_second(steps: float, seconds: float) -> float | None:
    """Return the speed of training; None if it took no step."""
    return steps / (seconds or 1) or None


def speed_in_words(summary: Mapping[str, Any]) -> str:
    """Return what a command prints of the devices, and of the speed if it is known."""
    speed = summary["env_steps_per_second"]
    steps = "" if speed is None else f"{speed:,.0f} steps/s "
    return f"{steps}on {summary['device']}"


def _by_seed_and_over_seeds(
    seeds: Sequence[int], quantities: Mapping[str, np.ndarray]
) -> dict[str, Any]:
    """Return each quantity, (seeds,), by seed, and over seeds; NaN becomes None."""
    fields: dict[str, Any] = {}
    for name, values in quantities.items():
        finite = np.isfinite(values)
        fields[name] = {
            str(seed): float(value) if is_finite else None
            for seed, value, is_finite in zip(seeds, values, finite, strict=True)
        }
        mean = float(values[finite].mean()) if finite.any() else None
        estimate = statistics.estimate(values)
        fields[f"{name}_mean"] = mean
        fields[f"{name}_interquartile_mean"] = estimate.interquartile_mean
        fields[f"{name}_interval"] = estimate.interval
    return fields


class _Trained(TypedDict):
    """What summary.json says of the training."""

    compile_seconds: float
    train_seconds: float
    env_steps_per_second: float | None
    device: str
    device_count: int
    versions: dict[str, str | None]
    evaluation_seconds: NotRequired[float]


def _recorded(path: pathlib.Path, trained: dict[str, Any]) -> dict[str, Any]:
    """Return the same fields from the existing summary, or else as they are given."""
    try:
        before = json_reader.read(path, _Trained)
        return {name: before[name] for name in trained}
    except (OSError, ValueError, KeyError):
        return trained

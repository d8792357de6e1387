"""Read the tables of a run, and write its policies, learning curve and summary."""

import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from gasil_jax import statistics
from gasil_jax.figures import plotting
from gasil_jax.host import json_reader, metrics_files, output_file, policy_file
from gasil_jax.host.driver import Outcome
from gasil_jax.host.members import Members
from gasil_jax.host.metrics_files import SUMMARIZED, Columns


def read(folder: pathlib.Path, members: Members) -> tuple[Columns, Columns]:
    """Return the metrics and the scores of a run's seeds, (seeds, rows) each.

    The scores are none if nothing was evaluated.

    Raises:
      InputError: if a table is damaged.
    """
    labels, required = {"seed": members.seeds}, (*SUMMARIZED, "faulty_steps")
    metrics = metrics_files.read_metrics(folder / "metrics.csv", labels, required)
    path = folder / "evaluations.csv"
    if not path.exists() or path.stat().st_size == 0:
        return metrics, {}
    return metrics, metrics_files.read_metrics(path, labels, ("mean",))


def finish(
    folder: pathlib.Path, env_name: str, members: Members, outcome: Outcome
) -> tuple[tuple[Columns, Columns], dict[str, Any]]:
    """Write policy.npz, learning_curve.png and summary.json of a run that has ended.

    Returns:
      The tables of the run, and the summary.

    Raises:
      InputError: if a table is damaged.
      OSError: if the folder can no longer be written, or could not before.
    """
    metrics, evaluations = tables = read(folder, members)
    seeds, agent = members.seeds, members.algorithm.agent.name
    returns, steps = metrics["episode_return"], metrics["env_steps"][0]
    finals = metrics_files.finals(metrics, evaluations)
    # The policies come first, because a figure or a summary can be made again.
    policies, final = folder / "policy.npz", finals["final_return"]
    policy_file.save(policies, outcome.states, members.env, seeds, final)
    with output_file.atomic(folder / "learning_curve.png") as partial:
        plotting.learning_curve(
            partial,
            steps,
            returns,
            title=f"{env_name}, {agent}",
            evaluations=evaluations or None,
        )
    faults = {
        name: np.nansum(metrics[name], axis=1).astype(int)
        for name in ("faulty_steps", "skipped_updates")
    }
    summary = {
        "env": env_name,
        "agent": agent,
        "env_steps_per_seed": int(steps[-1]),
        **_by_seed_and_over_seeds(seeds, finals),
        **{name: dict(zip(map(str, seeds), x.tolist())) for name, x in faults.items()},
        "unhealthy_seeds": [
            seed for seed, *bad in zip(seeds, *faults.values(), strict=True) if any(bad)
        ],
        **_trained(folder / "summary.json", outcome.measured),
    }
    metrics_files.write_json(folder / "summary.json", summary)
    if outcome.unsaved is not None:
        raise outcome.unsaved
    return tables, summary


def _by_seed_and_over_seeds(
    seeds: Sequence[int], quantities: Mapping[str, np.ndarray]
) -> dict[str, Any]:
    """Return each quantity, (seeds,), by seed, and over seeds; NaN becomes None."""
    fields: dict[str, Any] = {}
    for name, values in quantities.items():
        finite = values[np.isfinite(values)]
        jsonable = [x if np.isfinite(x) else None for x in values.tolist()]
        fields[name] = dict(zip(map(str, seeds), jsonable, strict=True))
        fields[f"{name}_mean"] = float(finite.mean()) if finite.size else None
        estimate = statistics.estimate(values)
        fields[f"{name}_interquartile_mean"] = estimate.interquartile_mean
        fields[f"{name}_interval"] = estimate.interval
    return fields


def _trained(path: pathlib.Path, measured: Mapping[str, Any]) -> dict[str, Any]:
    """Return what summary.json says of the training: as before if it took no step."""
    trained = {**speed([measured]), "versions": measured["versions"]}
    if measured["env_steps"]:
        return trained
    try:
        before = json_reader.read(path, dict[str, Any])
        return {name: before[name] for name in trained}
    except (OSError, ValueError, KeyError):
        return trained


def speed(trainings: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the seconds, steps/s and devices of programs trained one after the other.

    It is told from the `driver.Outcome.measured` of each. For shards, which run in
    parallel, "env_steps_per_second" is the average speed of one shard; None if no step
    was taken. "evaluation_seconds" is included if policies were evaluated.
    """
    seconds = [f"{x}_seconds" for x in ("compile", "train", "evaluation")]
    if any(x.get("evaluation_seconds") is None for x in trainings):
        del seconds[-1]
    total = {name: sum(x[name] for x in trainings) for name in seconds}
    steps = sum(x["env_steps"] for x in trainings)
    return {
        **total,
        "env_steps_per_second": steps / (total["train_seconds"] or 1) or None,
        **joined([{"device": x["device"]} for x in trainings]),
        "device_count": max(x["device_count"] for x in trainings),
    }


def joined(records: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the common value of each field, or one string of all different values."""
    every = {name: {record.get(name) for record in records} for name in records[0]}
    return {
        name: values.pop() if len(values) == 1 else ", ".join(sorted(map(str, values)))
        for name, values in every.items()
    }


def speed_in_words(summary: Mapping[str, Any]) -> str:
    """Return what a command prints of the devices, and of the speed if it is known."""
    speed = summary["env_steps_per_second"]
    steps = "" if speed is None else f"{speed:,.0f} steps/s "
    return f"{steps}on {summary['device']}"

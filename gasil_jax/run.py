"""Train an agent: ``python -m gasil_jax.run --env walker2d --seeds 10``."""

import pathlib
import sys
from collections.abc import Mapping, Sequence
from typing import Any, NotRequired, TypedDict

import numpy as np

from gasil_jax.figures import plotting
from gasil_jax.host import (
    command_line,
    driver,
    json_reader,
    metrics_files,
    output_file,
    policy_file,
    run_folder,
)
from gasil_jax.host.members import Members
from gasil_jax.host.progress import announced
from gasil_jax.host.run_options import (
    Options,
    check,
    check_out,
    open_folder,
    parse,
    resumed_run,
    seeds_of,
    write_config,
)
from gasil_jax.sweeps import assembly, shards
from gasil_jax.sweeps.shards import Program


def train(
    options: Options, env: Any, program: Program, folder: pathlib.Path
) -> dict[str, Any]:
    """Train, log and save a run; return the summary.

    Raises:
      Interrupted: if a signal was received.
      OSError: if the folder can no longer be written.
      ValueError: if the run to continue does not fit the options.
    """
    write = lambda: write_config(options, folder)
    # A run that is continued keeps its config.json until its checkpoint is restored.
    if not run_folder.has_run(folder):
        write()
    title = f"{options.env} {options.agent}"
    labels = {"seed": seeds_of(options)}
    job = assembly.Job(program, folder, labels, folder.absolute().name)
    finished: list[tuple[Members, driver.Outcome]] = []
    assembly.train(
        options,
        env,
        [job],
        title=title,
        on_finished=lambda job, members, outcome: finished.append((members, outcome)),
        on_restored=write,
    )
    # Only now, when the progress display has ended.
    with announced(title, "writing the curve, the policies and the summary"):
        members, outcome = finished[0]
        summary = _write_results(options, env, folder, members=members, outcome=outcome)
    if outcome.unsaved is not None:
        raise outcome.unsaved
    return summary


def _write_results(
    options: Options,
    env: Any,
    folder: pathlib.Path,
    *,
    members: Members,
    outcome: driver.Outcome,
) -> dict[str, Any]:
    """Write the learning curve, the policies and the summary; return the summary."""
    seeds = seeds_of(options)
    read = lambda name, required: metrics_files.read_metrics(
        folder / name, ("seed",), options.seeds, required
    )
    metrics = read("metrics.csv", (*metrics_files.SUMMARIZED, "faulty_steps"))
    returns, steps = metrics["episode_return"], metrics["env_steps"][0]
    evaluations = None
    if options.evaluate_every is not None:
        evaluations = read("evaluations.csv", ("mean",))
    title = f"{options.env}, {options.agent}"
    with output_file.atomic(folder / "learning_curve.png") as partial:
        plotting.learning_curve(
            partial, steps, returns, title=title, evaluations=evaluations
        )
    final = metrics_files.final_returns(returns)
    policy_file.save(folder / "policy.npz", outcome.states, env, seeds, final)
    faulty = np.nansum(metrics["faulty_steps"], axis=1)
    skipped = np.nansum(metrics["skipped_updates"], axis=1)
    by_seed = lambda values, kind: {
        str(seed): kind(value)
        for seed, value in zip(seeds, values, strict=True)
        if np.isfinite(value)
    }
    trained = {
        "compile_seconds": outcome.compile_seconds,
        "train_seconds": outcome.train_seconds,
        "env_steps_per_second": outcome.new_steps / max(outcome.train_seconds, 1e-9),
        "device": members.device_kind,
        "device_count": len(members.devices),
        "versions": metrics_files.versions(),
    }
    lengths = metrics_files.final_returns(metrics["episode_length"])
    finals = {"final_return": final, "final_length": lengths}
    if evaluations is not None:
        finals["final_evaluation"] = evaluations["mean"][:, -1]
        trained["evaluation_seconds"] = outcome.evaluation_seconds
    if not outcome.new_steps:
        trained = _recorded(folder / "summary.json", trained)
    summary = {
        "env": options.env,
        "agent": options.agent,
        "env_steps_per_seed": int(steps[-1]),
        **_by_seed_and_mean(seeds, finals),
        "faulty_steps": by_seed(faulty, int),
        "skipped_updates": by_seed(skipped, int),
        "unhealthy_seeds": [
            seed for seed, bad in zip(seeds, (faulty > 0) | (skipped > 0)) if bad
        ],
        **trained,
    }
    metrics_files.write_json(folder / "summary.json", summary)
    return summary


def _by_seed_and_mean(
    seeds: Sequence[int], quantities: Mapping[str, np.ndarray]
) -> dict[str, Any]:
    """Return each quantity, (seeds,), by seed, and its mean; NaN becomes None."""
    fields: dict[str, Any] = {}
    for name, values in quantities.items():
        finite = np.isfinite(values)
        fields[name] = {
            str(seed): float(value) if is_finite else None
            for seed, value, is_finite in zip(seeds, values, finite, strict=True)
        }
        mean = float(values[finite].mean()) if finite.any() else None
        fields[f"{name}_mean"] = mean
    return fields


class _Trained(TypedDict):
    """What summary.json says of the training."""

    compile_seconds: float
    train_seconds: float
    env_steps_per_second: float
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


@command_line.reports_errors
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status."""
    options = parse(Options, arguments, "gasil_jax.run", resumed_run(arguments))
    check(options)
    check_out(options)
    # A run is a sweep of one point, in one program.
    programs = shards.programs(options.algorithm, [{}], seeds_of(options))
    env = assembly.prepare(options, programs, programs)
    with open_folder(options, "gasil_jax.run") as folder:
        summary = train(options, env, programs[0], folder)
    mean = summary["final_return_mean"]
    evaluated = ""
    if options.evaluate_every is not None:
        evaluated = (
            f"final evaluation {summary['final_evaluation_mean']:.1f} "
            f"({summary['evaluation_seconds']:,.0f} s of evaluations), "
        )
    print(
        f"final return {'unknown' if mean is None else format(mean, '.1f')} "
        f"(mean over {options.seeds} seed{'s' * (options.seeds > 1)}), {evaluated}"
        f"{summary['env_steps_per_second']:,.0f} steps/s on {summary['device']}, "
        f"in {folder}"
    )
    if summary["unhealthy_seeds"]:
        print(
            f"warning: numbers that were not finite in seeds "
            f"{summary['unhealthy_seeds']}: see faulty_steps (simulation) and "
            f"skipped_updates (learning) in {folder / 'summary.json'}",
            file=sys.stderr,
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""Plot one or several runs: ``python -m gasil_jax.plot RUN [RUN ...]``."""

import dataclasses
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from gasil_jax import statistics
from gasil_jax.cli.parsing import POSITIONAL
from gasil_jax.cli.parsing import read as read_options
from gasil_jax.cli.reporting import reports_errors
from gasil_jax.errors import InputError
from gasil_jax.host import output_file, plotting, results, saved, tables
from gasil_jax.host.plotting import COLORS
from gasil_jax.host.programs import Program

_STYLES = ("-", "--", "-.", ":")


@dataclasses.dataclass(frozen=True)
class Options:
    """Draw learning curves, final returns and performance profiles.

    Attributes:
      runs: folders of runs and sweeps. Each is a separate curve, even if they differ
        only in their seeds; a sweep over agents is one for each.
      point: number of a sweep's point in results.csv; default the one with the
        highest mean final return, of those whose seeds all stayed finite.
      out: image file to write: PNG, PDF or SVG.
      labels: labels of the runs; default "ENVIRONMENT, AGENT", and the folder of those
        that would look alike.
    """

    runs: tuple[pathlib.Path, ...] = dataclasses.field(metadata=POSITIONAL)
    point: int | None = None
    out: pathlib.Path = pathlib.Path("curves.png")
    labels: tuple[str, ...] = ()


class Curves(NamedTuple):
    """The curves of one run.

    Attributes:
      env: the environment's name.
      label: label in the legend.
      env_steps: (points,).
      returns: (seeds, points), mean return of the episodes since the previous point.
      final: (seeds,), mean return over the last tenth of training.
      evaluations: "env_steps" and "mean" of the evaluations during training, (seeds,
        evaluations) each; None if there are none.
    """

    env: str
    label: str
    env_steps: np.ndarray
    returns: np.ndarray
    final: np.ndarray
    evaluations: Mapping[str, np.ndarray] | None


def read(
    folder: pathlib.Path, label: str | None = None, point: int | None = None
) -> Curves:
    """Return the curves of a run, or of a sweep's point, which need not be finished."""
    env, agent, programs = saved.find(folder, point)
    metrics = _read_tables(programs, "metrics.csv", "episode_return")
    if not metrics:
        raise InputError(f"{folder} has no curves to draw yet")
    steps, returns = metrics["env_steps"][0], metrics["episode_return"]
    env_steps, means = plotting.binned_returns(steps, returns)
    if not len(env_steps):
        raise InputError(f"{folder}: not every seed has ended an episode")
    return Curves(
        env=env,
        label=label or f"{env}, {agent}",
        env_steps=env_steps,
        returns=means,
        final=tables.final_returns(returns),
        evaluations=_read_tables(programs, "evaluations.csv", "mean") or None,
    )


def _read_tables(
    programs: Sequence[Program], name: str, column: str
) -> dict[str, np.ndarray]:
    """Return columns of tables for all members, up to the last row that all have."""
    every = [own for each in programs for own in each.table(name, (column,))]
    if not all(every):
        return {}
    length = min(len(columns["env_steps"]) for columns in every)
    return {
        x: np.stack([columns[x][:length] for columns in every])
        for x in ("env_steps", column)
    }


def draw(runs: Sequence[Curves], path: pathlib.Path) -> None:
    """Write the figure: interquartile means over seeds, with their 95% intervals.

    Each environment has a row of three panels. The left one shows returns over
    environment steps, with evaluations dashed; the middle one final returns, with a dot
    for each seed; the right one the share of seeds above each final return.
    """
    from matplotlib.figure import Figure

    envs = list(dict.fromkeys(run.env for run in runs))
    figure = Figure(figsize=(13.0, 0.4 + 3.8 * len(envs)), layout="constrained")
    grid = figure.subplots(len(envs), 3, width_ratios=(3, 2, 2), squeeze=False)
    for row, env in zip(grid, envs, strict=True):
        _draw_row(row, [run for run in runs if run.env == env])
        for axes in row:
            axes.set_title(env)
    more = "; dots: the final return of each seed"
    plotting.write_caption(figure, [len(run.final) for run in runs], more)
    figure.savefig(path, dpi=150)


def _draw_row(row: Any, runs: Sequence[Curves]) -> None:
    """Draw the runs of one environment in its three panels."""
    curves, bars, profile = row
    every = np.concatenate([run.final for run in runs])
    # Matplotlib would read formulas between dollars. The title names the environment.
    labels = [run.label.removeprefix(f"{run.env}, ") for run in runs]
    labels = [label.replace("$", r"\$") for label in labels]
    # It would leave a label that begins with an underscore out of its legends.
    labels = [f" {label}" if label.startswith("_") else label for label in labels]
    margin = 0.05 * (np.ptp(every) or 1.0)
    levels = np.linspace(every.min() - margin, every.max() + margin, 200)
    for number, run in enumerate(runs):
        color = COLORS[number % len(COLORS)]
        style = _STYLES[number // len(COLORS) % len(_STYLES)]
        plotting.draw_returns(
            curves,
            run.env_steps,
            run.returns,
            evaluations=run.evaluations,
            color=color,
            label=labels[number],
            evaluated=f"{labels[number]}, evaluations",
            style=style,
        )
        middle, interval = statistics.estimate(run.final)
        if interval is not None:
            low, high = interval
            bars.barh(number, high - low, left=low, height=0.5, color=color, alpha=0.4)
        bars.plot([middle, middle], [number - 0.25, number + 0.25], color=color, lw=2)
        bars.plot(run.final, [number] * len(run.final), "o", color="0.3", ms=3)

        share = statistics.performance_profile(run.final, levels)
        profile.plot(levels, share, style, color=color, label=labels[number])
    if len(runs) > 1 or runs[0].evaluations is not None:
        curves.legend(frameon=False)
    if len(runs) > 1:
        profile.legend(frameon=False)
    bars.set_yticks(range(len(runs)), labels)
    # The first is at the top, and no dot lies on the frame.
    bars.set(ylim=(len(runs) - 0.5, -0.5), xlim=(levels[0], levels[-1]))
    bars.set(xlabel="final return")
    profile.set(xlabel="final return", ylabel="share of seeds above", ylim=(0, 1.03))


@reports_errors
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status."""
    options = read_options(Options, arguments, "gasil_jax.plot")
    labels = options.labels or (None,) * len(options.runs)
    if not options.runs:
        raise InputError("runs is empty: name one folder or more")
    if len(labels) != len(options.runs):
        raise InputError(
            f"labels has {len(labels)} names: it must have one for each of the "
            f"{len(options.runs)} runs"
        )
    output_file.check(options.out, (".png", ".pdf", ".svg"))
    read_of: list[tuple[pathlib.Path, Curves]] = []
    for folder, label in zip(options.runs, labels, strict=True):
        best = results.best_of_agents(folder) if options.point is None else {}
        points: list[tuple[str | None, int | None]] = [*best.items()]
        for agent, point in points or [(None, options.point)]:
            own = f"{label}, {agent}" if label and agent else label
            read_of.append((folder, read(folder, own, point)))
    told = [run.label for _, run in read_of]
    runs = [
        run
        if told.count(run.label) == 1
        else run._replace(label=f"{run.label} ({folder})")
        for folder, run in read_of
    ]
    output_file.make_parent(options.out)
    with output_file.atomic(options.out) as partial:
        draw(runs, partial)
    print("run                             seeds  interquartile mean [95% interval]")
    for run in runs:
        estimate = statistics.estimate(run.final)
        print(f"{run.label:30} {len(run.final):6}  {estimate}")
    print(f"in {options.out}")
    return 0

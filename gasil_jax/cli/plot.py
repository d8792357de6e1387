"""Plot one or several runs: ``python -m gasil_jax.plot RUN [RUN ...]``."""

import csv
import dataclasses
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from gasil_jax import statistics
from gasil_jax.cli.parsing import POSITIONAL
from gasil_jax.cli.parsing import read as read_options
from gasil_jax.cli.reporting import reports_errors
from gasil_jax.errors import InputError, refusal, unknown
from gasil_jax.host import folders, output_file, plotting, results, saved, tables
from gasil_jax.host.plotting import COLORS
from gasil_jax.host.programs import Program

_STYLES = ("-", "--", "-.", ":")


@dataclasses.dataclass(frozen=True)
class Options:
    """Draw learning curves, final returns and performance profiles.

    Attributes:
      runs: folders of runs and sweeps, each a curve of its own, and a sweep over agents
        one for each agent; and CSV files of other libraries, or folders of them with
        one for each seed (see columns).
      point: number of a sweep's point in results.csv; default the one with the
        highest mean final return, of those whose seeds all stayed finite.
      out: image file to write: PNG, PDF or SVG.
      labels: labels of the runs; default "ENVIRONMENT, AGENT", and the folder of those
        that would look alike.
      metric: column of metrics.csv to draw.
      x: what is on the x axis.
      smooth: number of the 50 parts of training whose moving mean is drawn.
      columns: of CSV files the columns of x and of the return; "sum:" before a name
        adds its numbers up. For Stable-Baselines3 "time/total_timesteps
        rollout/ep_rew_mean" (progress.csv) or "sum:l r" (monitor.csv), for CleanRL
        "global_step charts/episodic_return".
    """

    runs: tuple[pathlib.Path, ...] = dataclasses.field(metadata=POSITIONAL)
    point: int | None = None
    out: pathlib.Path = pathlib.Path("curves.png")
    labels: tuple[str, ...] = ()
    metric: str = "episode_return"
    x: Literal["env_steps", "iteration", "episodes"] = "env_steps"
    smooth: int = 1
    columns: tuple[str, ...] = ()


class Curves(NamedTuple):
    """The curves of one run."""

    env: str  # the environment's name; empty if a file does not say it
    label: str  # label in the legend
    env_steps: np.ndarray  # (points,), or what else is on the x axis
    # (seeds, points), mean return of the episodes since the previous point.
    returns: np.ndarray
    final: np.ndarray  # (seeds,), mean return over the last tenth of training
    # "env_steps" and "mean" of the evaluations during training, (seeds, evaluations)
    # each; None if there are none.
    evaluations: Mapping[str, np.ndarray] | None


def read(
    folder: pathlib.Path,
    label: str | None = None,
    point: int | None = None,
    *,
    metric: str = "episode_return",
    x: str = "env_steps",
) -> Curves:
    """Return the curves of a run, or of a sweep's point, which need not be finished."""
    env, agent, programs = saved.find(folder, point)
    metrics = _read_tables(programs, "metrics.csv", metric, "episodes")
    if not metrics:
        raise InputError(f"{folder} has no curves to draw yet")
    values = metrics[metric]
    on_axis = {
        "env_steps": metrics["env_steps"][0],
        "iteration": np.arange(1, values.shape[1] + 1),
        "episodes": np.nancumsum(metrics["episodes"], axis=1).mean(axis=0),
    }
    env_steps, means = plotting.binned_returns(on_axis[x], values)
    if not len(env_steps):
        raise InputError(f"{folder}: not every seed has ended an episode")
    # Evaluations know the steps and the return alone.
    evaluations: Mapping[str, np.ndarray] = {}
    if (metric, x) == ("episode_return", "env_steps"):
        evaluations = _read_tables(programs, "evaluations.csv", "mean")
    return Curves(
        env=env,
        label=label or f"{env}, {agent}",
        env_steps=env_steps,
        returns=means,
        final=tables.final_returns(values),
        evaluations=evaluations or None,
    )


def _read_tables(
    programs: Sequence[Program], name: str, column: str, *others: str
) -> dict[str, np.ndarray]:
    """Return steps and columns for all members, up to the last row that all have."""
    required = (column,) if column in (*tables.COLUMNS, "mean") else ()
    every = [own for each in programs for own in each.table(name, required)]
    if not all(every):
        return {}
    if column not in every[0]:
        raise InputError(unknown("metric", column, [*every[0]]))
    length = min(len(columns["env_steps"]) for columns in every)
    return {
        x: np.stack([columns[x][:length] for columns in every])
        for x in ("env_steps", column, *others)
    }


def read_csv(path: pathlib.Path, label: str | None, columns: Sequence[str]) -> Curves:
    """Return the curves of another library's CSV file, or of a folder of them."""
    if len(columns) != 2:
        raise InputError(
            f"columns has {len(columns)} names: {path} needs two, of x and the return"
        )
    try:
        seeds = [
            _read_numbers(x, columns) for x in sorted(path.glob("*.csv")) or [path]
        ]
        # All seeds at the steps of the one with the fewest rows, as far as all reach.
        steps = min((own for own, _ in seeds), key=len)
        steps = steps[steps <= min(own[-1] for own, _ in seeds)]
        if not steps.size:
            raise ValueError(f"no {columns[0]} is in all its files")
        values = np.array([np.interp(steps, own, y) for own, y in seeds])
        env_steps, means = plotting.binned_returns(steps, values)
    except (OSError, ValueError, csv.Error) as error:
        raise InputError(f"{path} can't be drawn: {error}") from None
    final = tables.final_returns(values)
    return Curves("", label or path.stem, env_steps, means, final, None)


def _read_numbers(path: pathlib.Path, columns: Sequence[str]) -> list[np.ndarray]:
    """Return two columns of a CSV file, without rows that lack a number of either."""
    # Stable-Baselines3's monitor begins with a comment.
    lines = [x for x in path.read_text().splitlines() if not x.startswith("#")]
    table = csv.DictReader(lines)
    names = [x.removeprefix("sum:") for x in columns]
    for name in names:
        if name not in (there := table.fieldnames or ()):
            raise ValueError(unknown("column", name, there))
    numbers = [[float(row[x] or "nan") for x in names] for row in table]
    rows = np.array(numbers).reshape(-1, len(names))
    rows = rows[np.isfinite(rows).all(axis=1)]
    both = [
        np.cumsum(own) if name.startswith("sum:") else own
        for name, own in zip(columns, rows.T, strict=True)
    ]
    if not rows.size or (np.diff(both[0]) < 0.0).any():
        raise ValueError(f"{columns[0]} must have numbers that do not fall")
    return both


def draw(
    runs: Sequence[Curves],
    path: pathlib.Path,
    *,
    metric: str = "episode_return",
    x: str = "env_steps",
) -> None:
    """Draw each environment's returns, final returns and performance profiles."""
    from matplotlib.figure import Figure

    envs = list(dict.fromkeys(run.env for run in runs))
    figure = Figure(figsize=(13.0, 0.4 + 3.8 * len(envs)), layout="constrained")
    grid = figure.subplots(len(envs), 3, width_ratios=(3, 2, 2), squeeze=False)
    for row, env in zip(grid, envs, strict=True):
        own = [run for run in runs if run.env == env]
        _draw_row(row, own, x)
        words = metric.replace("_", " ")
        row[0].set_ylabel(words)
        for axes in row[1:]:
            axes.set_xlabel(f"final {words.removeprefix('episode ')}")
        for axes in row:
            axes.set_title(env if len(own) > 1 else own[0].label)
    more = "; dots: the final return of each seed"
    plotting.write_caption(figure, [len(run.final) for run in runs], more)
    figure.savefig(path, dpi=150)


def _draw_row(row: Any, runs: Sequence[Curves], x: str) -> None:
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
    unit, words = 1.0, x
    if x == "env_steps":
        unit, words = plotting.unit_of_steps(max(run.env_steps[-1] for run in runs))
    curves.set_xlabel(words)
    for number, run in enumerate(runs):
        color = COLORS[number % len(COLORS)]
        style = _STYLES[number // len(COLORS) % len(_STYLES)]
        plotting.draw_returns(
            curves,
            run.env_steps,
            run.returns,
            unit=unit,
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
    profile.set(ylabel="share of seeds above", ylim=(0, 1.03))
    for axes in (curves, profile):
        plotting.plain_ticks(axes)
    bars.ticklabel_format(axis="x", useOffset=False, style="plain")
    bars.locator_params(axis="x", nbins=5)


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
    if options.smooth < 1:
        raise refusal("smooth", options.smooth, "1 or more")
    output_file.check(options.out, (".png", ".pdf", ".svg"))
    drawn = {"metric": options.metric, "x": options.x}
    runs, sources = [], []
    for folder, label in zip(options.runs, labels, strict=True):
        foreign = options.columns and not folders.has_config(folder)
        if foreign or folder.suffix == ".csv":
            runs.append(read_csv(folder, label, options.columns))
            sources.append(folder)
            continue
        best = {} if options.point is not None else results.best_points(folder)[1]
        several = {x: y for x, y in best.items() if y is not None and len(best) > 1}
        for agent, point in several.items() or [("", options.point)]:
            own = f"{label}, {agent}" if label and agent else label
            runs.append(read(folder, own, point, **drawn))
            sources.append(folder)
    told = [run.label for run in runs]
    # A file does not say its environment: it stands beside the first run.
    env = next((run.env for run in runs if run.env), "")
    runs = [
        run._replace(
            env=run.env or env,
            label=f"{run.label} ({folder})" if told.count(run.label) > 1 else run.label,
            returns=plotting.smoothed(run.returns, options.smooth),
        )
        for folder, run in zip(sources, runs, strict=True)
    ]
    output_file.make_parent(options.out)
    with output_file.atomic(options.out) as partial:
        draw(runs, partial, **drawn)
    print("run                             seeds  interquartile mean [95% interval]")
    for run in runs:
        estimate = statistics.estimate(run.final)
        print(f"{run.label:30} {len(run.final):6}  {estimate}")
    print(f"in {options.out}")
    return 0

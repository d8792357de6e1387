"""Plot one or several runs: ``python -m gasil_jax.plot RUN [RUN ...]``."""

import dataclasses
import pathlib
import sys
from collections.abc import Mapping, Sequence
from typing import Annotated, NamedTuple

import numpy as np
import tyro

from gasil_jax.errors import InputError
from gasil_jax.figures import plotting, statistics
from gasil_jax.figures.plotting import COLORS
from gasil_jax.figures.statistics import final_returns
from gasil_jax.host import command_line, metrics_files, output_file, run_folder

_STYLES = ("-", "--", "-.", ":")


@dataclasses.dataclass(frozen=True)
class Options:
    """Draw learning curves, final returns and performance profiles.

    Attributes:
      runs: folders of the runs; each is a curve of its own, even if they differ only
        in their seeds.
      out: image file to write: PNG, PDF or SVG.
      labels: labels of the runs; default environment and agent.
    """

    runs: Annotated[tuple[pathlib.Path, ...], tyro.conf.Positional]
    out: pathlib.Path = pathlib.Path("curves.png")
    labels: tuple[str, ...] = ()


class Curves(NamedTuple):
    """The curves of one run.

    Attributes:
      label: label in the legend.
      env_steps: (points,).
      returns: (seeds, points), mean return of the episodes since the previous point.
      final: (seeds,), mean return over the last tenth of training.
      evaluations: "env_steps" and "mean" of the evaluations during training, (seeds,
        evaluations) each; None if there are none.
    """

    label: str
    env_steps: np.ndarray
    returns: np.ndarray
    final: np.ndarray
    evaluations: Mapping[str, np.ndarray] | None


_POINTS = 50


def read(folder: pathlib.Path, label: str | None = None) -> Curves:
    """Return the curves of a run, which need not be finished.

    Raises:
      InputError: if it is not the folder of a run, or if no episode has ended in it.
    """
    described = run_folder.read(folder)
    if "points" in described:
        raise InputError(
            f"run is {folder}, a sweep: its plot is sweep.png, and its curves are in "
            "curves.npz"
        )
    read_table = lambda name, column: metrics_files.read_metrics(
        folder / name, ("seed",), described["seeds"], (column,)
    )
    evaluations, path = None, folder / "evaluations.csv"
    # The file may still be empty.
    if path.is_file() and path.stat().st_size:
        evaluations = read_table("evaluations.csv", "mean")
    path = folder / "metrics.csv"
    if not (path.is_file() and path.stat().st_size):
        raise InputError(f"{path} has no curves to draw yet")
    metrics = read_table("metrics.csv", "episode_return")
    steps, returns = metrics["env_steps"][0], metrics["episode_return"]
    count = min(_POINTS, len(steps))
    # Training is divided into this many equal parts.
    parts = np.array_split(np.arange(len(steps)), count)
    mean = lambda x: np.array([row[np.isfinite(row)].mean() for row in x])
    complete = [p for p in parts if np.isfinite(returns[:, p]).any(axis=1).all()]
    if not complete:
        raise InputError(f"{path}: not every seed has ended an episode")
    default = f"{described['env']}, {described['config'].agent}"
    return Curves(
        label=label or default,
        env_steps=np.array([steps[p[-1]] for p in complete]),
        returns=np.stack([mean(returns[:, p]) for p in complete], axis=1),
        final=final_returns(returns),
        evaluations=evaluations,
    )


def draw(runs: Sequence[Curves], path: pathlib.Path) -> None:
    """Write the figure: interquartile means over seeds, with 95% intervals.

    The left panel shows returns over environment steps, with evaluations dashed. The
    middle panel shows final returns, with a dot for each seed. The right panel shows
    the share of seeds above each final return.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (curves, bars, profile) = plt.subplots(
        1, 3, figsize=(13.0, 4.0), layout="constrained", width_ratios=(3, 2, 2)
    )
    every = np.concatenate([run.final for run in runs])
    # Matplotlib would read formulas between dollars.
    labels = [run.label.replace("$", r"\$") for run in runs]
    margin = 0.05 * (np.ptp(every) or 1.0)
    levels = np.linspace(every.min() - margin, every.max() + margin, 200)
    for number, run in enumerate(runs):
        color = COLORS[number % len(COLORS)]
        style = _STYLES[number // len(COLORS) % len(_STYLES)]
        low, high = statistics.bootstrap_interval(run.returns)
        middle = statistics.interquartile_mean(run.returns, axis=0)
        curves.fill_between(run.env_steps, low, high, color=color, alpha=0.2, lw=0)
        curves.plot(run.env_steps, middle, style, color=color, label=labels[number])
        if run.evaluations is not None:
            steps = run.evaluations["env_steps"][0]
            middle = statistics.interquartile_mean(run.evaluations["mean"], axis=0)
            label = f"{labels[number]}, evaluations"
            curves.plot(steps, middle, "--", color=color, lw=1, label=label)

        low, high = statistics.bootstrap_interval(run.final)
        middle = statistics.interquartile_mean(run.final)
        bars.barh(number, high - low, left=low, height=0.5, color=color, alpha=0.4)
        bars.plot([middle, middle], [number - 0.25, number + 0.25], color=color, lw=2)
        bars.plot(run.final, [number] * len(run.final), "o", color="0.3", ms=3)

        share = statistics.performance_profile(run.final, levels)
        profile.plot(levels, share, style, color=color)
    curves.set(xlabel="environment steps", ylabel="episode return")
    curves.legend(frameon=False)
    bars.set_yticks(range(len(runs)), labels)
    bars.invert_yaxis()
    bars.set(xlabel="final return")
    profile.set(xlabel="final return", ylabel="share of seeds above", ylim=(0, 1.03))
    plotting.save(figure, path, dpi=150)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status."""
    return command_line.exit_status(lambda: _main(arguments))


def _main(arguments: Sequence[str] | None) -> None:
    options = command_line.parse(Options, arguments, "gasil_jax.plot")
    labels = options.labels or (None,) * len(options.runs)
    if not options.runs:
        raise InputError("runs is empty: name one folder or more")
    if len(labels) != len(options.runs):
        raise InputError(f"labels are {len(labels)}: runs are {len(options.runs)}")
    output_file.check(options.out, (".png", ".pdf", ".svg"))
    runs = [read(*pair) for pair in zip(options.runs, labels, strict=True)]
    output_file.make_parent(options.out)
    with output_file.whole(options.out) as partial:
        draw(runs, partial)
    print("run                             seeds  interquartile mean  95% interval")
    for run in runs:
        low, high = statistics.bootstrap_interval(run.final)
        middle = statistics.interquartile_mean(run.final)
        interval = f"{low:.1f} to {high:.1f}"
        print(f"{run.label:30} {len(run.final):6} {middle:19.1f}  {interval}")
    print(f"in {options.out}")


if __name__ == "__main__":
    sys.exit(main())

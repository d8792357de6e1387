"""An experiment's figure and page, from its trials' CSV files and nothing else."""

import dataclasses
import math
import pathlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from experiments import trials
from experiments.trials import Results, Trial
from gasil_jax import plot, plotting, statistics


@dataclasses.dataclass(frozen=True)
class Figure:
    """What an experiment shows.

    Attributes:
      name: of its folder and files.
      title: of the page.
      claim: what the paper says.
      favourite: the curve that the claim is about; compared with each other curve of
        its panel. None where the claim is about the order of all.
      conclude: from panel -> curve -> results to what they say of the claim; default
        `tally` of the favourite.
      more: what else the page says: what was tried where the claim does not hold.
    """

    name: str
    title: str
    claim: str
    favourite: str | None = "ppo+gasil"
    conclude: Callable[[Mapping[str, Mapping[str, Results]]], str] | None = None
    more: str = ""

    def conclusions(self, shown: Mapping[str, Mapping[str, Results]]) -> str:
        """What the results say of the claim, Markdown."""
        if self.conclude is not None:
            return self.conclude(shown)
        return tally(shown, self.favourite) if self.favourite else ""


def difference(ours: np.ndarray, other: np.ndarray) -> tuple[float, float, float]:
    """Of the interquartile means of two sets of seeds: it and its 95% interval.

    Percentile bootstrap; each side's seeds, (seeds,), are drawn for themselves.
    """
    rng = np.random.default_rng(0)
    drawn = _resampled(ours, rng) - _resampled(other, rng)
    low, high = np.percentile(drawn, [2.5, 97.5])
    mean = statistics.interquartile_mean
    return float(mean(ours) - mean(other)), float(low), float(high)


def _resampled(scores: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Interquartile means of bootstrap draws of (seeds,): (draws,)."""
    rows = rng.integers(len(scores), size=(10_000, len(scores)))
    return np.asarray(statistics.interquartile_mean(scores[rows], axis=1))


def together(
    pairs: Sequence[tuple[np.ndarray, np.ndarray]],
) -> tuple[float, float, float]:
    """Mean over tasks of a difference as a share of the other's, and 95% interval.

    Interquartile means; the bootstrap draws the seeds of each task and side anew.

    Args:
      pairs: scores (seeds,) of ours and of the other, for each task; the other's
        interquartile means are above 0.
    """
    rng = np.random.default_rng(0)
    mean = statistics.interquartile_mean
    shares, drawn = [], []
    for ours, other in pairs:
        base = mean(other)
        shares.append((mean(ours) - base) / base)
        drawn.append((_resampled(ours, rng) - _resampled(other, rng)) / base)
    low, high = np.percentile(np.mean(drawn, axis=0), [2.5, 97.5])
    return float(np.mean(shares)), float(low), float(high)


def verdict(low: float, high: float) -> str:
    """Whether a difference is above 0, by its interval."""
    if math.isnan(low) or math.isnan(high):
        return "unknown"
    return "yes" if low > 0 else "no, it is lower" if high < 0 else "not clear"


def panels(
    wanted: Sequence[Trial], results: pathlib.Path
) -> dict[str, dict[str, Results]]:
    """Panel -> curve -> results, of the trials that have some."""
    found: dict[str, dict[str, Results]] = {}
    for trial in wanted:
        panel, curve = trial.name.split("/")
        if (known := trials.read(trial, results)) is not None:
            found.setdefault(panel, {})[curve] = known
    return found


def _number(value: float) -> str:
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.1f}"


def interval(scores: np.ndarray) -> str:
    """Interquartile mean and interval of (seeds,), without seeds that never ended."""
    middle = float(statistics.interquartile_mean(scores))
    low, high = statistics.bootstrap_interval(scores)
    return f"{_number(middle)} [{_number(float(low))}, {_number(float(high))}]"


def table(shown: Mapping[str, Mapping[str, Results]], favourite: str | None) -> str:
    """The final returns as Markdown: a row for each panel and curve."""
    lines = [
        "| task | agent | seeds | final return, interquartile mean [95%] |"
        + (" favourite better by [95%] | better? |" if favourite else ""),
        "|---|---|---|---|" + ("---|---|" if favourite else ""),
    ]
    for panel, curves in shown.items():
        for curve, known in curves.items():
            scores = known.final[0]
            cells = [panel, curve, str(len(scores)), interval(scores)]
            if favourite:
                cells += ["", ""]
                if curve != favourite and favourite in curves:
                    middle, low, high = difference(curves[favourite].final[0], scores)
                    cells[-2:] = [
                        f"{_number(middle)} [{_number(low)}, {_number(high)}]",
                        verdict(low, high),
                    ]
            lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def tally(shown: Mapping[str, Mapping[str, Results]], favourite: str) -> str:
    """On how many tasks the favourite is better than each other, and over all."""
    lines = []
    others = dict.fromkeys(
        curve for curves in shown.values() for curve in curves if curve != favourite
    )
    for other in others:
        pairs = [
            (curves[favourite].final[0], curves[other].final[0])
            for curves in shown.values()
            if favourite in curves and other in curves
        ]
        said = [verdict(*difference(*pair)[1:]) for pair in pairs]
        counts = ", ".join(
            f"{word} on {said.count(word)}"
            for word in ("yes", "not clear", "no, it is lower", "unknown")
            if word in said
        )
        if not said:
            continue
        line = f"- {favourite} better than {other}: {counts} of {len(said)}"
        if len(pairs) > 1 and all(
            statistics.interquartile_mean(scores) > 0 for _, scores in pairs
        ):
            middle, low, high = together(pairs)
            line += (
                f"; over all of them {100 * middle:+.0f}% [{100 * low:.0f}, "
                f"{100 * high:.0f}], {verdict(low, high)}"
            )
        lines.append(f"{line}.")
    return "\n".join(lines)


def gaps(shown: Mapping[str, Mapping[str, Results]], favourite: str, other: str) -> str:
    """How far the favourite is ahead in each panel, and whether by more than in the
    first, where every difference is one of interquartile means.
    """
    both = {
        panel: (curves[favourite].final[0], curves[other].final[0])
        for panel, curves in shown.items()
        if favourite in curves and other in curves
    }
    if not both:
        return ""
    mean = statistics.interquartile_mean
    rng = np.random.default_rng(0)
    middle = {name: float(mean(x) - mean(y)) for name, (x, y) in both.items()}
    drawn = {
        name: _resampled(x, rng) - _resampled(y, rng) for name, (x, y) in both.items()
    }
    first = next(iter(both))
    within = lambda draws: np.percentile(draws, [2.5, 97.5])
    said = lambda value, low, high: (
        f"{_number(value)} [{_number(low)}, {_number(high)}]"
    )
    lines = [
        f"- {first}: {favourite} ahead of {other} by "
        f"{said(middle[first], *within(drawn[first]))}."
    ]
    for panel in list(both)[1:]:
        growth = within(drawn[panel] - drawn[first])
        lines.append(
            f"- {panel}: by {said(middle[panel], *within(drawn[panel]))}; more than at "
            f"{first} by {said(middle[panel] - middle[first], *growth)}: "
            f"{verdict(*growth)}."
        )
    return "\n".join(lines)


def optimum(shown: Mapping[str, Mapping[str, Results]]) -> str:
    """Of panels whose curves are values in order: the best, against both ends."""
    lines = []
    for panel, curves in shown.items():
        names = list(curves)
        score = lambda name: float(
            statistics.interquartile_mean(curves[name].final[0])  # noqa: B023
        )
        best = max(names, key=score)
        against = [
            f"better than {end}: "
            + verdict(*difference(curves[best].final[0], curves[end].final[0])[1:])
            for end in (names[0], names[-1])
            if end != best
        ]
        place = "at an end" if best in (names[0], names[-1]) else "in the middle"
        lines.append(f"- {panel}: {best} is best, {place}; {', '.join(against)}.")
    return "\n".join(lines)


def settings_table(shown: Mapping[str, Mapping[str, Results]]) -> str:
    """What each curve was trained with, beyond the appendix's defaults."""
    lines = ["| task | agent | hyperparameters | trained with |", "|---|---|---|---|"]
    for panel, curves in shown.items():
        for curve, known in curves.items():
            point = known.trial.points[0]
            values = [f"{name} {value:g}" for name, value in point.items()]
            if known.trial.num_envs != trials.NUM_ENVS:
                values.append(f"{known.trial.num_envs} environments")
            made = {
                f"{made['physics']} physics, jax {made['versions'].get('jax', '?')}, "
                f"commit {made['commit'] or 'unknown'}"
                for made in known.made
            }
            made_by = "; ".join(sorted(made))
            lines.append(
                f"| {panel} | {curve} | {', '.join(values) or 'defaults'} | {made_by} |"
            )
    return "\n".join(lines)


def draw(shown: Mapping[str, Mapping[str, Results]], path: pathlib.Path) -> None:
    """Learning curves, a panel each: interquartile mean and 95% interval over seeds."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    columns = min(3, len(shown))
    rows = math.ceil(len(shown) / columns)
    figure, grid = plt.subplots(
        rows,
        columns,
        figsize=(4.2 * columns, 3.2 * rows),
        layout="constrained",
        squeeze=False,
    )
    for axes, (panel, curves) in zip(grid.flat, shown.items()):
        color_of = _colors(list(curves))
        for curve, known in curves.items():
            color = color_of[curve]
            some = np.isfinite(known.returns[0]).all(axis=0)
            returns = known.returns[0][:, some]
            steps = known.env_steps[some] / 1e6
            low, high = statistics.bootstrap_interval(returns, resamples=500)
            axes.fill_between(steps, low, high, color=color, alpha=0.2, linewidth=0)
            middle = statistics.interquartile_mean(returns, axis=0)
            axes.plot(steps, middle, color=color, label=curve)
        axes.set(title=panel, xlabel="million steps")
        axes.legend(frameon=False, fontsize=7)
    for axes in grid.flat[len(shown) :]:
        axes.set_visible(False)
    for row in grid:
        row[0].set_ylabel("episode return")
    plotting.save(figure, path, dpi=90)


def _colors(curves: Sequence[str]) -> dict[str, Any]:
    """An agent's is the same in every figure; values in order go from dark to light."""
    import matplotlib

    if set(curves) <= set(trials.AGENTS):
        return dict(zip(trials.AGENTS, plot.COLORS, strict=False))
    shades = matplotlib.colormaps["viridis"](np.linspace(0.0, 0.9, len(curves)))
    return dict(zip(curves, shades, strict=True))


def page(figure: Figure, shown: Mapping[str, Mapping[str, Results]]) -> str:
    """The experiment's page, Markdown."""
    parts = [
        f"# {figure.title}",
        f"**The paper's claim.** {figure.claim}",
        f"![learning curves]({figure.name}.png)",
        "Final return is the mean over the last tenth of training of the episodes "
        "that the acting policy ended. Intervals are percentile bootstraps over "
        'seeds; "better?" says "yes" where the 95% interval of the difference of '
        'interquartile means is above 0. "Over all of them" is the mean over tasks of '
        "that difference as a share of the other agent's.",
        table(shown, figure.favourite),
        figure.conclusions(shown),
        figure.more,
        "## Settings",
        "What differs from the appendix's defaults; the raw numbers are in the "
        f"CSV files under `{figure.name}/`, and `python -m experiments.{figure.name} "
        "--report` makes this page from them.",
        settings_table(shown),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def write(figure: Figure, wanted: Sequence[Trial], results: pathlib.Path) -> None:
    """Write the page and the figure of what there is."""
    shown = panels(wanted, results / figure.name)
    if not shown:
        return
    draw(shown, results / f"{figure.name}.png")
    (results / f"{figure.name}.md").write_text(page(figure, shown))

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
from gasil_jax.points import Point


@dataclasses.dataclass(frozen=True)
class Figure:
    """What an experiment shows.

    Attributes:
      name: of its folder and files.
      title: of the page.
      claim: what the paper says.
      favourite: the curve that the claim is about; compared with each other curve of
        its panel. None where the claim is about the order of all.
      conclude: from panel -> curve -> results, those with all their seeds, to what
        they say of the claim; default `tally` of the favourite.
      more: what else the page says: what was tried where the claim does not hold.
      gather: from trials and the folder of all results, to panel -> curve -> results
        of what is shown; default the trials' own.
    """

    name: str
    title: str
    claim: str
    favourite: str | None = "ppo+gasil"
    conclude: Callable[[Mapping[str, Mapping[str, Results]]], str] | None = None
    more: str = ""
    gather: (
        Callable[[Sequence[Trial], pathlib.Path], dict[str, dict[str, Results]]] | None
    ) = None

    def shown(
        self, wanted: Sequence[Trial], results: pathlib.Path
    ) -> dict[str, dict[str, Results]]:
        """Panel -> curve -> results, of what is there of trials."""
        if self.gather is not None:
            return self.gather(wanted, results)
        return panels(wanted, results / self.name)

    def conclusions(self, shown: Mapping[str, Mapping[str, Results]]) -> str:
        """What the results that have all their seeds say of the claim, Markdown."""
        shown = complete(shown)
        if self.conclude is not None:
            return self.conclude(shown)
        return tally(shown, self.favourite) if self.favourite else ""


def complete(
    shown: Mapping[str, Mapping[str, Results]],
) -> dict[str, dict[str, Results]]:
    """Of panel -> curve -> results those that have all their seeds."""
    return {
        panel: {name: known for name, known in curves.items() if known.complete}
        for panel, curves in shown.items()
    }


def difference(
    ours: np.ndarray, other: np.ndarray, comparisons: int = 1
) -> tuple[float, float, float]:
    """Of the interquartile means of two sets of seeds: it and its 95% interval.

    Args:
      ours: (seeds,).
      other: (seeds,).
      comparisons: of how many this is one: the intervals of all of them hold together
        with 95% (Bonferroni).
    """
    return contrast(((1, ours), (-1, other)), comparisons)


def contrast(
    terms: Sequence[tuple[float, np.ndarray]], comparisons: int = 1
) -> tuple[float, float, float]:
    """A weighted sum of interquartile means, and its 95% interval.

    Percentile bootstrap; each term's seeds, (seeds,), are drawn for themselves.

    Args:
      terms: weight and scores of each.
      comparisons: as in `difference`.
    """
    rng = np.random.default_rng(0)
    drawn = sum(weight * _resampled(scores, rng) for weight, scores in terms)
    tail = 2.5 / comparisons
    low, high = np.percentile(drawn, [tail, 100.0 - tail])
    mean = statistics.interquartile_mean
    return float(sum(x * mean(scores) for x, scores in terms)), float(low), float(high)


def _resampled(scores: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Interquartile means of bootstrap draws of (seeds,): (draws,)."""
    rows = rng.integers(len(scores), size=(10_000, len(scores)))
    return np.asarray(statistics.interquartile_mean(scores[rows], axis=1))


def together(
    pairs: Sequence[tuple[np.ndarray, np.ndarray]],
) -> tuple[float, float, float]:
    """By what share ours is more, over several tasks alike, and the 95% interval.

    The geometric mean over tasks of the ratio of interquartile means, less one; the
    bootstrap draws the seeds of each task and side anew.

    Args:
      pairs: scores (seeds,) of ours and of the other, for each task, all above 0.
    """
    rng = np.random.default_rng(0)
    mean = statistics.interquartile_mean
    found = [np.log(mean(ours) / mean(other)) for ours, other in pairs]
    drawn = [np.log(_resampled(x, rng) / _resampled(y, rng)) for x, y in pairs]
    low, high = np.percentile(np.mean(drawn, axis=0), [2.5, 97.5])
    middle, low, high = np.expm1([np.mean(found), low, high])
    return float(middle), float(low), float(high)


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


#: An interval of fewer seeds than this covers far less than it says.
_FEWEST_SEEDS = 5


def interval(scores: np.ndarray) -> str:
    """Interquartile mean and interval of (seeds,); NaN if a seed ended no episode.

    Of fewer than five seeds the mean alone.
    """
    middle = float(statistics.interquartile_mean(scores))
    if len(scores) < _FEWEST_SEEDS:
        return _number(middle)
    low, high = statistics.bootstrap_interval(scores)
    return said(middle, float(low), float(high))


def said(middle: float, low: float, high: float) -> str:
    """A number and its interval."""
    return f"{_number(middle)} [{_number(low)}, {_number(high)}]"


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
            seeds = str(len(scores))
            if not known.complete:
                seeds += f" of {known.trial.seeds}"
            cells = [panel, curve, seeds, interval(scores)]
            if favourite:
                cells += ["", ""]
                ours = curves.get(favourite)
                both = ours is not None and ours.complete and known.complete
                if curve != favourite and ours is not None and both:
                    gap = difference(ours.final[0], scores)
                    cells[-2:] = [said(*gap), verdict(*gap[1:])]
            lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def tally(shown: Mapping[str, Mapping[str, Results]], favourite: str) -> str:
    """On how many tasks the favourite is better than each other, and over all."""
    lines = []
    others = dict.fromkeys(
        curve for curves in shown.values() for curve in curves if curve != favourite
    )
    for other in others:
        pairs = {
            panel: (curves[favourite].final[0], curves[other].final[0])
            for panel, curves in shown.items()
            if favourite in curves and other in curves
        }
        said = [verdict(*difference(*pair)[1:]) for pair in pairs.values()]
        counts = ", ".join(
            f"{word} on {said.count(word)}"
            for word in ("yes", "not clear", "no, it is lower", "unknown")
            if word in said
        )
        if not said:
            continue
        line = f"- {favourite} better than {other}: {counts} of {len(said)}"
        # A ratio has no meaning where a seed learned nothing or lost.
        positive = {
            panel: pair
            for panel, pair in pairs.items()
            if all((scores > 0).all() for scores in pair)
        }
        if len(positive) > 1:
            which = "all of them"
            if len(positive) < len(pairs):
                which = f"the {len(positive)} where every seed's return is above 0"
            line += f"; over {which} {_said_together(list(positive.values()))}"
        if len(positive) > 2:
            # One task may make all of it.
            most = _most_telling(positive)
            rest = [pair for panel, pair in positive.items() if panel != most]
            line += f" (without {most} {_said_together(rest)})"
        lines.append(f"{line}.")
    return "\n".join(lines)


def _most_telling(pairs: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> str:
    """The panel that moves the mean of the logarithms of the ratios most."""
    mean = statistics.interquartile_mean
    logs = {panel: np.log(mean(x) / mean(y)) for panel, (x, y) in pairs.items()}
    middle = np.mean(list(logs.values()))
    return max(logs, key=lambda panel: abs(logs[panel] - middle))


def _said_together(pairs: Sequence[tuple[np.ndarray, np.ndarray]]) -> str:
    middle, low, high = together(pairs)
    return (
        f"{100 * middle:+.0f}% [{100 * low:.0f}, {100 * high:.0f}], "
        f"{verdict(low, high)}"
    )


def tallies(
    groups: Mapping[str, Mapping[str, Mapping[str, Results]]], favourite: str
) -> str:
    """The tally of each group of panels under its name, Markdown."""
    found = {name: tally(shown, favourite) for name, shown in groups.items()}
    return "\n\n".join(f"{name}:\n\n{said}" for name, said in found.items() if said)


def gaps(
    shown: Mapping[str, Mapping[str, Results]], first: str, favourite: str, other: str
) -> str:
    """How far the favourite is ahead in each panel, and whether by more than in one.

    Args:
      shown: panel -> curve -> results.
      first: the panel that the others are compared with.
      favourite: a curve.
      other: the one that it is compared with, by interquartile means.
    """
    both = {
        panel: (curves[favourite].final[0], curves[other].final[0])
        for panel, curves in shown.items()
        if favourite in curves and other in curves
    }
    lines = []
    for panel, (ours, theirs) in both.items():
        gap = difference(ours, theirs)
        line = f"- {panel}: {favourite} ahead of {other} by {said(*gap)}"
        if panel != first and first in both:
            before, behind = both[first]
            terms = ((1, ours), (-1, theirs), (-1, before), (1, behind))
            more = contrast(terms)
            line += f"; by {said(*more)} more than at {first}: {verdict(*more[1:])}"
        lines.append(f"{line}.")
    return "\n".join(lines)


def optimum(
    shown: Mapping[str, Mapping[str, Results]], values: Mapping[str, Sequence[str]]
) -> str:
    """The best of values in order, against each other one.

    Which is best is seen first, so any pair could have been compared: the intervals
    are those of as many comparisons as there are pairs.

    Args:
      shown: panel -> value -> results.
      values: panel -> all its values, in order; nothing is said before all are there.
    """
    lines = []
    for panel, names in values.items():
        scores = {name: known.final[0] for name, known in shown.get(panel, {}).items()}
        if set(names) - set(scores):
            continue
        best = max(names, key=lambda x: float(statistics.interquartile_mean(scores[x])))
        pairs = math.comb(len(names), 2)
        against = ", ".join(
            f"{name} {verdict(*difference(scores[best], scores[name], pairs)[1:])}"
            for name in names
            if name != best
        )
        place = "at an end" if best in (names[0], names[-1]) else "in the middle"
        lines.append(f"- {panel}: {best} is best, {place}; better than {against}.")
    return "\n".join(lines)


def point(of: Point) -> str:
    """A point in words."""
    return ", ".join(f"{name} {value:g}" for name, value in of.items())


def _made_by(made: Mapping[str, Any]) -> str:
    """What made a trial's results, or some of their seeds, in words."""
    seeds = made.get("seeds", ())
    # In order and without a gap, most often.
    if len(seeds) > 2 and len(seeds) == seeds[-1] - seeds[0] + 1:
        which = f"seeds {seeds[0]} to {seeds[-1]}: "
    else:
        which = f"seeds {', '.join(map(str, seeds))}: " if seeds else ""
    return (
        f"{which}{made['physics']} physics, jax {made['versions'].get('jax', '?')}, "
        f"collected at commit {made['commit'] or 'unknown'}"
    )


def settings_table(shown: Mapping[str, Mapping[str, Results]]) -> str:
    """What each curve was trained with, beyond the appendix's defaults."""
    lines = ["| task | agent | hyperparameters | trained with |", "|---|---|---|---|"]
    for panel, curves in shown.items():
        for curve, known in curves.items():
            trial = known.trial
            values = [words] if (words := point(trial.points[0])) else []
            values += [
                f"alpha x {factor:g} at {steps:g} steps"
                for steps, factor in trial.alpha_schedule
            ]
            if trial.normalize_rewards:
                values.append("rewards normalized")
            if trial.num_envs != trials.NUM_ENVS:
                values.append(f"{trial.num_envs} environments")
            made_by = "; ".join(sorted({_made_by(made) for made in known.made}))
            lines.append(
                f"| {panel} | {curve} | {', '.join(values) or 'defaults'} | {made_by} |"
            )
    return "\n".join(lines)


def mixed_physics(shown: Mapping[str, Mapping[str, Results]]) -> str:
    """Which panels have runs of more than one physics; empty for none."""
    of = {
        panel: {made["physics"] for known in curves.values() for made in known.made}
        for panel, curves in shown.items()
    }
    mixed = [panel for panel, physics in of.items() if len(physics) > 1]
    return f"Runs of more than one physics are in: {', '.join(mixed)}." if mixed else ""


def draw(
    shown: Mapping[str, Mapping[str, Results]],
    wanted: Sequence[Trial],
    path: pathlib.Path,
) -> None:
    """Learning curves, a panel each: interquartile mean and 95% interval over seeds.

    A curve has the colour that it has when all wanted trials are there.
    """
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
    names = [trial.name.split("/") for trial in wanted]
    for axes, (panel, curves) in zip(grid.flat, shown.items()):
        listed = [curve for of, curve in names if of == panel]
        color_of = _colors(list(dict.fromkeys([*listed, *curves])))
        for curve, known in curves.items():
            color = color_of[curve]
            some = np.isfinite(known.returns[0]).all(axis=0)
            if not some.any():
                continue
            returns = known.returns[0][:, some]
            steps = known.env_steps[some] / 1e6
            low, high = statistics.bootstrap_interval(returns, resamples=500)
            axes.fill_between(steps, low, high, color=color, alpha=0.2, linewidth=0)
            middle = statistics.interquartile_mean(returns, axis=0)
            axes.plot(steps, middle, color=color, label=curve)
        axes.set(title=panel, xlabel="million steps")
        if axes.get_lines():
            axes.legend(frameon=False, fontsize=7)
    for axes in grid.flat[len(shown) :]:
        axes.set_visible(False)
    for row in grid:
        row[0].set_ylabel("episode return")
    plotting.save(figure, path, dpi=90)


def _colors(curves: Sequence[str]) -> dict[str, Any]:
    """An agent's is the same in every figure; values in order go from dark to light."""
    import matplotlib

    if set(curves) & set(trials.AGENTS):
        every = dict.fromkeys([*trials.AGENTS, *curves])
        return dict(zip(every, plot.COLORS, strict=False))
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
        'interquartile means is above 0. "Over all of them" is the geometric mean over '
        "tasks of the ratio of the interquartile means, less one.",
        table(shown, figure.favourite),
        figure.conclusions(shown),
        figure.more,
        "## Settings",
        "What differs from the appendix's defaults; the raw numbers are in the "
        f"CSV files under `{figure.name}/`, and `python -m experiments.{figure.name} "
        "--report` makes this page from them.",
        settings_table(shown),
        mixed_physics(shown),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def write(figure: Figure, wanted: Sequence[Trial], results: pathlib.Path) -> None:
    """Write the page and the figure of what there is."""
    shown = figure.shown(wanted, results)
    if not shown:
        return
    draw(shown, wanted, results / f"{figure.name}.png")
    trials.write_whole(results / f"{figure.name}.md", page(figure, shown))

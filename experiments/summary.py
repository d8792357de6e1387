"""All figures in one page: ``python -m experiments.summary``."""

import dataclasses
import sys
from collections.abc import Sequence

from experiments import (
    comparison,
    delayed_mujoco,
    humanoid,
    hyperparameters,
    mujoco,
    normalized_rewards,
    point_mass,
    random_search,
    report,
    stochastic_walker2d,
    trials,
    wider_search,
)
from gasil_jax import command_line

#: Each figure with the function that makes its trials.
FIGURES = (
    (point_mass.FIGURE, point_mass.make),
    (mujoco.FIGURE, lambda: comparison.make(1)),
    (stochastic_walker2d.FIGURE, stochastic_walker2d.make),
    (delayed_mujoco.FIGURE, lambda: comparison.make(random_search.DELAY)),
    (normalized_rewards.FIGURE, normalized_rewards.make),
    (wider_search.FIGURE, wider_search.make),
    (humanoid.FIGURE, humanoid.make),
    (hyperparameters.FIGURE, hyperparameters.make),
)
# Of all agents on the locomotion tasks, with the reward's delay.
_COMPARISONS = ((mujoco.FIGURE, 1), (delayed_mujoco.FIGURE, random_search.DELAY))


def table() -> str:
    """The locomotion tasks that have results, an agent a column: Markdown."""
    lines = [
        f"| | {' | '.join(agent.upper() for agent in trials.AGENTS)} |",
        "| --- | --- | --- | --- | --- |",
    ]
    for figure, delay in _COMPARISONS:
        shown = figure.shown(comparison.make(delay), trials.RESULTS)
        for task, curves in shown.items():
            name = task if delay == 1 else f"{task}, delayed"
            cells = [_cell(curves.get(agent)) for agent in trials.AGENTS]
            lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines)


def tallies() -> tuple[str, ...]:
    """What the comparisons of figures 5 and 7 come to: Markdown."""
    return tuple(
        figure.conclusions(figure.shown(comparison.make(delay), trials.RESULTS))
        for figure, delay in _COMPARISONS
    )


def _cell(known: trials.Results | None) -> str:
    if known is None:
        return ""
    partly = "" if known.complete else f" ({len(known.seeds)} seeds)"
    return report.interval(known.final[0]) + partly


def page() -> str:
    """Claim by claim, what was measured: Markdown, from the CSV files alone."""
    parts = [
        "# The paper's claims, measured",
        "Written by `python -m experiments.summary` from the CSV files in this folder. "
        "Numbers are interquartile means over seeds of the return in the last tenth of "
        "training, with 95% bootstrap intervals; [how every agent was tuned]"
        "(random_search.md).",
        table(),
    ]
    for figure, make in FIGURES:
        wanted = make()
        shown = figure.shown(wanted, trials.RESULTS)
        folder = trials.RESULTS / figure.name
        missing = [x.name for x in wanted if trials.read_whole(x, folder) is None]
        parts += [f"## {figure.title}", f"**Claim.** {figure.claim}"]
        conclusions = figure.conclusions(shown)
        linked = (trials.RESULTS / f"{figure.name}.md").exists()
        link = f"[Tables, curves and settings]({figure.name}.md)." if linked else ""
        parts += [conclusions, link, figure.more if shown else ""]
        if missing:
            parts.append(f"Not run yet, or not wholly: {', '.join(missing)}.")
    return "\n\n".join(part for part in parts if part) + "\n"


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the page; returns the exit status."""
    return command_line.exit_status(lambda: _main(arguments))


def _main(arguments: Sequence[str] | None) -> None:
    command_line.parse(Options, arguments, "experiments.summary")
    path = trials.RESULTS / "README.md"
    path.write_text(page())
    print(f"in {path}")


@dataclasses.dataclass(frozen=True)
class Options:
    """Write the page of all figures, from the CSV files alone."""


if __name__ == "__main__":
    sys.exit(main())

"""All figures in one page: ``python -m experiments.summary``."""

import dataclasses
import sys
from collections.abc import Iterable, Mapping, Sequence

from experiments import (
    comparison,
    constant_bonus,
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
from experiments.trials import Results
from gasil_jax import command_line

#: Each figure with the function that makes its trials.
FIGURES = (
    (point_mass.FIGURE, point_mass.make),
    (mujoco.FIGURE, lambda: comparison.make(1)),
    (stochastic_walker2d.FIGURE, stochastic_walker2d.make),
    (delayed_mujoco.FIGURE, lambda: comparison.make(random_search.DELAY)),
    (normalized_rewards.FIGURE, normalized_rewards.make),
    (constant_bonus.FIGURE, constant_bonus.make),
    (wider_search.FIGURE, wider_search.make),
    (humanoid.FIGURE, humanoid.make),
    (hyperparameters.FIGURE, hyperparameters.make),
)
# Each of the paper's claims, and what the figures say of it.
_IN_SHORT = (
    (
        "Point mass: PPO settles early on a poorer policy, PPO+GASIL is slower at "
        "first and ends higher",
        "holds, both clearly, in a layout of 128 that was chosen for it",
    ),
    (
        "Dense rewards: PPO+GASIL is ahead of PPO, PPO+BC and PPO+SIL on most tasks",
        "does not hold: it is clearly ahead of all three on ant alone",
    ),
    (
        "Delayed rewards: it is ahead by a large margin on all tasks",
        "holds on hopper and walker2d, of all three, with normalized rewards; on no "
        "other task",
    ),
    (
        "Noise: the gap to PPO is larger with it",
        "in part, with normalized rewards: no gap is clear without noise, at 0.05 and "
        "0.1 it is, at 0.5 nobody walks; that it grows is not clear",
    ),
    (
        "Discriminator updates: one is too few, twenty are too many",
        "twenty have least in all four panels, clearly in one; one is nowhere clearly "
        "too few",
    ),
    (
        "Buffer: 500 steps are too few, 5,000 too many",
        "no order, in any of four panels",
    ),
)
# Of all agents on the locomotion tasks, rewards as they are: by the reward's delay.
_COMPARISONS = {random_search.DELAY: delayed_mujoco.FIGURE, 1: mujoco.FIGURE}


def tuned() -> str:
    """Every agent with what its tuned preset has, a task a row: Markdown.

    First the tasks that were tuned with normalized rewards, then the others.
    """
    rows = dict(_rows(_normalized()))
    for name, curves in _rows(_as_they_are()):
        rows.setdefault(name, curves)
    return _table(rows)


def as_they_are() -> str:
    """Every agent on the tasks that have normalized rewards too, without: Markdown."""
    both = dict(_rows(_normalized()))
    rows = dict(_rows(_as_they_are()))
    return _table({name: curves for name, curves in rows.items() if name in both})


def tallies() -> tuple[str, ...]:
    """What the agents with normalized rewards come to, delayed and dense: Markdown."""
    return tuple(
        report.tally(report.complete(tasks), trials.AGENTS[-1])
        for tasks in _normalized().values()
    )


#: Task -> curve -> results.
_Tasks = Mapping[str, Mapping[str, Results]]


def _normalized() -> Mapping[int, _Tasks]:
    """By the reward's delay."""
    figure = normalized_rewards.FIGURE
    shown = figure.shown(normalized_rewards.make(), trials.RESULTS)
    return normalized_rewards.by_delay(shown)


def _as_they_are() -> Mapping[int, _Tasks]:
    return {
        delay: figure.shown(comparison.make(delay), trials.RESULTS)
        for delay, figure in _COMPARISONS.items()
    }


def _rows(of: Mapping[int, _Tasks]) -> Iterable[tuple[str, Mapping[str, Results]]]:
    """(name of the row, curve -> results), of all delays."""
    for delay, tasks in of.items():
        for env, curves in tasks.items():
            yield _row(env, delay), curves


def _row(env: str, delay: int) -> str:
    return env if delay == 1 else f"{env}, delayed"


def _table(rows: _Tasks) -> str:
    """An agent a column."""
    lines = [
        f"| | {' | '.join(agent.upper() for agent in trials.AGENTS)} |",
        "| --- | --- | --- | --- | --- |",
    ]
    for name, curves in rows.items():
        cells = [_cell(curves.get(agent)) for agent in trials.AGENTS]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines)


def _cell(known: Results | None) -> str:
    if known is None:
        return ""
    partly = "" if known.complete else f" ({len(known.seeds)} seeds)"
    return report.interval(known.final[0]) + partly


def _in_short() -> str:
    rows = [f"| {claim} | {here} |" for claim, here in _IN_SHORT]
    return "\n".join(["| The paper's claim | Here |", "| --- | --- |", *rows])


def page() -> str:
    """Claim by claim, what was measured: Markdown, from the CSV files alone."""
    parts = [
        "# The paper's claims, measured",
        "Written by `python -m experiments.summary` from the CSV files in this folder. "
        "Numbers are interquartile means over seeds of the return in the last tenth of "
        "training, with 95% bootstrap intervals.",
        _in_short(),
        "With what the tuned presets have: rewards [normalized]"
        "(normalized_rewards.md), but for ant's and humanoid's:",
        tuned(),
        "[Rewards as they are](random_search.md):",
        as_they_are(),
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
    trials.write_whole(path, page())
    print(f"in {path}")


@dataclasses.dataclass(frozen=True)
class Options:
    """Write the page of all figures, from the CSV files alone."""


if __name__ == "__main__":
    sys.exit(main())

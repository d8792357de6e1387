"""PPO+GASIL on delayed tasks, searched further: ``python -m experiments.wider_search``.

Figure 7's search gives every agent as many runs. PPO+BC and PPO+SIL have eight points,
all of them tried; PPO+GASIL has 256, of which it tries sixteen. Here it gets another
search. Learning rate and alpha are the values that did best in the first (by the mean
of the points that have them: each met every value of the others equally often), and all
32 points of the other three hyperparameters get two seeds, then the best four get four
more. The best point of all has ten seeds, the first of figure 7's, with whose curves it
is compared. The command lists and trains a stage once the one before it is complete:
start it three times.
"""

import dataclasses
import pathlib
import sys
from collections.abc import Sequence
from typing import Any

import numpy as np

from experiments import (
    command,
    comparison,
    delayed_mujoco,
    random_search,
    report,
    trials,
    two_stage,
)
from experiments.report import Figure
from experiments.trials import Results, Trial

AGENT = "ppo+gasil"
# What a first search leaves open.
_FREE = ("discriminator_updates", "discriminator_learning_rate", "buffer_steps")
#: Ant and humanoid cost several times as much, and no agent has learned to walk there.
TASKS = ("hopper", "walker2d", "halfcheetah", "swimmer")
_SEEDS = 2
# The agent's curve in figure 7, beside the one of here.
_FIRST = f"{AGENT} of figure 7"


def _gather(
    wanted: Sequence[Trial], results: pathlib.Path
) -> dict[str, dict[str, Results]]:
    """What is there of the tuned agent on each task, beside figure 7's curves."""
    figure7 = comparison.make(random_search.DELAY)
    before = report.panels(figure7, results / delayed_mujoco.FIGURE.name)
    shown = {}
    for panel, curves in report.panels(wanted, results / FIGURE.name).items():
        env = panel.removesuffix(two_stage.PANEL_SUFFIX)
        others = dict(before.get(env, {}))
        if AGENT in others:
            others[_FIRST] = others.pop(AGENT)
        # The panel of the tuned agent comes after that of its search.
        if found := others | (curves if panel == env else {}):
            shown[env] = found
    return shown


FIGURE = Figure(
    name="wider_search",
    title="PPO+GASIL on delayed tasks, searched further",
    claim=delayed_mujoco.FIGURE.claim,
    more="""**What it says.** Twice as many points find none that is better over all:
what is chosen here and in figure 7 are not told apart, better on hopper, where most
seeds run now, worse on halfcheetah; on walker2d more seeds run fast and more never
start. With alpha 1 the points of hopper and walker2d have on average about what the
best of the first search had, and the four best of 32 on two seeds did worse on four
others: what sets such points apart is mostly which seeds learn to run, so that more
seeds are wanted, not more points. Swimmer's search is half done. The other curves are
[figure 7's](delayed_mujoco.md).""",
    gather=_gather,
)


def search(env: str) -> Trial | None:
    """The search on a task; None before figure 7's own is complete."""
    known = random_search.stages(env, AGENT, random_search.DELAY)
    if known is None:
        return None
    space = dict(random_search.space(env, AGENT))
    for name in set(space) - set(_FREE):
        space[name] = (_best_value(known.first, name),)
    return dataclasses.replace(
        known.first.trial,
        name=f"{env}{two_stage.PANEL_SUFFIX}/{AGENT}",
        points=random_search.every_point(space),
        seeds=_SEEDS,
    )


def _best_value(known: Results, name: str) -> Any:
    """The value of a hyperparameter whose points do best, by their mean."""
    scores_of: dict[Any, list[float]] = {}
    for point, score in zip(known.trial.points, two_stage.scores(known), strict=True):
        scores_of.setdefault(point[name], []).append(float(score))
    return max(scores_of, key=lambda value: np.mean(scores_of[value]))


def make() -> list[Trial]:
    """On each task the search's stages, and ten seeds of its best point once whole."""
    folder = trials.RESULTS / FIGURE.name
    first = [found for env in TASKS if (found := search(env)) is not None]
    return [trial for each in first for trial in two_stage.trials_of(each, folder)]


def _searches(wanted: Sequence[Trial], results: pathlib.Path) -> str:
    """What each search found, a table for each task, and its second stage: Markdown."""
    folder = results / FIGURE.name
    parts = []
    for trial in wanted:
        # The second stage is read with its first.
        if not two_stage.is_search(trial) or trial.name.endswith(two_stage.SUFFIX):
            continue
        if (known := two_stage.read(trial, folder)) is not None:
            parts += [_grid(known.first), _second_stage(known.first, known.second)]
    return "\n\n".join(parts)


def _grid(known: Results) -> str:
    points = known.trial.points
    score_of = {
        tuple(point[name] for name in _FREE): score
        for point, score in zip(points, two_stage.scores(known), strict=True)
    }
    updates, rates, sizes = (
        sorted({point[name] for point in points}) for name in _FREE
    )
    fixed = {name: value for name, value in points[0].items() if name not in _FREE}
    env = known.trial.name.split(two_stage.PANEL_SUFFIX)[0]
    lines = [
        f"**{env}**, {report.point(fixed)}: mean "
        f"return of the last fifth of training of {len(known.seeds)} seeds, by "
        "discriminator updates "
        f"and learning rate; in a cell with buffers of {' and '.join(map(str, sizes))} "
        "steps.",
        "",
        f"| updates | {' | '.join(f'at {rate:g}' for rate in rates)} |",
        "|---" * (1 + len(rates)) + "|",
    ]
    for count in updates:
        cells = [
            ", ".join(f"{score_of[count, rate, size]:.0f}" for size in sizes)
            for rate in rates
        ]
        lines.append(f"| {' | '.join([str(count), *cells])} |")
    return "\n".join(lines)


def _second_stage(first: Results, second: Results | None) -> str:
    if second is None:
        return "The best four have not been tried again yet."
    tried = ", ".join(f"{score:.0f}" for score in two_stage.scores(second))
    point, final = two_stage.best_point(first, second)
    return (
        f"The best four, on {len(second.seeds)} other seeds: {tried}. Chosen: "
        f"{report.point(point)}; {final.mean():.0f} over {len(final)} seeds of both "
        "stages."
    )


def write(figure: Figure, wanted: Sequence[Trial], results: pathlib.Path) -> None:
    """Write the page, with the searches, and the figure of what there is."""
    two_stage.write(figure, wanted, results, _searches(wanted, results))


def quick(wanted: Sequence[Trial]) -> list[Trial]:
    """Four points on hopper."""
    return two_stage.quick(wanted, (f"hopper{two_stage.PANEL_SUFFIX}/{AGENT}",))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    return command.main(FIGURE, make, quick, arguments, write)


if __name__ == "__main__":
    sys.exit(main())

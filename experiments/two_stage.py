"""A search in two stages: many points on few seeds, then the best again on more.

The best of many points on few seeds is partly the luckiest. A figure may hold searches
of its own beside its curves: in panels whose name ends with `PANEL_SUFFIX`.
"""

import dataclasses
import pathlib
from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np

from experiments import report, trials
from experiments.report import Figure
from experiments.trials import Results, Trial
from gasil_jax.points import Point

#: What the name of a second stage ends with.
SUFFIX = "-best"
#: What the name of a search's panel ends with, in a figure of its own curves.
PANEL_SUFFIX = "-search"
_POINTS, _SEEDS, _FIRST_SEED = 4, 4, 2000
# Where a run costs several times as much.
_SEEDS_OF = {"ant": 2, "humanoid": 2}
_ENOUGH_SEEDS = 8


class Stages(NamedTuple):
    """What there is of a search whose first stage is complete.

    Attributes:
      first: its results.
      again: the trial that gives its best points more seeds; None where they have
        enough.
      second: the results of that, once it is complete.
    """

    first: Results
    again: Trial | None
    second: Results | None

    @property
    def is_whole(self) -> bool:
        """Whether nothing is left to train, so that `best` is final."""
        return self.again is None or self.second is not None

    @property
    def best(self) -> Point:
        """The best point so far: of the second stage once there is one."""
        return best_point(self.first, self.second)[0]


def read(search: Trial, folder: pathlib.Path) -> Stages | None:
    """A search by its results in a folder; None before its first stage is complete."""
    first = trials.read_whole(search, folder)
    if first is None:
        return None
    if search.seeds >= _ENOUGH_SEEDS:
        return Stages(first, None, None)
    best_first = np.argsort(-scores(first), kind="stable")
    again = dataclasses.replace(
        search,
        name=search.name + SUFFIX,
        points=tuple(search.points[i] for i in best_first[:_POINTS]),
        seeds=_SEEDS_OF.get(search.env, _SEEDS),
        first_seed=_FIRST_SEED,
    )
    return Stages(first, again, trials.read_whole(again, folder))


def best(search: Trial, folder: pathlib.Path) -> Point | None:
    """What a search has chosen, by its results in a folder; None before it is whole."""
    found = read(search, folder)
    return found.best if found is not None and found.is_whole else None


def is_search(trial: Trial) -> bool:
    """Whether a figure's trial is of one of its searches."""
    return trial.name.split("/")[0].endswith(PANEL_SUFFIX)


def trials_of(
    search: Trial, folder: pathlib.Path, seeds: int = Trial.seeds
) -> list[Trial]:
    """A search's stages so far and, once it is whole, seeds of its best point.

    Args:
      search: PANEL-search/CURVE.
      folder: of the results.
      seeds: of the best point.

    Returns:
      Up to three trials, the last of the name PANEL/CURVE.
    """
    known = read(search, folder)
    if known is None:
        return [search]
    found = [search] if known.again is None else [search, known.again]
    if known.is_whole:
        panel, curve = search.name.split("/")
        final = Trial(
            name=f"{panel.removesuffix(PANEL_SUFFIX)}/{curve}",
            env=search.env,
            agent=search.agent,
            points=(known.best,),
            reward_delay=search.reward_delay,
            obs_noise=search.obs_noise,
            seeds=seeds,
            alpha_schedule=search.alpha_schedule,
            normalize_rewards=search.normalize_rewards,
        )
        found.append(final)
    return found


def quick(wanted: Sequence[Trial], names: Collection[str]) -> list[Trial]:
    """Four points each of the searches of these names."""
    return [
        dataclasses.replace(trial, points=trial.points[:4])
        for trial in wanted
        if trial.name in names
    ]


def write(
    figure: Figure, wanted: Sequence[Trial], results: pathlib.Path, searches: str
) -> None:
    """Write a figure's page and picture, or a page of its searches alone.

    Args:
      figure: which.
      wanted: its trials.
      results: the folder of all results.
      searches: what they found, Markdown; empty where there is nothing.
    """
    if searches:
        searches = f"## The searches\n\n{searches}"
    if figure.shown(wanted, results):
        more = "\n\n".join(part for part in (figure.more, searches) if part)
        report.write(dataclasses.replace(figure, more=more), wanted, results)
    elif searches:
        page = results / f"{figure.name}.md"
        trials.write_whole(page, f"# {figure.title}\n\n{searches}\n")


def scores(known: Results) -> np.ndarray:
    """What the points of a search are compared by, (points,).

    -inf where a seed ended no episode.
    """
    return _score(_final(known))


def best_point(first: Results, second: Results | None) -> tuple[Point, np.ndarray]:
    """The best point, and its final returns in both stages (seeds,).

    Once there is a second stage, it is one of that stage's.
    """
    points, final = first.trial.points, _final(first)
    if second is not None:
        places = [points.index(point) for point in second.trial.points]
        points = second.trial.points
        final = np.concatenate([final[places], _final(second)], axis=1)
    place = int(_score(final).argmax())
    return points[place], final[place]


def _score(final: np.ndarray) -> np.ndarray:
    """What points are compared by: (points, seeds) -> (points,).

    -inf where a seed ended no episode.
    """
    score = final.mean(axis=1)
    return np.where(np.isfinite(score), score, -np.inf)


def _final(known: Results) -> np.ndarray:
    """Mean return over the last fifth of training, (points, seeds)."""
    return known.part(0.8, 1.0)

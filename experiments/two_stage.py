"""A search in two stages: many points on few seeds, then the best again on more.

The best of many points on few seeds is partly the luckiest.
"""

import dataclasses
import pathlib

import numpy as np

from experiments import trials
from experiments.trials import Results, Trial
from gasil_jax.points import Point

#: What the name of a second stage ends with.
SUFFIX = "-best"
_POINTS, _SEEDS, _FIRST_SEED = 4, 4, 2000
# Where a run costs several times as much.
_SEEDS_OF = {"ant": 2, "humanoid": 2}
_ENOUGH_SEEDS = 8


def second(first: Trial, folder: pathlib.Path) -> Trial | None:
    """The trial that gives the best points of a search more seeds.

    None before the search is complete, and where its points have enough.

    Args:
      first: the search.
      folder: of its results.
    """
    known = trials.read_whole(first, folder)
    if known is None or first.seeds >= _ENOUGH_SEEDS:
        return None
    best_first = np.argsort(-scores(known), kind="stable")
    return dataclasses.replace(
        first,
        name=first.name + SUFFIX,
        points=tuple(first.points[i] for i in best_first[:_POINTS]),
        seeds=_SEEDS_OF.get(first.env, _SEEDS),
        first_seed=_FIRST_SEED,
    )


def best(first: Trial, folder: pathlib.Path) -> Point | None:
    """The best point of a search so far, by its results in a folder.

    None before the first stage is complete.
    """
    known = trials.read_whole(first, folder)
    if known is None:
        return None
    again = second(first, folder)
    return best_point(known, again and trials.read_whole(again, folder))[0]


def is_whole(first: Trial, folder: pathlib.Path) -> bool:
    """Whether both stages of a search are in a folder's results."""
    if trials.read_whole(first, folder) is None:
        return False
    again = second(first, folder)
    return again is None or trials.read_whole(again, folder) is not None


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

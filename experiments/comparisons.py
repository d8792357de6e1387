"""Comparisons of final returns, and of the seeds that solve a task, with intervals.

Verdicts are corrected by Holm's method for the number of comparisons in their family.
"""

import dataclasses
import functools
import itertools
import math
import statistics
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from experiments.curves import Comparisons
from experiments.search import generator
from gasil_jax.statistics import interquartile_mean

#: Significance level of a family of verdicts.
LEVEL = 0.05
#: The probability with which the effect `Comparison.visible` would be found.
_POWER = 0.8
_DRAWS = 10_000
#: A permutation test is exact up to so many ways to split the seeds: ten against ten.
_MOST_SPLITS = math.comb(20, 10)
#: Beyond them so many ways are drawn: a family of 500 tests can still have a verdict.
_RANDOM_SPLITS = 50_000
#: With fewer seeds there is no verdict, and no interval, which would be far too narrow.
FEWEST_SEEDS = 5
#: The verdict on two curves that both return less than doing nothing.
BELOW = "both below doing nothing"
#: Scores, (seeds,), by panel and curve.
Scores = Mapping[tuple[str, str], np.ndarray]
#: The scores of our curve and of the other one on a task, (seeds,) each.
Sides = tuple[np.ndarray, np.ndarray]


class Effect(NamedTuple):
    """A difference, its p-value before correction, and bootstrap samples, (draws,)."""

    middle: float
    p: float
    drawn: np.ndarray


@dataclasses.dataclass(frozen=True)
class Comparison:
    """A difference of curves with its interval, which is its text: f"{comparison:.2f}".

    Attributes:
      middle: the difference.
      p: its p-value, corrected by Holm's method.
      low: the low end of its 95% interval.
      high: the high end.
      visible: the smallest true difference that would be found with a probability of
        80%, at the level of the family's smallest p-value.
      below: whether both curves return less than doing nothing.
    """

    middle: float
    p: float
    low: float
    high: float
    visible: float
    below: bool = False

    @property
    def verdict(self) -> str:
        """Better, worse, not clear, or that both are below doing nothing."""
        if self.below:
            return BELOW
        if not self.p <= LEVEL:
            return "not clear"
        return "better" if self.middle > 0 else "worse"

    def __format__(self, spec: str) -> str:
        return in_words(self.middle, self.low, self.high, spec)


def judged(effects: Mapping[Any, Effect], dropped: int = 0) -> dict[Any, Comparison]:
    """Return the comparisons of a family of tests, of which some may be dropped."""
    p_values = corrected({key: effect.p for key, effect in effects.items()}, dropped)
    compared = {}
    for key, (middle, _, drawn) in effects.items():
        low, high = map(float, np.percentile(drawn, [2.5, 97.5]))
        visible = visible_effect(drawn, len(effects) + dropped)
        compared[key] = Comparison(middle, p_values[key], low, high, visible)
    return compared


def corrected(p_values: Mapping[Any, float], dropped: int = 0) -> dict[Any, float]:
    """Return p-values corrected by Holm's method, as if `dropped` more were larger."""
    higher, least = {}, 0.0
    for i, key in enumerate(sorted(p_values, key=lambda key: p_values[key])):
        least = max(least, min(1.0, p_values[key] * (len(p_values) + dropped - i)))
        higher[key] = least
    return {key: higher[key] for key in p_values}


def visible_effect(drawn: np.ndarray, comparisons: int) -> float:
    """Return the effect that is found with a probability of 80%, by Holm's method."""
    quantile = statistics.NormalDist().inv_cdf
    errors = quantile(1 - LEVEL / (2 * comparisons)) + quantile(_POWER)
    return errors * float(np.std(drawn))


@functools.cache
def _draws(name: str, scores: tuple[float, ...]) -> np.ndarray:
    rng = generator(name)
    rows = rng.integers(len(scores), size=(_DRAWS, len(scores)))
    return interquartile_mean(np.array(scores)[rows], axis=1)


def draws(scores: Scores, panel: str, curve: str) -> np.ndarray:
    """Return interquartile means of bootstrap samples of a curve's seeds: (draws,)."""
    return _draws(f"{panel}/{curve}", tuple(scores[panel, curve].tolist()))


@functools.cache
def _splits(first: int, seeds: int) -> tuple[np.ndarray, bool]:
    """Return ways to split ascending scores, (ways, seeds), and if these are all."""
    exact = math.comb(seeds, first) <= _MOST_SPLITS
    if exact:
        chosen = np.array([*itertools.combinations(range(seeds), first)])
    else:
        rows = np.tile(np.arange(seeds), (_RANDOM_SPLITS, 1))
        dealt = np.random.default_rng(0).permuted(rows, axis=1)
        chosen = np.sort(dealt[:, :first], axis=1)
    # A way times the scores is the difference of its sides' interquartile means.
    taken = np.zeros((len(chosen), seeds), bool)
    taken[np.arange(len(chosen))[:, None], chosen] = True
    ways = np.empty(taken.shape)
    ways[taken] = np.tile(_weights(first), len(chosen))
    ways[~taken] = -np.tile(_weights(seeds - first), len(chosen))
    return ways, exact


@functools.cache
def _weights(seeds: int) -> np.ndarray:
    """Return the weights of ascending scores in their interquartile mean, (seeds,)."""
    # Scores of 0 below the one of a row and 1 from it on add the weights of the latter.
    return -np.diff(interquartile_mean(np.triu(np.ones((seeds, seeds)))), append=0.0)


def permutation_p(ours: np.ndarray, other: np.ndarray) -> float:
    """Return the p-value of a permutation test for two curves, of (seeds,) each.

    It is the share of the ways to divide all seeds between the two curves in which the
    interquartile means are at least as far apart. Up to ten seeds against ten it is
    exact; for more it is estimated by random ways. Unlike the bootstrap's it is valid
    for few seeds too: for five against five it is at least 0.008.
    """
    # The pair in either order is the same test and has the same random numbers.
    one, two = sorted([ours.tolist(), other.tolist()])
    pooled = np.sort(one + two)
    ways, exact = _splits(len(one), len(pooled))
    apart = np.sort(one) @ _weights(len(one)) - np.sort(two) @ _weights(len(two))
    # Sums in another order differ by rounding.
    dealt = np.abs(ways @ pooled) >= abs(apart) * (1 - 1e-9)
    as_far = int(dealt.sum())
    return as_far / len(dealt) if exact else (1 + as_far) / (1 + len(dealt))


def bootstrap_p(drawn: np.ndarray) -> float:
    """Return the p-value of bootstrap samples of an effect, (draws,)."""
    beyond = min(int((drawn <= 0).sum()), int((drawn >= 0).sum()))
    return min(1.0, 2 * beyond / len(drawn))


def compare(
    scores: Scores, family: Comparisons, dropped: int = 0
) -> dict[tuple[str, ...], Comparison]:
    """Return the comparisons of a family whose curves all have scores.

    The p-value is the percentile bootstrap's: twice the share of draws on the other
    side of 0. With few seeds that is too small. So for two curves it is the larger of
    the bootstrap's and the permutation test's; for a difference of differences it is
    the bootstrap's, at least that of one draw. Holm's method multiplies the smallest
    p-value by the number of comparisons, the next by one less, and so on, and makes
    none smaller than the one before.
    """
    effects = {}
    for key, terms in family.items():
        if not all((panel, curve) in scores for _, panel, curve in terms):
            continue
        sides = [scores[panel, curve] for _, panel, curve in terms]
        drawn = np.sum([w * draws(scores, *curve) for w, *curve in terms], axis=0)
        middle = sum(w * float(interquartile_mean(scores[p, c])) for w, p, c in terms)
        enough = all(len(x) >= FEWEST_SEEDS and np.isfinite(x).all() for x in sides)
        p_value = 1.0
        if enough:
            least = permutation_p(*sides) if len(sides) == 2 else 2 / _DRAWS
            p_value = max(least, bootstrap_p(drawn))
        effects[key] = Effect(middle, p_value, drawn)
    return judged(effects, dropped)


def more(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return 1 where one is more than the other, and one half where they are equal."""
    return np.add(one > other, one >= other, dtype=np.int8) / 2


def improvement(name: str, sides: Sequence[Sides]) -> Effect:
    """Return the probability of improvement over tasks, less one half.

    It is the probability that a random seed of ours has a higher score than a random
    seed of the other curve, where equal scores count half, averaged over tasks (Agarwal
    et al. 2021). A NaN, the score of a seed that ended no episode, is below all other
    scores. The p-value is that of a permutation of seeds within each task; `name` seeds
    its random numbers.
    """
    rng, middle = generator(name), 0.0
    dealt, drawn = np.zeros(_DRAWS), np.zeros(_DRAWS)
    for pair in sides:
        both = [np.nan_to_num(x, nan=-np.inf, neginf=-np.inf) for x in pair]
        ours, other = map(len, both)
        # Our seeds by the other's: (our seeds, other seeds).
        wins = more(both[0][:, None], both[1][None, :]) - 0.5
        middle += float(wins.mean())
        # The sum of our ranks among all says how often ours are more.
        pooled = np.concatenate(both)
        ranks = np.tile(more(pooled[:, None], pooled).sum(axis=1), (_DRAWS, 1))
        sums = rng.permuted(ranks, axis=1)[:, :ours].sum(axis=1)
        dealt += (sums - ours**2 / 2) / (ours * other) - 0.5
        first, second = (_resampled(size, rng) for size in (ours, other))
        drawn += np.sum(first @ wins * second, axis=1)
    as_far = int(np.sum(np.abs(dealt) >= abs(middle) - 1e-9))
    p_value = (1 + as_far) / (1 + _DRAWS)
    return Effect(middle / len(sides), p_value, drawn / len(sides))


def _resampled(size: int, rng: np.random.Generator) -> np.ndarray:
    """Return the share of each seed in bootstrap samples, (draws, seeds)."""
    drawn = rng.integers(size, size=(_DRAWS, size)) + size * np.arange(_DRAWS)[:, None]
    counts = np.bincount(drawn.ravel(), minlength=_DRAWS * size)
    return counts.reshape(_DRAWS, size) / size


@functools.cache
def fisher_p(ours: int, our_seeds: int, other: int, other_seeds: int) -> float:
    """Return Fisher's exact p-value, two-sided, of how many seeds solve a task."""
    solved, seeds = ours + other, our_seeds + other_seeds

    def ways(x: int) -> int:
        return math.comb(our_seeds, x) * math.comb(other_seeds, solved - x)

    counts = range(max(0, solved - other_seeds), min(solved, our_seeds) + 1)
    as_rare = [ways(x) for x in counts if ways(x) <= ways(ours)]
    return sum(as_rare) / math.comb(seeds, solved)


def lead(name: str, sides: Sequence[Sides]) -> Effect:
    """Return how much larger our share of solving seeds is, averaged over tasks.

    `sides` say which seeds solve a task, as bool. The p-value is Fisher's for one task,
    else that of a permutation of seeds within each task; `name` seeds its random
    numbers.
    """
    rng, middle = generator(name), 0.0
    dealt, drawn = np.zeros(_DRAWS), np.zeros(_DRAWS)
    for first, second in sides:
        middle += float(first.mean() - second.mean())
        for seeds, sign in ((first, 1), (second, -1)):
            drawn += sign * rng.binomial(len(seeds), seeds.mean(), _DRAWS) / len(seeds)
        total = int(first.sum() + second.sum())
        left = len(first) + len(second) - total
        got = rng.hypergeometric(total, left, len(first), _DRAWS)
        dealt += got / len(first) - (total - got) / len(second)
    as_far = int(np.sum(np.abs(dealt) >= abs(middle) - 1e-9))
    p_value = (1 + as_far) / (1 + _DRAWS)
    if len(sides) == 1:
        p_value = fisher_p(int(first.sum()), len(first), int(second.sum()), len(second))
    return Effect(middle / len(sides), p_value, drawn / len(sides))


def number(value: float, spec: str = "") -> str:
    """Return a score as text; by default without decimals from 100 on."""
    return format(value, spec or (",.0f" if abs(value) >= 100 else ".1f"))


def in_words(middle: float, low: float, high: float, spec: str = "") -> str:
    """Return a number and its interval as text, formatted as by `number`."""
    return "{} [{}, {}]".format(*(number(x, spec) for x in (middle, low, high)))


def over_tasks(name: str, scores: Sequence[np.ndarray]) -> tuple[float, float, float]:
    """Return the interquartile mean over the seeds of all tasks, and its interval.

    Every task has the same weight; its scores are (seeds,), in one unit. The 95%
    interval is the percentile bootstrap's over seeds, drawn within each task; `name`
    seeds its random numbers.
    """
    most = math.lcm(*map(len, scores))
    rng = generator(name)
    drawn = [
        rng.choice(x, (_DRAWS // 10, len(x))).repeat(most // len(x), axis=1)
        for x in scores
    ]
    means = interquartile_mean(np.concatenate(drawn, axis=1), axis=1)
    low, high = np.percentile(means, [2.5, 97.5])
    every = np.concatenate([x.repeat(most // len(x)) for x in scores])
    return float(interquartile_mean(every)), float(low), float(high)


def mean_share(solved: Sequence[np.ndarray]) -> tuple[float, float, float]:
    """Return the mean over tasks of the share of seeds that solve, and its interval."""
    rng = np.random.default_rng(0)
    drawn = [rng.binomial(len(x), x.mean(), _DRAWS) / len(x) for x in solved]
    low, high = np.percentile(np.mean(drawn, axis=0), [2.5, 97.5])
    return float(np.mean([x.mean() for x in solved])), float(low), float(high)

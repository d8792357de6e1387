"""Comparisons of final returns with their intervals, as numbers and as text.

Verdicts are corrected by Holm's method for the number of comparisons in their family.
"""

import dataclasses
import functools
import math
import statistics
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from experiments.curves import Comparisons
from experiments.search import generator
from gasil_jax.statistics import bootstrap_interval, interquartile_mean

#: Significance level of a family of verdicts.
LEVEL = 0.05
#: The probability with which the effect `Comparison.visible` would be found.
_POWER = 0.8
_DRAWS = 10_000
#: With fewer seeds there is no verdict, and no interval, which would be far too narrow.
FEWEST_SEEDS = 5
#: The verdict on two curves that both return less than doing nothing.
BELOW = "both below doing nothing"
_VERDICTS = ("better", "not clear", "worse", BELOW)
#: Scores, (seeds,), by panel and curve.
Scores = Mapping[tuple[str, str], np.ndarray]


class Effect(NamedTuple):
    """A difference, its p-value before correction, and bootstrap samples, (draws,)."""

    middle: float
    p: float
    drawn: np.ndarray


def verdict(middle: float, p: float) -> str:
    """Return whether a difference with a corrected p-value is better or worse."""
    if not p <= LEVEL:
        return "not clear"
    return "better" if middle > 0 else "worse"


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
        return BELOW if self.below else verdict(self.middle, self.p)

    def __format__(self, spec: str) -> str:
        return in_words(self.middle, self.low, self.high, spec)

    def verdict_in_words(self, spec: str = "") -> str:
        """Return the verdict; if it is not clear, with what would have been."""
        if self.verdict != "not clear":
            return self.verdict
        return f"not clear (visible from {number(self.visible, spec)} on)"


def judged(effects: Mapping[Any, Effect], dropped: int = 0) -> dict[Any, Comparison]:
    """Return the comparisons of a family of tests, of which some may be dropped."""
    p_values = corrected({key: effect.p for key, effect in effects.items()}, dropped)
    compared = {}
    for key, (middle, _, drawn) in effects.items():
        low, high = map(float, np.percentile(drawn, [2.5, 97.5]))
        visible = visible_effect(drawn, len(effects) + dropped)
        compared[key] = Comparison(middle, p_values[key], low, high, visible)
    return compared


@functools.cache
def _draws(name: str, scores: tuple[float, ...]) -> np.ndarray:
    rng = generator(name)
    rows = rng.integers(len(scores), size=(_DRAWS, len(scores)))
    return interquartile_mean(np.array(scores)[rows], axis=1)


def draws(scores: Scores, panel: str, curve: str) -> np.ndarray:
    """Return interquartile means of bootstrap samples of a curve's seeds: (draws,)."""
    return _draws(f"{panel}/{curve}", tuple(scores[panel, curve].tolist()))


def permutation_p(ours: np.ndarray, other: np.ndarray) -> float:
    """Return the p-value of a permutation test for two curves, of (seeds,) each.

    It is the share of the ways to divide all seeds between the two curves in which the
    interquartile means are at least as far apart, estimated by random ways. Unlike the
    bootstrap's it is valid for few seeds too: for five against five it is at least
    0.008.
    """

    def distance(first: np.ndarray, second: np.ndarray) -> np.ndarray:
        return np.abs(interquartile_mean(first) - interquartile_mean(second))

    # The pair in either order is the same test and has the same random numbers.
    pair = sorted([ours.tolist(), other.tolist()])
    rows = np.tile(np.concatenate(pair), (_DRAWS, 1))
    rows = np.random.default_rng(0).permuted(rows, axis=1)
    dealt = distance(*np.split(rows, [len(pair[0])], axis=1))
    # Sums in another order differ by rounding.
    as_far = dealt >= distance(ours, other) * (1 - 1e-9)
    return float((1 + as_far.sum()) / (1 + _DRAWS))


def compare(
    scores: Scores, family: Comparisons, dropped: int = 0
) -> dict[tuple[str, ...], Comparison]:
    """Return the comparisons of a family whose curves all have scores.

    The p-value is the percentile bootstrap's: twice the share of draws on the other
    side of 0. With few seeds that is too small. So for two curves it is the larger of
    the bootstrap's and the permutation test's; for a difference of differences it is
    the bootstrap's alone. Holm's method multiplies the smallest p-value by the number
    of comparisons, the next by one less, and so on, and makes none smaller than the one
    before.
    """
    complete = {
        key: terms
        for key, terms in family.items()
        if all((panel, curve) in scores for _, panel, curve in terms)
    }
    effects = {}
    for key, terms in complete.items():
        sides = [scores[panel, curve] for _, panel, curve in terms]
        drawn = np.sum([w * draws(scores, *curve) for w, *curve in terms], axis=0)
        middle = sum(w * float(interquartile_mean(scores[p, c])) for w, p, c in terms)
        enough = all(len(x) >= FEWEST_SEEDS and np.isfinite(x).all() for x in sides)
        p_value = bootstrap_p(drawn) if enough else 1.0
        if enough and len(sides) == 2:
            p_value = max(p_value, permutation_p(*sides))
        effects[key] = Effect(middle, p_value, drawn)
    return judged(effects, dropped)


def bootstrap_p(drawn: np.ndarray) -> float:
    """Return the p-value of bootstrap samples of an effect, (draws,)."""
    beyond = min(int((drawn <= 0).sum()), int((drawn >= 0).sum()))
    return min(1.0, 2 * (1 + beyond) / (1 + len(drawn)))


def visible_effect(drawn: np.ndarray, comparisons: int) -> float:
    """Return the smallest true effect that would be found with a probability of 80%.

    The level of the test is `LEVEL` / `comparisons`, as for Holm's smallest p-value.
    """
    quantile = statistics.NormalDist().inv_cdf
    errors = quantile(1 - LEVEL / (2 * comparisons)) + quantile(_POWER)
    return errors * float(np.std(drawn))


def corrected(p_values: Mapping[Any, float], dropped: int = 0) -> dict[Any, float]:
    """Return the p-values of a family, corrected by Holm's method.

    Those that are dropped, because their runs are, count as if they were the largest.
    """
    higher, least = {}, 0.0
    for i, key in enumerate(sorted(p_values, key=lambda key: p_values[key])):
        least = max(least, min(1.0, p_values[key] * (len(p_values) + dropped - i)))
        higher[key] = least
    return {key: higher[key] for key in p_values}


def more(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return 1 where one is more than the other, and one half where they are equal."""
    return np.add(one > other, one >= other, dtype=np.int8) / 2


def share_of_more(ours: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return the share of pairs of seeds in which ours is more, from (..., seeds)."""
    return more(ours[..., :, None], others[..., None, :]).mean(axis=(-1, -2))


def improvement_share(scores: Scores, panel: str, ours: str, other: str) -> float:
    """Return `share_of_more` of two curves, NaN below all; NaN without scores."""
    if not {(panel, ours), (panel, other)} <= scores.keys():
        return math.nan
    pair = [
        np.nan_to_num(scores[panel, x], nan=-np.inf, neginf=-np.inf)
        for x in (ours, other)
    ]
    return float(share_of_more(*pair))


def improvement(scores: Scores, panels: Sequence[str], ours: str, *, other: str) -> str:
    """Return the probability of improvement over the panels, as text.

    It is the probability that a random seed of `ours` has a higher score than a random
    seed of `other`, where equal scores count half, averaged over the panels (Agarwal et
    al. 2021). The 95% percentile bootstrap interval is over seeds, drawn within each
    panel. A NaN, the score of a seed that ended no episode, is below all other scores.
    """
    rng = generator(f"{ours}/{other}")

    def resampled(values: np.ndarray) -> np.ndarray:
        return values[rng.integers(len(values), size=(_DRAWS // 10, len(values)))]

    def of(panel: str, x: str) -> np.ndarray:
        return np.nan_to_num(scores[panel, x], nan=-np.inf, neginf=-np.inf)

    pairs = [(of(panel, ours), of(panel, other)) for panel in panels]
    middle = np.mean([share_of_more(*pair) for pair in pairs])
    drawn = [share_of_more(*map(resampled, pair)) for pair in pairs]
    low, high = np.percentile(np.mean(drawn, axis=0), [2.5, 97.5])
    return in_words(float(middle), low, high, ".2f")


def counted(verdicts: Sequence[str]) -> str:
    """Return the count of each verdict as text, such as "better on 2, worse on 1"."""
    words = [word for word in _VERDICTS if word in verdicts]
    return ", ".join(f"{word} on {verdicts.count(word)}" for word in words)


def number(value: float, spec: str = "") -> str:
    """Return a score as text; by default without decimals from 100 on."""
    return format(value, spec or (".0f" if abs(value) >= 100 else ".1f"))


def in_words(middle: float, low: float, high: float, spec: str = "") -> str:
    """Return a number and its interval as text, formatted as by `number`."""
    return "{} [{}, {}]".format(*(number(x, spec) for x in (middle, low, high)))


def interval(scores: np.ndarray) -> str:
    """Return as text the interquartile mean of (seeds,), if enough with an interval."""
    middle = float(interquartile_mean(scores))
    if len(scores) < FEWEST_SEEDS:
        return number(middle)
    low, high = map(float, bootstrap_interval(scores))
    return in_words(middle, low, high)


def over_tasks(name: str, scores: Sequence[np.ndarray]) -> str:
    """Return the interquartile mean over the seeds of all tasks, as text.

    Every task has the same weight; its scores are (seeds,), in one unit. The 95%
    interval is the percentile bootstrap's over seeds, drawn within each task; `name`
    seeds its random numbers.
    """
    most = math.lcm(*map(len, scores))
    rng = generator(name)
    drawn = [
        [rng.choice(x, len(x)).repeat(most // len(x)) for x in scores]
        for _ in range(_DRAWS // 10)
    ]
    means = interquartile_mean(np.reshape(drawn, (len(drawn), -1)), axis=1)
    low, high = np.percentile(means, [2.5, 97.5])
    every = np.concatenate([x.repeat(most // len(x)) for x in scores])
    return in_words(float(interquartile_mean(every)), low, high, ".2f")

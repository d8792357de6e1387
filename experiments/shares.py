"""Shares of seeds that solve a task, steps until then, and their comparisons.

Where a task is either solved or not, this says more than a mean return. Verdicts are
corrected by Holm's method for the number of comparisons in their family.
"""

import functools
import math
from collections.abc import Mapping, Sequence

import numpy as np

from experiments.comparisons import (
    Effect,
    bootstrap_p,
    corrected,
    more,
    verdict,
)
from experiments.search import generator
from experiments.store import Record

#: Which seeds solve a panel's task, bool (seeds,), by panel and curve.
Solved = Mapping[tuple[str, str], np.ndarray]
#: The results of `steps_until_solved`, (seeds,), by panel and curve.
Steps = Mapping[tuple[str, str], np.ndarray]
#: Our curve, and the other one.
Pair = tuple[str, str]
_DRAWS = 10_000


def steps_until_solved(record: Record, success: float) -> float:
    """Return the steps after which a run's mean return is half of a success's.

    They are infinite for a run that does not solve its task: whose final return is less
    than half of a success's, whatever it was before.
    """
    if not record.final >= success / 2:
        return math.inf
    return float(record.env_steps[(record.episode_return >= success / 2).argmax()])


@functools.cache
def fisher_p(ours: int, our_seeds: int, other: int, other_seeds: int) -> float:
    """Return the p-value of Fisher's exact test, two-sided.

    `ours` of our seeds and `other` of the other curve's solve the task.
    """
    solved, seeds = ours + other, our_seeds + other_seeds

    def ways(x: int) -> int:
        return math.comb(our_seeds, x) * math.comb(other_seeds, solved - x)

    counts = range(max(0, solved - other_seeds), min(solved, our_seeds) + 1)
    as_rare = [ways(x) for x in counts if ways(x) <= ways(ours)]
    return sum(as_rare) / math.comb(seeds, solved)


def verdicts(
    solved: Solved, pairs: Sequence[tuple[str, str, str]], dropped: int = 0
) -> dict[tuple[str, str, str], str]:
    """Return the verdicts of a family of (panel, ours, other)."""
    middle, p_values = {}, {}
    for key in pairs:
        first, second = (solved[key[0], curve] for curve in key[1:])
        middle[key] = float(first.mean() - second.mean())
        counts = (int(first.sum()), len(first), int(second.sum()), len(second))
        p_values[key] = fisher_p(*counts)
    return {k: verdict(middle[k], p) for k, p in corrected(p_values, dropped).items()}


def _mean_lead(
    solved: Solved, panels: Sequence[str], pair: Pair, rng: np.random.Generator
) -> tuple[float, np.ndarray]:
    """Return the mean over panels of a pair's difference, and its bootstrap draws."""
    middle, drawn = 0.0, np.zeros(_DRAWS)
    for panel in panels:
        for curve, sign in zip(pair, (1, -1)):
            seeds = solved[panel, curve]
            middle += sign * float(seeds.mean())
            drawn += sign * rng.binomial(len(seeds), seeds.mean(), _DRAWS) / len(seeds)
    return middle / len(panels), drawn / len(panels)


def overall(solved: Solved, panels: Sequence[str], pair: Pair) -> Effect:
    """Return the mean difference over panels.

    The p-value is that of a permutation of seeds within each panel.
    """
    rng = generator("/".join(pair))
    middle, drawn = _mean_lead(solved, panels, pair, rng)
    dealt = np.zeros(_DRAWS)
    for panel in panels:
        first, second = (solved[panel, curve] for curve in pair)
        total = int(first.sum() + second.sum())
        left = len(first) + len(second) - total
        got = rng.hypergeometric(total, left, len(first), _DRAWS)
        dealt += got / len(first) - (total - got) / len(second)
    as_far = int(np.sum(np.abs(dealt) >= abs(middle) * len(panels) - 1e-9))
    return Effect(middle, (1 + as_far) / (1 + _DRAWS), drawn)


def change(
    solved: Solved, panels: Sequence[str], others: Sequence[str], *, pair: Pair
) -> Effect:
    """Return how much a pair's mean difference is larger on other panels.

    The p-value is that of the percentile bootstrap.
    """
    rng = generator("/".join(pair))
    before, after = (_mean_lead(solved, x, pair, rng) for x in (panels, others))
    drawn = after[1] - before[1]
    return Effect(after[0] - before[0], bootstrap_p(drawn), drawn)


def sooner(steps: Steps, panels: Sequence[str], pair: Pair) -> Effect:
    """Return how much more often than not a seed of ours is sooner.

    It is the probability that a random seed of ours solves its task in fewer steps than
    a random seed of the other curve, where equal ones count half, less one half,
    averaged over panels. The p-value is that of a permutation of seeds within each
    panel.
    """
    rng, middle = generator("/".join(pair)), 0.0
    dealt, drawn = np.zeros(_DRAWS), np.zeros(_DRAWS)
    for panel in panels:
        both = [steps[panel, curve] for curve in pair]
        ours, other = map(len, both)
        # Ours is sooner where the other's steps are more: (our seeds, other seeds).
        wins = more(both[1][None, :], both[0][:, None]) - 0.5
        middle += float(wins.mean())
        # The sum of the other's ranks says how often its steps are more.
        pooled = np.concatenate(both)
        ranks = np.tile(more(pooled[:, None], pooled).sum(axis=1), (_DRAWS, 1))
        sums = rng.permuted(ranks, axis=1)[:, ours:].sum(axis=1)
        dealt += (sums - other**2 / 2) / (ours * other) - 0.5
        first, second = (_resampled(size, rng) for size in (ours, other))
        drawn += np.sum(first @ wins * second, axis=1)
    as_far = int(np.sum(np.abs(dealt) >= abs(middle) - 1e-9))
    p_value = (1 + as_far) / (1 + _DRAWS)
    return Effect(middle / len(panels), p_value, drawn / len(panels))


def _resampled(size: int, rng: np.random.Generator) -> np.ndarray:
    """Return the share of each seed in bootstrap samples, (draws, seeds)."""
    drawn = rng.integers(size, size=(_DRAWS, size)) + size * np.arange(_DRAWS)[:, None]
    counts = np.bincount(drawn.ravel(), minlength=_DRAWS * size)
    return counts.reshape(_DRAWS, size) / size

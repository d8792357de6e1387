"""Shares of seeds that solve a task, steps until then, and their comparisons.

Where a task is either solved or not, this says more than a mean return. Verdicts are
corrected by Holm's method for the number of comparisons in their family.
"""

import dataclasses
import functools
import math
import zlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from experiments.comparisons import (
    LEVEL,
    bootstrap_p,
    corrected,
    share_of_more,
    visible_effect,
)
from experiments.store import Record

#: Which seeds solve a panel's task, bool (seeds,), by panel and curve.
Solved = Mapping[tuple[str, str], np.ndarray]
#: The results of `steps_until_solved`, (seeds,), by panel and curve.
Steps = Mapping[tuple[str, str], np.ndarray]
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

    Args:
      ours: number of our seeds that solve the task.
      our_seeds: number of our seeds.
      other: number of the other curve's seeds that solve it.
      other_seeds: number of its seeds.
    """
    solved, seeds = ours + other, our_seeds + other_seeds

    def ways(x: int) -> int:
        return math.comb(our_seeds, x) * math.comb(other_seeds, solved - x)

    counts = range(max(0, solved - other_seeds), min(solved, our_seeds) + 1)
    as_rare = [ways(x) for x in counts if ways(x) <= ways(ours)]
    return sum(as_rare) / math.comb(seeds, solved)


@dataclasses.dataclass(frozen=True)
class Difference:
    """A difference of shares.

    Attributes:
      middle: the difference.
      p: its p-value, corrected.
    """

    middle: float
    p: float

    @property
    def verdict(self) -> str:
        """Better, worse or not clear."""
        if self.p > LEVEL:
            return "not clear"
        return "better" if self.middle > 0 else "worse"


def compare(
    solved: Solved, pairs: Sequence[tuple[str, str, str]]
) -> dict[tuple[str, str, str], Difference]:
    """Return the differences of a family of (panel, ours, other)."""
    middle, p_values = {}, {}
    for panel, ours, other in pairs:
        first, second = solved[panel, ours], solved[panel, other]
        key = panel, ours, other
        middle[key] = float(first.mean() - second.mean())
        counts = (int(first.sum()), len(first), int(second.sum()), len(second))
        p_values[key] = fisher_p(*counts)
    return {k: Difference(middle[k], p) for k, p in corrected(p_values).items()}


@dataclasses.dataclass(frozen=True)
class Lead(Difference):
    """A difference of shares that is averaged over panels.

    Attributes:
      drawn: its bootstrap samples over seeds, drawn within each panel, (draws,).
      comparisons: the number of comparisons in its family.
    """

    drawn: np.ndarray
    comparisons: int = 1

    def __str__(self) -> str:
        return "{:+z.2f} [{:+z.2f}, {:+z.2f}]".format(*self.middle_and_interval)

    @property
    def middle_and_interval(self) -> tuple[float, float, float]:
        """The difference, and the ends of its 95% interval."""
        low, high = np.percentile(self.drawn, [2.5, 97.5])
        return self.middle, float(low), float(high)

    @property
    def verdict_in_words(self) -> str:
        """The verdict; if it is not clear, with what would have been."""
        if self.verdict != "not clear":
            return self.verdict
        visible = visible_effect(self.drawn, self.comparisons)
        return f"not clear (visible from {visible:.2f} on)"


def family(leads: Mapping[Any, Lead]) -> dict[Any, Lead]:
    """Return the leads of a family with their p-values corrected."""
    p_values = corrected({key: lead.p for key, lead in leads.items()})
    count = len(leads)
    return {
        key: dataclasses.replace(lead, p=p_values[key], comparisons=count)
        for key, lead in leads.items()
    }


def _mean_lead(
    solved: Solved,
    panels: Sequence[str],
    pair: tuple[str, str],
    rng: np.random.Generator,
) -> tuple[float, np.ndarray]:
    """Return the mean over panels of a pair's difference, and its bootstrap draws."""
    middle, drawn = 0.0, np.zeros(_DRAWS)
    for panel in panels:
        for curve, sign in zip(pair, (1, -1)):
            seeds = solved[panel, curve]
            middle += sign * float(seeds.mean())
            drawn += sign * rng.binomial(len(seeds), seeds.mean(), _DRAWS) / len(seeds)
    return middle / len(panels), drawn / len(panels)


def overall(solved: Solved, panels: Sequence[str], ours: str, *, other: str) -> Lead:
    """Return the mean difference over panels.

    The p-value, not corrected, is that of a permutation of seeds within each panel.
    """
    rng = np.random.default_rng(zlib.crc32(f"{ours}/{other}".encode()))
    middle, drawn = _mean_lead(solved, panels, (ours, other), rng)
    dealt = np.zeros(_DRAWS)
    for panel in panels:
        first, second = solved[panel, ours], solved[panel, other]
        total = int(first.sum() + second.sum())
        left = len(first) + len(second) - total
        got = rng.hypergeometric(total, left, len(first), _DRAWS)
        dealt += got / len(first) - (total - got) / len(second)
    as_far = int(np.sum(np.abs(dealt) >= abs(middle) * len(panels) - 1e-9))
    return Lead(middle, (1 + as_far) / (1 + _DRAWS), drawn)


def change(
    solved: Solved,
    panels: Sequence[str],
    others: Sequence[str],
    *,
    pair: tuple[str, str],
) -> Lead:
    """Return how much a pair's mean difference is larger on other panels.

    The p-value, not corrected, is that of the percentile bootstrap.
    """
    rng = np.random.default_rng(zlib.crc32("/".join(pair).encode()))
    before, after = (_mean_lead(solved, x, pair, rng) for x in (panels, others))
    drawn = after[1] - before[1]
    return Lead(after[0] - before[0], bootstrap_p(drawn), drawn)


def sooner(steps: Steps, panels: Sequence[str], ours: str, *, other: str) -> Lead:
    """Return how much more often than not a seed of ours is sooner.

    It is the probability that a random seed of ours solves its task in fewer steps than
    a random seed of the other curve, where equal ones count half, less one half,
    averaged over panels. The p-value, not corrected, is that of a permutation of seeds
    within each panel.
    """
    rng = np.random.default_rng(zlib.crc32(f"{ours}/{other}".encode()))
    middle, dealt, drawn = 0.0, np.zeros(_DRAWS), np.zeros(_DRAWS)
    for panel in panels:
        pair = steps[panel, ours], steps[panel, other]
        # Ours is sooner where the other's steps are more.
        middle += float(share_of_more(*pair[::-1])) - 0.5
        all_seeds = np.tile(np.concatenate(pair), (_DRAWS, 1))
        parts = np.split(rng.permuted(all_seeds, axis=1), [len(pair[0])], axis=1)
        dealt += share_of_more(*parts[::-1]) - 0.5
        resampled = [rng.choice(x, (_DRAWS, len(x))) for x in pair]
        drawn += share_of_more(*resampled[::-1]) - 0.5
    as_far = int(np.sum(np.abs(dealt) >= abs(middle) - 1e-9))
    p_value = (1 + as_far) / (1 + _DRAWS)
    return Lead(middle / len(panels), p_value, drawn / len(panels))

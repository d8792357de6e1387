"""Shares of seeds that solve a task, and their comparisons.

Where a task is either solved or not, this says more than a mean return. Verdicts are
corrected by Holm's method for the number of comparisons in their family.
"""

import dataclasses
import functools
import math
import zlib
from collections.abc import Mapping, Sequence

import numpy as np

from experiments.comparisons import LEVEL, corrected
from experiments.store import Record

#: Which seeds solve a panel's task, bool (seeds,), by panel and curve.
Solved = Mapping[tuple[str, str], np.ndarray]
_DRAWS = 10_000


def is_solved(record: Record, threshold: float) -> bool:
    """Return whether a run's final return is at least half of a success's."""
    return record.final >= threshold / 2


def steps_until(record: Record, threshold: float) -> float:
    """Return the steps after which the mean return is half of a success's, or NaN."""
    reached = record.episode_return >= threshold / 2
    return float(record.env_steps[reached.argmax()]) if reached.any() else math.nan


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


def overall(
    solved: Solved, panels: Sequence[str], ours: str, *, other: str
) -> tuple[float, tuple[float, float], float]:
    """Return the mean difference over panels, its 95% interval, and its p-value.

    The interval is the percentile bootstrap's over seeds, drawn within each panel. The
    p-value, not corrected, is that of a permutation of seeds within each panel.
    """
    rng = np.random.default_rng(zlib.crc32(f"{ours}/{other}".encode()))
    middle, drawn, dealt = 0.0, np.zeros(_DRAWS), np.zeros(_DRAWS)
    for panel in panels:
        first, second = solved[panel, ours], solved[panel, other]
        middle += first.mean() - second.mean()
        sizes = len(first), len(second)
        shares = [rng.binomial(len(x), x.mean(), _DRAWS) for x in (first, second)]
        drawn += shares[0] / sizes[0] - shares[1] / sizes[1]
        total = int(first.sum() + second.sum())
        got = rng.hypergeometric(total, sum(sizes) - total, sizes[0], _DRAWS)
        dealt += got / sizes[0] - (total - got) / sizes[1]
    low, high = np.percentile(drawn, [2.5, 97.5]) / len(panels)
    as_far = int(np.sum(np.abs(dealt) >= abs(middle) - 1e-9))
    interval = float(low), float(high)
    return middle / len(panels), interval, (1 + as_far) / (1 + _DRAWS)

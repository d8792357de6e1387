"""Shares of seeds that solve a task, steps until then, and their comparisons.

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


def _lead(
    solved: Solved,
    panels: Sequence[str],
    pair: tuple[str, str],
    rng: np.random.Generator,
) -> tuple[float, np.ndarray]:
    """Return the mean over panels of a pair's difference, and its bootstrap draws.

    Seeds are drawn within each panel.
    """
    middle, drawn = 0.0, np.zeros(_DRAWS)
    for panel in panels:
        for curve, sign in zip(pair, (1, -1)):
            seeds = solved[panel, curve]
            middle += sign * seeds.mean()
            drawn += sign * rng.binomial(len(seeds), seeds.mean(), _DRAWS) / len(seeds)
    return middle / len(panels), drawn / len(panels)


def overall(
    solved: Solved, panels: Sequence[str], ours: str, *, other: str
) -> tuple[float, tuple[float, float], float]:
    """Return the mean difference over panels, its 95% interval, and its p-value.

    The interval is the percentile bootstrap's over seeds, drawn within each panel. The
    p-value, not corrected, is that of a permutation of seeds within each panel.
    """
    rng = np.random.default_rng(zlib.crc32(f"{ours}/{other}".encode()))
    middle, drawn = _lead(solved, panels, (ours, other), rng)
    dealt = np.zeros(_DRAWS)
    for panel in panels:
        first, second = solved[panel, ours], solved[panel, other]
        total = int(first.sum() + second.sum())
        left = len(first) + len(second) - total
        got = rng.hypergeometric(total, left, len(first), _DRAWS)
        dealt += got / len(first) - (total - got) / len(second)
    low, high = np.percentile(drawn, [2.5, 97.5])
    as_far = int(np.sum(np.abs(dealt) >= abs(middle) * len(panels) - 1e-9))
    return middle, (float(low), float(high)), (1 + as_far) / (1 + _DRAWS)


def change(
    solved: Solved,
    panels: Sequence[str],
    others: Sequence[str],
    *,
    pair: tuple[str, str],
) -> tuple[float, tuple[float, float], float]:
    """Return how much a pair's mean difference is larger on other panels.

    The 95% interval and the p-value, not corrected, are those of the percentile
    bootstrap over seeds, drawn within each panel.
    """
    rng = np.random.default_rng(zlib.crc32("/".join(pair).encode()))
    before, after = (_lead(solved, x, pair, rng) for x in (panels, others))
    drawn = after[1] - before[1]
    low, high = np.percentile(drawn, [2.5, 97.5])
    beyond = min(int((drawn <= 0).sum()), int((drawn >= 0).sum()))
    p_value = min(1.0, 2 * (1 + beyond) / (1 + _DRAWS))
    return after[0] - before[0], (float(low), float(high)), p_value


def sooner(
    steps: Steps, panels: Sequence[str], ours: str, *, other: str
) -> tuple[float, float]:
    """Return how much more often than not a seed of ours is sooner, and its p-value.

    It is the probability that a random seed of ours solves its task in fewer steps than
    a random seed of the other curve, where equal ones count half, less one half,
    averaged over panels. The p-value, not corrected, is that of a permutation of seeds
    within each panel.
    """
    rng = np.random.default_rng(zlib.crc32(f"{ours}/{other}".encode()))
    middle, dealt = 0.0, np.zeros(_DRAWS)
    for panel in panels:
        first, second = steps[panel, ours], steps[panel, other]
        x = np.concatenate([first, second])
        # How many seeds are later; equal ones, and the seed itself, count half.
        later = ((x > x[:, None]) + 0.5 * (x == x[:, None])).sum(axis=1)
        among_ours = len(first) ** 2 / 2
        pairs = len(first) * len(second)
        middle += (later[: len(first)].sum() - among_ours) / pairs - 0.5
        rows = rng.permuted(np.tile(later, (_DRAWS, 1)), axis=1)[:, : len(first)]
        dealt += (rows.sum(axis=1) - among_ours) / pairs - 0.5
    as_far = int(np.sum(np.abs(dealt) >= abs(middle) - 1e-9))
    return middle / len(panels), (1 + as_far) / (1 + _DRAWS)

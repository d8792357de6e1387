"""Interquartile means and their intervals over seeds (Agarwal et al. 2021)."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from gasil_jax.errors import refusal

#: Fewer seeds tell too little for an interval.
FEWEST_SEEDS = 5


def interquartile_mean(scores: np.ndarray, axis: int = -1) -> np.ndarray:
    """Return the mean of the middle half of `scores` along an axis.

    If their number is not a multiple of four, the outermost scores of the middle half
    count in part. The package rliable drops whole scores instead, so that the two agree
    for multiples of four only.
    """
    scores = np.asarray(scores)
    if scores.dtype.kind not in "biuf" or not scores.size or not scores.ndim:
        raise refusal("scores", scores.tolist(), "an array of numbers, one or more")
    ordered = np.moveaxis(np.sort(scores, axis=axis), axis, -1)
    count = ordered.shape[-1]
    # The weight of score i is how much of [i, i + 1] lies in [count / 4, 3 count / 4].
    index = np.arange(count)
    weight = np.minimum(index + 1, 0.75 * count) - np.maximum(index, 0.25 * count)
    weight = np.maximum(weight, 0.0)
    return (ordered * weight).sum(axis=-1) / weight.sum()


def bootstrap_interval(
    scores: np.ndarray, resamples: int = 2000
) -> tuple[np.ndarray, np.ndarray]:
    """Return the 95% percentile bootstrap interval of the interquartile mean.

    Args:
      scores: (seeds, ...). Seeds are drawn with replacement, the same ones for all
        trailing entries, which have an interval each.
      resamples: number of resamples; their draws are the same in every call.

    Returns:
      The low and high ends of the intervals, (...) each.
    """
    count = scores.shape[0]
    drawn = np.random.default_rng(0).integers(count, size=(resamples, count))
    flat = scores.reshape(count, -1)
    # One column at a time, because all at once need `resamples` times the memory.
    means = np.stack(
        [interquartile_mean(column[drawn], axis=1) for column in flat.T], axis=1
    )
    low, high = np.percentile(means, [2.5, 97.5], axis=0)
    return low.reshape(scores.shape[1:]), high.reshape(scores.shape[1:])


class Estimate(NamedTuple):
    """An interquartile mean over seeds, with its interval.

    Attributes:
      interquartile_mean: the mean of the middle half; None if no score is finite.
      interval: the ends of its 95% bootstrap interval; None for fewer than five seeds.
    """

    interquartile_mean: float | None
    interval: tuple[float, float] | None

    def __str__(self) -> str:
        if self.interquartile_mean is None:
            return "unknown"
        middle = f"{self.interquartile_mean:.1f}"
        if self.interval is None:
            return middle
        low, high = self.interval
        return f"{middle} [{low:.1f}, {high:.1f}]"


def estimate(scores: np.ndarray) -> Estimate:
    """Return the interquartile mean of scores, (seeds,), and its interval.

    Scores that are not finite are left out.
    """
    finite = scores[np.isfinite(scores)]
    if not finite.size:
        return Estimate(None, None)
    interval = None
    if finite.size >= FEWEST_SEEDS:
        low, high = bootstrap_interval(finite)
        interval = (float(low), float(high))
    return Estimate(float(interquartile_mean(finite)), interval)


def in_words(scores: Mapping[str, np.ndarray]) -> str:
    """Return estimates of the same seeds' scores, (seeds,) each, as a line to print."""
    estimates = {name: estimate(values) for name, values in scores.items()}
    shown = ", ".join(f"{name} {value}" for name, value in estimates.items())
    (count,) = {len(values) for values in scores.values()}
    if count == 1:
        return f"{shown} (1 seed)"
    has_interval = any(x.interval is not None for x in estimates.values())
    interval = " [95% interval]" if has_interval else ""
    return f"{shown} (interquartile mean{interval} over {count} seeds)"


def performance_profile(scores: np.ndarray, levels: np.ndarray) -> np.ndarray:
    """Return the share of seeds above each level: (seeds,), (levels,) -> (levels,)."""
    return np.mean(scores[:, None] > levels[None, :], axis=0)

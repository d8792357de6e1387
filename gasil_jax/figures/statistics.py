"""Interquartile means and their intervals over seeds (Agarwal et al. 2021)."""

import numpy as np


def interquartile_mean(scores: np.ndarray, axis: int = -1) -> np.ndarray:
    """The mean of the middle half of `scores` along an axis.

    Where four does not divide their number, a quarter of it has a fraction of a score:
    the outermost that are left count in part, where the package rliable drops whole
    scores. The same where four divides it.
    """
    ordered = np.moveaxis(np.sort(scores, axis=axis), axis, -1)
    count = ordered.shape[-1]
    # How much of each score, [i, i + 1], lies in [count / 4, 3 count / 4].
    place = np.arange(count)
    weight = np.minimum(place + 1, 0.75 * count) - np.maximum(place, 0.25 * count)
    weight = np.maximum(weight, 0.0)
    return (ordered * weight).sum(axis=-1) / weight.sum()


def bootstrap_interval(
    scores: np.ndarray,
    *,
    confidence: float = 0.95,
    resamples: int = 2000,
    seed: int = 0,
) -> tuple[np.ndarray, np.ndarray]:
    """Percentile bootstrap interval of the interquartile mean over seeds.

    Args:
      scores: (seeds, ...); each of the trailing places is its own stratum, seeds are
        drawn with replacement, the same ones for every place.
      confidence: share of the resampled means inside the interval.
      resamples: how many.
      seed: of the draws.

    Returns:
      its ends, (...) each.
    """
    count = scores.shape[0]
    drawn = np.random.default_rng(seed).integers(count, size=(resamples, count))
    flat = scores.reshape(count, -1)
    # A place at a time: all at once would take resamples times the scores' memory.
    means = np.stack(
        [interquartile_mean(column[drawn], axis=1) for column in flat.T], axis=1
    )
    tail = 50.0 * (1.0 - confidence)
    low, high = np.percentile(means, [tail, 100.0 - tail], axis=0)
    return low.reshape(scores.shape[1:]), high.reshape(scores.shape[1:])


def performance_profile(scores: np.ndarray, levels: np.ndarray) -> np.ndarray:
    """The share of seeds above each level: (seeds,), (levels,) -> (levels,)."""
    return np.mean(scores[:, None] > levels[None, :], axis=0)


def final_returns(returns: np.ndarray) -> np.ndarray:
    """Each seed's mean return over the last tenth of iterations, (seeds,).

    The same of another metric of episodes: their length. Where no episode ended in that
    time, of the last iteration in which one did, for in some tasks all last as long;
    NaN where none has.
    """
    last = returns[:, -max(1, returns.shape[1] // 10) :]
    count = np.isfinite(last).sum(axis=1)
    mean = np.nansum(last, axis=1) / np.maximum(count, 1)
    ended = np.isfinite(returns)
    place = returns.shape[1] - 1 - ended[:, ::-1].argmax(axis=1)
    newest = np.take_along_axis(returns, place[:, None], axis=1)[:, 0]
    newest = np.where(ended.any(axis=1), newest, np.nan)
    return np.where(count > 0, mean, newest)

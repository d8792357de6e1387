"""Statistics against plain twins."""

import numpy as np
import pytest
import scipy.stats

from gasil_jax import statistics


@pytest.mark.parametrize("count", [4, 8, 20])
def test_the_interquartile_mean_is_scipys_trimmed_mean(count):
    scores = np.random.default_rng(count).normal(size=(count, 3))
    np.testing.assert_allclose(
        statistics.interquartile_mean(scores, axis=0),
        scipy.stats.trim_mean(scores, 0.25, axis=0),
    )


def test_the_interquartile_mean_of_counts_that_no_four_divides():
    assert statistics.interquartile_mean(np.array([7.0])) == 7.0
    assert statistics.interquartile_mean(np.array([1.0, 3.0])) == 2.0
    # Of five: a quarter of 5 is 1.25, so 2 and 4 count 0.75 each and 3 whole.
    scores = np.array([100.0, 3.0, 2.0, 4.0, -50.0])
    assert statistics.interquartile_mean(scores) == pytest.approx(
        (0.75 * 2 + 3 + 0.75 * 4) / 2.5
    )


def test_the_interval_is_scipys():
    scores = np.random.default_rng(0).gamma(2.0, size=(30, 2))
    low, high = statistics.bootstrap_interval(scores, resamples=4000)
    for i in range(2):
        given = {"n_resamples": 4000, "rng": np.random.default_rng(1)}
        expected = scipy.stats.bootstrap(
            (scores[:, i],), statistics.interquartile_mean, method="percentile", **given
        ).confidence_interval
        np.testing.assert_allclose([low[i], high[i]], expected, atol=0.05)


def test_seeds_are_told_in_one_way():
    scores = np.array([1.0, 2.0, 3.0, 4.0, 90.0])
    low, high = statistics.bootstrap_interval(scores)
    told = f"3.0 [{low:.1f}, {high:.1f}]"
    assert str(statistics.estimate(scores)) == told
    assert statistics.in_words({"return": scores, "length": np.ones(5)}) == (
        f"return {told}, length 1.0 [1.0, 1.0] "
        "(interquartile mean [95% interval] over 5 seeds)"
    )
    # Fewer have no interval, and an unknown score counts nowhere.
    scores[4] = np.nan
    assert statistics.estimate(scores) == (2.5, None)
    assert statistics.in_words({"return": scores[1:2]}) == "return 2.0 (1 seed)"
    unknown = {"return": np.full(3, np.nan)}
    assert statistics.in_words(unknown).startswith("return unknown (interq")


def test_the_profile_counts():
    scores, levels = np.array([1.0, 2.0, 3.0, 4.0]), np.array([0.0, 2.0, 3.5, 9.0])
    profile = statistics.performance_profile(scores, levels)
    np.testing.assert_array_equal(profile, [1.0, 0.5, 0.25, 0.0])

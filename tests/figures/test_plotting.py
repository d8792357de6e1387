"""Smoothing against a plain loop."""

import numpy as np

from gasil_jax.figures import plotting


def test_smooth_is_the_mean_of_the_last_that_are_there():
    curves = np.array([[np.nan, 1.0, 2.0, np.nan, np.nan, np.nan, 6.0, 4.0], range(8)])
    smoothed = plotting.smooth(curves, 3)
    for curve, result in zip(curves, smoothed, strict=True):
        for i, value in enumerate(result):
            seen = [x for x in curve[max(0, i - 2) : i + 1] if not np.isnan(x)]
            expected = np.mean(seen) if seen else np.nan
            np.testing.assert_allclose(value, expected, atol=1e-12)

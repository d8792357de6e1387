"""Running normalization against NumPy over all that was seen."""

import jax.numpy as jnp
import numpy as np
import pytest

from gasil_jax import normalization


def test_batches_give_the_statistics_of_all_rows():
    rng = np.random.default_rng(0)
    batches = [rng.normal(3.0, [0.1, 20.0], (n, 2)).astype("f") for n in (5, 1, 300)]
    normalizer = normalization.init(2)
    for batch in batches:
        normalizer = normalization.update(normalizer, jnp.asarray(batch))
    rows = np.concatenate(batches).astype(np.float64)
    np.testing.assert_allclose(normalizer.mean, rows.mean(0), rtol=1e-5)
    np.testing.assert_allclose(normalizer.m2 / len(rows), rows.var(0), rtol=1e-4)
    normalized = normalization.normalize(normalizer, jnp.asarray(rows, jnp.float32))
    expected = (rows - rows.mean(0)) / np.sqrt(rows.var(0) + 1e-8)
    np.testing.assert_allclose(normalized, expected, atol=1e-3)


@pytest.mark.parametrize("number", [np.nan, np.inf, -1e20, 1e11])
def test_rows_that_are_not_sound_are_left_out(number):
    rows = jnp.array([[1.0, 2.0], [number, 0.0], [0.0, number], [3.0, 6.0]])
    normalizer = normalization.update(normalization.init(2), rows)
    assert float(normalizer.count) == 2
    np.testing.assert_allclose(normalizer.mean, [2.0, 4.0])
    np.testing.assert_allclose(normalizer.m2, [2.0, 8.0])


def test_before_any_observation_it_only_clips():
    result = normalization.normalize(normalization.init(2), jnp.array([0.5, -1e6]))
    np.testing.assert_allclose(result, [0.5, -10.0], rtol=1e-6)

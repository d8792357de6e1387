"""Random permutations against JAX's and NumPy's."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gasil_jax.permutation import argsort, permutation


@pytest.mark.parametrize("size", [1, 7, 2048, 3000, 2**16 + 1])
def test_the_order_is_that_of_jax(size):
    key = jax.random.key(size)
    ours = jax.jit(permutation, static_argnums=1)(key, size)
    np.testing.assert_array_equal(ours, jax.random.permutation(key, size))
    assert ours.dtype == jnp.int32


@pytest.mark.parametrize("highest", [1, 3, 2**22, 2**32])
def test_argsort_is_stable(highest):
    keys = np.random.default_rng(0).integers(0, highest, 1000, dtype=np.uint32)
    np.testing.assert_array_equal(argsort(keys), np.argsort(keys, kind="stable"))

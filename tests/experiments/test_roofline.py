"""The count of floating-point operations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments import roofline


def _product(x: jax.Array) -> jax.Array:
    return x @ x


def _in_turn(x: jax.Array) -> jax.Array:
    return jax.lax.scan(lambda carry, row: (carry * row, carry + row), x[0], x)[1]


def _until_large(x: jax.Array) -> jax.Array:
    return jax.lax.while_loop(lambda x: x.sum() < 1000.0, lambda x: 2.0 * x, x)


def _chosen(x: jax.Array) -> jax.Array:
    return jax.lax.cond(x[0, 0] > 0, jnp.sqrt, lambda x: x + x + x, x)


@jax.custom_batching.custom_vmap
def _own_batch(x: jax.Array) -> jax.Array:
    return jnp.sin(x)


@_own_batch.def_vmap
def _(size: int, batched: list[bool], x: jax.Array) -> tuple[jax.Array, bool]:
    return jnp.cos(x) + 1.0, True


@pytest.mark.parametrize(
    ("function", "operations"),
    [
        (_product, 2 * 3 * 9),
        # Three rows of three, a product and a sum each.
        (_in_turn, 3 * 3 * 2),
        # 45, 90, ... 1440: five doublings, and six sums of nine numbers.
        (_until_large, 5 * 9 + 6 * 9),
        (_chosen, 9),
        (jax.vmap(_own_batch), 2 * 9),
        (jax.jit(lambda x: jnp.where(x > 5.0, x, -x)), 9),
        (lambda x: x.astype(int) * 2, 0),
    ],
)
def test_each_number_that_is_computed_counts_once(function, operations) -> None:
    x = jnp.arange(1.0, 10.0).reshape(3, 3)
    assert roofline.count_operations(function, x) == operations


def test_loops_and_branches_are_evaluated_as_they_are() -> None:
    x = jnp.arange(1.0, 10.0).reshape(3, 3)
    for function in (_product, _in_turn, _until_large, _chosen, jax.vmap(_own_batch)):
        _, (result,) = roofline.evaluate(jax.make_jaxpr(function)(x), x)
        np.testing.assert_allclose(result, function(x), rtol=1e-6)


def test_a_reversed_loop_keeps_the_order_of_its_rows() -> None:
    def sums(x: jax.Array) -> jax.Array:
        return jax.lax.scan(lambda c, r: (c + r, c + r), 0.0, x, reverse=True)[1]

    x = jnp.arange(4.0)
    _, (result,) = roofline.evaluate(jax.make_jaxpr(sums)(x), x)
    np.testing.assert_array_equal(result, sums(x))

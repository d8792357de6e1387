"""Systems of linear equations, each solved by one warp of a GPU.

Written as XLA's operations, each step of an elimination is a kernel that reads and
writes all matrices. Here a warp has one matrix in its registers from the first step to
the last. Arrays are padded to powers of two, as Triton needs them.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp

# Pallas takes long to import, and only a GPU needs it: functions import it themselves.

# Shape letters: V unknowns, padded in a kernel; B batch.

# On an H100 the elimination of 14 and of 23 unknowns is faster in a kernel, and that of
# 9 is not. The registers of a warp have no room for matrices of more than 32.
SIZES = range(12, 33)


def eliminate(matrix: jax.Array, right: jax.Array, size: int) -> jax.Array:
    """Return x of A x = b for symmetric positive A: (V, V), (V,) -> (V,).

    Gauss-Jordan elimination of the first `size` rows; the others are padding. The block
    that is not eliminated yet stays symmetric. An entry in an eliminated row i and
    another column j is kept at (j, i), where plain elimination would have a zero of the
    identity. So the pivot's row alone holds the factors of all rows, and no column
    needs to be read.
    """
    index = jax.lax.broadcasted_iota(jnp.int32, right.shape, 0)
    row_of = jax.lax.broadcasted_iota(jnp.int32, matrix.shape, 0)
    column_of = jax.lax.broadcasted_iota(jnp.int32, matrix.shape, 1)

    def step(k: jax.Array, carry: Any) -> Any:
        rest, x = carry
        row = jnp.sum(jnp.where(row_of == k, rest, 0.0), axis=0)
        inverse = 1.0 / jnp.sum(jnp.where(index == k, row, 0.0))
        scaled = jnp.where(index == k, -1.0, row) * inverse
        unknown = jnp.sum(jnp.where(index == k, x, 0.0)) * inverse
        rest = jnp.where(column_of == k, 0.0, rest)
        rest = rest - row[:, None] * scaled[None, :]
        return rest, jnp.where(index == k, unknown, x - row * unknown)

    return jax.lax.fori_loop(0, size, step, (matrix, right))[1]


def _kernel(size: int, matrix: Any, right: Any, out: Any) -> None:
    """Solve one system; the padding lies outside the arrays."""
    from jax.experimental.pallas import triton

    (padded,) = out.shape
    index = jax.lax.broadcasted_iota(jnp.int32, (padded,), 0)
    row_of = jax.lax.broadcasted_iota(jnp.int32, (padded, padded), 0)
    column_of = jax.lax.broadcasted_iota(jnp.int32, (padded, padded), 1)
    inside = (row_of < size) & (column_of < size)
    matrix = triton.load(matrix, mask=inside, other=0.0)
    right = triton.load(right, mask=index < size, other=0.0)
    out[:] = eliminate(matrix, right, size)


def solve_linear(
    matrix: jax.Array, right: jax.Array, *, interpret: bool = False
) -> jax.Array:
    """Return x of A x = b for symmetric positive A: (V, V, B), (V, B) -> (V, B).

    Args:
      matrix: A.
      right: b.
      interpret: run the kernel as XLA's operations, on any device, to test it.
    """
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import triton

    size, batch = right.shape
    padded = max(8, pl.next_power_of_2(size))
    of_vectors = pl.BlockSpec((None, padded), lambda b: (b, 0))
    of_matrices = pl.BlockSpec((None, padded, padded), lambda b: (b, 0, 0))
    result = pl.pallas_call(
        functools.partial(_kernel, size),
        grid=(batch,),
        in_specs=[of_matrices, of_vectors],
        out_specs=of_vectors,
        out_shape=jax.ShapeDtypeStruct((batch, padded), jnp.float32),
        compiler_params=triton.CompilerParams(num_warps=1, num_stages=1),
        interpret=interpret,
        name="eliminate",
    )(jnp.moveaxis(matrix, -1, 0), right.T)  # A warp reads a matrix as a whole.
    return result[:, :size].T

"""Constrained accelerations of many problems, in the way that suits the device."""

import jax

from gasil_envs.physics import newton, newton_batch, newton_kernel
from gasil_envs.physics.batching import has_triton


@jax.named_scope("solver")
def solve_many(
    iterations: int,
    line_search: int,
    problem: newton.Problem,
    *,
    for_speed: bool = True,
) -> newton.Solution:
    """Solve a batch of problems, the last axis of all arrays.

    `iterations` and `line_search` are the largest numbers of Newton's iterations and of
    steps of each line search. A CPU's program is unrolled for speed or compiled for
    size.
    """
    if has_triton():
        return newton_kernel.solve_many(iterations, line_search, problem)
    return newton_batch.solve_many(
        iterations, line_search, problem, for_speed=for_speed
    )


def eliminate(matrix: jax.Array, right: jax.Array) -> jax.Array:
    """Return x of A x = b for symmetric positive A: (V, V, B), (V, B) -> (V, B)."""
    if has_triton():
        return newton_kernel.eliminate_many(matrix, right)
    return newton_batch.eliminate(matrix, right)

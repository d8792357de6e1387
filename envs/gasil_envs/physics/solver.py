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
    """Solve a batch of problems.

    Args:
      iterations: largest number of Newton iterations.
      line_search: largest number of steps of each line search.
      problem: the problems; every array has one more axis, the batch, at its end.
      for_speed: whether a CPU's program is unrolled for speed or compiled for size.

    Returns:
      The solutions, with the batch as the last axis of every array.
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

"""Newton's method for small dense constraint problems, many at once.

MuJoCo's constrained acceleration minimizes, over qacc,

    1/2 (qacc - qacc_smooth)' M (qacc - qacc_smooth)
      + 1/2 sum_r D_r min(0, J_r qacc - aref_r)^2

(MuJoCo documentation, "Computation", pyramidal cones: every row is one-sided). The
cost is convex and piecewise quadratic, so Newton's method with an exact line search
ends as soon as it has found the active rows. The number of iterations is fixed, and
every array has the batch as its last axis: with 5 to 30 degrees of freedom the batch
is the only axis that is long enough to fill vector units.

Not reverse-mode differentiable (MJX's own solver is not either, its loop being
dynamic).
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

# Shape letters: V degrees of freedom, R rows, B batch.


@struct.dataclass
class Problem:
    """Constrained dynamics of one instant; float32.

    Attributes:
      inertia: (V, V), the joint-space inertia M.
      force: (V,), all forces but the constraints': M qacc_smooth.
      jacobian: (R, V), zero in rows that are out of play.
      reference: (R,), aref.
      weight: (R,), D, at least 0.
      warmstart: (V,), where to start if that is better than qacc_smooth.
    """

    inertia: jax.Array
    force: jax.Array
    jacobian: jax.Array
    reference: jax.Array
    weight: jax.Array
    warmstart: jax.Array


@struct.dataclass
class Solution:
    """What the constraints do.

    Attributes:
      qacc: (V,), acceleration.
      qacc_smooth: (V,), acceleration without constraints.
      row_force: (R,), force in each row, at least 0.
      constraint_force: (V,), J' row_force.
    """

    qacc: jax.Array
    qacc_smooth: jax.Array
    row_force: jax.Array
    constraint_force: jax.Array


def solve(problem: Problem, iterations: int = 4, line_search: int = 4) -> Solution:
    """Solve one problem; `jax.vmap` it for many, nested as deep as needed."""
    batched = _batch_last(functools.partial(_solve, iterations, line_search))
    solution = batched(jax.tree.map(lambda x: x[..., None], problem))
    return jax.tree.map(lambda x: x[..., 0], solution)


def linear_solve(matrix: jax.Array, right: jax.Array) -> jax.Array:
    """x of A x = b for symmetric positive A: (V, V), (V,) -> (V,); `jax.vmap` it."""
    batched = _batch_last(lambda pair: _eliminate(*pair))
    return batched((matrix[..., None], right[..., None]))[..., 0]


def _batch_last(function: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """`function` of a tree with trailing batch axes, vmapped by making them longer."""
    function = jax.custom_batching.custom_vmap(function)

    @function.def_vmap
    def rule(axis_size: int, in_batched: list[Any], tree: Any) -> tuple[Any, Any]:
        is_batched = in_batched[0]

        def join(x: jax.Array, batched: bool) -> jax.Array:
            if not batched:
                x = jnp.broadcast_to(x, (axis_size, *x.shape))
            x = jnp.moveaxis(x, 0, -2)
            return x.reshape(*x.shape[:-2], -1)

        def part(x: jax.Array) -> jax.Array:
            x = x.reshape(*x.shape[:-1], axis_size, -1)
            return jnp.moveaxis(x, -2, 0)

        joined = _materialize(jax.tree.map(join, tree, is_batched))
        result = _materialize(function(joined))
        result = jax.tree.map(part, result)
        return result, jax.tree.map(lambda _: True, result)

    return function


# XLA's CPU backend fuses a chain of elementwise operations into each of its users and
# computes it anew there; where many read one value, it has to be told to store it.
_materialize = jax.lax.optimization_barrier


def _dot(a: jax.Array, b: jax.Array) -> jax.Array:
    return jnp.sum(a * b, axis=0)


# Above this many entries of the Jacobian, sums are left to reductions: spelled out
# they are up to 4 times as fast, but the time to compile them grows with the entries.
_MOST_ENTRIES_SPELLED_OUT = 700


def _is_small(jacobian: jax.Array) -> bool:
    return jacobian.shape[0] * jacobian.shape[1] <= _MOST_ENTRIES_SPELLED_OUT


def _matvec(matrix: jax.Array, vector: jax.Array) -> jax.Array:
    """(N, V, B), (V, B) -> (N, B)."""
    if _is_small(matrix):
        return sum(matrix[:, i] * vector[i] for i in range(vector.shape[0]))
    return jnp.sum(matrix * vector, axis=1)


def _matvec_transposed(matrix: jax.Array, vector: jax.Array) -> jax.Array:
    """(R, V, B), (R, B) -> (V, B)."""
    if _is_small(matrix):
        return sum(matrix[r] * vector[r] for r in range(vector.shape[0]))
    return jnp.sum(matrix * vector[:, None], axis=0)


def _gram(jacobian: jax.Array, weight: jax.Array) -> jax.Array:
    """J' diag(w) J: (R, V, B), (R, B) -> (V, V, B)."""
    num_rows, size, _ = jacobian.shape
    weighted = _materialize(weight[:, None] * jacobian)
    if not _is_small(jacobian):
        return jnp.moveaxis(jnp.einsum("rib,rjb->bij", weighted, jacobian), 0, -1)
    rows = [
        sum(weighted[r, i] * jacobian[r, : i + 1] for r in range(num_rows))
        for i in range(size)
    ]
    rows = [_materialize(row) for row in rows]
    return jnp.stack(
        [
            jnp.concatenate(
                [rows[i], *(rows[j][i : i + 1] for j in range(i + 1, size))]
            )
            for i in range(size)
        ]
    )


def _eliminate(matrix: jax.Array, right: jax.Array) -> jax.Array:
    """x of A x = b by Gauss and Jordan's elimination: (V, V, B), (V, B) -> (V, B).

    Symmetric positive matrices need no pivoting. Each step drops the first column
    and moves the first row to the end, so that all steps are alike.
    """
    table = jnp.concatenate([matrix, right[:, None]], axis=1)
    for _ in range(matrix.shape[0]):
        row = table[0, 1:] / table[0, 0]
        others = table[1:, 1:] - table[1:, :1] * row
        table = _materialize(jnp.concatenate([others, row[None]]))
    return table[:, 0]


def _solve(iterations: int, line_search: int, problem: Problem) -> Solution:
    """`solve` with the batch as the last axis of everything."""
    inertia, force = problem.inertia, problem.force
    jacobian, reference = problem.jacobian, problem.reference
    weight = problem.weight
    qacc_smooth = _eliminate(inertia, force)

    def cost(qacc: jax.Array) -> jax.Array:
        away = qacc - qacc_smooth
        distance = jnp.minimum(_matvec(jacobian, qacc) - reference, 0.0)
        return _dot(away, _matvec(inertia, away)) + _dot(weight, distance**2)

    better = cost(problem.warmstart) < cost(qacc_smooth)
    start = jnp.where(better, problem.warmstart, qacc_smooth)

    def iterate(_: int, carry: tuple[jax.Array, jax.Array]) -> Any:
        qacc, distance = carry
        active = jnp.where(distance < 0.0, weight, 0.0)
        residual = _matvec(inertia, qacc) - force
        gradient = residual + _matvec_transposed(jacobian, active * distance)
        active, gradient = _materialize((active, gradient))
        hessian = inertia + _gram(jacobian, active)
        direction = -_eliminate(hessian, gradient)

        # phi(s) = cost(qacc + s direction); phi' is increasing and piecewise linear.
        slope = _materialize(_matvec(jacobian, direction))
        linear = _dot(direction, residual)
        quadratic = _dot(direction, _matvec(inertia, direction))

        def newton(_: int, search: tuple[jax.Array, ...]) -> Any:
            step, low, high = search
            here = jnp.where(distance + step * slope < 0.0, weight * slope, 0.0)
            second = quadratic + _dot(here, slope)
            first = linear + step * quadratic + _dot(here, distance + step * slope)
            low = jnp.where(first < 0.0, step, low)
            high = jnp.where(first < 0.0, high, step)
            following = step - first / jnp.maximum(second, 1e-20)
            inside = (following >= low) & (following <= high)
            return jnp.where(inside, following, 0.5 * (low + high)), low, high

        step = jnp.ones_like(linear)
        search = (step, jnp.zeros_like(step), jnp.full_like(step, 1e3))
        step = jax.lax.fori_loop(0, line_search, newton, search)[0]
        return qacc + step * direction, distance + step * slope

    qacc, distance = jax.lax.fori_loop(
        0, iterations, iterate, (start, _matvec(jacobian, start) - reference)
    )
    row_force = weight * jnp.maximum(-distance, 0.0)
    return Solution(
        qacc=qacc,
        qacc_smooth=qacc_smooth,
        row_force=row_force,
        constraint_force=_matvec_transposed(jacobian, row_force),
    )

"""Newton's method for small dense constraint problems, many at once.

MuJoCo's constrained acceleration minimizes, over qacc,

    1/2 (qacc - qacc_smooth)' M (qacc - qacc_smooth)
      + 1/2 sum_r D_r min(0, J_r qacc - aref_r)^2

(MuJoCo documentation, "Computation", pyramidal cones: every row is one-sided). The
cost is convex and piecewise quadratic, so Newton's method with an exact line search
ends as soon as it has found the active rows. The number of iterations is fixed, and
every array has the batch as its last axis: with 5 to 30 degrees of freedom the batch
is the only axis that is long enough to fill vector units.

Rows are not stored one by one. A joint's limit is one entry of a diagonal. The rows
of a contact are the edges of its friction pyramid, normal +- friction * tangent: with
E the small constant matrix that makes edges of normal and tangents, J = E B, and

    J q = E (B q),    J' diag(w) J = B' (E' diag(w) E) B,

where B has 2 or 3 rows for each contact and J has 4.

It is not reverse-mode differentiable. Neither is MJX's own solver, because its loop is
dynamic.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from gasil_envs.physics import newton_fused, newton_kernel
from gasil_envs.physics.batching import (
    add,
    fold,
    has_triton,
    materialize,
    on_cpu,
    on_gpu,
    sum_signed,
    total,
)

# Shape letters: V degrees of freedom, B batch; and for a group of contacts with the
# same number of edges: C contacts, T tangents, E edges. The classes give the shapes of
# one problem; in a batch every array has B as a further, last axis.


class ContactRows(struct.PyTreeNode):
    """The rows of a group of contacts with the same number of edges; float32.

    Attributes:
      normal: (C, V), Jacobian of the normal; zero where out of play.
      tangents: (C, T, V), Jacobian of the tangents, times the friction.
      reference: (C, E), aref of the edges.
      weight: (C, E), D of the edges; 0 where out of play and above 0 elsewhere.
      edges: E rows of T signs: an edge is normal + signs @ tangents.
    """

    normal: jax.Array
    tangents: jax.Array
    reference: jax.Array
    weight: jax.Array
    edges: tuple[tuple[int, ...], ...] = struct.field(pytree_node=False)


class LimitRows(struct.PyTreeNode):
    """The rows of joint limits, at most one for each degree of freedom; float32.

    Attributes:
      sign: (V,), the Jacobian: 1 at a lower, -1 at an upper limit, 0 in between.
      reference: (V,), aref.
      weight: (V,), D, at least 0.
    """

    sign: jax.Array
    reference: jax.Array
    weight: jax.Array


class Problem(struct.PyTreeNode):
    """The constrained dynamics of one instant; float32.

    Attributes:
      inertia: (V, V), the joint-space inertia M.
      force: (V,), all forces but the constraints': M qacc_smooth.
      warmstart: (V,), initial guess, used if it is better than qacc_smooth.
      limits: the limits of the joints.
      contacts: groups of contacts.
    """

    inertia: jax.Array
    force: jax.Array
    warmstart: jax.Array
    limits: LimitRows
    contacts: tuple[ContactRows, ...] = ()


class Solution(struct.PyTreeNode):
    """The accelerations and the forces of the constraints; float32.

    Attributes:
      qacc: (V,), acceleration.
      edge_forces: (C, E) for each group of contacts, force along each edge.
      constraint_force: (V,), J' times these forces and those of the limits.
    """

    qacc: jax.Array
    edge_forces: tuple[jax.Array, ...]
    constraint_force: jax.Array


def _dot(a: jax.Array, b: jax.Array) -> jax.Array:
    return total(a * b)


# Sums over matrices with more entries than this are left to reductions. Spelled out
# they are up to 4 times as fast, but their compile time grows with the entries, on a
# GPU more steeply (ant: 89 s instead of MJX's 20).
_MOST_ENTRIES_SPELLED_OUT = {"cpu": 1100, "gpu": 300}
# On an H200 a solve of 9 unknowns in one kernel takes half of the time or less. More
# than 11 unknowns are eliminated in a kernel, and the rest of a solve is not in one.
_MOST_UNKNOWNS_OF_ONE_KERNEL = min(newton_kernel.SIZES) - 1


def _spells_out(matrix: jax.Array) -> bool:
    most = _MOST_ENTRIES_SPELLED_OUT["cpu" if on_cpu() else "gpu"]
    return matrix.shape[0] * matrix.shape[1] <= most


def _sum_in_a_loop(term: Callable[[Any], jax.Array], count: int) -> jax.Array:
    """Sum terms by their index, compiled for size.

    A CPU's kernel of many operations can hold neither a matrix product nor, from jaxlib
    0.11 on, a sum over an axis: XLA hands both to libraries.
    """
    first = term(0)
    return jax.lax.fori_loop(1, count, lambda i, sum_: sum_ + term(i), first)


def _matvec(matrix: jax.Array, vector: jax.Array, spell_out: bool) -> jax.Array:
    """(N, V, B), (V, B) -> (N, B)."""
    if spell_out:
        return add(matrix[:, i] * vector[i] for i in range(vector.shape[0]))
    if on_gpu():
        return jnp.sum(matrix * vector, axis=1)
    return _sum_in_a_loop(lambda i: matrix[:, i] * vector[i], vector.shape[0])


def _matvec_transposed(
    matrix: jax.Array, vector: jax.Array, spell_out: bool
) -> jax.Array:
    """(N, V, B), (N, B) -> (V, B)."""
    if spell_out:
        return add(matrix[n] * vector[n] for n in range(vector.shape[0]))
    if on_gpu():
        return jnp.sum(matrix * vector[:, None], axis=0)
    return _sum_in_a_loop(lambda n: matrix[n] * vector[n], vector.shape[0])


def _symmetric_product(left: jax.Array, right: jax.Array, spell_out: bool) -> jax.Array:
    """Return left' right, if it is symmetric: (N, V, B), (N, V, B) -> (V, V, B)."""
    num_rows, size, _ = left.shape
    if not spell_out and on_gpu():
        return jnp.moveaxis(jnp.einsum("nib,njb->bij", left, right), 0, -1)
    if not spell_out:
        return _sum_in_a_loop(lambda n: left[n][:, None] * right[n], num_rows)
    rows = [
        add(left[n, i] * right[n, : i + 1] for n in range(num_rows))
        for i in range(size)
    ]
    rows = [materialize(row) for row in rows]
    return jnp.stack(
        [
            jnp.concatenate(
                [rows[i], *(rows[j][i : i + 1] for j in range(i + 1, size))]
            )
            for i in range(size)
        ]
    )


class _Rows:
    """The constraint matrix J of a `Problem` whose batch is the last axis.

    A vector with one number per row is a list: (V, B) for the limits, and (E, C, B) for
    each group of contacts.
    """

    def __init__(self, problem: Problem, for_speed: bool):
        def edges_first(x: jax.Array) -> jax.Array:
            return jnp.swapaxes(x, 0, 1)

        self._sign = problem.limits.sign
        self._edges = [group.edges for group in problem.contacts]
        self._shapes = [group.tangents.shape[:2] for group in problem.contacts]
        self.reference = [
            problem.limits.reference,
            *(edges_first(group.reference) for group in problem.contacts),
        ]
        self.weight = [
            problem.limits.weight,
            *(edges_first(group.weight) for group in problem.contacts),
        ]
        # B has, group after group, the normals, the first and the second tangents.
        parts = []
        for group in problem.contacts:
            parts += [group.normal, *jnp.moveaxis(group.tangents, 1, 0)]
        self._basis = materialize(jnp.concatenate(parts)) if parts else None
        self._spell_out = (
            self._basis is not None and for_speed and _spells_out(self._basis)
        )

    def _split(self, along: jax.Array) -> list[list[jax.Array]]:
        """(rows of B, ...) to [normal (C, ...), tangents...] of each group."""
        groups, first = [], 0
        for contacts, tangents in self._shapes:
            bounds = [first + i * contacts for i in range(tangents + 2)]
            groups.append([along[i : i + contacts] for i in bounds[:-1]])
            first = bounds[-1]
        return groups

    def times(self, vector: jax.Array) -> list[jax.Array]:
        """J vector: (V, B) -> rows."""
        result = [self._sign * vector]
        if self._basis is None:
            return result
        for edges, (normal, *tangents) in zip(
            self._edges,
            self._split(_matvec(self._basis, vector, self._spell_out)),
            strict=True,
        ):
            result.append(
                jnp.stack([_add_signed(normal, tangents, signs) for signs in edges])
            )
        return result

    def transposed_times(self, rows: list[jax.Array]) -> jax.Array:
        """J' rows: -> (V, B)."""
        of_limits, *of_groups = rows
        result = self._sign * of_limits
        if self._basis is None:
            return result
        along: list[jax.Array] = []
        for edges, of_edges, (_, tangents) in zip(
            self._edges, of_groups, self._shapes, strict=True
        ):
            along.append(add(of_edges))
            for t in range(tangents):
                signs = [signs[t] for signs in edges]
                along.append(sum_signed(of_edges, signs))
        joined = materialize(jnp.concatenate(along))
        return result + _matvec_transposed(self._basis, joined, self._spell_out)

    def gram(self, weights: list[jax.Array]) -> jax.Array:
        """J' diag(weights) J: -> (V, V, B)."""
        of_limits, *of_groups = weights
        diagonal = self._sign**2 * of_limits
        result = jnp.eye(diagonal.shape[0])[:, :, None] * diagonal
        if self._basis is None:
            return result
        weighted = []
        for edges, of_edges, basis in zip(
            self._edges, of_groups, self._split(self._basis), strict=True
        ):
            signs = [(1, *signs) for signs in edges]
            for i in range(len(basis)):
                # Row i of E' diag(w) E, times B.
                terms = []
                for j, part in enumerate(basis):
                    products = [s[i] * s[j] for s in signs]
                    if any(products):
                        terms.append(sum_signed(of_edges, products)[:, None] * part)
                weighted.append(sum(terms))
        weighted = materialize(jnp.concatenate(weighted))
        return result + _symmetric_product(weighted, self._basis, self._spell_out)


def _add_signed(
    first: jax.Array, others: list[jax.Array], signs: tuple[int, ...]
) -> jax.Array:
    for other, sign in zip(others, signs, strict=True):
        if sign:
            first = first + other if sign > 0 else first - other
    return first


def eliminate(matrix: jax.Array, right: jax.Array) -> jax.Array:
    """Return x of A x = b by Gauss-Jordan elimination: (V, V, B), (V, B) -> (V, B).

    Symmetric positive matrices need no pivoting. Each step drops the first column and
    moves the first row to the end, so that all steps are the same. On a GPU larger
    matrices are eliminated in one kernel.
    """
    if matrix.shape[0] in newton_kernel.SIZES and has_triton():
        return newton_kernel.solve_linear(matrix, right)
    table = jnp.concatenate([matrix, right[:, None]], axis=1)
    for _ in range(matrix.shape[0]):
        row = table[0, 1:] / table[0, 0]
        others = table[1:, 1:] - table[1:, :1] * row
        table = materialize(jnp.concatenate([others, row[None]]))
    return table[:, 0]


def _repeat(
    function: Callable[[Any], tuple[Any, jax.Array]],
    carry: Any,
    *,
    least: int,
    most: int,
    unroll: bool,
) -> Any:
    """Call a function `least` to `most` times, and on a CPU until nothing changes.

    The function returns the carry and whether something has changed. On a GPU each
    test would wait for the host, and a loop costs more than a small body, so it
    may be unrolled there. On a CPU unrolling it only costs compile time.
    """
    if not on_cpu():

        def call(_: Any, carry: Any) -> Any:
            return function(carry)[0]

        return jax.lax.fori_loop(0, most, call, carry, unroll=unroll)

    def goes_on(state: Any) -> jax.Array:
        count, changed, _ = state
        return (count < least) | (changed & (count < most))

    def body(state: Any) -> Any:
        count, _, carry = state
        carry, changed = function(carry)
        return count + 1, changed, carry

    return jax.lax.while_loop(goes_on, body, (0, True, carry))[2]


@jax.named_scope("solver")
def solve_many(
    iterations: int, line_search: int, problem: Problem, *, for_speed: bool = True
) -> Solution:
    """Solve a batch of problems.

    Args:
      iterations: largest number of Newton iterations.
      line_search: largest number of steps of each line search.
      problem: the problems; every array has one more axis, the batch, at its end.
      for_speed: whether sums are unrolled for speed; otherwise compiled for size.

    Returns:
      The solutions, with the batch as the last axis of every array.
    """
    inertia, force = problem.inertia, problem.force
    if len(force) <= _MOST_UNKNOWNS_OF_ONE_KERNEL and has_triton():
        return Solution(*newton_fused.solve_many(iterations, line_search, problem))
    rows = _Rows(problem, for_speed)
    spell_out = for_speed and _spells_out(inertia)
    weight = rows.weight
    each = jax.tree.map

    def flat(x: jax.Array) -> jax.Array:
        return x.reshape(-1, x.shape[-1])

    def of_rows(parts: Any) -> jax.Array:
        return add(total(flat(x)) for x in parts)

    # J qacc - aref of each row, by MuJoCo's name: a row pushes where it is negative.
    def jaref_at(qacc: Any) -> Any:
        return each(jnp.subtract, rows.times(qacc), rows.reference)

    qacc_smooth = eliminate(inertia, force)

    def is_pushing(jaref: Any) -> Any:
        return each(lambda d: d < 0.0, jaref)

    def changes(a: Any, b: Any) -> jax.Array:
        pairs = zip(a, b, strict=True)
        parts = [fold(jnp.logical_or, flat(x != y)) for x, y in pairs]
        return jnp.any(functools.reduce(jnp.logical_or, parts))

    def cost(qacc: jax.Array) -> jax.Array:
        away = qacc - qacc_smooth

        def square(d: jax.Array, w: jax.Array) -> jax.Array:
            return w * jnp.minimum(d, 0.0) ** 2

        constraint_cost = of_rows(each(square, materialize(jaref_at(qacc)), weight))
        return _dot(away, _matvec(inertia, away, spell_out)) + constraint_cost

    better = cost(problem.warmstart) < cost(qacc_smooth)
    start = jnp.where(better, problem.warmstart, qacc_smooth)

    def iterate(carry: tuple[jax.Array, list[jax.Array]]) -> Any:
        qacc, jaref = carry
        active = each(lambda d, w: jnp.where(d < 0.0, w, 0.0), jaref, weight)
        residual = _matvec(inertia, qacc, spell_out) - force
        pull = rows.transposed_times(each(jnp.multiply, active, jaref))
        active, gradient = materialize((active, residual + pull))
        hessian = inertia + rows.gram(active)
        direction = -eliminate(hessian, gradient)

        # phi(s) = cost(qacc + s direction); phi' is increasing and piecewise linear.
        slope = materialize(rows.times(direction))
        linear = _dot(direction, residual)
        quadratic = _dot(direction, _matvec(inertia, direction, spell_out))

        def search_step(search: tuple[Any, ...]) -> Any:
            step, low, high, pushing = search
            there = each(lambda d, s: d + step * s, jaref, slope)
            pushed = each(
                lambda d, s, w: jnp.where(d < 0.0, w * s, 0.0), there, slope, weight
            )
            second = quadratic + of_rows(each(jnp.multiply, pushed, slope))
            first = linear + step * quadratic
            first = first + of_rows(each(jnp.multiply, pushed, there))
            low = jnp.where(first < 0.0, step, low)
            high = jnp.where(first < 0.0, high, step)
            following = step - first / jnp.maximum(second, 1e-20)
            inside = (following >= low) & (following <= high)
            following = jnp.where(inside, following, 0.5 * (low + high))
            now = is_pushing(there)
            return (following, low, high, now), changes(pushing, now)

        step = jnp.ones_like(linear)
        pushing = is_pushing(jaref)
        search = (step, jnp.zeros_like(step), jnp.full_like(step, 1e3), pushing)
        step = _repeat(search_step, search, least=1, most=line_search, unroll=True)[0]
        moved = each(lambda d, s: d + step * s, jaref, slope)
        return (qacc + step * direction, moved), changes(pushing, is_pushing(moved))

    begin = (start, jaref_at(start))
    qacc, jaref = _repeat(iterate, begin, least=2, most=iterations, unroll=False)
    push = each(lambda d, w: w * jnp.maximum(-d, 0.0), jaref, weight)
    return Solution(
        qacc=qacc,
        edge_forces=tuple(jnp.swapaxes(x, 0, 1) for x in push[1:]),
        constraint_force=rows.transposed_times(push),
    )

"""Newton's method on arrays whose last axis is the batch.

With 5 to 30 degrees of freedom the batch is the only axis that is long enough to fill
vector units.
"""

import functools
import operator
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from gasil_envs.physics import newton
from gasil_envs.physics.batching import (
    add,
    fold,
    materialize,
    on_cpu,
    sum_signed,
    total,
)

# Shape letters are those of `newton`, with B for the batch.

# On a CPU sums over matrices with more entries than this are left to loops. Spelled out
# they are up to 4 times as fast, but their compile time grows with the entries.
_MOST_ENTRIES_SPELLED_OUT = 1100


def _sum_in_a_loop(term: Callable[[Any], jax.Array], count: int) -> jax.Array:
    """Sum terms by their index, compiled for size.

    A CPU's kernel of many operations can hold neither a matrix product nor, from jaxlib
    0.11 on, a sum over an axis: XLA hands both to libraries.
    """
    first = term(0)
    return jax.lax.fori_loop(1, count, lambda i, sum_: sum_ + term(i), first)


def _matvec(matrix: jax.Array, vector: jax.Array, spell_out: bool) -> jax.Array:
    """(N, V, B), (V, B) -> (N, B)."""
    if not on_cpu():
        return jnp.einsum("nvb,vb->nb", matrix, vector)
    if spell_out:
        return add(matrix[:, i] * vector[i] for i in range(vector.shape[0]))
    return _sum_in_a_loop(lambda i: matrix[:, i] * vector[i], vector.shape[0])


def _matvec_transposed(
    matrix: jax.Array, vector: jax.Array, spell_out: bool
) -> jax.Array:
    """(N, V, B), (N, B) -> (V, B)."""
    if not on_cpu():
        return jnp.einsum("nvb,nb->vb", matrix, vector)
    if spell_out:
        return add(matrix[n] * vector[n] for n in range(vector.shape[0]))
    return _sum_in_a_loop(lambda n: matrix[n] * vector[n], vector.shape[0])


def _symmetric_product(left: jax.Array, right: jax.Array, spell_out: bool) -> jax.Array:
    """Return left' right, if it is symmetric: (N, V, B), (N, V, B) -> (V, V, B)."""
    num_rows, size, _ = left.shape
    if not on_cpu():
        return jnp.einsum("nib,njb->ijb", left, right)
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


def eliminate(matrix: jax.Array, right: jax.Array) -> jax.Array:
    """Return x of A x = b by Gauss-Jordan elimination: (V, V, B), (V, B) -> (V, B).

    Symmetric positive matrices need no pivoting. Each step drops the first column and
    moves the first row to the end, so that all steps are the same.
    """
    table = jnp.concatenate([matrix, right[:, None]], axis=1)
    for _ in range(matrix.shape[0]):
        row = table[0, 1:] / table[0, 0]
        others = table[1:, 1:] - table[1:, :1] * row
        table = materialize(jnp.concatenate([others, row[None]]))
    return table[:, 0]


class _Batch:
    """A batch of problems, a `newton.System`.

    A vector is (V, B). Rows are a list: (V, B) for each of the joints' rows, then
    (E, C, B) for each group of contacts, or a list of (C, B) if these have cones.
    """

    def __init__(self, problem: newton.Problem, for_speed: bool):
        def edges_first(x: jax.Array) -> jax.Array:
            return jnp.swapaxes(x, 0, 1)

        def spells_out(matrix: jax.Array) -> bool:
            entries = matrix.shape[0] * matrix.shape[1]
            return for_speed and entries <= _MOST_ENTRIES_SPELLED_OUT

        joints, contacts = problem.joints, problem.contacts
        self.force, self.warmstart = problem.force, problem.warmstart
        self._have_cones = [isinstance(x.bound, newton.Cone) for x in contacts]
        self.reference: list[Any] = [x.reference for x in joints]
        for group, has_cones in zip(contacts, self._have_cones, strict=True):
            reference = edges_first(group.reference)
            self.reference.append([*reference] if has_cones else reference)
        self.weight = [x.weight for x in joints]
        self.weight += [edges_first(group.weight) for group in contacts]
        self.bound: list[Any] = [x.bound for x in joints]
        self.bound += [jax.tree.map(edges_first, group.bound) for group in contacts]
        self._inertia, self._signs = problem.inertia, [x.sign for x in joints]
        self._edges = [group.edges for group in contacts]
        self._shapes = [group.basis.shape[:2] for group in contacts]
        # B has, group after group, the normals, the first and the second tangents.
        parts = [part for group in contacts for part in edges_first(group.basis)]
        self._basis = materialize(jnp.concatenate(parts)) if parts else None
        self._spell_out = self._basis is not None and spells_out(self._basis)
        self._spell_out_inertia = spells_out(self._inertia)

    def _split(self, along: jax.Array) -> list[list[jax.Array]]:
        """(rows of B, ...) to a list of A arrays (C, ...) for each group."""
        groups, first = [], 0
        for contacts, axes in self._shapes:
            bounds = [first + i * contacts for i in range(axes + 1)]
            groups.append([along[i : i + contacts] for i in bounds[:-1]])
            first = bounds[-1]
        return groups

    def inertia_times(self, vector: jax.Array) -> jax.Array:
        return _matvec(self._inertia, vector, self._spell_out_inertia)

    def times(self, vector: jax.Array) -> list[Any]:
        result: list[Any] = [sign * vector for sign in self._signs]
        if self._basis is not None:
            along = self._split(_matvec(self._basis, vector, self._spell_out))
            for edges, axes, has_cones in zip(self._edges, along, self._have_cones):
                rows = [sum_signed(axes, signs) for signs in edges]
                result.append(rows if has_cones else jnp.stack(rows))
        return result

    def transposed_times(self, rows: list[Any]) -> jax.Array:
        result = add(map(operator.mul, self._signs, rows))
        of_groups = rows[len(self._signs) :]
        if self._basis is None:
            return result
        along = [
            sum_signed(of_edges, signs)
            for edges, of_edges in zip(self._edges, of_groups, strict=True)
            for signs in zip(*edges, strict=True)
        ]
        joined = materialize(jnp.concatenate(along))
        return result + _matvec_transposed(self._basis, joined, self._spell_out)

    def solve(self, active: list[Any] | None, right: jax.Array) -> jax.Array:
        if active is None:
            return eliminate(self._inertia, right)
        return eliminate(self._inertia + self._gram(active), right)

    def _gram(self, weights: list[Any]) -> jax.Array:
        """J' diag(weights) J: -> (V, V, B)."""
        diagonal = add(sign**2 * x for sign, x in zip(self._signs, weights))
        of_groups = weights[len(self._signs) :]
        result = jnp.eye(diagonal.shape[0])[:, :, None] * diagonal
        if self._basis is None:
            return result
        weighted: list[jax.Array] = []
        for edges, of_edges, basis in zip(
            self._edges, of_groups, self._split(self._basis)
        ):
            weighted += newton.weighted_axes(edges, of_edges, basis)
        joined = materialize(jnp.concatenate(weighted))
        return result + _symmetric_product(joined, self._basis, self._spell_out)

    def total(self, tree: Any) -> jax.Array:
        return add(total(_flat(x)) for x in jax.tree.leaves(tree))

    def differ(self, a: Any, b: Any) -> jax.Array:
        parts = jax.tree.leaves(
            jax.tree.map(lambda x, y: fold(jnp.logical_or, _flat(x != y)), a, b)
        )
        return functools.reduce(jnp.logical_or, parts)

    def store(self, tree: Any) -> Any:
        return materialize(tree)

    def repeat(
        self,
        function: Callable[[Any], Any],
        carry: Any,
        *,
        least: int,
        most: int,
        is_short: bool,
    ) -> Any:
        del is_short
        # On a GPU each test would wait for the host.
        if not on_cpu():
            return jax.lax.fori_loop(0, most, lambda _, x: function(x)[0], carry)

        def goes_on(state: Any) -> jax.Array:
            count, changed, _ = state
            return (count < least) | (changed & (count < most))

        def body(state: Any) -> Any:
            count, _, carry = state
            carry, changed = function(carry)
            return count + 1, jnp.any(changed), carry

        return jax.lax.while_loop(goes_on, body, (0, True, carry))[2]


def _flat(x: jax.Array) -> jax.Array:
    return x.reshape(-1, x.shape[-1])


def solve_many(
    iterations: int, line_search: int, problem: newton.Problem, *, for_speed: bool
) -> newton.Solution:
    """Solve a batch of problems as `solver.solve_many` does, by XLA's operations."""
    batch = _Batch(problem, for_speed)
    qacc, forces = newton.minimize(batch, iterations, line_search)
    return newton.Solution(
        qacc=qacc,
        edge_forces=tuple(
            jnp.swapaxes(jnp.asarray(x), 0, 1) for x in forces[len(problem.joints) :]
        ),
        constraint_force=batch.transposed_times(forces),
    )

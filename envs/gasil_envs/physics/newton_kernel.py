"""Newton's method in one kernel of a GPU: a thread block solves one problem.

Written as XLA's operations, a solve is more than a hundred kernels, each of which reads
and writes arrays of all problems. Here a block, mostly of one warp, has a problem in
its registers from the first step to the last. Triton wants arrays whose sizes are
powers of two: degrees of freedom are in parts of WIDTH, the last one padded with zeros,
and contacts are padded. What a block reads often it reads again from the first cache,
because that leaves registers.
"""

import functools
import operator
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from gasil_envs.physics import newton
from gasil_envs.physics.batching import add, keep_layout, sum_signed

# Pallas takes long to import, and only a GPU needs it: functions import it themselves.

# Shape letters are those of `newton`, with W for the width of a part and C for padded
# contacts. A vector is a list of its parts, (W,) each. A symmetric matrix is a list of
# rows of parts (W, W), from the diagonal on.

#: Degrees of freedom of a part: Triton multiplies matrices of no fewer rows.
WIDTH = 16
_FEWEST_CONTACTS = 8
# Entries of the contacts' Jacobians that a warp should have.
_ENTRIES_OF_A_WARP = 1024

Load = Callable[[], jax.Array]
Matrix = list[list[jax.Array]]


def _iota(shape: tuple[int, ...], axis: int) -> jax.Array:
    return jax.lax.broadcasted_iota(jnp.int32, shape, axis)


def _product(left: jax.Array, right: jax.Array) -> jax.Array:
    """Return left' right in float32: (N, V), (N, W) -> (V, W)."""
    return jax.lax.dot_general(
        left,
        right,
        (((0,), (0,)), ((), ())),
        precision=jax.lax.DotAlgorithmPreset.F32_F32_F32,
    )


def _matvec(matrix: jax.Array, vector: jax.Array) -> jax.Array:
    """(N, V), (V,) -> (N,)."""
    return jnp.sum(matrix * vector[None, :], axis=1)


def _matvec_transposed(matrix: jax.Array, vector: jax.Array) -> jax.Array:
    """(N, V), (N,) -> (V,)."""
    return jnp.sum(matrix * vector[:, None], axis=0)


def eliminate(matrix: Matrix, right: list[jax.Array], size: int) -> list[jax.Array]:
    """Return x of A x = b for symmetric positive A with `size` unknowns.

    Gauss-Jordan elimination of the first part's rows, then of what is left of the
    others. The block of the first part that is not eliminated yet stays symmetric. An
    entry in an eliminated row i and another column j is kept at (j, i), where plain
    elimination would have a zero of the identity. So the pivot's row alone holds the
    factors of all rows, and no column needs to be read.
    """
    (first, *beside), *below = matrix
    index = _iota((WIDTH,), 0)
    row_of, column_of = _iota(first.shape, 0), _iota(first.shape, 1)

    def step(k: jax.Array, carry: Any) -> Any:
        left, beside, x = carry
        row = jnp.sum(jnp.where(row_of == k, left, 0.0), axis=0)
        inverse = 1.0 / jnp.sum(jnp.where(index == k, row, 0.0))

        def eliminated(part: jax.Array) -> jax.Array:
            pivot = jnp.sum(jnp.where(row_of == k, part, 0.0), axis=0) * inverse
            others = part - row[:, None] * pivot[None, :]
            return jnp.where(row_of == k, pivot[None, :], others)

        scaled = jnp.where(index == k, -1.0, row) * inverse
        left = jnp.where(column_of == k, 0.0, left) - row[:, None] * scaled[None, :]
        unknown = jnp.sum(jnp.where(index == k, x, 0.0)) * inverse
        x = jnp.where(index == k, unknown, x - row * unknown)
        return left, list(map(eliminated, beside)), x

    carry = (first, beside, right[0])
    _, solved, x = jax.lax.fori_loop(0, min(size, WIDTH), step, carry)
    if not beside:
        return [x]
    rest = [
        [part - _product(beside[i], solved[i + j]) for j, part in enumerate(row)]
        for i, row in enumerate(below)
    ]
    reduced = [
        b - _matvec_transposed(part, x)
        for part, b in zip(beside, right[1:], strict=True)
    ]
    others = eliminate(rest, reduced, size - WIDTH)
    return [x - add(map(_matvec, solved, others)), *others]


def _load(ref: Any, *sizes: int) -> jax.Array:
    """Read an array; its entries from `sizes` on are padding, which is not there."""
    from jax.experimental.pallas import triton

    inside = [_iota(ref.shape, axis) < size for axis, size in enumerate(sizes)]
    return triton.load(ref, mask=functools.reduce(jnp.logical_and, inside), other=0.0)


def _parts(size: int) -> list[tuple[slice, int]]:
    """Return the parts of V numbers, and how many numbers are left from each on."""
    return [(slice(i, i + WIDTH), size - i) for i in range(0, size, WIDTH)]


def _load_vector(ref: Any, size: int) -> list[jax.Array]:
    return [_load(ref.at[part], left) for part, left in _parts(size)]


def _loads_of_matrix(ref: Any, size: int) -> list[list[Load]]:
    """Return functions that read the parts of a symmetric matrix."""
    parts = _parts(size)
    return [
        [
            functools.partial(_load, ref.at[rows, columns], height, width)
            for columns, width in parts[i:]
        ]
        for i, (rows, height) in enumerate(parts)
    ]


def _store_vector(ref: Any, vector: list[jax.Array]) -> None:
    for i, part in enumerate(vector):
        ref[i * WIDTH : (i + 1) * WIDTH] = part


def _multiply(a: list[jax.Array], b: list[jax.Array]) -> list[jax.Array]:
    """Return the product of two vectors, entry by entry."""
    return list(map(operator.mul, a, b))


def _sum(vectors: Iterable[list[jax.Array]]) -> list[jax.Array]:
    return [add(parts) for parts in zip(*vectors, strict=True)]


class _Block:
    """One problem, a `newton.System`.

    Rows are a list: a vector for each of the joints' rows, then a list of E arrays (C,)
    for each group of contacts.
    """

    def __init__(self, refs: Any, size: int, groups: Sequence[Any]) -> None:
        """Load a problem.

        `refs` are the inertia, force and warm start, the vectors of each of the joints'
        rows, and each group's axes (C, V), references, weights and bounds (C,);
        `groups` each group's edges, number of contacts and structure of its bounds.
        """
        inertia, vectors, joints, contacts = refs
        self.force, self.warmstart = (_load_vector(ref, size) for ref in vectors)
        loaded = [[_load_vector(ref, size) for ref in rows] for rows in joints]
        self.signs = [rows[0] for rows in loaded]
        self.reference: list[Any] = [rows[1] for rows in loaded]
        self.weight: list[Any] = [rows[2] for rows in loaded]
        # Those of limits have no bound.
        self.bound: list[Any] = [(*rows, None)[3] for rows in loaded]
        self._size, self._edges = size, [edges for edges, *_ in groups]
        self._inertia = _loads_of_matrix(inertia, size)
        # For each group a list of axes, each a list of parts (C, W).
        self._basis: list[list[list[Load]]] = []
        for (axes, *of_edges), (_, count, structure) in zip(contacts, groups):
            references, weights, *bound = [
                [_load(x, count) for x in values] for values in of_edges
            ]
            self.reference.append(references)
            self.weight.append(weights)
            self.bound.append(jax.tree.unflatten(structure, bound))
            self._basis.append(
                [
                    [
                        functools.partial(_load, x.at[:, part], count, left)
                        for part, left in _parts(size)
                    ]
                    for x in axes
                ]
            )

    def inertia_times(self, vector: list[jax.Array]) -> list[jax.Array]:
        result = []
        for i, row in enumerate(self._inertia):
            terms = [
                _matvec_transposed(self._inertia[j][i - j](), vector[j])
                for j in range(i + 1)
            ]
            terms += [
                _matvec(part(), x)
                for part, x in zip(row[1:], vector[i + 1 :], strict=True)
            ]
            result.append(add(terms))
        return result

    def times(self, vector: list[jax.Array]) -> list[Any]:
        rows: list[Any] = [_multiply(sign, vector) for sign in self.signs]
        for edges, axes in zip(self._edges, self._basis, strict=True):
            along = [
                add(_matvec(part(), x) for part, x in zip(parts, vector, strict=True))
                for parts in axes
            ]
            rows.append([sum_signed(along, signs) for signs in edges])
        return rows

    def transposed_times(self, rows: list[Any]) -> list[jax.Array]:
        result = _sum(map(_multiply, self.signs, rows))
        of_groups = rows[len(self.signs) :]
        for edges, axes, of_edges in zip(self._edges, self._basis, of_groups):
            along = [sum_signed(of_edges, signs) for signs in zip(*edges, strict=True)]
            for i in range(len(result)):
                terms = [
                    parts[i]() * x[:, None]
                    for parts, x in zip(axes, along, strict=True)
                ]
                result[i] = result[i] + jnp.sum(add(terms), axis=0)
        return result

    def solve(self, active: list[Any] | None, right: list[jax.Array]) -> Any:
        matrix = [[part() for part in row] for row in self._inertia]
        if active is not None:
            self._add_gram(matrix, active)
        return eliminate(matrix, right, self._size)

    def _add_gram(self, matrix: Matrix, weights: list[Any]) -> None:
        """Add J' diag(weights) J."""
        diagonal = _iota((WIDTH, WIDTH), 0) == _iota((WIDTH, WIDTH), 1)
        squares = [_multiply(sign, sign) for sign in self.signs]
        own = _sum(map(_multiply, squares, weights))
        of_groups = weights[len(self.signs) :]
        for row, entry in zip(matrix, own, strict=True):
            entries = jnp.broadcast_to(entry[:, None], diagonal.shape)
            row[0] = row[0] + jnp.where(diagonal, entries, 0.0)
        for edges, axes, of_edges in zip(self._edges, self._basis, of_groups):
            for i, row in enumerate(matrix):
                weighted = newton.weighted_axes(
                    edges, of_edges, [parts[i]() for parts in axes]
                )
                for left, parts in zip(weighted, axes, strict=True):
                    for j in range(len(row)):
                        row[j] = row[j] + _product(left, parts[i + j]())

    def total(self, tree: Any) -> jax.Array:
        # Arrays of one shape are added before a sum that all threads take part in.
        sums: dict[tuple[int, ...], jax.Array] = {}
        for x in jax.tree.leaves(tree):
            sums[x.shape] = sums[x.shape] + x if x.shape in sums else x
        return add(map(jnp.sum, sums.values()))

    def differ(self, a: Any, b: Any) -> jax.Array:
        def differences(x: jax.Array, y: jax.Array) -> jax.Array:
            return (x != y).astype(jnp.int32)

        return self.total(jax.tree.map(differences, a, b)) > 0

    def store(self, tree: Any) -> Any:
        return tree

    def repeat(
        self,
        function: Callable[[Any], Any],
        carry: Any,
        *,
        least: int,
        most: int,
        is_short: bool,
    ) -> Any:
        if is_short:
            return jax.lax.fori_loop(0, most, lambda _, x: function(x)[0], carry)

        # Triton has no `while` (jaxlib 0.11.2 crashes).
        def body(count: jax.Array, state: Any) -> Any:
            goes_on = (count < least) | state[1]
            return jax.lax.cond(goes_on, lambda x: function(x[0]), lambda x: x, state)

        return jax.lax.fori_loop(0, most, body, (carry, jnp.bool(True)))[0]


def _newton(
    read: Callable[[Any], _Block],
    iterations: int,
    line_search: int,
    problem: Any,
    *results: Any,
) -> None:
    """Solve the problem of a block."""
    block = read(problem)
    qacc, forces = newton.minimize(block, iterations, line_search)
    for ref, vector in zip(results, (qacc, block.transposed_times(forces))):
        _store_vector(ref, vector)
    of_groups = forces[len(block.signs) :]
    for refs, of_edges in zip(results[2], of_groups, strict=True):
        for ref, force in zip(refs, of_edges, strict=True):
            ref[...] = force


def _elimination(size: int, inputs: Any, result: Any) -> None:
    """Solve the system of linear equations of a block."""
    matrix, right = inputs
    parts = [[load() for load in row] for row in _loads_of_matrix(matrix, size)]
    _store_vector(result, eliminate(parts, _load_vector(right, size), size))


def _call(
    kernel: Callable[..., None],
    arrays: Any,
    specs: Any,
    results: Any,
    *,
    interpret: bool,
    warps: int = 1,
) -> Any:
    """Call a kernel for each problem; the first axis of its results is the batch.

    `arrays` are a tree whose last axis is the batch, `specs` the same tree of their
    padded parts that a block has, and `results` the specifications of what it returns.
    With `interpret` it runs as XLA's operations, on any device.
    """
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import triton

    batch = jax.tree.leaves(arrays)[0].shape[-1]

    def shape(spec: Any) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct((batch, *spec.block_shape[1:]), jnp.float32)

    return pl.pallas_call(
        kernel,
        grid=(batch,),
        in_specs=[specs],
        out_specs=results,
        out_shape=jax.tree.map(shape, results),
        compiler_params=triton.CompilerParams(num_warps=warps, num_stages=1),
        interpret=interpret,
        name="newton",
    )(jax.tree.map(lambda x: jnp.moveaxis(keep_layout(x), -1, 0), arrays))


def _spec(*shape: int) -> Any:
    """Specify that a block has a problem's array, padded to this shape."""
    from jax.experimental import pallas as pl

    return pl.BlockSpec((None, *shape), lambda b: (b, *(0 for _ in shape)))


def solve_many(
    iterations: int,
    line_search: int,
    problem: newton.Problem,
    *,
    interpret: bool = False,
) -> newton.Solution:
    """Solve a batch of problems as `solver.solve_many` does."""
    size = problem.force.shape[0]
    padded = len(_parts(size)) * WIDTH
    joints = list(map(jax.tree.leaves, problem.joints))
    counts = [len(group.basis) for group in problem.contacts]
    groups, of_groups, of_edges, entries = [], [], [], 0
    for group, count in zip(problem.contacts, counts, strict=True):
        arrays = [group.basis, group.reference, group.weight]
        arrays += jax.tree.leaves(group.bound)
        groups.append([list(jnp.moveaxis(x, 1, 0)) for x in arrays])
        contacts = max(_FEWEST_CONTACTS, 1 << (count - 1).bit_length())
        axes, edges = group.basis.shape[1], len(group.edges)
        of_edges.append([_spec(contacts)] * edges)
        per_edge = [[_spec(contacts)] * x.shape[1] for x in arrays[1:]]
        of_groups.append([[_spec(contacts, padded)] * axes, *per_edge])
        entries += axes * contacts * padded
    read = functools.partial(
        _Block,
        size=size,
        groups=[
            (x.edges, len(x.basis), jax.tree.structure(x.bound))
            for x in problem.contacts
        ],
    )
    vector = _spec(padded)
    of_joints = [[vector] * len(rows) for rows in joints]
    qacc, constraint_force, forces = _call(
        functools.partial(_newton, read, iterations, line_search),
        (problem.inertia, [problem.force, problem.warmstart], joints, groups),
        (_spec(padded, padded), [vector] * 2, of_joints, of_groups),
        [vector, vector, of_edges],
        warps=1 << max(0, (entries // _ENTRIES_OF_A_WARP).bit_length() - 1),
        interpret=interpret,
    )
    return newton.Solution(
        qacc=qacc[:, :size].T,
        edge_forces=tuple(
            jnp.stack([x[:, :count].T for x in of_group], axis=1)
            for of_group, count in zip(forces, counts, strict=True)
        ),
        constraint_force=constraint_force[:, :size].T,
    )


def eliminate_many(
    matrix: jax.Array, right: jax.Array, *, interpret: bool = False
) -> jax.Array:
    """Return x of A x = b for symmetric positive A: (V, V, B), (V, B) -> (V, B)."""
    size = right.shape[0]
    padded = len(_parts(size)) * WIDTH
    specs = (_spec(padded, padded), _spec(padded))
    kernel = functools.partial(_elimination, size)
    result = _call(kernel, (matrix, right), specs, _spec(padded), interpret=interpret)
    return result[:, :size].T

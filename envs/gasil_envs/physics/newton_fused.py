"""The solver of `newton` as one kernel of a GPU.

Written as XLA's operations, a solve is more than a hundred kernels, each of which reads
and writes arrays of all environments. Here a thread solves the problem of one
environment from the first step to the last. A block is one warp, and the batch is the
last axis, so its threads read adjacent numbers.

A kernel has only registers and arrays: what a later step needs is stored in further
results of the kernel. Its loops are not unrolled, because the time in which Triton
compiles a kernel grows with the third power of its length.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from gasil_envs.physics.batching import sum_signed

# Pallas takes long to import, and only a GPU needs it: functions import it themselves.

# Shape letters are those of `newton`. The arrays in the classes are references to
# memory with LANES as a further, last axis: what is read at an index is (LANES,).

#: Environments of a block: the threads of one warp.
LANES = 32
# Terms of a sum that are read at once, so that their latencies overlap.
_AT_ONCE = 4


class _Group(NamedTuple):
    """A group of contacts.

    Attributes:
      edges: E rows of (1, signs of the T tangents).
      basis: (C, 1 + T, V), Jacobians of the normal and the tangents.
      reference: (C, E), aref.
      weight: (C, E), D.
      jaref: (C, E), J qacc - aref, and at last the edges' forces.
      slope: (C, E), J direction.
      push: (C, 1 + T), force along the normal and the tangents.
      weighted: (C, 1 + T, V), rows of E' diag(active D) E B.
    """

    edges: Sequence[Sequence[int]]
    basis: Any
    reference: Any
    weight: Any
    jaref: Any
    slope: Any
    push: Any
    weighted: Any

    @property
    def signs(self) -> list[tuple[int, ...]]:
        """The rows of E', one for the normal and each tangent."""
        return list(zip(*self.edges, strict=True))


class _Inputs(NamedTuple):
    """The parts of a `newton.Problem` that are not of contacts."""

    inertia: Any
    force: Any
    warmstart: Any
    sign: Any
    reference: Any
    weight: Any


class _Memory(NamedTuple):
    """What steps of a solve leave for later ones, (V,) each but for the factor.

    Attributes:
      qacc: acceleration, the result.
      constraint_force: the constraints' force, the other result.
      factor: (V, V), L of a matrix A = L L', with the reciprocals of its diagonal.
      direction: solution of the last system of linear equations.
      residual: M qacc - force.
      product: M direction.
    """

    qacc: Any
    constraint_force: Any
    factor: Any
    direction: Any
    residual: Any
    product: Any


def _each(count: Any, function: Callable[..., Any], carry: Any = None) -> Any:
    """Call carry = function(index, carry) for each index."""
    return jax.lax.fori_loop(0, count, function, carry)


def _sum(count: Any, most: int, term: Callable[[Any], Any]) -> Any:
    """Sum the trees of arrays term(0) to term(count - 1); `most` bounds the count."""
    at_once = min(_AT_ONCE, most)

    def add_term(index: Any, sums: Any) -> Any:
        return jax.tree.map(
            lambda total, x: total + jnp.where(index < count, x, 0.0),
            sums,
            term(jnp.minimum(index, most - 1)),
        )

    def add_terms(i: Any, sums: Any) -> Any:
        for k in range(at_once):
            sums = add_term(at_once * i + k, sums)
        return sums

    shapes = jax.eval_shape(lambda: term(0))
    zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    return _each((count + at_once - 1) // at_once, add_terms, zeros)


def _factorize(entry: Callable[[Any, Any], jax.Array], factor: Any) -> None:
    """Store the factor of a matrix; `entry` returns its entry at i and j <= i."""
    size = factor.shape[0]

    def row(i: Any, _: None) -> None:
        def column(j: Any, _: None) -> None:
            of_others = _sum(j, size, lambda k: factor[i, k] * factor[j, k])
            rest = entry(i, j) - of_others
            factor[i, j] = jnp.where(i == j, jax.lax.rsqrt(rest), rest * factor[j, j])

        _each(i + 1, column)

    _each(size, row)


def _solve(factor: Any, right: Callable[[Any], jax.Array], x: Any) -> None:
    """Store x of L L' x = b, (V,); `right` returns b's entry at i."""
    size, last = factor.shape[0], factor.shape[0] - 1

    def forward(i: Any, _: None) -> None:
        of_others = _sum(i, size, lambda k: factor[i, k] * x[k])
        x[i] = (right(i) - of_others) * factor[i, i]

    def backward(count: Any, _: None) -> None:
        i = last - count
        of_others = _sum(count, size, lambda k: factor[last - k, i] * x[last - k])
        x[i] = (x[i] - of_others) * factor[i, i]

    _each(size, forward)
    _each(size, backward)


class _Block:
    """The problems of a block, and the steps of `newton.solve_many`."""

    def __init__(
        self, inputs: _Inputs, memory: _Memory, groups: Sequence[_Group]
    ) -> None:
        self._inputs, self._memory, self._groups = inputs, memory, groups
        self._size = inputs.inertia.shape[0]

        def last_in_play(group: _Group) -> jax.Array:
            def last(c: Any, count: Any) -> Any:
                in_play = jnp.max(group.weight[c, 0]) > 0.0
                return jnp.where(in_play, c + 1, count)

            return _each(group.basis.shape[0], last, jnp.int32(0))

        # Contacts in play are mostly the first ones.
        self._counts = [last_in_play(group) for group in groups]

    def _each_contact(self, function: Callable[..., Any], carry: Any = None) -> Any:
        """Call carry = function(group, contact, carry) for the contacts in play."""
        for group, count in zip(self._groups, self._counts):
            carry = _each(count, functools.partial(function, group), carry)
        return carry

    def _sum_over_joints(self, term: Callable[[Any], Any]) -> Any:
        """Sum the trees of arrays term(v) over the degrees of freedom."""
        return _sum(self._size, self._size, term)

    def _sum_over_contacts(
        self, term: Callable[[_Group, Any, int], jax.Array], total: jax.Array
    ) -> jax.Array:
        """Add term(group, contact, axis) over the normals and tangents in play."""

        def add(group: _Group, c: Any, total: jax.Array) -> jax.Array:
            for axis in range(group.basis.shape[1]):
                total = total + term(group, c, axis)
            return total

        return self._each_contact(add, total)

    def _along_edges(
        self, group: _Group, c: Any, vectors: Sequence[Any]
    ) -> list[list[jax.Array]]:
        """Return J vector of a contact's edges, for each vector in memory."""

        def term(v: Any) -> list[list[jax.Array]]:
            rows = [group.basis[c, a, v] for a in range(group.basis.shape[1])]
            return [[row * vector[v] for row in rows] for vector in vectors]

        along = self._sum_over_joints(term)
        return [[sum_signed(x, signs) for signs in group.edges] for x in along]

    def _of_limit(self, v: Any) -> jax.Array:
        """J qacc - aref of a joint's limit."""
        sign, reference = self._inputs.sign[v], self._inputs.reference[v]
        return sign * self._memory.qacc[v] - reference

    def start(self) -> None:
        """Begin at the acceleration without constraints, or at the initial guess."""
        inputs, memory = self._inputs, self._memory
        warmstart, smooth = inputs.warmstart, memory.direction
        _factorize(lambda i, j: inputs.inertia[i, j], memory.factor)
        _solve(memory.factor, lambda i: inputs.force[i], smooth)

        def limit_costs(v: Any) -> tuple[jax.Array, ...]:
            return tuple(
                inputs.weight[v]
                * jnp.minimum(inputs.sign[v] * x[v] - inputs.reference[v], 0.0) ** 2
                for x in (warmstart, smooth)
            )

        def contact_costs(group: _Group, c: Any, costs: Any) -> Any:
            rows = self._along_edges(group, c, (warmstart, smooth))
            for e in range(len(group.edges)):
                distances = [row[e] - group.reference[c, e] for row in rows]
                group.jaref[c, e], group.slope[c, e] = distances
                costs = tuple(
                    cost + group.weight[c, e] * jnp.minimum(d, 0.0) ** 2
                    for cost, d in zip(costs, distances)
                )
            return costs

        def away_cost(i: Any, cost: jax.Array) -> jax.Array:
            memory.residual[i] = self._sum_over_joints(
                lambda j: inputs.inertia[i, j] * (warmstart[j] - smooth[j])
            )
            return cost + (warmstart[i] - smooth[i]) * memory.residual[i]

        costs = self._sum_over_joints(limit_costs)
        of_warmstart, of_smooth = self._each_contact(contact_costs, costs)
        better = _each(self._size, away_cost, of_warmstart) < of_smooth

        def choose(v: Any, _: None) -> None:
            memory.qacc[v] = jnp.where(better, warmstart[v], smooth[v])
            memory.residual[v] = jnp.where(better, memory.residual[v], 0.0)

        def choose_of_contact(group: _Group, c: Any, _: None) -> None:
            for e in range(len(group.edges)):
                of_both = group.jaref[c, e], group.slope[c, e]
                group.jaref[c, e] = jnp.where(better, *of_both)

        _each(self._size, choose)
        self._each_contact(choose_of_contact)

    def _weigh(self, group: _Group, c: Any, _: None) -> None:
        """Store a contact's forces, and its rows of J' diag(active D) J."""
        distance = [group.jaref[c, e] for e in range(len(group.edges))]
        active = [
            jnp.where(d < 0.0, group.weight[c, e], 0.0) for e, d in enumerate(distance)
        ]
        forces = [w * d for w, d in zip(active, distance)]
        for a, signs in enumerate(group.signs):
            group.push[c, a] = sum_signed(forces, signs)

        def row(v: Any, _: None) -> None:
            basis = [group.basis[c, a, v] for a in range(len(group.signs))]
            on_edges = [w * sum_signed(basis, x) for w, x in zip(active, group.edges)]
            for a, signs in enumerate(group.signs):
                group.weighted[c, a, v] = sum_signed(on_edges, signs)

        _each(self._size, row)

    def _hessian(self, i: Any, j: Any) -> jax.Array:
        """Return an entry of M + J' diag(active D) J."""
        of_limit = self._inputs.sign[i] ** 2 * self._inputs.weight[i]
        of_limit = jnp.where(self._of_limit(i) < 0.0, of_limit, 0.0)
        return self._sum_over_contacts(
            lambda group, c, a: group.basis[c, a, i] * group.weighted[c, a, j],
            self._inputs.inertia[i, j] + jnp.where(i == j, of_limit, 0.0),
        )

    def _pull(self, v: Any, other: jax.Array) -> jax.Array:
        """Return an entry of J' diag(active D) (J qacc - aref), plus another number."""
        of_limit = self._inputs.weight[v] * jnp.minimum(self._of_limit(v), 0.0)
        return self._sum_over_contacts(
            lambda group, c, a: group.push[c, a] * group.basis[c, a, v],
            other + self._inputs.sign[v] * of_limit,
        )

    def improve(self, line_search: int) -> jax.Array:
        """Do an iteration; return 1 if other rows are active now, 0 otherwise."""
        memory = self._memory
        self._each_contact(self._weigh)
        _factorize(self._hessian, memory.factor)
        _solve(
            memory.factor,
            lambda v: -self._pull(v, memory.residual[v]),
            memory.direction,
        )

        def slopes(group: _Group, c: Any, _: None) -> None:
            (along,) = self._along_edges(group, c, [memory.direction])
            for e, slope in enumerate(along):
                group.slope[c, e] = slope

        self._each_contact(slopes)
        step = self._search(line_search)

        def move(v: Any, changed: jax.Array) -> jax.Array:
            before = self._of_limit(v)
            memory.qacc[v] = memory.qacc[v] + step * memory.direction[v]
            memory.residual[v] = memory.residual[v] + step * memory.product[v]
            other = (before < 0.0) != (self._of_limit(v) < 0.0)
            return jnp.where(other, 1, changed)

        def move_contact(group: _Group, c: Any, changed: jax.Array) -> jax.Array:
            for e in range(len(group.edges)):
                before = group.jaref[c, e]
                after = before + step * group.slope[c, e]
                group.jaref[c, e] = after
                changed = jnp.where((before < 0.0) != (after < 0.0), 1, changed)
            return changed

        changed = _each(self._size, move, jnp.zeros_like(step, jnp.int32))
        return jnp.max(self._each_contact(move_contact, changed))

    def _search(self, steps: int) -> jax.Array:
        """Return the step to the least cost along the direction.

        phi(s) = cost(qacc + s direction); phi' is increasing and piecewise linear.
        """
        inputs, memory = self._inputs, self._memory

        def multiply(i: Any, sums: Any) -> Any:
            memory.product[i] = self._sum_over_joints(
                lambda j: inputs.inertia[i, j] * memory.direction[j]
            )
            (linear, quadratic), along = sums, memory.direction[i]
            linear = linear + along * memory.residual[i]
            return linear, quadratic + along * memory.product[i]

        none = jnp.zeros_like(memory.residual[0])
        linear, quadratic = _each(self._size, multiply, (none, none))

        def derivatives(d: jax.Array, slope: jax.Array, weight: jax.Array) -> Any:
            pushed = jnp.where(d < 0.0, weight * slope, 0.0)
            return pushed * d, pushed * slope

        def search(_: Any, carry: Any) -> Any:
            step, low, high = carry

            def of_limit(v: Any) -> Any:
                slope = inputs.sign[v] * memory.direction[v]
                there = self._of_limit(v) + step * slope
                return derivatives(there, slope, inputs.weight[v])

            def add_contact(group: _Group, c: Any, sums: Any) -> Any:
                for e in range(len(group.edges)):
                    slope = group.slope[c, e]
                    there = group.jaref[c, e] + step * slope
                    terms = derivatives(there, slope, group.weight[c, e])
                    sums = jax.tree.map(jnp.add, sums, terms)
                return sums

            first, second = self._sum_over_joints(of_limit)
            sums = first + linear + step * quadratic, second + quadratic
            first, second = self._each_contact(add_contact, sums)
            low = jnp.where(first < 0.0, step, low)
            high = jnp.where(first < 0.0, high, step)
            following = step - first / jnp.maximum(second, 1e-20)
            inside = (following >= low) & (following <= high)
            return jnp.where(inside, following, 0.5 * (low + high)), low, high

        one = jnp.ones_like(none)
        return _each(steps, search, (one, none, 1e3 * one))[0]

    def finish(self) -> None:
        """Store the forces. Contacts out of play have some too, which are 0."""

        def forces(group: _Group, c: Any, _: None) -> None:
            values = []
            for e in range(len(group.edges)):
                weight = group.weight[c, e]
                force = weight * jnp.maximum(-group.jaref[c, e], 0.0)
                values.append(jnp.where(weight > 0.0, force, 0.0))
                group.jaref[c, e] = values[-1]
            for a, signs in enumerate(group.signs):
                group.push[c, a] = -sum_signed(values, signs)

        for group in self._groups:
            _each(group.basis.shape[0], functools.partial(forces, group))
        result = self._memory.constraint_force

        def total(v: Any, _: None) -> None:
            result[v] = -self._pull(v, jnp.zeros_like(result[v]))

        _each(self._size, total)


def _kernel(
    iterations: int, line_search: int, edges: Sequence[Any], *refs: Any
) -> None:
    """Solve the problems of a block: Newton's iterations until no row changes."""
    left, count = list(refs), len(edges)

    def take(number: int) -> list[Any]:
        taken = left[:number]
        del left[:number]
        return taken

    inputs = _Inputs(*take(len(_Inputs._fields)))
    of_groups = [take(3) for _ in edges]
    memory = _Memory(*take(len(_Memory._fields)))
    groups = [
        _Group([(1, *signs) for signs in rows], *of_group, *left[i::count])
        for i, (rows, of_group) in enumerate(zip(edges, of_groups))
    ]
    block = _Block(inputs, memory, groups)
    block.start()

    def iterate(done: Any, changed: jax.Array) -> jax.Array:
        goes_on = (done < 2) | (changed > 0)
        return jax.lax.cond(
            goes_on, lambda: block.improve(line_search), lambda: changed
        )

    _each(iterations, iterate, jnp.int32(1))
    block.finish()


def _call(
    kernel: Callable[..., None],
    arrays: Sequence[jax.Array],
    shapes: Sequence[tuple[int, ...]],
    interpret: bool,
) -> list[jax.Array]:
    """Call a kernel on blocks of the last axis, which the results' `shapes` lack."""
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import triton

    batch = arrays[0].shape[-1]
    blocks = -(-batch // LANES)

    def padded(x: jax.Array) -> jax.Array:
        pads = [(0, 0)] * (x.ndim - 1) + [(0, blocks * LANES - batch)]
        return jnp.pad(x, pads, mode="edge")

    def spec(shape: Sequence[int]) -> Any:
        zeros = (0,) * len(shape)
        return pl.BlockSpec((*shape, LANES), lambda b: (*zeros, b))

    results = pl.pallas_call(
        kernel,
        grid=(blocks,),
        in_specs=[spec(x.shape[:-1]) for x in arrays],
        out_specs=[spec(x) for x in shapes],
        out_shape=[
            jax.ShapeDtypeStruct((*x, blocks * LANES), jnp.float32) for x in shapes
        ],
        compiler_params=triton.CompilerParams(num_warps=1, num_stages=1),
        interpret=interpret,
        name="newton",
    )(*map(padded, arrays))
    return [x[..., :batch] for x in results]


def solve_many(
    iterations: int, line_search: int, problem: Any, *, interpret: bool = False
) -> tuple[jax.Array, tuple[jax.Array, ...], jax.Array]:
    """Return the fields of the `newton.Solution` of a `newton.Problem`.

    Args:
      iterations: largest number of Newton iterations.
      line_search: number of steps of each line search.
      problem: the problems; every array has the batch at its end.
      interpret: run the kernel as XLA's operations, on any device, to test it.
    """
    limits, contacts = problem.limits, problem.contacts
    arrays = [problem.inertia, problem.force, problem.warmstart]
    arrays += [limits.sign, limits.reference, limits.weight]
    for group in contacts:
        basis = jnp.concatenate([group.normal[:, None], group.tangents], axis=1)
        arrays += [basis, group.reference, group.weight]
    size = problem.force.shape[0]
    of_edges = [group.reference.shape[:-1] for group in contacts]
    of_basis = [(len(x.normal), 1 + x.tangents.shape[1]) for x in contacts]
    shapes: list[tuple[int, ...]] = [(size,) for _ in _Memory._fields]
    shapes[_Memory._fields.index("factor")] = (size, size)
    shapes += [*of_edges, *of_edges, *of_basis, *((*x, size) for x in of_basis)]
    kernel = functools.partial(
        _kernel, iterations, line_search, [group.edges for group in contacts]
    )
    qacc, force, *others = _call(kernel, arrays, shapes, interpret)
    first = len(_Memory._fields) - 2
    return qacc, tuple(others[first : first + len(contacts)]), force

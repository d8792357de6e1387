"""Newton's method for small dense constraint problems.

MuJoCo's constrained acceleration minimizes, over qacc,

    1/2 (qacc - qacc_smooth)' M (qacc - qacc_smooth)
      + 1/2 sum_r D_r min(0, J_r qacc - aref_r)^2

(MuJoCo documentation, "Computation", pyramidal cones). The cost is convex and piecewise
quadratic, so Newton's method with an exact line search ends as soon as it has found the
active rows. Most rows are one-sided, as here: they only push. Those of dry friction and
of equalities pull as well, with a force D_r (J_r qacc - aref_r) up to a bound, which is
infinite for an equality; beyond it the cost is linear. The rows of an elliptic cone are
the axes of a contact, whose cost is one of all of them (see `Cone`).

Rows are not stored one by one. A joint's is one entry of a diagonal. The rows
of a contact are the edges of its friction pyramid, normal +- friction * tangent: with
E the small constant matrix that makes edges of normal and tangents, J = E B, and

    J q = E (B q),    J' diag(w) J = B' (E' diag(w) E) B,

where B has 2 or 3 rows for each contact and J has 4.

The method is written once, for a `System`: `newton_batch` has many problems in arrays
with the batch as the last axis, `newton_kernel` one problem in a thread block of a GPU.

It is not reverse-mode differentiable. Neither is MJX's own solver, because its loop is
dynamic.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
from flax import struct

from gasil_envs.physics.batching import add, sum_signed

# Shape letters: V degrees of freedom; and for a group of contacts with the same number
# of edges: C contacts, A axes (the normal and the tangents), E edges. The classes give
# the shapes of one problem; in a batch every array has B as a further, last axis.


class Cone(NamedTuple):
    """Elliptic friction cones of contacts whose edges are their axes.

    With y = J qacc - aref, whose tangents are scaled by friction / ratio, t the length
    of the tangents of y, and u its normal, the cost of a contact is

      D/2 (u^2 + t^2) where ratio u + t <= 0: friction holds it,
      D/2 (u - ratio t)^2 / (1 + ratio^2) else, where u < ratio t: it slides,
      0 where it does not touch.
    """

    ratio: Any  # (C, 1), the first friction / sqrt(impratio).


class ContactRows(struct.PyTreeNode):
    """The rows of a group of contacts with the same number of edges; float32."""

    #: (C, A, V), Jacobians of the normal and of the tangents times the friction; zero
    #: where out of play.
    basis: jax.Array
    reference: jax.Array  # (C, E), aref of the edges.
    #: (C, E), D of the edges, (C, 1) of cones; 0 where out of play and above 0
    #: elsewhere.
    weight: jax.Array
    #: E rows of A signs: an edge is their product with the axes.
    edges: tuple[tuple[int, ...], ...] = struct.field(pytree_node=False)
    #: (C, E), largest force of rows that push and pull; None if they only push; or the
    #: cones.
    bound: jax.Array | Cone | None = None


class JointRows(struct.PyTreeNode):
    """Rows of one degree of freedom each, its limit or its dry friction; float32."""

    #: (V,), the Jacobian: 1 of friction and at a lower limit, -1 at an upper one, 0 in
    #: between.
    sign: jax.Array
    reference: jax.Array  # (V,), aref.
    weight: jax.Array  # (V,), D, at least 0.
    #: (V,), largest force of friction; None of limits, which only push.
    bound: jax.Array | None = None


class Problem(struct.PyTreeNode):
    """The constrained dynamics of one instant; float32."""

    inertia: jax.Array  # (V, V), the joint-space inertia M.
    force: jax.Array  # (V,), all forces but the constraints': M qacc_smooth.
    warmstart: jax.Array  # (V,), initial guess, used if it is better than qacc_smooth.
    #: The joints' limits, and their dry friction if there is any.
    joints: tuple[JointRows, ...]
    #: Groups of contacts, and of other rows as contacts with one axis.
    contacts: tuple[ContactRows, ...] = ()


class Solution(struct.PyTreeNode):
    """The accelerations and the forces of the constraints; float32."""

    qacc: jax.Array  # (V,), acceleration.
    #: (C, E) for each group of contacts, force along each edge.
    edge_forces: tuple[jax.Array, ...]
    constraint_force: jax.Array  # (V,), J' times these forces and those of the limits.


class System(Protocol):
    """Problems in the arrays in which a device solves them.

    A vector (V numbers a problem) and rows (a number for each row of J) are trees of
    arrays, which only a system looks into.
    """

    force: Any  # A vector, the problem's.
    warmstart: Any  # A vector, the problem's.
    reference: Any  # Rows, aref.
    weight: Any  # Rows, D.
    #: For each entry of the list of rows, None if these only push, or the largest force
    #: of each, or a `Cone`, whose rows are a list of axes.
    bound: list[Any]

    def inertia_times(self, vector: Any) -> Any:
        """M vector."""

    def times(self, vector: Any) -> Any:
        """J vector."""

    def transposed_times(self, rows: Any) -> Any:
        """J' rows."""

    def solve(self, active: Any, right: Any) -> Any:
        """Return x of (M + J' diag(active) J) x = right; of M x = right if None."""

    def total(self, tree: Any) -> jax.Array:
        """Return the sum of all numbers of each problem."""

    def differ(self, a: Any, b: Any) -> jax.Array:
        """Return whether two trees of booleans differ in a problem."""

    def store(self, tree: Any) -> Any:
        """Return the same, computed once however often it is used."""

    def repeat(
        self,
        function: Callable[[Any], Any],
        carry: Any,
        *,
        least: int,
        most: int,
        is_short: bool,
    ) -> Any:
        """Call a function `least` to `most` times, and return the last carry.

        It returns the carry and whether something has changed. After `least` calls it
        need not be called again once nothing changes; a test may cost as much as a
        short function.
        """


def weighted_axes(
    edges: Sequence[Sequence[int]], weights: Any, axes: Sequence[Any]
) -> Iterator[jax.Array]:
    """Yield, for each axis, its rows of E' diag(weights) E B of a group of contacts.

    `weights` are an array (C, ...) for each edge, or of cones A rows of A such arrays,
    and `axes` the rows of B (C, V, ...) of each axis.
    """
    if isinstance(weights[0], list):
        for row in weights:
            yield add(x[:, None] * axis for x, axis in zip(row, axes, strict=True))
        return
    signs = list(zip(*edges, strict=True))
    for own in signs:
        terms = []
        for others, axis in zip(signs, axes, strict=True):
            products = [a * b for a, b in zip(own, others, strict=True)]
            if any(products):
                terms.append(sum_signed(weights, products)[:, None] * axis)
        yield add(terms)


# A row's cost as a function of d = J qacc - aref, for a row that only pushes (`most` is
# None) and for one that also pulls, with a force up to `most`.


def _cost(d: jax.Array, w: jax.Array, most: Any) -> jax.Array:
    """Twice the cost."""
    if most is None:
        return w * jnp.minimum(d, 0.0) ** 2
    force = _derivative(d, w, most)
    return force * (2.0 * d - force / jnp.maximum(w, 1e-30))


def _derivative(d: jax.Array, w: jax.Array, most: Any) -> jax.Array:
    """The first derivative of the cost: the force, with the opposite sign."""
    if most is None:
        return _curvature(d, w, most) * d
    return jnp.clip(w * d, -most, most)


def _force(d: jax.Array, w: jax.Array, most: Any) -> jax.Array:
    """The force, which is 0 and not -0 of a row that only pushes and does not."""
    if most is None:
        return w * jnp.maximum(-d, 0.0)
    return -_derivative(d, w, most)


def _curvature(d: jax.Array, w: jax.Array, most: Any) -> jax.Array:
    """The second derivative of the cost."""
    return jnp.where(d < 0.0 if most is None else jnp.abs(w * d) < most, w, 0.0)


def _rate(d: jax.Array, w: jax.Array, most: Any, slope: jax.Array) -> jax.Array:
    """The derivative of the cost along a direction in which d changes by `slope`."""
    if most is None:
        return _curvature(d, w, most) * slope * d
    return _derivative(d, w, most) * slope


def _bend(d: jax.Array, w: jax.Array, most: Any, slope: jax.Array) -> jax.Array:
    """The second derivative of the cost along such a direction."""
    return _curvature(d, w, most) * slope * slope


def _piece(d: jax.Array, w: jax.Array, most: Any) -> jax.Array:
    """Which piece of the cost: whether it pushes, or which of its bounds it is at."""
    if most is None:
        return d < 0.0
    force = w * d
    # One that is not a number is equal to itself, so that the iterations end.
    return jnp.where(jnp.abs(force) >= most, jnp.sign(force), 0.0)


# The same of contacts with elliptic cones, from the list of a contact's axes.


def _cone_parts(d: Any, w: jax.Array, ratio: jax.Array) -> tuple[jax.Array, ...]:
    """Return what the others share.

    The weight of sliding, 0 where it does not; the derivative by the normal; what the
    tangents are multiplied with in theirs; the tangents' length; whether it is held.
    """
    normal, *tangents = d
    length = jnp.sqrt(add(x * x for x in tangents))
    held = ratio * normal + length <= 0.0
    beyond = normal - ratio * length
    sliding = w / (1.0 + ratio * ratio)
    push = jnp.where(held, w * normal, sliding * jnp.minimum(beyond, 0.0))
    length = jnp.maximum(length, 1e-15)
    side = jnp.where(held, w, -push * ratio / length)
    return jnp.where((beyond < 0.0) & ~held, sliding, 0.0), push, side, length, held


def _cone_derivative(d: Any, w: jax.Array, ratio: jax.Array) -> list[jax.Array]:
    _, push, side, *_ = _cone_parts(d, w, ratio)
    return [push, *(side * x for x in d[1:])]


def _cone_cost(d: Any, w: jax.Array, ratio: jax.Array) -> jax.Array:
    # Of degree 2, as all three pieces are.
    return add(x * y for x, y in zip(d, _cone_derivative(d, w, ratio), strict=True))


def _cone_curvature(d: Any, w: jax.Array, ratio: jax.Array) -> list[list[jax.Array]]:
    """The second derivatives by the normal and the tangents."""
    sliding, _, side, length, held = _cone_parts(d, w, ratio)
    # The cost bends along the normal less `ratio` times the tangents' direction.
    along = [jnp.ones_like(length), *(-ratio * x / length for x in d[1:])]
    # In their direction the tangents' own derivative does not change by `side`.
    lost = jnp.where(held, 0.0, side / (ratio * ratio))

    def second(i: int, j: int) -> jax.Array:
        own = side if i else jnp.where(held, w, 0.0)
        bend = sliding - lost if i and j else sliding
        return bend * along[i] * along[j] + (own if i == j else 0.0)

    return [[second(i, j) for j in range(len(d))] for i in range(len(d))]


def _cone_rate(d: Any, w: jax.Array, ratio: jax.Array, slope: Any) -> jax.Array:
    derivative = _cone_derivative(d, w, ratio)
    return add(x * y for x, y in zip(derivative, slope, strict=True))


def _cone_bend(d: Any, w: jax.Array, ratio: jax.Array, slope: Any) -> jax.Array:
    sliding, _, side, length, held = _cone_parts(d, w, ratio)
    along = add(x * y for x, y in zip(d[1:], slope[1:], strict=True)) / length
    square = add(x * x for x in slope[1:]) - jnp.where(held, 0.0, along * along)
    bent = sliding * (slope[0] - ratio * along) ** 2 + side * square
    return bent + jnp.where(held, w * slope[0] ** 2, 0.0)


def _cone_piece(d: Any, w: jax.Array, ratio: jax.Array) -> jax.Array:
    sliding, *_, held = _cone_parts(d, w, ratio)
    return jnp.where(held, 2.0, jnp.where(sliding > 0.0, 1.0, 0.0))


_OF_CONES: dict[Any, Callable[..., Any]] = {
    _cost: _cone_cost,
    _derivative: _cone_derivative,
    _force: lambda *x: [0.0 - y for y in _cone_derivative(*x)],
    _curvature: _cone_curvature,
    _rate: _cone_rate,
    _bend: _cone_bend,
    _piece: _cone_piece,
}


def minimize(system: System, iterations: int, line_search: int) -> tuple[Any, Any]:
    """Return the accelerations, a vector, and the forces along the rows."""
    each = jax.tree.map
    has_cones = any(isinstance(most, Cone) for most in system.bound)
    # A row that bends twice can send a search from one end to the other for ever.
    pulls = any(most is not None for most in system.bound)
    thorough = pulls or line_search > 4

    def of_rows(function: Callable[..., jax.Array], jaref: Any, *others: Any) -> Any:
        """Return a function of each row; `others` are the last arguments."""

        def of_one(d: Any, w: Any, most: Any, *x: Any) -> Any:
            if isinstance(most, Cone):
                return _OF_CONES[function](d, w[0], most.ratio[0], *x)
            if most is None:
                return each(lambda d, w, *x: function(d, w, None, *x), d, w, *x)
            return each(function, d, w, most, *x)

        rows = zip(jaref, system.weight, system.bound, *others, strict=True)
        return [of_one(*row) for row in rows]

    # J qacc - aref of each row, by MuJoCo's name.
    def jaref_at(qacc: Any) -> Any:
        return system.store(each(jnp.subtract, system.times(qacc), system.reference))

    def dot(a: Any, b: Any) -> jax.Array:
        return system.total(each(jnp.multiply, a, b))

    def row_cost(jaref: Any) -> jax.Array:
        return system.total(of_rows(_cost, jaref))

    warmstart, smooth = system.warmstart, system.solve(None, system.force)
    away = each(jnp.subtract, warmstart, smooth)
    at_warmstart, at_smooth = jaref_at(warmstart), jaref_at(smooth)
    cost = dot(away, system.inertia_times(away)) + row_cost(at_warmstart)
    better = cost < row_cost(at_smooth)

    def choose(a: jax.Array, b: jax.Array) -> jax.Array:
        return jnp.where(better, a, b)

    def iterate(carry: Any) -> Any:
        qacc, jaref = carry
        residual = each(jnp.subtract, system.inertia_times(qacc), system.force)
        derivative = of_rows(_derivative, jaref)
        pull = system.transposed_times(derivative)
        active, gradient = system.store(
            (of_rows(_curvature, jaref), each(jnp.add, residual, pull))
        )
        direction = each(jnp.negative, system.solve(active, gradient))

        # phi(s) = cost(qacc + s direction); phi' is increasing and piecewise linear.
        slope = system.store(system.times(direction))
        linear = dot(direction, gradient if thorough else residual)
        quadratic = dot(direction, system.inertia_times(direction))
        size = dot(smooth, system.force)
        size += dot(qacc, each(jnp.add, residual, system.force))

        def moves(far: Any, step: jax.Array) -> jax.Array:
            """Whether a step is more than the rounding of accelerations."""
            far &= step * step * quadratic > 1e-11 * size
            return system.differ(far, far & False)

        def search_step(search: Any) -> Any:
            (step, is_newton), low, high, before = search
            there = each(lambda d, s: d + step * s, jaref, slope)
            second = quadratic + system.total(of_rows(_bend, there, slope))
            if thorough:  # Large forces that balance each other are not added again.
                change = each(jnp.subtract, of_rows(_derivative, there), derivative)
                rates = each(jnp.multiply, change, slope)
            else:
                rates = of_rows(_rate, there, slope)
            first = linear + step * quadratic + system.total(rates)
            low = jnp.where(first < 0.0, step, low)
            high = jnp.where(first < 0.0, high, step)
            following = step - first / jnp.maximum(second, 1e-20)
            inside = (following >= low) & (following <= high)
            if pulls:
                other_end = jnp.where(first < 0.0, high, low)
                inside &= jnp.abs(following - other_end) > 0.01 * (high - low)
            following = jnp.where(inside, following, 0.5 * (low + high))
            now = of_rows(_piece, there)
            goes_on = system.differ(before, now)
            if thorough and not has_cones:
                # Within a piece it is at the minimum already, but for rounding.
                exact = is_newton & ~goes_on
                following = jnp.where(exact, step, following)
                inside |= exact
            if has_cones:
                change = following - step
                goes_on |= moves(jnp.abs(change) > 0.01 * step, change)
            elif thorough:  # Half of the way is no step to end with.
                goes_on |= system.differ(is_newton, is_newton | True)
            return ((following, inside), low, high, now), goes_on

        step, before = jnp.ones_like(linear), of_rows(_piece, jaref)
        low, high = jnp.zeros_like(step), jnp.full_like(step, 1e3)
        search = ((step, step > 0.0), low, high, before)
        (step, _), *_ = system.repeat(
            search_step, search, least=1, most=line_search, is_short=True
        )
        qacc, moved = each(
            lambda x, change: x + step * change, (qacc, jaref), (direction, slope)
        )
        goes_on = system.differ(before, of_rows(_piece, moved))
        if has_cones:  # Their cost is not quadratic.
            goes_on |= moves(True, step)
        return (qacc, moved), goes_on

    start = each(choose, (warmstart, at_warmstart), (smooth, at_smooth))
    qacc, jaref = system.repeat(
        iterate, start, least=2, most=iterations, is_short=False
    )
    return qacc, of_rows(_force, jaref)

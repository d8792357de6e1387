"""Contacts of geoms with planes that do not move, and of spheres and capsules.

A sphere is a capsule of length 0, and each end of a capsule meets a plane as a sphere.
Boxes, cylinders and ellipsoids meet planes in points, a box meets a sphere, and a
cylinder spheres and capsules, of which a lying one touches its disk twice. The formulas
are C MuJoCo's (but for a capsule whose axis is inside a cylinder, which C pushes out
another way), and every array has the batch as its last axis. Two things differ from
MJX:

- The tangent of a capsule on a plane is the capsule's axis, however steep it is, as in
  C MuJoCo. MJX takes a fixed tangent above 60 degrees. The pyramidal friction cone, and
  therefore the motion, depends on the tangent.
- In a model that can only move in a plane, and whose contacts' tangents are in it or
  across it, the tangent across is left out. Nothing moves along it, so its two edges
  would both equal the normal.

Shape letters: C contacts, A axes, B batch.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from gasil_envs.physics import tree
from gasil_envs.physics.batching import (
    add,
    constant_times,
    materialize,
    on_cpu,
    stacked,
    take,
    total,
)

_PLANE, _SPHERE, _CAPSULE, _ELLIPSOID, _CYLINDER, _BOX = (
    int(getattr(mujoco.mjtGeom, f"mjGEOM_{name}"))
    for name in ("PLANE", "SPHERE", "CAPSULE", "ELLIPSOID", "CYLINDER", "BOX")
)
#: How many points of a geom can touch a plane.
_POINTS = {_ELLIPSOID: 1, _CYLINDER: 4, _BOX: 8}


@dataclasses.dataclass(frozen=True, eq=False)
class Pairs:
    """The pairs of geoms of one group of contacts."""

    on_plane: np.ndarray  # (2, n), planes and spheres or capsules.
    end: np.ndarray  # (n,), 1 or -1 for an end of a capsule on a plane, 0 for a sphere.
    #: (2, k), planes and other geoms; all points of a pair follow each other.
    points: np.ndarray
    between: np.ndarray  # (2, m), spheres and capsules.
    #: (2, l), spheres or capsules and boxes or cylinders; a capsule that can lie on a
    #: cylinder is there twice. Contacts are in the order of these four.
    solids: np.ndarray
    margin: np.ndarray  # (l,), distance in metres from which these are in play.
    num_tangents: int  # Number of tangents of a contact.
    #: (3,), the normal of the plane that all motion is in, or None.
    motion_normal: np.ndarray | None

    @property
    def geoms(self) -> np.ndarray:
        """The two geoms of each contact, (C, 2)."""
        every = [self.on_plane, self.points, self.between, self.solids]
        return np.concatenate(every, axis=1).T


class Touch(NamedTuple):
    """Where contacts are, in metres. An axis of length 1 is broadcast."""

    distance: jax.Array  # (C, B), negative if they penetrate.
    position: jax.Array  # (C, 3, B).
    #: (C or 1, A, 3, B or 1): normal from the first geom to the second, tangents.
    axes: jax.Array | np.ndarray


def pairs(
    model: mujoco.MjModel,
    geoms: np.ndarray,
    num_tangents: int,
    *,
    margin: np.ndarray,
    motion_normal: np.ndarray | None,
) -> tuple[Pairs, np.ndarray]:
    """Return the contacts of pairs (P, 2), and which pair each contact is of, (C,)."""
    first, second = model.geom_type[geoms].T
    plane, rounded = first == _PLANE, second <= _CAPSULE
    count = np.array([_POINTS.get(kind, 0) for kind in second], int)
    number = np.arange(len(geoms))
    ends = np.where(second == _CAPSULE, 2, 1) * (plane & rounded)
    on_plane = np.repeat(number, ends)
    is_second = np.diff(on_plane, prepend=-1) == 0
    end = np.where(second[on_plane] == _CAPSULE, np.where(is_second, -1.0, 1.0), 0.0)
    points = np.repeat(number, count * (plane & ~rounded))
    between, solids = number[~plane & rounded], number[~plane & ~rounded]
    if not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_MULTICCD:
        solids = np.repeat(solids, np.where(first[solids] == _CAPSULE, 2, 1))
    index = np.concatenate([on_plane, points, between, solids])
    every = Pairs(
        on_plane=geoms[on_plane].T,
        end=end,
        points=geoms[points].T,
        between=geoms[between].T,
        solids=geoms[solids].T,
        margin=margin[solids],
        num_tangents=num_tangents,
        motion_normal=motion_normal,
    )
    return every, index


def unsupported(model: mujoco.MjModel, geoms: np.ndarray) -> str | None:
    """Return why `touch` does not describe these pairs (P, 2), or None if it does."""
    kinds = model.geom_type[geoms]
    on_plane = kinds[:, 0] == _PLANE
    round_geoms = [_SPHERE, _CAPSULE]
    for (first, second), plane in zip(kinds, on_plane, strict=True):
        allowed = [*round_geoms, *(_POINTS if plane else [_CYLINDER])]
        allowed = [*allowed, _BOX] if first == _SPHERE else allowed
        if second not in allowed or first > _CAPSULE:
            names = [mujoco.mjtGeom(x).name[len("mjGEOM_") :] for x in (first, second)]
            return f"it has contacts of {' and '.join(names).lower()}"
    if model.body_weldid[model.geom_bodyid[geoms[on_plane, 0]]].any():
        return "it has planes that move"
    long = (kinds[:, 0] == _CAPSULE) & np.isin(kinds[:, 1], [_CAPSULE, _CYLINDER])
    if stay_parallel(model, geoms[long]):
        return "it has contacts of capsules that stay parallel"
    return None


def stay_parallel(model: mujoco.MjModel, geoms: np.ndarray) -> bool:
    """Whether two capsules are parallel in any state: they touch in two points then."""
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    parallel = np.ones(len(geoms), bool)
    for _ in range(2 if len(geoms) else 0):
        data.qpos[:] = model.qpos0 + rng.normal(size=model.nq)
        mujoco.mj_kinematics(model, data)
        axes = data.geom_xmat.reshape(-1, 3, 3)[geoms, :, 2]
        sine = np.linalg.norm(np.cross(axes[:, 0], axes[:, 1]), axis=1)
        parallel &= sine < 1e-7
    return bool(parallel.any())


def depth(model: mujoco.MjModel) -> float:
    """Return how deep the deepest contact is at the start, in sizes of a body."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    size = max(model.stat.meansize, mujoco.mjMINVAL)
    return -float(data.contact.dist.min(initial=0.0)) / size


class Segments(NamedTuple):
    """The lines along the middle of geoms, metres."""

    middle: jax.Array  # (geom, 3, B), their centres.
    half: jax.Array  # (geom, 3, B), from there to one end.
    #: Rotations of the geoms that are no capsules, spheres or planes.
    columns: dict[int, list[jax.Array]]


@jax.named_scope("collision")
def segments(model: mujoco.MjModel, at: tree.Kinematics) -> Segments:
    """Return the line of each geom; that of a sphere or a plane is a point."""
    middle, half, rotations = [], [], {}
    for geom in range(model.ngeom):
        body = model.geom_bodyid[geom]
        columns, origin = at.columns[body], at.xpos[body]
        middle.append(origin + tree.rotate(columns, model.geom_pos[geom]))
        matrix = np.zeros(9)
        mujoco.mju_quat2Mat(matrix, model.geom_quat[geom])
        if model.geom_type[geom] in _POINTS:
            local = matrix.reshape(3, 3).T
            rotations[geom] = materialize([tree.rotate(columns, x) for x in local])
        if model.geom_type[geom] == _CAPSULE:
            half.append(tree.rotate(columns, matrix[2::3] * model.geom_size[geom, 1]))
        else:
            half.append(jnp.zeros_like(origin))
    places = materialize((stacked(middle), stacked(half)))
    return Segments(places[0], places[1], rotations)


@jax.named_scope("collision")
def touch(model: mujoco.MjModel, pairs: Pairs, lines: Segments) -> Touch:
    """Return the contacts of a group."""
    kinds = (
        (pairs.on_plane, _touch_planes),
        (pairs.points, _touch_planes_in_points),
        (pairs.between, _touch_each_other),
        (pairs.solids, _touch_solids),
    )
    parts = [function(model, pairs, lines) for x, function in kinds if x.size]
    if len(parts) == 1:
        return parts[0]
    distance, position, axes = zip(*parts, strict=True)
    wide = [
        jnp.broadcast_to(x, (len(y), x.shape[1], *y.shape[1:]))
        for x, y in zip(axes, position, strict=True)
    ]
    return Touch(*map(jnp.concatenate, (distance, position, wide)))


def _touch_planes(model: mujoco.MjModel, pairs: Pairs, lines: Segments) -> Touch:
    plane, geom = pairs.on_plane
    normal, height = _planes(model, plane)

    def constant(x: Any) -> Any:
        return x.astype(np.float32)[..., None]

    radius = constant(model.geom_size[geom, 0])
    axis = take(lines.half, geom)
    centre = take(lines.middle, geom) + constant(pairs.end[:, None]) * axis
    distance = total(constant(normal) * centre, 1) - constant(height) - radius
    position = centre - constant(normal) * (radius + 0.5 * distance)[:, None]
    if np.allclose(normal, normal[0]):
        normal = normal[:1]
    if pairs.num_tangents == 0:
        return Touch(distance, position, constant(normal[:, None]))
    if pairs.motion_normal is not None:
        tangent = np.cross(pairs.motion_normal, normal)
        return Touch(distance, position, constant(np.stack([normal, tangent], axis=1)))
    # mjc_PlaneCapsule gives the capsule's axis, mju_makeFrame projects it.
    up = constant(normal)
    across = axis - up * total(axis * up, 1)[:, None]
    length = jnp.sqrt(total(across**2, 1)[:, None])
    # The axis of an upright capsule is the normal but for rounding.
    along = across / jnp.maximum(length, 1e-6)
    along = jnp.where(length > 1e-6, along, _orthogonal(up))
    up = jnp.broadcast_to(up, along.shape)
    axes = [up, along, tree.cross(up, along)]
    return Touch(distance, position, jnp.stack(axes, axis=1))


def _planes(model: mujoco.MjModel, plane: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return normals (n, 3) of planes, and their distances (n,) from the origin."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    normal = data.geom_xmat[plane].reshape(-1, 3, 3)[:, :, 2]
    return normal, np.sum(normal * data.geom_xpos[plane], axis=1)


def _touch_planes_in_points(
    model: mujoco.MjModel, pairs: Pairs, lines: Segments
) -> Touch:
    distances, positions, axes = [], [], []
    for plane, geom in np.unique(pairs.points, axis=1).T:
        (normal,), (height,) = _planes(model, np.array([plane]))
        size, columns = model.geom_size[geom], lines.columns[geom]
        # Each axis of the geom, as it is and as long as the geom is, along the normal.
        up = [_dot(column, normal) for column in columns]
        distance = _dot(lines.middle[geom], normal) - float(height)
        if model.geom_type[geom] == _BOX:
            points = _corners(size, columns, up)
        elif model.geom_type[geom] == _CYLINDER:
            points = _rim(size, columns, up)
        else:
            square = (size**2).astype(np.float32)[:, None]
            length = jnp.sqrt(total(jnp.stack(up) ** 2 * square))
            lowest = -total(
                jnp.stack(columns) * jnp.stack(up)[:, None] * square[..., None]
            )
            points = [(lowest / length, -length)]
        for away, lower in points:
            distances.append(distance + lower)
            centre = lines.middle[geom] + away
            down = 0.5 * jnp.where(jnp.isfinite(distances[-1]), distances[-1], 0.0)
            positions.append(centre - normal.astype(np.float32)[:, None] * down)
            axes.append(normal)
    normals = jnp.asarray(np.stack(axes).astype(np.float32)[..., None])
    return Touch(stacked(distances), stacked(positions), _frames(pairs, normals))


def _dot(vector: jax.Array, constant: np.ndarray) -> jax.Array:
    """Return the dot product of (3, B) and a constant (3,), (B,)."""
    return constant_times(constant[None], vector)[0]


# Points are from a geom's middle, and their heights are along the plane's normal.
_Points = list[tuple[jax.Array, jax.Array]]


def _corners(
    size: np.ndarray, columns: list[jax.Array], up: list[jax.Array]
) -> _Points:
    corners = []
    for i in range(8):
        signs = [1.0 if i & bit else -1.0 for bit in (1, 2, 4)]
        scale = [float(sign * x) for sign, x in zip(signs, size, strict=True)]
        away = add(x * column for x, column in zip(scale, columns, strict=True))
        height = add(x * y for x, y in zip(scale, up, strict=True))
        # The upper corners never touch.
        corners.append((away, jnp.where(height > 0.0, jnp.inf, height)))
    return corners


def _rim(size: np.ndarray, columns: list[jax.Array], up: list[jax.Array]) -> _Points:
    """The lowest point of each disk of a cylinder, and two more of the lower one."""
    radius, half = map(float, size[:2])
    down = jnp.where(up[2] > 0.0, -1.0, 1.0)
    axis, along = columns[2] * (half * down), up[2] * down
    # The lowest direction in the plane of the disk, which is the axes' x and y.
    flat = jnp.sqrt(up[0] ** 2 + up[1] ** 2)
    is_flat = flat < 1e-7
    x, y = (-a / jnp.maximum(flat, 1e-7) for a in up[:2])
    x, y = jnp.where(is_flat, 1.0, x), jnp.where(is_flat, 0.0, y)
    low = radius * (x * columns[0] + y * columns[1])
    side = radius * (x * columns[1] - y * columns[0]) * float(np.sqrt(0.75))
    height, base = -radius * flat, half * along
    corner = base - 0.5 * height
    points = [(low + axis, base + height), (low - axis, height - base)]
    return points + [(axis - 0.5 * low + s * side, corner) for s in (1.0, -1.0)]


# Halvings until the point of a capsule that is nearest to a cylinder is known.
_HALVINGS = 25


def _touch_solids(model: mujoco.MjModel, pairs: Pairs, lines: Segments) -> Touch:
    distances: list[jax.Array] = []
    positions: list[jax.Array] = []
    normals: list[jax.Array] = []
    every, first, counts = np.unique(
        pairs.solids, axis=1, return_index=True, return_counts=True
    )
    for i in np.argsort(first):
        geom, solid = every[:, i]
        columns, up = lines.columns[solid], np.eye(3, dtype=np.float32)[..., None]
        size = model.geom_size[solid].astype(np.float32)[:, None]
        is_round = model.geom_type[solid] == _CYLINDER
        nearest = functools.partial(_nearest, size, is_round)
        centre, half = (
            stacked([total(column * x) for column in columns])
            for x in (lines.middle[geom] - lines.middle[solid], lines.half[geom])
        )
        middle = centre
        if model.geom_type[geom] == _CAPSULE:
            centre = _nearest_on_line(nearest, centre, half)
        away = nearest(centre) - centre
        apart = _length(away)
        sides = list(zip(centre, size, up, strict=True))
        if is_round:
            across = jnp.concatenate([centre[:2], 0.0 * centre[2:]])
            length = _length(across)
            sides = [(length, size[0], across / jnp.maximum(length, 1e-15))]
            sides.append((centre[2], size[1], up[2]))
        # Where the centre is inside, the nearest side.
        depth, inwards = jnp.full_like(apart, jnp.inf), jnp.zeros_like(centre)
        for along, most, axis in sides:
            nearer = most - jnp.abs(along) < depth
            depth = jnp.where(nearer, most - jnp.abs(along), depth)
            inwards = jnp.where(nearer, jnp.where(along > 0.0, -axis, axis), inwards)
        inside, radius = apart <= 1e-7, float(model.geom_size[geom, 0])
        distance = jnp.where(inside, -depth, apart)
        normal = jnp.where(inside, inwards, away / jnp.maximum(apart, 1e-7))
        position = centre + normal * (0.5 * (radius + distance))
        points = [(distance - radius, position, normal)]
        if counts[i] == 2:
            on_disk = (jnp.abs(centre[2]) > size[1]) & ~inside
            points = _lying(
                points[0],
                (middle, half),
                size=size,
                radius=radius,
                margin=float(pairs.margin[first[i]]),
                on_disk=on_disk,
            )
        for distance, position, normal in points:
            distances.append(distance)
            for x, results in ((position, positions), (normal, normals)):
                results.append(add(x[i] * columns[i] for i in range(3)))
            positions[-1] = positions[-1] + lines.middle[solid]
    axes = _frames(pairs, stacked(normals))
    return Touch(stacked(distances), stacked(positions), axes)


# C takes a capsule to lie on a disk up to this angle, and 16 edges for the disk's own.
_LYING = float(np.sin(0.0889))
_EDGES = [(np.cos(x), np.sin(x)) for x in (np.arange(8) + 0.5) * np.pi / 8]
_Point = tuple[jax.Array, jax.Array, jax.Array]


def _lying(
    one: _Point,
    line: tuple[jax.Array, jax.Array],
    *,
    size: np.ndarray,
    radius: float,
    margin: float,
    on_disk: jax.Array,
) -> list[_Point]:
    """Return two contacts, (distance, position, normal), of a capsule and a cylinder.

    If the capsule lies on a disk, they are the ends of its line (middle, half), moved
    to its surface and cut off at the edge of the disk; else they are `one` and none.
    """
    (middle, half), (distance, position, normal) = line, one
    square = jnp.maximum(total(half**2), 1e-30)
    aside = (radius + 0.5 * margin) * normal
    middle = middle + aside - half * (total(aside * half) / square)
    low, high = -jnp.ones_like(distance), jnp.ones_like(distance)
    most = float(size[0, 0] * np.cos(np.pi / 16))
    for edge in _EDGES:
        at, rate = (
            add(float(e) * x[i] for i, e in enumerate(edge)) for x in (middle, half)
        )
        rate = jnp.where(jnp.abs(rate) < 1e-15, 1e-15, rate)
        crossings = (-most - at) / rate, (most - at) / rate
        low = jnp.maximum(low, jnp.minimum(*crossings))
        high = jnp.minimum(high, jnp.maximum(*crossings))
    up = jnp.where(position[2] > 0.0, 1.0, -1.0)
    ends = [middle + low * half, middle + high * half]
    heights = [up * end[2] - size[1] + 0.5 * margin for end in ends]
    lies = on_disk & (jnp.abs(half[2]) < _LYING * jnp.sqrt(square)) & (low <= high)
    near = [lies & (height <= margin) for height in heights]

    def contact(own: int) -> _Point:
        height = jnp.where(near[own], heights[own], heights[1 - own])
        x, y, _ = jnp.where(near[own], ends[own], ends[1 - own])
        point = jnp.stack([x, y, up * (size[1] + 0.5 * height)])
        down = jnp.stack([0.0 * up, 0.0 * up, -up])
        mine = zip((height, point, down), one, strict=True)
        a, b, c = (jnp.where(near[0] | near[1], x, y) for x, y in mine)
        return a, b, c

    first, second = contact(0), contact(1)
    # An end that is cut off counts twice where the other one is too far.
    is_two = near[0] & near[1] | near[0] & (low > -1.0) | near[1] & (high < 1.0)
    return [first, (jnp.where(is_two, second[0], jnp.inf), *second[1:])]


def _length(x: jax.Array) -> jax.Array:
    return jnp.sqrt(total(x**2))


def _nearest(size: np.ndarray, is_round: bool, x: jax.Array) -> jax.Array:
    """Return the point of a cylinder or a box that is nearest to x, (3, B)."""
    if not is_round:
        return jnp.clip(x, -size, size)
    within = jnp.minimum(size[0] / jnp.maximum(_length(x[:2]), 1e-15), 1.0)
    flat = jnp.clip(x[2], -size[1], size[1])
    return jnp.stack([x[0] * within, x[1] * within, flat])


def _nearest_on_line(
    nearest: Callable[[jax.Array], jax.Array], middle: jax.Array, half: jax.Array
) -> jax.Array:
    """Return the point of a line that is nearest to a convex body, (3, B)."""

    def halve(_: Any, ends: tuple[jax.Array, jax.Array]) -> Any:
        low, high = ends
        at = 0.5 * (low + high)
        point = middle + at * half
        falls = total((point - nearest(point)) * half) < 0.0
        return jnp.where(falls, at, low), jnp.where(falls, high, at)

    one = jnp.ones_like(middle[0])
    unroll = 1 if on_cpu() else _HALVINGS  # On a GPU each turn would be some kernels.
    low, high = jax.lax.fori_loop(0, _HALVINGS, halve, (-one, one), unroll=unroll)
    return middle + 0.5 * (low + high) * half


def _orthogonal(normal: jax.Array | np.ndarray) -> jax.Array:
    """Return MuJoCo's tangent of a normal: (C, 3, B) -> (C, 3, B)."""
    y, z = (np.eye(3, dtype=np.float32)[i][:, None] for i in (1, 2))
    start = jnp.where(jnp.abs(normal[:, 1:2]) < 0.5, y, z)
    tangent = start - normal * total(jnp.asarray(normal * start), 1)[:, None]
    return tangent / jnp.sqrt(total(tangent**2, 1)[:, None])


def _touch_each_other(model: mujoco.MjModel, pairs: Pairs, lines: Segments) -> Touch:
    first, second = pairs.between
    a, b = (
        Segments(take(lines.middle, i), take(lines.half, i), {}) for i in pairs.between
    )

    def length(i: np.ndarray) -> np.ndarray:
        return np.where(
            model.geom_type[i] == _CAPSULE, model.geom_size[i, 1], 0.0
        ).astype(np.float32)[:, None]

    near_a, near_b = _nearest_points(a, b, length(first), length_b=length(second))
    radius = model.geom_size[pairs.between, 0].astype(np.float32)[..., None]
    away = materialize(near_b - near_a)
    apart = jnp.sqrt(total(away**2, 1))
    normal = jnp.where(
        apart[:, None] > 0.0,
        away / jnp.maximum(apart, 1e-15)[:, None],
        np.eye(3, dtype=np.float32)[0][:, None],
    )
    distance = apart - (radius[0] + radius[1])
    position = near_a + normal * (radius[0] + 0.5 * distance)[:, None]
    return Touch(distance, position, _frames(pairs, normal))


def _frames(pairs: Pairs, normal: jax.Array) -> jax.Array:
    """Return normals (C, 3, B) and as many tangents as a group has, (C, A, 3, B)."""
    axes = [normal]
    if pairs.num_tangents and pairs.motion_normal is not None:
        across = pairs.motion_normal.astype(np.float32)[:, None]
        axes.append(tree.cross(jnp.broadcast_to(across, normal.shape), normal))
    elif pairs.num_tangents:
        axes.append(_orthogonal(normal))
        axes.append(tree.cross(normal, axes[1]))
    return jnp.stack(axes, axis=1)


def _nearest_points(
    a: Segments, b: Segments, length_a: np.ndarray, *, length_b: np.ndarray
) -> tuple[jax.Array, jax.Array]:
    """Return the points of two segments that are nearest to each other, (C, 3, B).

    The lengths (C, 1) are halves. The nearest points of the two lines are moved onto
    the segments; then the better of two corrections is taken.
    """

    def dot(x: jax.Array, y: jax.Array) -> jax.Array:
        return total(x * y, 1)

    along_a = a.half / np.maximum(length_a, 1e-15)[..., None]
    along_b = b.half / np.maximum(length_b, 1e-15)[..., None]
    between = a.middle - b.middle
    cosine, from_a, from_b = materialize(
        (dot(along_a, along_b), dot(along_a, between), dot(along_b, between))
    )
    # 1e-6 is for parallel lines.
    at_a = (cosine * from_b - from_a) / (1.0 - cosine**2 + 1e-6)
    at_b = from_b + at_a * cosine

    def on_a(x: jax.Array) -> jax.Array:
        return jnp.clip(x, -length_a, length_a)

    def on_b(x: jax.Array) -> jax.Array:
        return jnp.clip(x, -length_b, length_b)

    at_a, at_b = materialize((on_a(at_a), on_b(at_b)))
    # Of each segment the point that is nearest to the other's point.
    other_a, other_b = on_a(at_b * cosine - from_a), on_b(at_a * cosine + from_b)

    def point(line: Any, along: jax.Array, at: jax.Array) -> jax.Array:
        return line.middle + along * at[:, None]

    one = point(a, along_a, other_a), point(b, along_b, at_b)
    two = point(a, along_a, at_a), point(b, along_b, other_b)

    def square(x: tuple[jax.Array, jax.Array]) -> jax.Array:
        return dot(x[0] - x[1], x[0] - x[1])

    nearer = (square(one) < square(two))[:, None]
    return jnp.where(nearer, one[0], two[0]), jnp.where(nearer, one[1], two[1])

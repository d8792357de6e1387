"""Contacts of spheres and capsules with each other and with planes that do not move.

A sphere is a capsule of length 0, and each end of a capsule meets a plane as a sphere.
The formulas are MJX's, and every array has the batch as its last axis. Two things
differ from MJX:

- The tangent of a capsule on a plane is the capsule's axis, however steep it is, as in
  C MuJoCo. MJX takes a fixed tangent above 60 degrees. The pyramidal friction cone, and
  therefore the motion, depends on the tangent.
- In a model that can only move in a plane, and whose contacts' tangents are in it or
  across it, the tangent across is left out. Nothing moves along it, so its two edges
  would both equal the normal.

Shape letters: C contacts, A axes, B batch.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from gasil_envs.physics import tree
from gasil_envs.physics.batching import materialize, stacked, take, total

_PLANE, _SPHERE, _CAPSULE = (
    int(mujoco.mjtGeom.mjGEOM_PLANE),
    int(mujoco.mjtGeom.mjGEOM_SPHERE),
    int(mujoco.mjtGeom.mjGEOM_CAPSULE),
)


@dataclasses.dataclass(frozen=True, eq=False)
class Pairs:
    """The pairs of geoms of one group of contacts.

    Attributes:
      on_plane: (2, n), the plane's and the other geom.
      end: (n,), 1 or -1 for an end of a capsule on a plane, 0 for a sphere.
      between: (2, m), the geoms of contacts without a plane; these follow the others.
      num_tangents: number of tangents of a contact.
      motion_normal: (3,), the normal of the plane that all motion is in, or None.
    """

    on_plane: np.ndarray
    end: np.ndarray
    between: np.ndarray
    num_tangents: int
    motion_normal: np.ndarray | None

    @property
    def geoms(self) -> np.ndarray:
        """The two geoms of each contact, (C, 2)."""
        return np.concatenate([self.on_plane, self.between], axis=1).T


class Touch(NamedTuple):
    """Where contacts are, in metres. An axis of length 1 is broadcast.

    Attributes:
      distance: (C, B), negative if they penetrate.
      position: (C, 3, B).
      axes: (C or 1, A, 3, B or 1): normal from the first geom to the second, tangents.
    """

    distance: jax.Array
    position: jax.Array
    axes: jax.Array | np.ndarray


def pairs(
    model: mujoco.MjModel,
    geoms: np.ndarray,
    num_tangents: int,
    *,
    motion_normal: np.ndarray | None,
) -> Pairs:
    """Divide contacts, by their geoms (C, 2), into those with a plane and others."""
    plane = model.geom_type[geoms[:, 0]] == _PLANE
    on_plane, between = geoms[plane], geoms[~plane]
    # The two ends of a capsule follow each other.
    again = np.zeros(len(on_plane), bool)
    again[1:] = (on_plane[1:] == on_plane[:-1]).all(axis=1)
    capsule = model.geom_type[on_plane[:, 1]] == _CAPSULE
    end = np.where(capsule, np.where(again, -1.0, 1.0), 0.0)
    return Pairs(on_plane.T, end, between.T, num_tangents, motion_normal)


def unsupported(model: mujoco.MjModel) -> str | None:
    """Return why `touch` does not describe this model, or None if it does."""
    collides = (model.geom_contype | model.geom_conaffinity).astype(bool)
    kinds = model.geom_type[collides]
    if not np.isin(kinds, [_PLANE, _SPHERE, _CAPSULE]).all():
        return "it has contacts of geoms other than planes, spheres and capsules"
    planes = collides & (model.geom_type == _PLANE)
    if model.body_weldid[model.geom_bodyid[planes]].any():
        return "it has planes that move"
    return None


class Segments(NamedTuple):
    """The lines along the middle of geoms, metres.

    Attributes:
      middle: (geom, 3, B), their centres.
      half: (geom, 3, B), from there to one end.
    """

    middle: jax.Array
    half: jax.Array


@jax.named_scope("collision")
def segments(model: mujoco.MjModel, at: tree.Kinematics) -> Segments:
    """Return the line of each geom; that of a sphere or a plane is a point."""
    middle, half = [], []
    for geom in range(model.ngeom):
        columns = at.columns[model.geom_bodyid[geom]]
        origin = at.xpos[model.geom_bodyid[geom]]
        middle.append(origin + tree.rotate(columns, model.geom_pos[geom]))
        if model.geom_type[geom] == _CAPSULE:
            matrix = np.zeros(9)
            mujoco.mju_quat2Mat(matrix, model.geom_quat[geom])
            half.append(tree.rotate(columns, matrix[2::3] * model.geom_size[geom, 1]))
        else:
            half.append(jnp.zeros_like(origin))
    return Segments(*materialize((stacked(middle), stacked(half))))


@jax.named_scope("collision")
def touch(model: mujoco.MjModel, pairs: Pairs, lines: Segments) -> Touch:
    """Return the contacts of a group."""
    parts = []
    if pairs.on_plane.size:
        parts.append(_touch_planes(model, pairs, lines))
    if pairs.between.size:
        parts.append(_touch_each_other(model, pairs, lines))
    if len(parts) == 1:
        return parts[0]
    distance = jnp.concatenate([part.distance for part in parts])
    position = jnp.concatenate([part.position for part in parts])

    def shape(x: Touch) -> tuple[int, ...]:
        return (x.position.shape[0], x.axes.shape[1], *x.position.shape[1:])

    axes = [jnp.broadcast_to(part.axes, shape(part)) for part in parts]
    return Touch(distance, position, jnp.concatenate(axes))


def _touch_planes(model: mujoco.MjModel, pairs: Pairs, lines: Segments) -> Touch:
    plane, geom = pairs.on_plane
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    normal = data.geom_xmat[plane].reshape(-1, 3, 3)[:, :, 2]

    def constant(x: Any) -> Any:
        return x.astype(np.float32)[..., None]

    height = constant(np.sum(normal * data.geom_xpos[plane], axis=1))
    radius = constant(model.geom_size[geom, 0])
    axis = take(lines.half, geom)
    centre = take(lines.middle, geom) + constant(pairs.end[:, None]) * axis
    distance = total(constant(normal) * centre, 1) - height - radius
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
    along = across / jnp.maximum(length, 1e-15)
    along = jnp.where(length > 1e-15, along, _orthogonal(up))
    up = jnp.broadcast_to(up, along.shape)
    axes = [up, along, tree.cross(up, along)]
    return Touch(distance, position, jnp.stack(axes, axis=1))


def _orthogonal(normal: jax.Array | np.ndarray) -> jax.Array:
    """Return MuJoCo's tangent of a normal: (C, 3, B) -> (C, 3, B)."""
    y, z = (np.eye(3, dtype=np.float32)[i][:, None] for i in (1, 2))
    start = jnp.where(jnp.abs(normal[:, 1:2]) < 0.5, y, z)
    tangent = start - normal * total(jnp.asarray(normal * start), 1)[:, None]
    return tangent / jnp.sqrt(total(tangent**2, 1)[:, None])


def _touch_each_other(model: mujoco.MjModel, pairs: Pairs, lines: Segments) -> Touch:
    first, second = pairs.between
    a, b = (Segments(take(lines.middle, i), take(lines.half, i)) for i in pairs.between)

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
    axes = [normal]
    if pairs.num_tangents and pairs.motion_normal is not None:
        across = pairs.motion_normal.astype(np.float32)[:, None]
        axes.append(tree.cross(jnp.broadcast_to(across, normal.shape), normal))
    elif pairs.num_tangents:
        axes.append(_orthogonal(normal))
        axes.append(tree.cross(normal, axes[1]))
    return Touch(distance, position, jnp.stack(axes, axis=1))


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

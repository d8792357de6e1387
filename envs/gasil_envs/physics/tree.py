"""Kinematics, inertia and bias forces of a tree of bodies, many states at once.

The quantities and their names are MuJoCo's (``engine_core_smooth.c``). Every array has
the batch as its last axis. The model is known when a program is traced: recursions over
bodies are unrolled, and products with its zeros are left out.

Shape letters: N bodies, the world first; V degrees of freedom; B batch. A spatial
vector (6, B) is a rotation and then a translation of the point at the centre of mass of
the bodies of its tree that move; a rotation matrix is the list of its columns, (3, B)
each.
"""

import itertools
import operator
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from gasil_envs.physics.batching import add, materialize, stacked, take, total

FREE, BALL, SLIDE, HINGE = (
    int(mujoco.mjtJoint.mjJNT_FREE),
    int(mujoco.mjtJoint.mjJNT_BALL),
    int(mujoco.mjtJoint.mjJNT_SLIDE),
    int(mujoco.mjtJoint.mjJNT_HINGE),
)
_NEGLIGIBLE = 1e-9
#: From this distance from the origin on, metres and sizes of a body, and this condition
#: of the joint-space inertia on, rounding costs more than 1e-5 of a step.
_FAR, _FAR_IN_SIZES, _UNEVEN = 20.0, 100.0, 800.0


def moves(model: mujoco.MjModel) -> np.ndarray:
    """Return 1 where a degree of freedom moves a body, else 0, (N, V)."""
    result = np.zeros((model.nbody, model.nv))
    for body in range(1, model.nbody):
        result[body] = result[model.body_parentid[body]] + (model.dof_bodyid == body)
    return result


class Kinematics(NamedTuple):
    """Positions in the world's frame, metres."""

    columns: list[list[jax.Array]]  # Rotation of each body.
    xpos: jax.Array  # (N, 3, B), origins of the bodies.
    xipos: jax.Array  # (N, 3, B), their centres of mass.
    #: (3, B), centre of mass of all bodies that move; of each body's tree if there are
    #: several, (N, 3, B).
    com: jax.Array
    #: (N, 10, B), inertia of each body about `com`: xx, yy, zz, xy, xz, yz, mass times
    #: offset, mass.
    cinert: jax.Array
    cdof: jax.Array  # (V, 6, B), motion of one unit of each velocity.


def unsupported(model: mujoco.MjModel) -> str | None:
    """Return why these functions do not describe this model, or None if they do."""
    if model.jnt_actgravcomp.any():
        return "it has gravity compensated by actuators"
    if model.jnt_stiffness[model.jnt_type <= BALL].any():
        return "it has springs of balls or free joints"
    if model.opt.wind.any() or (model.geom_fluid[:, 0] > 0).any():
        return "it has wind or the ellipsoid model of fluids"
    return None


def has_lone_bodies(model: mujoco.MjModel) -> bool:
    """Whether a free body has no other ones attached."""
    bodies = model.jnt_bodyid[model.jnt_type == FREE]
    return not np.isin(bodies, model.body_parentid).all()


def rounding(model: mujoco.MjModel) -> list[str]:
    """Return the parts of a model that float32 resolves too little of."""
    data, inertia = mujoco.MjData(model), np.zeros((model.nv, model.nv))
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, inertia)
    own = np.sqrt(np.diag(inertia))
    away = np.linalg.norm(data.xpos[model.body_treeid >= 0], axis=1).max(initial=0.0)
    found = []
    if away > min(_FAR, _FAR_IN_SIZES * model.stat.meansize):
        found.append(
            f"bodies {away:.3g} m from the origin, where positions are rounded to "
            f"{away * 1e-7:.0e} m"
        )
    if (condition := np.linalg.cond(inertia / np.outer(own, own))) > _UNEVEN:
        found.append(f"bodies, whose inertia has the condition {condition:.0e}")
    return found


def trees(model: mujoco.MjModel) -> list[tuple[int, slice]]:
    """Return a body of each tree that moves, and the tree's degrees of freedom."""
    roots = model.body_rootid[model.dof_bodyid]
    bounds = [*np.flatnonzero(np.diff(roots, prepend=-1)), model.nv]
    return [
        (int(roots[first]), slice(int(first), int(last)))
        for first, last in itertools.pairwise(bounds)
    ]


def cross(a: jax.Array, b: jax.Array) -> jax.Array:
    """Cross product along the axis before the last: (..., 3, B)."""
    return stacked(_cross(a, b), -2)


def _cross(a: jax.Array, b: jax.Array) -> list[jax.Array]:
    """Cross product of arrays (..., 3, B), as three arrays (..., B)."""
    a1, a2, a3 = (a[..., i, :] for i in range(3))
    b1, b2, b3 = (b[..., i, :] for i in range(3))
    return [a2 * b3 - a3 * b2, a3 * b1 - a1 * b3, a1 * b2 - a2 * b1]


def rotate(columns: Sequence[jax.Array], vector: np.ndarray) -> jax.Array:
    """Return a rotation matrix times a constant vector (3,): (3, B)."""
    terms = [
        float(x) * column
        for x, column in zip(vector, columns, strict=True)
        if abs(x) > _NEGLIGIBLE
    ]
    return add(terms) if terms else jnp.zeros_like(columns[0])


def _matrix(quaternion: np.ndarray) -> np.ndarray:
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, quaternion)
    return matrix.reshape(3, 3)


def _turn(
    columns: Sequence[jax.Array],
    axis: np.ndarray,
    cosine: jax.Array,
    *,
    sine: jax.Array,
) -> list[jax.Array]:
    """Return a rotation matrix times a rotation about a constant unit axis."""
    along = np.outer(axis, axis)
    skew = np.cross(np.eye(3), axis)  # skew @ x is the cross product axis x x.
    parts = ((along, 1.0), (np.eye(3) - along, cosine), (skew, sine))

    def column(j: int) -> jax.Array:
        terms = []
        for k in range(3):
            factors = [
                float(matrix[k, j]) * x
                for matrix, x in parts
                if abs(matrix[k, j]) > _NEGLIGIBLE
            ]
            if factors:
                terms.append(sum(factors) * columns[k])
        return add(terms)

    return [column(j) for j in range(3)]


def _product(
    columns: Sequence[jax.Array], local: Sequence[jax.Array]
) -> list[jax.Array]:
    """Return the product of two rotation matrices."""
    return [add(column[k] * columns[k] for k in range(3)) for column in local]


def axis_angle(quaternion: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return axis (3, B) and angle (B,), from 0 to pi, of a quaternion (4, B)."""
    w, vector = quaternion[0], quaternion[1:]
    length = jnp.sqrt(total(vector**2))
    axis = vector * (jnp.where(w < 0.0, -1.0, 1.0) / jnp.maximum(length, 1e-15))
    return axis, 2.0 * jnp.arctan2(length, jnp.abs(w))


def _free_rotation(quaternion: jax.Array) -> list[jax.Array]:
    """Return the rotation of a quaternion of any length, (4, B)."""
    w, x, y, z = quaternion / jnp.sqrt(total(quaternion**2))
    return [
        jnp.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)]),
        jnp.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)]),
        jnp.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)]),
    ]


@jax.named_scope("smooth_dynamics")
def kinematics(
    model: mujoco.MjModel, qpos: jax.Array, *, with_bases: bool = False
) -> Kinematics:
    """Compute positions, inertia and axes of motion at qpos (nq, B).

    With `with_bases` a tree's centre of mass is also that of its parts that do not
    move.
    """
    size = qpos.shape[1:]
    zero = jnp.zeros((3, *size), jnp.float32)
    world = [jnp.broadcast_to(x[:, None], zero.shape) for x in np.eye(3, dtype="f")]
    angle = qpos - model.qpos0.astype(np.float32)[:, None]
    cosine, sine = materialize((jnp.cos(angle), jnp.sin(angle)))
    xpos, columns = [zero], [world]
    # For each degree of freedom: rotation axis, point on it, translation.
    dofs: list[tuple[jax.Array, jax.Array, jax.Array]] = []
    for body in range(1, model.nbody):
        parent = model.body_parentid[body]
        turned = columns[parent]
        position = xpos[parent] + rotate(turned, model.body_pos[body])
        if not np.allclose(model.body_quat[body], [1, 0, 0, 0]):
            local = _matrix(model.body_quat[body])
            turned = [rotate(turned, local[:, j]) for j in range(3)]
        first = model.body_jntadr[body]
        for joint in range(first, first + model.body_jntnum[body]):
            at = model.jnt_qposadr[joint]
            if model.jnt_type[joint] == FREE:
                position = qpos[at : at + 3]
                turned = materialize(_free_rotation(qpos[at + 3 : at + 7]))
                dofs += [(zero, zero, x) for x in world]
                dofs += [(x, position, zero) for x in turned]
                continue
            if model.jnt_type[joint] == BALL:
                anchor = position + rotate(turned, model.jnt_pos[joint])
                turned = _product(turned, _free_rotation(qpos[at : at + 4]))
                turned = materialize(turned)
                position = anchor - rotate(turned, model.jnt_pos[joint])
                dofs += [(x, anchor, zero) for x in turned]
                continue
            axis = rotate(turned, model.jnt_axis[joint])
            if model.jnt_type[joint] == SLIDE:
                dofs.append((zero, zero, axis))
                position = position + axis * angle[at]
                continue
            anchor = position + rotate(turned, model.jnt_pos[joint])
            turned = _turn(turned, model.jnt_axis[joint], cosine[at], sine=sine[at])
            turned = materialize(turned)
            position = anchor - rotate(turned, model.jnt_pos[joint])
            dofs.append((axis, anchor, zero))
        xpos.append(materialize(position))
        columns.append(turned)
    places = zip(xpos, columns, model.body_ipos, strict=True)
    xipos = stacked([x + rotate(turned, local) for x, turned, local in places])
    mass = model.body_mass.astype(np.float32)[:, None]
    # What does not move is not counted: it may be heavy, and far away.
    moving = mass * ((model.body_treeid >= 0) | with_bases)[:, None]

    def centre(mass: np.ndarray) -> jax.Array:
        return add(m * x for m, x in zip(mass[:, 0], xipos, strict=True)) / mass.sum()

    of_trees = trees(model)
    if len(of_trees) == 1 and not with_bases:
        com = centre(moving)
    else:
        # Trees may be far from each other.
        centres = {}
        for root in np.unique(model.body_rootid):
            own = (model.body_rootid == root)[:, None]
            own_mass = moving * own if (moving * own).any() else mass * own
            centres[root] = centre(own_mass) if own_mass.any() else xipos[root]
        com = stacked([centres[root] for root in model.body_rootid])
    xipos, com = materialize((xipos, com))
    of_dof = com if com.ndim == 2 else take(com, model.dof_bodyid)
    cinert = _inertia(model, columns, xipos - com, mass=mass)
    axis, anchor, translation = map(stacked, zip(*dofs, strict=True))
    turning = _cross(axis, of_dof - anchor)
    moved = [translation[:, i] + turning[i] for i in range(3)]
    cdof = stacked([*(axis[:, i] for i in range(3)), *moved], 1)
    cinert, cdof = materialize((cinert, cdof))
    return Kinematics(columns, jnp.stack(xpos), xipos, com, cinert, cdof)


def _inertia(
    model: mujoco.MjModel,
    columns: list[list[jax.Array]],
    offset: jax.Array,
    *,
    mass: np.ndarray,
) -> jax.Array:
    """Return the bodies' inertia about a point `offset` away: (N, 10, B)."""
    rotation = materialize(stacked([column for x in columns for column in x]))
    rotation = rotation.reshape(-1, 3, *rotation.shape[1:])  # (N, k, i, B)
    local = np.stack(
        [
            _matrix(quaternion) * inertia @ _matrix(quaternion).T
            for quaternion, inertia in zip(model.body_iquat, model.body_inertia)
        ]
    ).astype(np.float32)[..., None, None]
    # local is symmetric: row j of (local @ rotation') is the sum over its columns.
    half = add(local[:, :, k] * rotation[:, k, None] for k in range(3))  # (N, k, i, B)
    half = materialize(half)

    def entry(i: int, j: int) -> jax.Array:
        return add(half[:, k, i] * rotation[:, k, j] for k in range(3))

    x, y, z = (offset[:, i] for i in range(3))
    return stacked(
        [
            entry(0, 0) + mass * (y * y + z * z),
            entry(1, 1) + mass * (x * x + z * z),
            entry(2, 2) + mass * (x * x + y * y),
            entry(0, 1) - mass * x * y,
            entry(0, 2) - mass * x * z,
            entry(1, 2) - mass * y * z,
            mass * x,
            mass * y,
            mass * z,
            jnp.broadcast_to(mass, x.shape),
        ],
        1,
    )


def _momentum(inertia: jax.Array, motion: jax.Array) -> jax.Array:
    """Inertia times motion: (..., 10, B), (..., 6, B) -> (..., 6, B)."""
    xx, yy, zz, xy, xz, yz, *_, mass = (inertia[..., i, :] for i in range(10))
    a, b, c = (motion[..., i, :] for i in range(3))
    offset, rotation, translation = (
        inertia[..., 6:9, :],
        motion[..., :3, :],
        motion[..., 3:, :],
    )
    turned = [
        x * a + y * b + z * c for x, y, z in ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))
    ]
    moved = [mass * translation[..., i, :] for i in range(3)]
    rows = [
        *map(operator.add, turned, _cross(offset, translation)),
        *map(operator.sub, moved, _cross(offset, rotation)),
    ]
    return stacked(rows, -2)


def _cross_motion(a: jax.Array, b: jax.Array) -> jax.Array:
    """Change of motion b that moves with motion a: (..., 6, B)."""
    turn, turned = a[..., :3, :], b[..., :3, :]
    moved = (_cross(a[..., 3:, :], turned), _cross(turn, b[..., 3:, :]))
    return stacked([*_cross(turn, turned), *map(operator.add, *moved)], -2)


def _cross_force(a: jax.Array, f: jax.Array) -> jax.Array:
    """Change of force f that moves with motion a: (..., 6, B)."""
    turn, pushed = a[..., :3, :], f[..., 3:, :]
    torque = (_cross(turn, f[..., :3, :]), _cross(a[..., 3:, :], pushed))
    return stacked([*map(operator.add, *torque), *_cross(turn, pushed)], -2)


def _sum_down(model: mujoco.MjModel, of_dof: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Sum from the root to each degree of freedom, without it, and to each body.

    The three rotations of a free joint or a ball are one step.
    (V, 6, B) -> (V, 6, B), (N, 6, B).
    """
    before, to_body = [], [jnp.zeros_like(of_dof[0])]
    for body in range(1, model.nbody):
        running = to_body[model.body_parentid[body]]
        first = model.body_jntadr[body]
        for joint in range(first, first + model.body_jntnum[body]):
            dof = model.jnt_dofadr[joint]
            for width in {FREE: (3, 3), BALL: (3,)}.get(model.jnt_type[joint], (1,)):
                before += [running] * width
                running = add([running, *of_dof[dof : dof + width]])
                dof += width
        to_body.append(running)
    return jnp.stack(before), jnp.stack(to_body)


def _sum_up(model: mujoco.MjModel, of_body: jax.Array) -> list[jax.Array]:
    """Sum over each body's subtree: (N, K, B) -> N times (K, B)."""
    subtree = list(of_body)
    for body in range(model.nbody - 1, 0, -1):
        parent = model.body_parentid[body]
        subtree[parent] = subtree[parent] + subtree[body]
    return subtree


class Smooth(NamedTuple):
    """The dynamics without constraints."""

    inertia: jax.Array  # (V, V, B), the joint-space inertia.
    force: jax.Array  # (V, B), passive forces less bias forces.
    cvel: jax.Array  # (N, 6, B), velocity of each body.


def velocity(model: mujoco.MjModel, cdof: jax.Array, qvel: jax.Array) -> jax.Array:
    """Return the velocity of each body, (N, 6, B)."""
    return _sum_down(model, materialize(cdof * qvel[:, None]))[1]


@jax.named_scope("smooth_dynamics")
def smooth(
    model: mujoco.MjModel, at: Kinematics, qpos: jax.Array, qvel: jax.Array
) -> Smooth:
    """Compute inertia and forces at qpos (nq, B) and qvel (V, B)."""
    cdof, cinert = at.cdof, at.cinert
    before, cvel = _sum_down(model, materialize(cdof * qvel[:, None]))
    before, cvel = materialize((before, cvel))
    change = materialize(_cross_motion(before, cdof) * qvel[:, None])
    gravity = np.concatenate([np.zeros(3), model.opt.gravity]).astype(np.float32)
    falling = gravity[:, None]
    if model.body_gravcomp.any():
        weight = 1 - model.body_gravcomp.astype(np.float32)
        falling = weight[:, None, None] * falling
    acceleration = _sum_down(model, change)[1] - falling
    momentum = materialize(_momentum(cinert, cvel))
    of_body = _momentum(cinert, materialize(acceleration))
    of_body = of_body + _cross_force(cvel, momentum)
    if model.opt.density > 0 or model.opt.viscosity > 0:
        of_body = of_body - _drag(model, at, cvel)
    in_subtree = _sum_up(model, materialize(jnp.concatenate([cinert, of_body], axis=1)))
    moved = materialize(jnp.stack([in_subtree[i] for i in model.dof_bodyid]))
    bias = total(cdof * moved[:, 10:], 1)
    passive = -model.dof_damping.astype(np.float32)[:, None] * qvel
    scalar = model.jnt_type > BALL
    if model.jnt_stiffness[scalar].any():
        index = model.jnt_qposadr[scalar]
        stretch = (
            take(qpos, index) - model.qpos_spring[index].astype(np.float32)[:, None]
        )
        stiffness = np.zeros((model.nv, scalar.sum()), np.float32)
        stiffness[model.jnt_dofadr[scalar], np.arange(scalar.sum())] = (
            model.jnt_stiffness[scalar]
        )
        passive = passive - total(stiffness[..., None] * stretch, 1)
    unit_momentum = materialize(_momentum(moved[:, :10], cdof))
    return Smooth(_joint_inertia(model, unit_momentum, cdof), passive - bias, cvel)


def _joint_inertia(
    model: mujoco.MjModel, unit_momentum: jax.Array, cdof: jax.Array
) -> jax.Array:
    """Return the inertia (V, V, B), from the momentum of each unit motion (V, 6, B)."""
    above = np.zeros((model.nv, model.nv, 1), bool)
    for dof, parent in enumerate(model.dof_parentid):
        if parent >= 0:
            above[dof] = above[parent]
            above[dof, parent] = True
    product = add(unit_momentum[:, None, k] * cdof[None, :, k] for k in range(6))
    product = materialize(product)
    own = np.eye(model.nv, dtype=bool)[..., None]
    armature = np.diag(model.dof_armature).astype(np.float32)[..., None]
    one_sided = jnp.where(above | own, product, 0.0) + armature
    return one_sided + jnp.where(
        np.swapaxes(above, 0, 1), jnp.swapaxes(product, 0, 1), 0.0
    )


def _drag(model: mujoco.MjModel, at: Kinematics, cvel: jax.Array) -> jax.Array:
    """Return the force of a medium on each body, taken as a box, (N, 6, B)."""
    mass = np.maximum(model.body_mass, mujoco.mjMINVAL)[:, None]
    trace = model.body_inertia.sum(axis=1, keepdims=True)
    square = 6.0 * np.maximum(trace - 2 * model.body_inertia, mujoco.mjMINVAL) / mass
    box = np.sqrt(square) * (model.body_mass[:, None] > 0)
    diameter = box.mean(axis=1, keepdims=True)
    area = np.prod(box, axis=1, keepdims=True) / np.maximum(box, mujoco.mjMINVAL)
    fourth = box**4
    turning = box * (fourth.sum(axis=1, keepdims=True) - fourth)
    rho, mu = model.opt.density, model.opt.viscosity
    linear = np.stack([np.pi * diameter**3 * mu, 3 * np.pi * diameter * mu])
    square = np.stack([rho * turning / 64, rho * area / 2])
    # The box's axes, (N, axis, 3, B).
    axes = jnp.stack(
        [
            jnp.stack([rotate(columns, x) for x in _matrix(quaternion).T])
            for columns, quaternion in zip(at.columns, model.body_iquat, strict=True)
        ]
    )
    arm = at.xipos - at.com
    turn = cvel[:, :3]
    local = jnp.stack([turn, cvel[:, 3:] - cross(arm, turn)])  # (2, N, 3, B)
    local = total(axes * local[:, :, None], 3)

    def factor(x: np.ndarray) -> np.ndarray:
        return x.astype(np.float32)[..., None]

    against = -(factor(linear) + factor(square) * jnp.abs(local)) * local
    torque, force = total(axes * against[:, :, :, None], 2)
    return jnp.concatenate([torque + cross(arm, force), force], axis=1)

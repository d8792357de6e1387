"""The constraints of joints, tendons and contacts as rows for `newton`.

The numbers are C MuJoCo's (``engine_core_constraint.c``). Everything that does not
depend on the state is computed once, in NumPy. Every array has the batch as its last
axis; of a NumPy array it is 1.

Shape letters: C contacts, A axes (normal and tangents), V degrees of freedom, N bodies,
B batch.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct

from gasil_envs.physics import candidates, collision, newton, tendons, tree
from gasil_envs.physics.batching import (
    add,
    constant_times,
    fold,
    materialize,
    stacked,
    take,
    total,
)

#: The largest weight of an edge, in units of the inertia that it moves. Float32 does
#: not resolve more. A contact is off by a share of 1 / this.
_MOST_STIFFNESS = 1e5
# The edges normal +- tangent, and the normal itself with twice the weight.
_FLAT_PYRAMID = ((1, 1), (1, -1), (1, 0))
_ELLIPTIC = mujoco.mjtCone.mjCONE_ELLIPTIC


class Impedance(struct.PyTreeNode):
    """The coefficients that follow from MuJoCo's solref and solimp, (n or 1, 1) each.

    See https://mujoco.readthedocs.io/en/stable/modeling.html#solver-parameters.
    """

    stiffness: np.ndarray
    damping: np.ndarray
    lowest: np.ndarray
    highest: np.ndarray
    width: np.ndarray
    midpoint: np.ndarray
    power: np.ndarray

    @classmethod
    def of(
        cls, model: mujoco.MjModel, solref: np.ndarray, solimp: np.ndarray
    ) -> "Impedance":
        """From (n, 2) solref and (n, 5) solimp."""
        time, damping_ratio = np.asarray(solref, np.float64).reshape(-1, 2).T
        lowest, highest, width, midpoint, power = (
            np.asarray(solimp, np.float64).reshape(-1, 5).T
        )

        def within(x: np.ndarray) -> np.ndarray:
            return np.clip(x, mujoco.mjMINIMP, mujoco.mjMAXIMP)

        lowest, highest, midpoint = within(lowest), within(highest), within(midpoint)
        is_flat = (width <= mujoco.mjMINVAL) | (lowest == highest)
        safe = time
        if not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_REFSAFE:
            safe = np.maximum(time, 2 * model.opt.timestep)
        with np.errstate(divide="ignore", invalid="ignore"):
            stiffness = np.where(
                time > 0, 1 / (highest * safe * damping_ratio) ** 2, -time / highest**2
            )
            damping = np.where(
                damping_ratio > 0, 2 / (highest * safe), -damping_ratio / highest
            )
        mean = 0.5 * (lowest + highest)
        arrays = (
            stiffness,
            damping,
            np.where(is_flat, mean, lowest),
            np.where(is_flat, mean, highest),
            np.where(width <= mujoco.mjMINVAL, 1.0, width),
            midpoint,
            np.maximum(power, 1.0),
        )
        return cls(*(_constant(x) for x in arrays))

    def __call__(self, distance: jax.Array) -> jax.Array:
        """Return the impedance d(r), in (0, 1), at each distance: (n, B) -> (n, B)."""
        x = jnp.abs(distance) / self.width
        below = _power(x, self.power) / self.midpoint ** (self.power - 1)
        above = 1.0 - _power(jnp.maximum(1.0 - x, 0.0), self.power) / (
            1.0 - self.midpoint
        ) ** (self.power - 1)
        shape = jnp.where(x < self.midpoint, below, above)
        value = self.lowest + shape * (self.highest - self.lowest)
        return jnp.where(x > 1.0, self.highest, value)


def _power(x: Any, power: np.ndarray | jax.Array) -> Any:
    # A general power is an exponential and a logarithm for every row.
    if isinstance(power, np.ndarray) and np.all(power == 2.0):
        return x * x
    if isinstance(power, np.ndarray) and np.all(power == 1.0):
        return x
    return x**power


def _constant(x: np.ndarray) -> np.ndarray:
    """(n, ...) to float32 (n, ..., 1), or (1, ..., 1) if all n are equal."""
    x = x[..., None].astype(np.float32)
    return x[:1] if len(x) and (x == x[:1]).all() else x


class Constants(struct.PyTreeNode):
    """The constants of a group's contacts, (C or 1, ..., 1) each.

    They do not depend on the state.
    """

    #: (C, V, 1), 1 where a degree of freedom moves the second body, -1 where it moves
    #: the first and 0 where it moves both or none.
    chain: np.ndarray
    #: (C, N, 1), 1 at the second body and -1 at the first, unless that is the world; 0
    #: elsewhere.
    body: np.ndarray
    #: (C or 1, tangents or 1, 1), of sliding, and of turning about the axes; of cones
    #: these divided by their ratio.
    friction: np.ndarray
    #: (C or 1, 1), that of elliptic cones, see `newton.Cone`; None of pyramids.
    ratio: np.ndarray | None
    margin: np.ndarray  # Distance from which a contact is in play.
    inverse_weight: np.ndarray  # Of an edge of the pyramid.
    least_resistance: np.ndarray  # Of an edge, the inverse of its greatest weight.
    impedance: Impedance  # Of an edge.


class Group(NamedTuple):
    """The possible contacts of one condim; `edges` are as in `newton.ContactRows`.

    `stiffness` is that of the stiffest, in units of the inertia that it moves.
    """

    edges: tuple[tuple[int, ...], ...]
    pairs: collision.Pairs
    constants: Constants
    stiffness: float


class Strength(NamedTuple):
    """How hard n rows push or pull, none of them of contacts."""

    inverse_weight: np.ndarray  # (n or 1, 1).
    impedance: Impedance
    #: (n, 1), largest force of rows that push and pull; None if they only push.
    bound: np.ndarray | None

    @classmethod
    def of(
        cls, model: mujoco.MjModel, inverse_weight: Any, solver: Any, bound: Any = None
    ) -> "Strength":
        """From (n,) weights, solref and solimp, and (n,) bounds."""
        bound = None if bound is None else bound[:, None].astype(np.float32)
        return cls(_constant(inverse_weight), Impedance.of(model, *solver), bound)


class Limits(NamedTuple):
    """The limits of L slide and hinge joints, in metres or radians."""

    qpos: np.ndarray  # int (L,), index of each joint in qpos.
    dof: np.ndarray  # int (L,), index of its degree of freedom.
    low: np.ndarray  # float32 (L or 1, 1), its lower limit.
    high: np.ndarray  # float32 (L or 1, 1), its upper limit.
    #: float32 (L or 1, 1), distance to a limit below which the limit acts.
    margin: np.ndarray
    strength: Strength


#: (nq, B) positions and where they place the bodies -> (n, B) how far n rows are from
#: being held, and their Jacobians (n, V, B). Rows that only push act where that is
#: negative.
Residual = Callable[[jax.Array, tree.Kinematics], tuple[jax.Array, jax.Array]]


class Layout(NamedTuple):
    """The parts of a model's constraint rows that do not depend on the state."""

    limits: Limits
    groups: tuple[Group, ...]
    friction: Strength | None
    others: tuple[tuple[Strength, Residual], ...]

    @property
    def stiffness(self) -> float:
        """How much stiffer the stiffest contact is than the inertia that it moves."""
        return max((group.stiffness for group in self.groups), default=0.0)


class Contacts(NamedTuple):
    """The contacts of a group in their present state."""

    touch: collision.Touch
    constants: Constants


def unsupported(model: mujoco.MjModel) -> str | None:
    """Return why `layout` can't describe this model, or None if it can."""
    if model.opt.cone == _ELLIPTIC and model.pair_solreffriction.any():
        return "it has pairs of geoms with solreffriction"
    allowed = [int(mujoco.mjtEq.mjEQ_JOINT), int(mujoco.mjtEq.mjEQ_TENDON)]
    if not np.isin(model.eq_type[model.eq_active0.astype(bool)], allowed).all():
        return "it has equality constraints of bodies"
    span = model.jnt_range[:, 1] - model.jnt_range[:, 0]
    scalar = model.jnt_limited.astype(bool) & (model.jnt_type != tree.BALL)
    both = [scalar & (span <= 2 * model.jnt_margin)]
    span = model.tendon_range[:, 1] - model.tendon_range[:, 0]
    both.append(model.tendon_limited.astype(bool) & (span <= 2 * model.tendon_margin))
    if np.concatenate(both).any():
        return "it has joints or tendons whose two limits act at once"
    return collision.unsupported(model, candidates.candidates(model).geoms)


def layout(model: mujoco.MjModel) -> Layout:
    """Compute everything that does not depend on the state."""
    limited = np.flatnonzero(model.jnt_limited & (model.jnt_type != tree.BALL))
    dof, solver = model.jnt_dofadr[limited], (model.jnt_solref, model.jnt_solimp)
    low, high = map(_constant, model.jnt_range[limited].T)
    limits = Limits(
        model.jnt_qposadr[limited],
        dof,
        low,
        high,
        _constant(model.jnt_margin[limited]),
        Strength.of(model, model.dof_invweight0[dof], [x[limited] for x in solver]),
    )
    contact = candidates.candidates(model)
    normal = motion_normal(model, contact.geoms)
    round_geoms = model.geom_type[contact.geoms] <= int(mujoco.mjtGeom.mjGEOM_CAPSULE)
    anisotropic = (contact.friction[:, 0] != contact.friction[:, 1]).any()
    if (contact.dim > 3).any() or not round_geoms.all() or anisotropic:
        normal = None
    groups = [
        _group(model, contact, dim, motion_normal=normal)
        for dim in (1, 3, 4, 6)
        if (contact.dim == dim).any()
    ]
    friction = None
    if (loss := model.dof_frictionloss).any():
        solver = model.dof_solref, model.dof_solimp
        friction = Strength.of(model, model.dof_invweight0, solver, loss)
    kinds = (_equalities, _tendon_limits, _ball_limits)
    others = tuple(rows for kind in kinds if (rows := kind(model)) is not None)
    return Layout(limits, tuple(groups), friction, others)


def _edges(condim: int, *, flat: bool, elliptic: bool) -> tuple[tuple[int, ...], ...]:
    """Return normal +- tangent for each direction of friction, or the axes of cones."""
    axes = np.eye(2 if flat else condim, dtype=int)
    if condim == 1 or elliptic:
        return tuple(tuple(map(int, axis)) for axis in axes)
    if flat:
        return _FLAT_PYRAMID
    edges = [axes[0] + sign * x for x in axes[1:] for sign in (1, -1)]
    return tuple(tuple(map(int, edge)) for edge in edges)


def motion_normal(model: mujoco.MjModel, geoms: np.ndarray) -> np.ndarray | None:
    """Return the normal of the plane that contains all motion, or None if none does.

    It is also None if a tangent of one of the contacts (C, 2) may be neither in the
    plane nor across it: the edges of its pyramid are then others. MuJoCo makes tangents
    of a coordinate axis or of a capsule's axis.
    """
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    hinge = model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE
    slide = model.jnt_type == mujoco.mjtJoint.mjJNT_SLIDE
    if not hinge.any() or not (hinge | slide).all():
        return None
    # Turning about the normal leaves all of these properties as they are.
    normal = data.xaxis[hinge][0]

    def is_all(x: np.ndarray, value: float) -> bool:
        return np.allclose(x, value, atol=1e-6)

    across = np.abs(data.xaxis @ normal)
    moves_in_it = is_all(across[hinge], 1.0) and is_all(across[slide], 0.0)
    is_coordinate_axis = is_all(np.abs(normal).max(), 1.0)
    # The third axis of a frame is a plane's normal, and the direction of a capsule.
    across = data.geom_xmat.reshape(-1, 3, 3)[:, :, 2] @ normal
    has_direction = model.geom_type[geoms] != mujoco.mjtGeom.mjGEOM_SPHERE
    lies_in_it = is_all(across[geoms][has_direction], 0.0)
    # On a plane it does not matter where along the normal a geom is.
    first, second = geoms[model.geom_type[geoms[:, 0]] != mujoco.mjtGeom.mjGEOM_PLANE].T
    offset = (data.geom_xpos[second] - data.geom_xpos[first]) @ normal
    if moves_in_it and is_coordinate_axis and lies_in_it and is_all(offset, 0.0):
        return normal.astype(np.float32)
    return None


def _group(
    model: mujoco.MjModel,
    contact: candidates.Candidates,
    condim: int,
    *,
    motion_normal: np.ndarray | None,
) -> Group:
    flat = motion_normal is not None and condim == 3
    elliptic = model.opt.cone == _ELLIPTIC and condim > 1
    edges = _edges(condim, flat=flat, elliptic=elliptic)
    chosen = np.flatnonzero(contact.dim == condim)
    pairs, index = collision.pairs(
        model,
        contact.geoms[chosen],
        min(len(edges[0]) - 1, 2),
        margin=contact.margin[chosen],
        motion_normal=motion_normal,
    )
    index = chosen[index]
    body = model.geom_bodyid[contact.geoms[index]]
    moves = tree.moves(model)
    is_body = np.eye(model.nbody) * (np.arange(model.nbody) > 0)

    def at(x: np.ndarray) -> np.ndarray:
        return x[index].astype(np.float32)

    friction = contact.friction[index, : max(1, condim - 1)].astype(np.float32)
    if flat or (friction == friction[:, :1]).all():
        friction = friction[:, :1]
    sliding = friction[:, 0]
    inverse_weight = model.body_invweight0[body, 0].sum(axis=1)
    floor = np.full(len(index), mujoco.mjMINVAL)
    # A body that turns about its middle resists as what it touches with does.
    reach = model.geom_rbound[contact.geoms[index]]
    turned = (model.body_invweight0[body, 1] * reach**2).sum(axis=1)
    moved = np.where(inverse_weight < 1e-4 * turned, turned, inverse_weight)
    ratio = None
    if elliptic:
        # The weight of sliding is `impratio` times that of touching.
        scale = max(model.opt.impratio, mujoco.mjMINVAL)
        moved = moved * max(scale, 1.0)
        ratio = sliding / np.float32(np.sqrt(scale))
        friction = friction / ratio[:, None]
    elif condim > 1:
        moved, inverse_weight = (x * (1 + sliding**2) for x in (moved, inverse_weight))
        inverse_weight = inverse_weight * 2 * sliding**2 / model.opt.impratio
        floor = floor * 2 * sliding**2 / model.opt.impratio
    # Without friction an edge would weigh 1e10 times as much as what it moves.
    floor = np.maximum(floor, moved / _MOST_STIFFNESS)
    impedance = Impedance.of(model, at(contact.solref), at(contact.solimp))
    highest = impedance.highest[:, 0].astype(np.float64)
    resistance = np.maximum(inverse_weight * (1 - highest) / highest, floor)
    stiffness = float(np.max(moved / resistance))
    if (inverse_weight * (1 - highest) > floor * highest).all():
        floor = np.full(1, mujoco.mjMINVAL)  # It is not reached.

    constants = Constants(
        chain=(moves[body[:, 1]] - moves[body[:, 0]])[..., None].astype(np.float32),
        body=(is_body[body[:, 1]] - is_body[body[:, 0]])[..., None].astype(np.float32),
        friction=_constant(friction),
        ratio=None if ratio is None else _constant(ratio),
        margin=_constant(contact.margin[index]),
        inverse_weight=_constant(inverse_weight),
        least_resistance=_constant(floor),
        impedance=impedance,
    )
    return Group(edges, pairs, constants, stiffness)


def _weight(
    impedance: jax.Array, inverse_weight: np.ndarray, least: Any = mujoco.mjMINVAL
) -> jax.Array:
    resistance = inverse_weight * (1.0 - impedance) / impedance
    return 1.0 / jnp.maximum(resistance, least)


@jax.named_scope("constraint_rows")
def limit_rows(limits: Limits, qpos: jax.Array, qvel: jax.Array) -> newton.JointRows:
    """Return the limits of all degrees of freedom at qpos (nq, B) and qvel (V, B)."""
    joint = take(qpos, limits.qpos)
    above_low, below_high = joint - limits.low, limits.high - joint
    distance = jnp.minimum(above_low, below_high) - limits.margin
    inside = jnp.where(above_low < below_high, 1.0, -1.0)
    sign = jnp.where(distance < 0.0, inside, 0.0)
    distance = jnp.minimum(distance, 0.0)
    inverse_weight, solimp, _ = limits.strength
    impedance = solimp(distance)
    pull = solimp.stiffness * impedance * distance
    damp = solimp.damping * sign * take(qvel, limits.dof)
    of_limit = (sign, -damp - pull, _weight(impedance, inverse_weight))
    # Put each limit at the index of its degree of freedom, without a scatter.
    index = np.full(qvel.shape[0], limits.dof.size)
    index[limits.dof] = np.arange(limits.dof.size)
    none = jnp.zeros((1, qvel.shape[1]), jnp.float32)
    return newton.JointRows(
        *(take(jnp.concatenate([x, none]), index) for x in map(materialize, of_limit))
    )


def _wide(x: np.ndarray, qpos: jax.Array) -> jax.Array:
    """(n, ...) to float32 (n, ..., B)."""
    x = x.astype(np.float32)[..., None]
    return jnp.broadcast_to(x, (*x.shape[:-1], qpos.shape[-1]))


def _equalities(model: mujoco.MjModel) -> tuple[Strength, Residual] | None:
    """Joints and tendons whose positions are polynomials of others'."""
    index = np.flatnonzero(model.eq_active0)
    if not index.size:
        return None
    fixed, joints = tendons.fixed(model), (model.jnt_qposadr, model.jnt_dofadr)
    # Of the joints, then of the tendons, and 0 for no second one.
    of_qpos, of_qvel, start, weight = (
        np.concatenate([of_joints, of_tendons, 0 * of_joints[:1]])
        for of_joints, of_tendons in (
            (np.eye(model.nq)[joints[0]], fixed.of_qpos),
            (np.eye(model.nv)[joints[1]], fixed.of_qvel),
            (model.qpos0[joints[0]], model.tendon_length0),
            (model.dof_invweight0[joints[1]], model.tendon_invweight0),
        )
    )
    is_joint = model.eq_type[index] == mujoco.mjtEq.mjEQ_JOINT
    first, second = (
        np.where(i < 0, -1, np.where(is_joint, i, i + model.njnt))
        for i in (model.eq_obj1id[index], model.eq_obj2id[index])
    )

    def residual(qpos: jax.Array, at: Any) -> tuple[jax.Array, jax.Array]:
        own, x = (
            constant_times(of_qpos[i], qpos) - start[i, None].astype(np.float32)
            for i in (first, second)
        )
        value, slope = jnp.zeros_like(x), jnp.zeros_like(x)
        for c in model.eq_data[index, 4::-1].T[..., None].astype(np.float32):
            slope = slope * x + value
            value = value * x + c
        others = slope[:, None] * _wide(of_qvel[second], qpos)
        return own - value, _wide(of_qvel[first], qpos) - others

    solver = model.eq_solref[index], model.eq_solimp[index]
    unbounded = np.full(index.size, np.inf)
    return Strength.of(
        model, weight[first] + weight[second], solver, unbounded
    ), residual


def _tendon_limits(model: mujoco.MjModel) -> tuple[Strength, Residual] | None:
    index = np.flatnonzero(model.tendon_limited)
    if not index.size:
        return None
    low, high = model.tendon_range[index].T[..., None].astype(np.float32)
    margin = model.tendon_margin[index, None].astype(np.float32)

    def residual(qpos: jax.Array, at: Any) -> tuple[jax.Array, jax.Array]:
        length, jacobian = tendons.lengths(model, index, qpos, at)
        sign = jnp.where(length - low < high - length, 1.0, -1.0)
        distance = jnp.minimum(length - low, high - length) - margin
        return distance, sign[:, None] * jacobian

    solver = model.tendon_solref_lim[index], model.tendon_solimp_lim[index]
    return Strength.of(model, model.tendon_invweight0[index], solver), residual


def _ball_limits(model: mujoco.MjModel) -> tuple[Strength, Residual] | None:
    index = np.flatnonzero(model.jnt_limited & (model.jnt_type == tree.BALL))
    if not index.size:
        return None
    most = model.jnt_range[index].max(axis=1) - model.jnt_margin[index]

    def residual(qpos: jax.Array, at: Any) -> tuple[jax.Array, jax.Array]:
        angles, jacobians = [], []
        for joint in index:
            first, dof = model.jnt_qposadr[joint], model.jnt_dofadr[joint]
            axis, angle = tree.axis_angle(qpos[first : first + 4])
            angles.append(angle)
            none = jnp.zeros((model.nv, angle.shape[-1]), jnp.float32)
            jacobians.append(jnp.concatenate([none[:dof], -axis, none[dof + 3 :]]))
        return _wide(most, qpos) - stacked(angles), stacked(jacobians)

    solver = model.jnt_solref[index], model.jnt_solimp[index]
    weight = model.dof_invweight0[model.jnt_dofadr[index]]
    return Strength.of(model, weight, solver), residual


def friction_rows(friction: Strength, qvel: jax.Array) -> newton.JointRows:
    """Return the dry friction of the degrees of freedom at qvel (V, B)."""
    inverse_weight, solimp, most = friction
    weight = _weight(solimp(jnp.zeros_like(qvel)), inverse_weight)
    bound = jnp.broadcast_to(jnp.asarray(most), qvel.shape)
    return newton.JointRows(
        sign=jnp.ones_like(qvel),
        reference=jnp.asarray(-solimp.damping) * qvel,
        weight=jnp.where(bound > 0, weight, 0.0),
        bound=bound,
    )


@jax.named_scope("constraint_rows")
def other_rows(
    strength: Strength,
    residual: Residual,
    at: tree.Kinematics,
    *,
    qpos: jax.Array,
    qvel: jax.Array,
) -> newton.ContactRows:
    """Return rows of joints or tendons as contacts with one axis."""
    distance, jacobian = residual(qpos, at)
    inverse_weight, solimp, bound = strength
    acts = distance < 0.0 if bound is None else jnp.ones_like(distance, bool)
    jacobian = materialize(jnp.where(acts[:, None], jacobian, 0.0))
    distance = jnp.where(acts, distance, 0.0)
    impedance = solimp(distance)
    pull = solimp.stiffness * impedance * distance
    weight = jnp.where(acts, _weight(impedance, inverse_weight), 0.0)
    reference = -solimp.damping * total(jacobian * qvel, 1) - pull
    return newton.ContactRows(
        basis=jacobian[:, None],
        reference=reference[:, None],
        weight=weight[:, None],
        edges=((1,),),
        bound=None if bound is None else jnp.broadcast_to(bound, weight.shape)[:, None],
    )


@jax.named_scope("constraint_rows")
def contact_rows(
    edges: tuple[tuple[int, ...], ...],
    contacts: Contacts,
    at: tree.Kinematics,
    *,
    trees: Sequence[tuple[int, slice]],
    qvel: jax.Array,
) -> newton.ContactRows:
    """Return the rows of a group of contacts at qvel (V, B); `trees` as in `tree`."""
    (distance, position, axes), constants = contacts
    gap = distance - constants.margin
    active = gap < 0.0
    axes = jnp.asarray(axes)

    def jacobian(com: jax.Array, cdof: jax.Array) -> jax.Array:
        torque = materialize(tree.cross((position - com)[:, None], axes))
        # cdof is (rotation, translation) of the point at the centre of mass.
        return add(
            x[:, :, k, None] * cdof[:, first + k]
            for x, first in ((torque, 0), (axes, 3))
            for k in range(3)
        )

    if at.com.ndim == 2:
        along = jacobian(at.com, at.cdof)
    else:
        along = jnp.concatenate(
            [jacobian(at.com[body], at.cdof[dofs]) for body, dofs in trees], axis=2
        )
    turning = len(edges[0]) - axes.shape[1]
    if turning > 0:
        turns = add(axes[:, :turning, k, None] * at.cdof[:, k] for k in range(3))
        turns = jnp.broadcast_to(turns, (along.shape[0], *turns.shape[1:]))
        along = jnp.concatenate([along, turns], axis=1)
    along = along * jnp.where(active[:, None], constants.chain, 0.0)[:, None]
    is_normal = np.arange(along.shape[1])[:, None, None] == 0
    friction = jnp.asarray(constants.friction)
    if friction.shape[1] > 1:
        friction = jnp.concatenate([jnp.ones_like(friction[:, :1]), friction], axis=1)
    scale = jnp.where(is_normal, 1.0, friction[:, :, None])
    along = materialize(along * scale)  # (C, A, V, B)
    speed = materialize(total(along * qvel, 2))
    signs = np.array(edges, np.float32)[..., None]
    speed = total(speed[:, None] * signs, 2)  # (C, edges, B)
    impedance = constants.impedance(gap)
    pull = constants.impedance.stiffness * impedance * jnp.where(active, gap, 0.0)
    weight = _weight(impedance, constants.inverse_weight, constants.least_resistance)
    weight = jnp.where(active, weight, 0.0)
    # A normal that stands for two edges weighs as both.
    count = [
        2.0 if edges == _FLAT_PYRAMID and signs == (1, 0) else 1.0 for signs in edges
    ]
    cone = None
    if constants.ratio is not None:
        ratio = jnp.broadcast_to(jnp.asarray(constants.ratio), weight.shape)
        count, cone = [1.0], newton.Cone(ratio[:, None])
    reference = speed * -constants.impedance.damping[:, None]
    return newton.ContactRows(
        basis=along,
        reference=reference - pull[:, None] * signs[:, 0],
        weight=weight[:, None] * np.array(count, np.float32)[:, None],
        edges=edges,
        bound=cone,
    )


@jax.named_scope("constraint_rows")
def body_forces(
    edges: tuple[tuple[int, ...], ...],
    contacts: Contacts,
    com: jax.Array,
    *,
    edge_forces: jax.Array,
) -> jax.Array:
    """Return contacts' torque about `com` and force on each body, (N, 6, B).

    `com` is as in `tree.Kinematics`, and `edge_forces` are (C, E, B).
    """
    (_, position, axes), constants = contacts
    normal, *tangents = np.array(edges, np.float32).T
    force = total(edge_forces * normal[:, None], 1)[:, None] * axes[:, 0]
    turn = None
    for t, signs in enumerate(tangents, 1):
        friction = constants.friction[
            :, 0 if constants.friction.shape[1] == 1 else t - 1
        ]
        along = (total(edge_forces * signs[:, None], 1) * friction)[:, None]
        if t < axes.shape[1]:
            force = force + along * axes[:, t]
        else:
            turn = along * axes[:, t - axes.shape[1]] + (0.0 if turn is None else turn)

    def wrenches(com: jax.Array, body: Any) -> jax.Array:
        torque = tree.cross(position - com, force)
        torque = torque if turn is None else torque + turn
        wrench = materialize(jnp.concatenate([torque, force], axis=1))
        return total(body[:, :, None] * wrench[:, None])

    if com.ndim == 2:
        return wrenches(com, constants.body)
    return jnp.concatenate(
        [wrenches(x, constants.body[:, i : i + 1]) for i, x in enumerate(com)]
    )


# Few of the possible contacts are in play at once: humanoid has 138 possible contacts,
# and no more than 8 in play in any group unless it lies with folded arms.
MOST_IN_PLAY = 8


def num_in_play(contacts: Contacts) -> jax.Array:
    """Return how many contacts of a group are in play, (B,)."""
    in_play = contacts.touch.distance < contacts.constants.margin
    return fold(jnp.add, in_play.astype(jnp.int32))


@jax.named_scope("constraint_rows")
def gather(contacts: Contacts) -> Contacts:
    """Move the contacts in play into `MOST_IN_PLAY` slots.

    A slot that stays empty is at an infinite distance.
    """
    num_contacts = contacts.touch.distance.shape[0]
    if num_contacts <= MOST_IN_PLAY:
        return contacts
    in_play = contacts.touch.distance < contacts.constants.margin  # (C, B)
    number = jnp.arange(num_contacts, dtype=jnp.int32)[:, None]
    index, last = [], jnp.int32(-1)
    for _ in range(MOST_IN_PLAY):
        left = jnp.where(in_play & (number > last), number, num_contacts)
        last = fold(jnp.minimum, left)
        index.append(last)
    chosen = materialize(jnp.stack(index))  # (P, B)
    safe = jnp.minimum(chosen, num_contacts - 1)

    def move(x: Any) -> Any:
        if x.shape[0] == 1:
            return x
        at = safe.reshape(MOST_IN_PLAY, *(1,) * (x.ndim - 2), -1)
        x = jnp.broadcast_to(x, (*x.shape[:-1], at.shape[-1]))
        return jnp.take_along_axis(x, at, axis=0)

    touch, constants = jax.tree.map(move, contacts)
    empty = chosen == num_contacts
    touch = touch._replace(distance=jnp.where(empty, jnp.inf, touch.distance))
    return Contacts(touch, constants)

"""Joint limits and contacts as one-sided constraints for `newton`.

The numbers are those of MJX's rows (``mjx.make_constraint``), which are C MuJoCo's.
Everything that does not depend on the state is computed once, in NumPy. Every array has
the batch as its last axis; of a NumPy array it is 1.

Shape letters: C contacts, A axes (normal and tangents), V degrees of freedom, N bodies,
B batch.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct
from mujoco import mjx

from gasil_envs.physics import collision, newton, tree
from gasil_envs.physics.batching import add, fold, materialize, take, total

_PYRAMID = ((1, 1, 0), (1, -1, 0), (1, 0, 1), (1, 0, -1))
# The edges normal +- tangent, and the normal itself with twice the weight.
_FLAT_PYRAMID = ((1, 1), (1, -1), (1, 0))


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
        arrays = (
            stiffness,
            damping,
            lowest,
            highest,
            np.maximum(width, mujoco.mjMINVAL),
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


@dataclasses.dataclass(frozen=True, eq=False)
class Limits:
    """The limits of L slide and hinge joints, in metres or radians.

    Attributes:
      qpos: int (L,), index of each joint in qpos.
      dof: int (L,), index of its degree of freedom.
      low: float32 (L or 1, 1), its lower limit.
      high: float32 (L or 1, 1), its upper limit.
      margin: float32 (L or 1, 1), distance to a limit below which the limit acts.
      inverse_weight: float32 (L or 1, 1), MuJoCo's dof_invweight0.
      impedance: the coefficients of the limits.
    """

    qpos: np.ndarray
    dof: np.ndarray
    low: np.ndarray
    high: np.ndarray
    margin: np.ndarray
    inverse_weight: np.ndarray
    impedance: Impedance


class Constants(struct.PyTreeNode):
    """The constants of a group's contacts, (C or 1, ..., 1) each.

    They do not depend on the state.

    Attributes:
      chain: (C, V, 1), 1 where a degree of freedom moves the second body, -1 where it
        moves the first and 0 where it moves both or none.
      body: (C, N, 1), 1 at the second body and -1 at the first, unless that is the
        world; 0 elsewhere.
      friction: of sliding.
      margin: distance from which a contact is in play.
      inverse_weight: of an edge of the pyramid.
      impedance: of an edge.
    """

    chain: np.ndarray
    body: np.ndarray
    friction: np.ndarray
    margin: np.ndarray
    inverse_weight: np.ndarray
    impedance: Impedance


class Group(NamedTuple):
    """The possible contacts of one condim; `edges` are as in `newton.ContactRows`."""

    edges: tuple[tuple[int, ...], ...]
    pairs: collision.Pairs
    constants: Constants


class Layout(NamedTuple):
    """The parts of a model's constraint rows that do not depend on the state."""

    limits: Limits
    groups: tuple[Group, ...]


class Contacts(NamedTuple):
    """The contacts of a group in their present state."""

    touch: collision.Touch
    constants: Constants


def unsupported(model: mujoco.MjModel) -> str | None:
    """Return why `layout` can't describe this model, or None if it can."""
    if model.opt.cone != mujoco.mjtCone.mjCONE_PYRAMIDAL:
        return "its friction cones are elliptic"
    if model.neq:
        return "it has equality constraints"
    if model.dof_frictionloss.any() or model.tendon_frictionloss.any():
        return "it has friction loss"
    if model.tendon_limited.any():
        return "it has limited tendons"
    if not np.isin(model.geom_condim, [1, 3]).all() or model.npair:
        return "it has contacts with torsional or rolling friction, or named pairs"
    flags = mujoco.mjtDisableBit.mjDSBL_CONSTRAINT | mujoco.mjtDisableBit.mjDSBL_CONTACT
    if model.opt.disableflags & (flags | mujoco.mjtDisableBit.mjDSBL_LIMIT):
        return "its constraints are disabled"
    return collision.unsupported(model)


def layout(model: mujoco.MjModel) -> Layout:
    """Compute everything that does not depend on the state."""
    limited = np.flatnonzero(model.jnt_limited)
    dof = model.jnt_dofadr[limited]
    limits = Limits(
        qpos=model.jnt_qposadr[limited],
        dof=dof,
        low=_constant(model.jnt_range[limited, 0]),
        high=_constant(model.jnt_range[limited, 1]),
        margin=_constant(model.jnt_margin[limited]),
        inverse_weight=_constant(model.dof_invweight0[dof]),
        impedance=Impedance.of(
            model, model.jnt_solref[limited], model.jnt_solimp[limited]
        ),
    )
    # Which geoms collide, and with which parameters, is for MJX to say. The model is an
    # argument: MJX would compile each operation on a constant by itself.
    with jax.ensure_compile_time_eval():
        contact = jax.tree.map(
            np.asarray, _contact(mjx.put_model(model), mjx.make_data(model))
        )
    motion_normal = _motion_normal(model, contact.geom.reshape(-1, 2))
    pyramid = _PYRAMID if motion_normal is None else _FLAT_PYRAMID
    groups = [
        _group(model, contact, dim, edges=edges, motion_normal=motion_normal)
        for dim, edges in ((1, ((1,),)), (3, pyramid))
    ]
    return Layout(limits, tuple(x for x in groups if len(x.pairs.geoms)))


@jax.jit
def _contact(model: mjx.Model, data: mjx.Data) -> mjx.Contact:
    """Return MJX's possible contacts, without their present positions."""
    contact = mjx.collision(model, data)._impl.contact
    return contact.replace(dist=None, pos=None, frame=None)


def _motion_normal(model: mujoco.MjModel, geoms: np.ndarray) -> np.ndarray | None:
    """Return the normal of the plane that contains all motion, or None if none does.

    It is also None if a contact's tangents may be neither in the plane nor across it:
    the edges of its pyramid are then others. MuJoCo makes tangents of a coordinate axis
    or of a capsule's axis.

    Args:
      model: the model.
      geoms: (C, 2), the geoms of each possible contact; a plane is the first.
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
    contact: mjx.Contact,
    condim: int,
    *,
    edges: tuple[tuple[int, ...], ...],
    motion_normal: np.ndarray | None,
) -> Group:
    index = np.flatnonzero(contact.dim.reshape(-1) == condim)
    geom = contact.geom.reshape(-1, 2)
    on_plane = model.geom_type[geom[index, 0]] == mujoco.mjtGeom.mjGEOM_PLANE
    index = np.concatenate([index[on_plane], index[~on_plane]])
    body = model.geom_bodyid[geom[index]]
    moves = np.zeros((model.nbody, model.nv))
    for i in range(1, model.nbody):
        moves[i] = moves[model.body_parentid[i]] + (model.dof_bodyid == i)
    is_body = np.eye(model.nbody) * (np.arange(model.nbody) > 0)
    friction = contact.friction.reshape(-1, 5)[index, 0]
    inverse_weight = model.body_invweight0[body, 0].sum(axis=1)
    if condim > 1:
        inverse_weight = inverse_weight * (1 + friction**2)
        inverse_weight = inverse_weight * 2 * friction**2 / model.opt.impratio

    def at(x: np.ndarray, width: int) -> np.ndarray:
        return x.reshape(-1, width)[index]

    constants = Constants(
        chain=(moves[body[:, 1]] - moves[body[:, 0]])[..., None].astype(np.float32),
        body=(is_body[body[:, 1]] - is_body[body[:, 0]])[..., None].astype(np.float32),
        friction=_constant(friction),
        margin=_constant(contact.includemargin.reshape(-1)[index]),
        inverse_weight=_constant(inverse_weight),
        impedance=Impedance.of(model, at(contact.solref, 2), at(contact.solimp, 5)),
    )
    pairs = collision.pairs(
        model, geom[index], len(edges[0]) - 1, motion_normal=motion_normal
    )
    return Group(edges, pairs, constants)


def _weight(impedance: jax.Array, inverse_weight: np.ndarray) -> jax.Array:
    resistance = inverse_weight * (1.0 - impedance) / impedance
    return 1.0 / jnp.maximum(resistance, mujoco.mjMINVAL)


@jax.named_scope("constraint_rows")
def limit_rows(limits: Limits, qpos: jax.Array, qvel: jax.Array) -> newton.LimitRows:
    """Return the limits of all degrees of freedom at qpos (nq, B) and qvel (V, B)."""
    joint = take(qpos, limits.qpos)
    above_low, below_high = joint - limits.low, limits.high - joint
    distance = jnp.minimum(above_low, below_high) - limits.margin
    inside = jnp.where(above_low < below_high, 1.0, -1.0)
    sign = jnp.where(distance < 0.0, inside, 0.0)
    distance = jnp.minimum(distance, 0.0)
    impedance = limits.impedance(distance)
    pull = limits.impedance.stiffness * impedance * distance
    damp = limits.impedance.damping * sign * take(qvel, limits.dof)
    of_limit = (sign, -damp - pull, _weight(impedance, limits.inverse_weight))
    # Put each limit at the index of its degree of freedom, without a scatter.
    index = np.full(qvel.shape[0], limits.dof.size)
    index[limits.dof] = np.arange(limits.dof.size)
    none = jnp.zeros((1, qvel.shape[1]), jnp.float32)
    return newton.LimitRows(
        *(take(jnp.concatenate([x, none]), index) for x in map(materialize, of_limit))
    )


@jax.named_scope("constraint_rows")
def contact_rows(
    edges: tuple[tuple[int, ...], ...],
    contacts: Contacts,
    at: tree.Kinematics,
    *,
    qvel: jax.Array,
) -> newton.ContactRows:
    """Return the rows of a group of contacts at qvel (V, B)."""
    (distance, position, axes), constants = contacts
    gap = distance - constants.margin
    active = gap < 0.0
    arm = (position - at.com)[:, None]
    axes = jnp.asarray(axes)
    torque = materialize(tree.cross(arm, axes))
    # cdof is (rotation, translation) of the point at the centre of mass.
    along = add(
        x[:, :, k, None] * at.cdof[:, first + k]
        for x, first in ((torque, 0), (axes, 3))
        for k in range(3)
    )
    along = along * jnp.where(active[:, None], constants.chain, 0.0)[:, None]
    is_normal = np.arange(along.shape[1])[:, None, None] == 0
    scale = jnp.where(is_normal, 1.0, constants.friction[:, None, None])
    along = materialize(along * scale)  # (C, A, V, B)
    speed = materialize(total(along * qvel, 2))
    signs = np.array(edges, np.float32)[..., None]
    speed = total(speed[:, None] * signs, 2)  # (C, edges, B)
    impedance = constants.impedance(gap)
    pull = constants.impedance.stiffness * impedance * jnp.where(active, gap, 0.0)
    weight = jnp.where(active, _weight(impedance, constants.inverse_weight), 0.0)
    # A normal that stands for two edges weighs as both.
    count = [
        2.0 if edges == _FLAT_PYRAMID and signs == (1, 0) else 1.0 for signs in edges
    ]
    return newton.ContactRows(
        basis=along,
        reference=-constants.impedance.damping[:, None] * speed - pull[:, None],
        weight=weight[:, None] * np.array(count, np.float32)[:, None],
        edges=edges,
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

    Args:
      edges: the group's edges.
      contacts: the group's contacts.
      com: (3, B), centre of mass of the tree, metres.
      edge_forces: (C, E, B), force along each edge.
    """
    (_, position, axes), constants = contacts
    force = total(edge_forces, 1)[:, None] * axes[:, 0]
    for t, signs in enumerate(np.array(edges, np.float32).T[1:], 1):
        along = total(edge_forces * signs[:, None], 1) * constants.friction
        force = force + along[:, None] * axes[:, t]
    wrench = jnp.concatenate([tree.cross(position - com, force), force], axis=1)
    wrench = materialize(wrench)
    return total(constants.body[:, :, None] * wrench[:, None])


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

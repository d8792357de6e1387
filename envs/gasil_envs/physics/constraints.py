"""Joint limits and contacts as rows of a one-sided least-squares problem.

The rows, their order and their numbers are MJX's (``mjx.make_constraint``), which are
C MuJoCo's; what does not depend on the state is worked out once, in NumPy. One thing
differs from MJX and agrees with C MuJoCo: the tangent of a capsule on a plane is the
capsule's axis however steep it is. MJX takes a fixed one above 60 degrees, and the
pyramidal friction cone, and with it the motion, depends on the tangent.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

#: Joint types with one degree of freedom.
SLIDE_AND_HINGE = [int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_HINGE)]
_PLANE_AND_CAPSULE = [
    int(mujoco.mjtGeom.mjGEOM_PLANE),
    int(mujoco.mjtGeom.mjGEOM_CAPSULE),
]


@dataclasses.dataclass(frozen=True, eq=False)
class Impedance:
    """MuJoCo's solref and solimp of some constraints, (n,) each, worked out.

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
        within = lambda x: np.clip(x, mujoco.mjMINIMP, mujoco.mjMAXIMP)
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
            *(stiffness, damping, lowest, highest),
            *(np.maximum(width, mujoco.mjMINVAL), midpoint, np.maximum(power, 1.0)),
        )
        return cls(*(x.astype(np.float32) for x in arrays))

    def __call__(self, distance: jax.Array) -> jax.Array:
        """The impedance d(r), in (0, 1), at each distance: (n,) -> (n,)."""
        x = jnp.abs(distance) / self.width
        below = _power(x, self.power) / self.midpoint ** (self.power - 1)
        above = 1.0 - _power(jnp.maximum(1.0 - x, 0.0), self.power) / (
            1.0 - self.midpoint
        ) ** (self.power - 1)
        shape = jnp.where(x < self.midpoint, below, above)
        value = self.lowest + shape * (self.highest - self.lowest)
        return jnp.where(x > 1.0, self.highest, value)


def _power(x: jax.Array, power: np.ndarray) -> jax.Array:
    # A general power is an exponential and a logarithm for every row.
    if np.all(power == 2.0):
        return x * x
    return x if np.all(power == 1.0) else jnp.power(x, power)


@dataclasses.dataclass(frozen=True, eq=False)
class Limits:
    """The limited slide and hinge joints."""

    qpos: np.ndarray
    dof: np.ndarray
    low: np.ndarray
    high: np.ndarray
    margin: np.ndarray
    inverse_weight: np.ndarray
    impedance: Impedance


@dataclasses.dataclass(frozen=True, eq=False)
class Contacts:
    """Possible contacts of one condim; `index` is their place in MJX's contacts.

    `mask` (n, nv) is 1 where a degree of freedom moves the second body, -1 where it
    moves the first and 0 where it moves both or none; `root` is the body whose
    subtree's centre of mass the motion is expressed about.
    """

    condim: int
    index: np.ndarray
    root: np.ndarray
    mask: np.ndarray
    friction: np.ndarray
    margin: np.ndarray
    inverse_weight: np.ndarray
    impedance: Impedance


class Layout(NamedTuple):
    """All that is known of a model's constraint rows before the state is.

    Attributes:
      limits: of joints.
      contacts: by condim.
      capsule_on_plane: (2, n), which of MJX's contacts are of a capsule on a plane,
        and the capsule's geom.
    """

    limits: Limits
    contacts: tuple[Contacts, ...]
    capsule_on_plane: np.ndarray


class Rows(NamedTuple):
    """Rows J (R, nv), references aref (R,) and weights D (R,)."""

    jacobian: jax.Array
    reference: jax.Array
    weight: jax.Array


def unsupported(model: mujoco.MjModel) -> str | None:
    """Why `layout` can't describe this model, or None."""
    if model.opt.cone != mujoco.mjtCone.mjCONE_PYRAMIDAL:
        return "its friction cones are elliptic"
    if model.neq:
        return "it has equality constraints"
    if model.dof_frictionloss.any() or model.tendon_frictionloss.any():
        return "it has friction loss"
    if model.tendon_limited.any():
        return "it has limited tendons"
    limited = model.jnt_type[model.jnt_limited.astype(bool)]
    if not np.isin(limited, SLIDE_AND_HINGE).all():
        return "it has limited ball joints"
    if not np.isin(model.geom_condim, [1, 3]).all() or model.npair:
        return "it has contacts with torsional or rolling friction, or named pairs"
    if np.unique(model.body_rootid[1:]).size > 1:
        return "it has more than one kinematic tree"
    flags = mujoco.mjtDisableBit.mjDSBL_CONSTRAINT | mujoco.mjtDisableBit.mjDSBL_CONTACT
    if model.opt.disableflags & (flags | mujoco.mjtDisableBit.mjDSBL_LIMIT):
        return "its constraints are disabled"
    return None


def layout(model: mujoco.MjModel, mjx_model: mjx.Model) -> Layout:
    """Work out everything that does not depend on the state."""
    limited = np.flatnonzero(model.jnt_limited)
    dof = model.jnt_dofadr[limited]
    limits = Limits(
        qpos=model.jnt_qposadr[limited],
        dof=dof,
        low=model.jnt_range[limited, 0].astype(np.float32),
        high=model.jnt_range[limited, 1].astype(np.float32),
        margin=model.jnt_margin[limited].astype(np.float32),
        inverse_weight=model.dof_invweight0[dof].astype(np.float32),
        impedance=Impedance.of(
            model, model.jnt_solref[limited], model.jnt_solimp[limited]
        ),
    )
    # MJX orders its contacts itself; which geoms they are does not change.
    with jax.ensure_compile_time_eval():
        collide = jax.jit(lambda data: mjx.collision(mjx_model, data)._impl.contact)
        contact = collide(mjx.make_data(model))
    condim = np.asarray(contact.dim).reshape(-1)
    contacts = [_contacts(model, contact, condim, dim) for dim in (1, 3)]
    geom = np.asarray(contact.geom).reshape(-1, 2)
    kind = model.geom_type[geom]
    index = np.flatnonzero((kind == _PLANE_AND_CAPSULE).all(axis=1))
    return Layout(
        limits,
        tuple(c for c in contacts if c.index.size),
        np.stack([index, geom[index, 1]]),
    )


def _contacts(
    model: mujoco.MjModel, contact: mjx.Contact, condims: np.ndarray, condim: int
) -> Contacts:
    index = np.flatnonzero(condims == condim)
    geom = np.asarray(contact.geom).reshape(-1, 2)[index]
    body = model.geom_bodyid[geom]
    moves = np.zeros((model.nbody, model.nv))
    for i in range(1, model.nbody):
        moves[i] = moves[model.body_parentid[i]] + (model.dof_bodyid == i)
    friction = np.asarray(contact.friction).reshape(-1, 5)[index, 0]
    inverse_weight = model.body_invweight0[body, 0].sum(axis=1)
    if condim > 1:
        inverse_weight = inverse_weight * (1 + friction**2)
        inverse_weight = inverse_weight * 2 * friction**2 / model.opt.impratio
    at = lambda x, width: np.asarray(x).reshape(-1, width)[index]
    return Contacts(
        condim=condim,
        index=index,
        root=model.body_rootid[body].max(axis=1),
        mask=(moves[body[:, 1]] - moves[body[:, 0]]).astype(np.float32),
        friction=friction.astype(np.float32),
        margin=np.asarray(contact.includemargin).reshape(-1)[index],
        inverse_weight=inverse_weight.astype(np.float32),
        impedance=Impedance.of(model, at(contact.solref, 2), at(contact.solimp, 5)),
    )


def make(layout: Layout, data: mjx.Data) -> Rows:
    """The rows at the positions and velocities of `data`, after MJX's collision."""
    parts = [_limit_rows(layout.limits, data)] if layout.limits.dof.size else []
    parts += [_contact_rows(contacts, data) for contacts in layout.contacts]
    if not parts:
        nothing = jnp.zeros(0, jnp.float32)
        return Rows(jnp.zeros((0, data.qvel.shape[0])), nothing, nothing)
    return Rows(*map(jnp.concatenate, zip(*parts, strict=True)))


def _weight(impedance: jax.Array, inverse_weight: np.ndarray) -> jax.Array:
    resistance = inverse_weight * (1.0 - impedance) / impedance
    return 1.0 / jnp.maximum(resistance, mujoco.mjMINVAL)


def _limit_rows(limits: Limits, data: mjx.Data) -> Rows:
    qpos = data.qpos[limits.qpos]
    above_low, below_high = qpos - limits.low, limits.high - qpos
    distance = jnp.minimum(above_low, below_high) - limits.margin
    inside = jnp.where(above_low < below_high, 1.0, -1.0)
    sign = jnp.where(distance < 0.0, inside, 0.0)
    distance = jnp.minimum(distance, 0.0)
    select = np.eye(data.qvel.shape[0], dtype=np.float32)[limits.dof]
    impedance = limits.impedance(distance)
    pull = limits.impedance.stiffness * impedance * distance
    damp = limits.impedance.damping * sign * data.qvel[limits.dof]
    return Rows(
        sign[:, None] * select,
        -damp - pull,
        _weight(impedance, limits.inverse_weight),
    )


def align_frames(layout: Layout, data: mjx.Data) -> mjx.Data:
    """Contact frames as C MuJoCo chooses them, after MJX's collision."""
    index, capsule = layout.capsule_on_plane
    if not index.size:
        return data
    # mjc_PlaneCapsule gives the capsule's axis, mju_makeFrame projects it.
    contact = data._impl.contact
    frame = contact.frame[index]
    normal = frame[:, 0]
    axis = data.geom_xmat[capsule].reshape(-1, 3, 3)[:, :, 2]
    tangent = axis - normal * jnp.sum(normal * axis, axis=-1, keepdims=True)
    length = jnp.sqrt(jnp.sum(tangent**2, axis=-1, keepdims=True))
    tangent = tangent / jnp.maximum(length, 1e-15)
    aligned = jnp.stack([normal, tangent, jnp.cross(normal, tangent)], axis=1)
    aligned = jnp.where(length[..., None] > 1e-15, aligned, frame)
    contact = contact.replace(frame=contact.frame.at[index].set(aligned))
    return data.tree_replace({"_impl.contact": contact})


def _contact_rows(contacts: Contacts, data: mjx.Data) -> Rows:
    contact = data._impl.contact
    distance = contact.dist[contacts.index] - contacts.margin
    active = distance < 0.0
    distance = jnp.where(active, distance, 0.0)
    arm = contact.pos[contacts.index] - data.subtree_com[contacts.root]
    axes = contact.frame[contacts.index][:, : contacts.condim]
    # cdof is (rotation, translation) of a point at the root's centre of mass.
    wrench = jnp.concatenate([jnp.cross(arm[:, None], axes), axes], axis=-1)
    along = wrench @ data.cdof.T * contacts.mask[:, None]  # (n, condim, nv)
    along = jnp.where(active[:, None, None], along, 0.0)
    speed = along @ data.qvel  # (n, condim)
    impedance = contacts.impedance(contact.dist[contacts.index] - contacts.margin)
    pull = contacts.impedance.stiffness * impedance * distance
    weight = _weight(impedance, contacts.inverse_weight)
    damping = contacts.impedance.damping[:, None]
    if contacts.condim == 1:
        return Rows(along[:, 0], -damping[:, 0] * speed[:, 0] - pull, weight)

    def edges(x: jax.Array, friction: np.ndarray) -> jax.Array:
        normal, tangents = x[:, :1], friction * x[:, 1:]
        pairs = jnp.stack([normal + tangents, normal - tangents], axis=2)
        return pairs.reshape(-1, *x.shape[2:])

    friction = contacts.friction[:, None]
    speed = edges(speed, friction)
    return Rows(
        edges(along, friction[..., None]),
        -jnp.repeat(contacts.impedance.damping, 4) * speed - jnp.repeat(pull, 4),
        jnp.repeat(weight, 4),
    )

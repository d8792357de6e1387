"""Joint limits and contacts as one-sided constraints for `newton`.

The numbers are those of MJX's rows (``mjx.make_constraint``), which are C MuJoCo's.
Everything that does not depend on the state is computed once, in NumPy. Two things
differ from MJX:

- The tangent of a capsule on a plane is the capsule's axis, however steep it is, as in
  C MuJoCo. MJX takes a fixed tangent above 60 degrees. The pyramidal friction cone, and
  therefore the motion, depends on the tangent.
- In a model that can only move in a plane, the tangent across the plane is left out.
  Nothing moves along it, so its two edges would both equal the normal.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from gasil_envs.physics import newton

_PYRAMID = ((1, 0), (-1, 0), (0, 1), (0, -1))
# The edges normal +- tangent, and the normal itself with twice the weight.
_FLAT_PYRAMID = ((1,), (-1,), (0,))

#: Joint types with one degree of freedom.
SLIDE_AND_HINGE = [int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_HINGE)]
_PLANE_AND_CAPSULE = [
    int(mujoco.mjtGeom.mjGEOM_PLANE),
    int(mujoco.mjtGeom.mjGEOM_CAPSULE),
]


@dataclasses.dataclass(frozen=True, eq=False)
class Impedance:
    """The coefficients that follow from MuJoCo's solref and solimp, (n,) each.

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
            stiffness,
            damping,
            lowest,
            highest,
            np.maximum(width, mujoco.mjMINVAL),
            midpoint,
            np.maximum(power, 1.0),
        )
        return cls(*(x.astype(np.float32) for x in arrays))

    def __call__(self, distance: jax.Array) -> jax.Array:
        """Return the impedance d(r), in (0, 1), at each distance: (n,) -> (n,)."""
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
    """The possible contacts with the same condim.

    `edges` are those of `newton.Contacts`, and `index` (n,) are the contacts' indices
    in MJX's contacts. `mask` (n, nv) is 1 where a degree of
    freedom moves the second body, -1 where it moves the first and 0 where it moves both
    or none; `root` is the body whose subtree's centre of mass the motion is expressed
    about.
    """

    edges: tuple[tuple[int, ...], ...]
    index: np.ndarray
    root: np.ndarray
    mask: np.ndarray
    friction: np.ndarray
    margin: np.ndarray
    inverse_weight: np.ndarray
    impedance: Impedance


class Layout(NamedTuple):
    """The parts of a model's constraint rows that do not depend on the state.

    Attributes:
      limits: the limits of joints.
      contacts: a group of contacts for each condim.
      capsule_on_plane: (2, n), indices in MJX's contacts of those between a capsule
        and a plane, and the capsules' geoms.
      plane: (3,), the normal of the plane that all motion is in, or None.
    """

    limits: Limits
    contacts: tuple[Contacts, ...]
    capsule_on_plane: np.ndarray
    plane: np.ndarray | None


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
    """Compute everything that does not depend on the state."""
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
    plane = _plane(model)
    pyramid = _PYRAMID if plane is None else _FLAT_PYRAMID
    contacts = [
        _contacts(model, contact, condim, dim, edges)
        for dim, edges in ((1, ((),)), (3, pyramid))
    ]
    geom = np.asarray(contact.geom).reshape(-1, 2)
    kind = model.geom_type[geom]
    index = np.flatnonzero((kind == _PLANE_AND_CAPSULE).all(axis=1))
    return Layout(
        limits,
        tuple(c for c in contacts if c.index.size),
        np.stack([index, geom[index, 1]]),
        plane,
    )


def _plane(model: mujoco.MjModel) -> np.ndarray | None:
    """Return the normal of the plane that contains all motion, or None if none does."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    hinge = model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE
    slide = model.jnt_type == mujoco.mjtJoint.mjJNT_SLIDE
    if not hinge.any() or not (hinge | slide).all():
        return None
    # Turning about the normal leaves both properties as they are.
    normal = data.xaxis[hinge][0]
    across = np.abs(data.xaxis @ normal)
    flat = np.allclose(across[hinge], 1.0) and np.allclose(across[slide], 0.0)
    return normal.astype(np.float32) if flat else None


def _contacts(
    model: mujoco.MjModel,
    contact: mjx.Contact,
    condims: np.ndarray,
    condim: int,
    edges: tuple[tuple[int, ...], ...],
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
        edges=edges,
        index=index,
        root=model.body_rootid[body].max(axis=1),
        mask=(moves[body[:, 1]] - moves[body[:, 0]]).astype(np.float32),
        friction=friction.astype(np.float32),
        margin=np.asarray(contact.includemargin).reshape(-1)[index],
        inverse_weight=inverse_weight.astype(np.float32),
        impedance=Impedance.of(model, at(contact.solref, 2), at(contact.solimp, 5)),
    )


def make(
    layout: Layout, data: mjx.Data
) -> tuple[newton.Limits, tuple[newton.Contacts, ...]]:
    """Return the constraints at the state of `data`, after MJX's collision."""
    return (
        _make_limits(layout.limits, data),
        tuple(_make_contacts(group, layout.plane, data) for group in layout.contacts),
    )


def row_forces(layout: Layout, solution: newton.Solution) -> jax.Array:
    """Return the forces of all rows in the order of MJX and C MuJoCo, (R,)."""
    forces = [solution.limit_force[layout.limits.dof]]
    for group, force in zip(layout.contacts, solution.edge_forces, strict=True):
        if group.edges == _FLAT_PYRAMID:
            half = 0.5 * force[:, 2:]
            force = jnp.concatenate([force[:, :2], half, half], axis=1)
        forces.append(force.ravel())
    return jnp.concatenate(forces)


def _weight(impedance: jax.Array, inverse_weight: np.ndarray) -> jax.Array:
    resistance = inverse_weight * (1.0 - impedance) / impedance
    return 1.0 / jnp.maximum(resistance, mujoco.mjMINVAL)


def _make_limits(limits: Limits, data: mjx.Data) -> newton.Limits:
    qpos = data.qpos[limits.qpos]
    above_low, below_high = qpos - limits.low, limits.high - qpos
    distance = jnp.minimum(above_low, below_high) - limits.margin
    inside = jnp.where(above_low < below_high, 1.0, -1.0)
    sign = jnp.where(distance < 0.0, inside, 0.0)
    distance = jnp.minimum(distance, 0.0)
    impedance = limits.impedance(distance)
    pull = limits.impedance.stiffness * impedance * distance
    damp = limits.impedance.damping * sign * data.qvel[limits.dof]
    of_limit = (sign, -damp - pull, _weight(impedance, limits.inverse_weight))
    # Put each limit at the index of its degree of freedom, without a scatter.
    index = np.full(data.qvel.shape[0], limits.dof.size)
    index[limits.dof] = np.arange(limits.dof.size)
    spread = lambda x: jnp.concatenate([x, jnp.zeros(1, jnp.float32)])[index]
    return newton.Limits(*map(spread, of_limit))


def align_frames(layout: Layout, data: mjx.Data) -> mjx.Data:
    """Return `data` with the contact frames that C MuJoCo chooses, after collision."""
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


def _make_contacts(
    contacts: Contacts, plane: np.ndarray | None, data: mjx.Data
) -> newton.Contacts:
    contact, index = data._impl.contact, contacts.index
    num_tangents = len(contacts.edges[0])
    gap = contact.dist[index] - contacts.margin
    active = gap < 0.0
    arm = contact.pos[index] - data.subtree_com[contacts.root]
    axes = contact.frame[index][:, : 1 + num_tangents]
    if num_tangents and plane is not None:
        # Which of MJX's two tangents is in the plane depends on the state.
        axes = jnp.stack([axes[:, 0], jnp.cross(plane, axes[:, 0])], axis=1)
    # cdof is (rotation, translation) of a point at the root's centre of mass.
    wrench = jnp.concatenate([jnp.cross(arm[:, None], axes), axes], axis=-1)
    along = wrench @ data.cdof.T * contacts.mask[:, None]  # (n, 1 + tangents, nv)
    along = jnp.where(active[:, None, None], along, 0.0)
    friction = np.ones((index.size, 1 + num_tangents, 1), np.float32)
    friction[:, 1:] = contacts.friction[:, None, None]
    along = along * friction
    signs = np.array([(1, *signs) for signs in contacts.edges], np.float32)
    speed = (along @ data.qvel) @ signs.T  # (n, edges)
    impedance = contacts.impedance(gap)
    pull = contacts.impedance.stiffness * impedance * jnp.where(active, gap, 0.0)
    weight = jnp.where(active, _weight(impedance, contacts.inverse_weight), 0.0)
    # A normal that stands for two edges weighs as both.
    count = [
        2.0 if contacts.edges == _FLAT_PYRAMID and not any(s) else 1.0
        for s in contacts.edges
    ]
    return newton.Contacts(
        normal=along[:, 0],
        tangents=along[:, 1:],
        reference=-contacts.impedance.damping[:, None] * speed - pull[:, None],
        weight=weight[:, None] * np.array(count, np.float32),
        edges=contacts.edges,
    )

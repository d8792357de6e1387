"""Fixed tendons, weighted sums of joint positions, and strings between sites."""

import itertools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from gasil_envs.physics import tree
from gasil_envs.physics.batching import add, constant_times, stacked, total


class Tendons(NamedTuple):
    """Lengths are `of_qpos` @ qpos, and their rates of change `of_qvel` @ qvel."""

    of_qpos: np.ndarray  # (T, nq).
    of_qvel: np.ndarray  # (T, V).


_JOINT, _SITE = int(mujoco.mjtWrap.mjWRAP_JOINT), int(mujoco.mjtWrap.mjWRAP_SITE)


def unsupported(model: mujoco.MjModel) -> str | None:
    """Return why this module does not describe a model's tendons; None if it does."""
    if not np.isin(model.wrap_type, [_JOINT, _SITE]).all():
        return "it has tendons with pulleys or around geoms"
    between = strings(model)
    pulling = (model.tendon_stiffness, model.tendon_damping)
    held = model.eq_type == int(mujoco.mjtEq.mjEQ_TENDON)
    if any(x[between].any() for x in pulling) or (between.any() and held.any()):
        return "it has spatial tendons that do more than to limit their length"
    others = (model.tendon_armature, model.tendon_actfrclimited)
    if any(x.any() for x in (*others, model.tendon_frictionloss)):
        return "it has tendons with armature, friction or a range of actuators' force"
    return None


def strings(model: mujoco.MjModel) -> np.ndarray:
    """Return which tendons are spatial, (T,)."""
    return model.wrap_type[model.tendon_adr] == _SITE


def fixed(model: mujoco.MjModel) -> Tendons:
    """Return the tendons of a supported model; those of strings are zeros."""
    of_qpos = np.zeros((model.ntendon, model.nq))
    of_qvel = np.zeros((model.ntendon, model.nv))
    for tendon in range(model.ntendon):
        first = model.tendon_adr[tendon]
        for i in range(first, first + model.tendon_num[tendon]):
            if model.wrap_type[i] == _SITE:
                continue
            joint = model.wrap_objid[i]
            of_qpos[tendon, model.jnt_qposadr[joint]] += model.wrap_prm[i]
            of_qvel[tendon, model.jnt_dofadr[joint]] += model.wrap_prm[i]
    return Tendons(of_qpos, of_qvel)


def forces(
    model: mujoco.MjModel, tendons: Tendons, qpos: jax.Array, qvel: jax.Array
) -> jax.Array | None:
    """Return generalized forces (V, B) of springs and dampers, if there are any."""
    if not (model.tendon_stiffness.any() or model.tendon_damping.any()):
        return None

    def constant(x: np.ndarray) -> np.ndarray:
        return x.astype(np.float32)[:, None]

    length = constant_times(tendons.of_qpos, qpos)
    low, high = map(constant, model.tendon_lengthspring.T)
    stretch = length - jnp.clip(length, low, high)
    speed = constant_times(tendons.of_qvel, qvel)
    force = -constant(model.tendon_stiffness) * stretch
    force = force - constant(model.tendon_damping) * speed
    return constant_times(tendons.of_qvel.T, force)


def lengths(
    model: mujoco.MjModel, index: np.ndarray, qpos: jax.Array, at: tree.Kinematics
) -> tuple[jax.Array, jax.Array]:
    """Return the lengths (n, B) of some tendons, and their Jacobians (n, V, B)."""
    results, tendons = [], fixed(model)
    for tendon in index:
        first = model.tendon_adr[tendon]
        parts = range(first, first + model.tendon_num[tendon])
        if model.wrap_type[first] == _JOINT:
            of_qvel = tendons.of_qvel[tendon].astype(np.float32)[:, None]
            jacobian = jnp.broadcast_to(of_qvel, (model.nv, qpos.shape[-1]))
            length = constant_times(tendons.of_qpos[tendon][None], qpos)[0]
            results.append((length, jacobian))
            continue
        sites = [_site(model, model.wrap_objid[i], at) for i in parts]
        pieces = []
        for (start, of_start), (end, of_end) in itertools.pairwise(sites):
            away = end - start
            length = jnp.sqrt(total(away**2))
            along = away / jnp.maximum(length, mujoco.mjMINVAL)
            pieces.append((length, total((of_end - of_start) * along, 1)))
        lengths, jacobians = zip(*pieces, strict=True)
        results.append((add(lengths), add(jacobians)))
    length, jacobian = map(stacked, zip(*results, strict=True))
    return length, jacobian


def _site(
    model: mujoco.MjModel, site: int, at: tree.Kinematics
) -> tuple[jax.Array, jax.Array]:
    """Return the position (3, B) of a site, and its Jacobian (V, 3, B)."""
    body = model.site_bodyid[site]
    position = at.xpos[body] + tree.rotate(at.columns[body], model.site_pos[site])
    arm = position - (at.com if at.com.ndim == 2 else at.com[body])
    moves = tree.moves(model)[body, :, None, None].astype(np.float32)
    turned = tree.cross(at.cdof[:, :3], jnp.broadcast_to(arm, at.cdof[:, :3].shape))
    return position, (at.cdof[:, 3:] + turned) * moves

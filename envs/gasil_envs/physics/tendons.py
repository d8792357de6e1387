"""Fixed tendons: weighted sums of joint positions."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from gasil_envs.physics.batching import constant_times


class Tendons(NamedTuple):
    """Lengths are `of_qpos` @ qpos, and their rates of change `of_qvel` @ qvel.

    Attributes:
      of_qpos: (T, nq).
      of_qvel: (T, V).
    """

    of_qpos: np.ndarray
    of_qvel: np.ndarray


def unsupported(model: mujoco.MjModel) -> str | None:
    """Return why `fixed` does not describe this model's tendons; None if it does."""
    if (model.wrap_type != int(mujoco.mjtWrap.mjWRAP_JOINT)).any():
        return "it has spatial tendons"
    if model.tendon_armature.any() or model.tendon_actfrclimited.any():
        return "it has tendons with armature or a limit of the actuators' force"
    return None


def fixed(model: mujoco.MjModel) -> Tendons:
    """Return the tendons of a supported model."""
    of_qpos = np.zeros((model.ntendon, model.nq))
    of_qvel = np.zeros((model.ntendon, model.nv))
    for tendon in range(model.ntendon):
        first = model.tendon_adr[tendon]
        for i in range(first, first + model.tendon_num[tendon]):
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

"""Actuators without a state of their own, on slides, hinges and fixed tendons.

An actuator's force is gain * control + bias, within its range. Gain and bias are affine
in its length and velocity: so are position and velocity servos, dampers and motors.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from gasil_envs.physics import tendons, tree
from gasil_envs.physics.batching import constant_times

_OF_JOINT = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
_OF_TENDON = int(mujoco.mjtTrn.mjTRN_TENDON)
_GAINS = (int(mujoco.mjtGain.mjGAIN_FIXED), int(mujoco.mjtGain.mjGAIN_AFFINE))
_BIASES = (int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE))


class Actuators(NamedTuple):
    """The constants of nu actuators."""

    transmission: tendons.Tendons  # The lengths and velocities of the actuators.
    gain: np.ndarray  # (nu, 3), constant, of length, of velocity.
    bias: np.ndarray  # (nu, 3), the same.
    control_range: np.ndarray  # (2, nu, 1).
    force_range: np.ndarray  # (2, nu, 1).
    #: (2, V, 1), of the sum of the forces on a degree of freedom.
    joint_range: np.ndarray

    @property
    def are_motors(self) -> bool:
        """Whether the forces depend on nothing but the controls."""
        affine = self.gain[:, 1:].any() or self.bias.any()
        ranges = np.concatenate([self.force_range, self.joint_range], axis=1)
        return not affine and bool(np.isinf(ranges).all())


def unsupported(model: mujoco.MjModel) -> str | None:
    """Return why `make` does not describe this model's actuators; None if it does."""
    kinds = model.actuator_trntype
    on_joint = np.isin(kinds, _OF_JOINT)
    of_tendons = model.actuator_trnid[kinds == _OF_TENDON, 0]
    joint = model.jnt_type[model.actuator_trnid[on_joint, 0]]
    if model.na or model.nactuator != model.nu:
        return "it has actuators with a state or with several controls"
    others = not (on_joint | (kinds == _OF_TENDON)).all()
    if others or tendons.strings(model)[of_tendons].any() or (joint <= tree.BALL).any():
        return "it has actuators of other things than slides, hinges and fixed tendons"
    if (
        not np.isin(model.actuator_gaintype, _GAINS).all()
        or not np.isin(model.actuator_biastype, _BIASES).all()
        or model.actuator_dyntype.any()
    ):
        return "it has actuators whose force is not affine"
    return None


def make(model: mujoco.MjModel) -> Actuators:
    """Compute the constants of a supported model's actuators."""
    fixed = tendons.fixed(model)
    of_joint = np.eye(model.nq)[model.jnt_qposadr], np.eye(model.nv)[model.jnt_dofadr]
    on_tendon = model.actuator_trntype == _OF_TENDON

    def rows(joints: np.ndarray, of_tendons: np.ndarray) -> np.ndarray:
        chosen = [
            gear * (of_tendons if tendon else joints)[i]
            for gear, tendon, i in zip(
                model.actuator_gear[:, 0],
                on_tendon,
                model.actuator_trnid[:, 0],
                strict=True,
            )
        ]
        return np.reshape(chosen, (-1, joints.shape[1]))

    def limits(limited: np.ndarray, allowed: np.ndarray) -> np.ndarray:
        limited = limited[:, None].astype(bool)
        values = np.where(limited, allowed, [-np.inf, np.inf])
        return values.T[..., None].astype(np.float32)

    def affine(kinds: np.ndarray, values: np.ndarray, depends: int) -> np.ndarray:
        values = values[:, :3].copy()
        values[kinds != depends, 1:] = 0.0
        return values

    bias = affine(model.actuator_biastype, model.actuator_biasprm, _BIASES[1])
    bias[model.actuator_biastype == _BIASES[0]] = 0.0
    dof_joint = model.dof_jntid
    return Actuators(
        tendons.Tendons(*map(rows, of_joint, fixed)),
        affine(model.actuator_gaintype, model.actuator_gainprm, _GAINS[1]),
        bias,
        limits(model.actuator_ctrllimited, model.actuator_ctrlrange),
        limits(model.actuator_forcelimited, model.actuator_forcerange),
        limits(model.jnt_actfrclimited[dof_joint], model.jnt_actfrcrange[dof_joint]),
    )


def forces(
    actuators: Actuators, control: jax.Array, qpos: jax.Array, qvel: jax.Array
) -> jax.Array:
    """Return generalized forces (V, B) of controls (nu, B)."""
    force = _own_forces(actuators, control, qpos, qvel=qvel)
    of_qvel = actuators.transmission.of_qvel
    return jnp.clip(constant_times(of_qvel.T, force), *actuators.joint_range)


def _own_forces(
    actuators: Actuators, control: jax.Array, qpos: jax.Array, *, qvel: jax.Array
) -> jax.Array:
    """Return the force of each actuator, (nu, B)."""
    of_qpos, of_qvel = actuators.transmission
    length, velocity = constant_times(of_qpos, qpos), constant_times(of_qvel, qvel)

    def affine(values: np.ndarray) -> jax.Array:
        constant, of_length, of_velocity = values.T[..., None].astype(np.float32)
        return constant + of_length * length + of_velocity * velocity

    force = affine(actuators.gain) * control + affine(actuators.bias)
    return jnp.clip(force, *actuators.force_range)


def damping(
    actuators: Actuators, control: jax.Array, qpos: jax.Array, *, qvel: jax.Array
) -> jax.Array:
    """Return minus the derivative of the forces by qvel, (V, V, B).

    As in C MuJoCo it counts an actuator's own range of force, but not a joint's.
    """
    force = _own_forces(actuators, control, qpos, qvel=qvel)
    low, high = actuators.force_range
    gain, bias = (x[:, 2:].astype(np.float32) for x in (actuators.gain, actuators.bias))
    rate = jnp.where((low < force) & (force < high), gain * control + bias, 0.0)
    of_qvel = actuators.transmission.of_qvel
    squares = of_qvel[:, :, None] * of_qvel[:, None]
    size = len(qvel)
    result = constant_times(squares.reshape(-1, size**2).T, -rate)
    return result.reshape(size, size, -1)

"""One time step of MuJoCo's dynamics: MJX's smooth part, our constraints and solver.

The stages and integrators are those of C MuJoCo (``engine_forward.c``). Kinematics,
collision, inertia and bias forces are MJX's; constraint rows are built in
`constraints`, and every linear system is solved in `newton`.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from gasil_envs.physics import constraints, newton

_JOINT_TRANSMISSION = [
    int(mujoco.mjtTrn.mjTRN_JOINT),
    int(mujoco.mjtTrn.mjTRN_JOINTINPARENT),
]


class Dynamics(NamedTuple):
    """A model, and the parts of its dynamics that do not depend on the state.

    Attributes:
      model: MJX's model.
      layout: layout of the constraints.
      motor: (nu, nv), generalized force of one unit of control.
      control_range: (2, nu), lowest and highest control.
      iterations: number of iterations of the solver.
    """

    model: mjx.Model
    layout: constraints.Layout
    motor: np.ndarray
    control_range: np.ndarray
    iterations: int


def unsupported(model: mujoco.MjModel) -> str | None:
    """Return why `make` does not support this model, or None if it does."""
    integrators = (mujoco.mjtIntegrator.mjINT_EULER, mujoco.mjtIntegrator.mjINT_RK4)
    if model.opt.integrator not in integrators:
        return "its integrator is neither Euler nor RK4"
    if (
        model.na
        or not np.isin(model.actuator_trntype, _JOINT_TRANSMISSION).all()
        or (model.actuator_gaintype != int(mujoco.mjtGain.mjGAIN_FIXED)).any()
        or (model.actuator_biastype != int(mujoco.mjtBias.mjBIAS_NONE)).any()
        or model.actuator_forcelimited.any()
        or model.jnt_actfrclimited.any()
        or not np.isin(
            model.jnt_type[model.actuator_trnid[:, 0]], constraints.SLIDE_AND_HINGE
        ).all()
    ):
        return "it has actuators other than plain motors on slides and hinges"
    if model.nv > 60:
        return "it has more than 60 degrees of freedom, and MJX's inertia is sparse"
    return constraints.unsupported(model)


def make(model: mujoco.MjModel, mjx_model: mjx.Model, iterations: int = 4) -> Dynamics:
    """Compute what does not depend on the state, for a supported model."""
    motor = np.zeros((model.nu, model.nv), np.float32)
    dof = model.jnt_dofadr[model.actuator_trnid[:, 0]]
    motor[np.arange(model.nu), dof] = (
        model.actuator_gear[:, 0] * model.actuator_gainprm[:, 0]
    )
    limited = model.actuator_ctrllimited[:, None].astype(bool)
    control_range = np.where(limited, model.actuator_ctrlrange, [-np.inf, np.inf])
    return Dynamics(
        mjx_model,
        constraints.layout(model, mjx_model),
        motor,
        control_range.T.astype(np.float32),
        iterations,
    )


def step(dynamics: Dynamics, data: mjx.Data) -> mjx.Data:
    """Advance one time step; derived fields of `data` are of the last evaluation."""
    if dynamics.model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4:
        return _runge_kutta(dynamics, data)
    return _euler(dynamics.model, forward(dynamics, data))


def forward(dynamics: Dynamics, data: mjx.Data) -> mjx.Data:
    """Compute accelerations and forces from positions, velocities and controls."""
    model = dynamics.model
    data = mjx.kinematics(model, data)
    data = mjx.com_pos(model, data)
    data = mjx.tendon(model, data)
    data = mjx.crb(model, data)
    data = mjx.tendon_armature(model, data)
    data = constraints.align_frames(dynamics.layout, mjx.collision(model, data))
    data = mjx.com_vel(model, data)
    data = mjx.passive(model, data)
    data = mjx.rne(model, data)
    data = mjx.tendon_bias(model, data)
    control = jnp.clip(data.ctrl, *dynamics.control_range)
    actuation = control @ dynamics.motor
    force = data.qfrc_passive - data.qfrc_bias + actuation
    limits, contacts = constraints.make(dynamics.layout, data)
    solution = newton.solve(
        newton.Problem(
            inertia=data._impl.M,
            force=force,
            warmstart=data.qacc_warmstart,
            limits=limits,
            contacts=contacts,
        ),
        dynamics.iterations,
    )
    return data.tree_replace(
        {
            "qfrc_actuator": actuation,
            "qfrc_smooth": force,
            "qacc_smooth": solution.qacc_smooth,
            "qacc": solution.qacc,
            "qfrc_constraint": solution.constraint_force,
            "_impl.efc_force": constraints.row_forces(dynamics.layout, solution),
        }
    )


def _integrate_positions(
    model: mjx.Model, qpos: jax.Array, qvel: jax.Array
) -> jax.Array:
    """qpos after one time step at qvel; the joint types are static."""
    dt = model.opt.timestep
    parts, q, v = [], 0, 0
    for kind in model.jnt_type:
        if kind == mujoco.mjtJoint.mjJNT_FREE:
            parts.append(qpos[q : q + 3] + dt * qvel[v : v + 3])
            parts.append(_rotate(qpos[q + 3 : q + 7], qvel[v + 3 : v + 6], dt))
            q, v = q + 7, v + 6
        elif kind == mujoco.mjtJoint.mjJNT_BALL:
            parts.append(_rotate(qpos[q : q + 4], qvel[v : v + 3], dt))
            q, v = q + 4, v + 3
        else:
            parts.append(qpos[q : q + 1] + dt * qvel[v : v + 1])
            q, v = q + 1, v + 1
    return jnp.concatenate(parts)


def _rotate(quaternion: jax.Array, velocity: jax.Array, dt: jax.Array) -> jax.Array:
    """A unit quaternion (4,) after turning with `velocity` (3,) rad/s for `dt`."""
    speed = jnp.linalg.norm(velocity)
    half = 0.5 * dt * speed
    scale = jnp.where(speed > 1e-10, jnp.sin(half) / jnp.maximum(speed, 1e-10), 0.0)
    w, x, y, z = quaternion
    a, (b, c, d) = jnp.cos(half), scale * velocity
    turned = jnp.stack(
        [
            w * a - x * b - y * c - z * d,
            w * b + x * a + y * d - z * c,
            w * c - x * d + y * a + z * b,
            w * d + x * c - y * b + z * a,
        ]
    )
    return turned / jnp.linalg.norm(turned)


def _euler(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Semi-implicit Euler, with the joints' damping taken implicitly."""
    dt = model.opt.timestep
    qacc = data.qacc
    if not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_EULERDAMP:
        inertia = data._impl.M + jnp.diag(dt * model.dof_damping)
        qacc = newton.linear_solve(inertia, data.qfrc_smooth + data.qfrc_constraint)
    qvel = data.qvel + dt * qacc
    return data.replace(
        qvel=qvel,
        qpos=_integrate_positions(model, data.qpos, qvel),
        qacc_warmstart=data.qacc,
    )


def _runge_kutta(dynamics: Dynamics, data: mjx.Data) -> mjx.Data:
    """Classical Runge-Kutta of order 4.

    The first evaluation, at the state itself, is a stage of the loop too, so that
    `forward`, the largest part of the program, is compiled only once.
    """
    model = dynamics.model
    dt = model.opt.timestep
    qpos, qvel = data.qpos, data.qvel

    def stage(carry: Any, coefficients: Any) -> Any:
        data, velocity_sum, acceleration_sum = carry
        ahead, weight = coefficients
        # Both are replaced at once: positions use the velocity of the previous stage.
        position = _integrate_positions(model, qpos, ahead * data.qvel)
        data = data.replace(qpos=position, qvel=qvel + dt * ahead * data.qacc)
        data = forward(dynamics, data)
        velocity_sum = velocity_sum + weight * data.qvel
        return (data, velocity_sum, acceleration_sum + weight * data.qacc), None

    stages = jnp.array(
        [[0.0, 1 / 6], [0.5, 1 / 3], [0.5, 1 / 3], [1.0, 1 / 6]], jnp.float32
    )
    carry = (data, jnp.zeros_like(qvel), jnp.zeros_like(qvel))
    (data, velocity, acceleration), _ = jax.lax.scan(stage, carry, stages)
    return data.replace(
        qpos=_integrate_positions(model, qpos, velocity),
        qvel=qvel + dt * acceleration,
        qacc_warmstart=data.qacc,
    )

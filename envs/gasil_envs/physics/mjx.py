"""MuJoCo physics in pure JAX, on MJX."""

import functools
import logging

import jax
import jax.numpy as jnp
import mujoco
from flax import struct
from mujoco import mjx

from gasil_envs.physics import dynamics

_LOGGER = logging.getLogger(__name__)


@struct.dataclass
class PhysicsState:
    """All that a later step depends on, so that replacing it resets everything.

    Attributes:
      qpos: positions, float32 (nq,).
      qvel: velocities, float32 (nv,).
      qacc_warmstart: where the constraint solver starts, float32 (nv,).
    """

    qpos: jax.Array
    qvel: jax.Array
    qacc_warmstart: jax.Array


#: What `MjxPhysics` takes as `solver`.
SOLVERS = ("small", "mjx")


class MjxPhysics:
    """Steps a MuJoCo model with MJX.

    Args:
      model: the model; its solver options are overwritten.
      solver: "small" takes our constraint rows and Newton's method for small dense
        problems (`dynamics`), or, for a model that these can't take, falls back to
        "mjx" with a warning in the log; "mjx" takes MJX's own step.
      iterations: Newton iterations, of both solvers.
      ls_iterations: line-search steps of MJX's solver. Float32 never meets the
        tolerance that is tuned for float64, so MuJoCo's 100 iterations would all be
        spent; with 4 and 8 the result is the same (relative error against C MuJoCo
        6e-7 on walker2d).
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        solver: str = "small",
        iterations: int = 4,
        ls_iterations: int = 8,
    ):
        model.opt.iterations = iterations
        model.opt.ls_iterations = ls_iterations
        # humanoid.xml asks for PGS, which MJX lacks.
        model.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON
        self._mjx_model = mjx.put_model(model)
        self._blank_data = mjx.make_data(model)
        reason = dynamics.unsupported(model) if solver == "small" else None
        if reason is not None:
            _LOGGER.warning("MJX's own solver steps this model: %s", reason)
        if solver == "small" and reason is None:
            small = dynamics.make(model, self._mjx_model, iterations)
            self._step = functools.partial(dynamics.step, small)
        else:
            self._step = functools.partial(mjx.step, self._mjx_model)

    def init(self, qpos: jax.Array, qvel: jax.Array) -> PhysicsState:
        """The state at rest in the solver: (nq,), (nv,) -> `PhysicsState`."""
        return PhysicsState(qpos, qvel, jnp.zeros_like(qvel))

    def data(self, state: PhysicsState) -> mjx.Data:
        """MJX's data for `state`, nothing derived from it computed yet."""
        return self._blank_data.replace(
            qpos=state.qpos, qvel=state.qvel, qacc_warmstart=state.qacc_warmstart
        )

    def kinematics(self, state: PhysicsState) -> mjx.Data:
        """Data with the positions and velocities of the bodies at `state`."""
        data = mjx.kinematics(self._mjx_model, self.data(state))
        data = mjx.com_pos(self._mjx_model, data)
        return mjx.com_vel(self._mjx_model, data)

    def step(
        self, state: PhysicsState, control: jax.Array, frame_skip: int
    ) -> tuple[PhysicsState, mjx.Data]:
        """Advance `frame_skip` time steps under one control (nu,).

        Returns the state and MJX's data. As in C MuJoCo, what the data derives
        from positions and velocities belongs to the last evaluation of the
        dynamics, not to the new state.
        """
        data = self.data(state).replace(ctrl=control)
        data = jax.lax.scan(
            lambda data, _: (self._step(data), None),
            data,
            length=frame_skip,
        )[0]
        return PhysicsState(data.qpos, data.qvel, data.qacc_warmstart), data

    def contact_forces(self, data: mjx.Data) -> jax.Array:
        """External force on each body, com-based, (nbody, 6): MuJoCo's cfrc_ext."""
        return mjx.rne_postconstraint(self._mjx_model, data)._impl.cfrc_ext

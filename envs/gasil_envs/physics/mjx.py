"""MJX as MuJoCo ships it, as an engine of `interface.Physics`."""

from collections.abc import Sequence
from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from gasil_envs.physics.interface import Fields, PhysicsState
from gasil_envs.precision import full_precision

#: The fields that MJX keeps among what depends on its implementation.
_OF_IMPLEMENTATION = ("cinert", "cfrc_ext")

#: Parts of a model that MJX leaves out without a word, and the arrays that have them.
_LEFT_OUT = {
    "nonlinear springs": ("jnt_stiffnesspoly", "tendon_stiffnesspoly"),
    "nonlinear damping": ("dof_dampingpoly", "tendon_dampingpoly"),
    "actuators with damping": ("actuator_damping", "actuator_dampingpoly"),
    "actuators with armature": ("actuator_armature",),
    "adhesion": ("geom_adhesion",),
    "moving surfaces": ("geom_surfacevel",),
    "plugins": ("nplugin",),
}


def left_out(model: mujoco.MjModel) -> str | None:
    """Return what both JAX engines would leave out of a model; None if nothing."""
    for what, names in _LEFT_OUT.items():
        if any(np.any(getattr(model, name)) for name in names):
            return what
    options = ("noslip_iterations", "disableactuator")
    return next((x for x in options if getattr(model.opt, x)), None)


class Unsupported(ValueError):
    """MJX does not take a model, because of `part`."""

    def __init__(self, part: str):
        super().__init__(
            f"physics 'mjx' does not support this model: {part} (use physics 'mujoco')"
        )
        self.part = part


class MjxPhysics:
    """Steps a MuJoCo model with MJX's own step; see `interface.Physics`.

    Args:
      model: the model; its solver options are overwritten.
      fields: names of the ``mjData`` arrays to return.
      iterations: Newton iterations.
      ls_iterations: line-search steps. Float32 never meets MuJoCo's tolerance, which is
        meant for float64, so that all of its 100 iterations would run. 4 and 8 give the
        same result (relative error against C MuJoCo 6e-7 on walker2d).

    Raises:
      Unsupported: if MJX does not take the model.
    """

    name = "mjx"

    def __init__(
        self,
        model: mujoco.MjModel,
        fields: Sequence[str] = (),
        iterations: int = 4,
        ls_iterations: int = 8,
    ):
        model.opt.iterations = iterations
        model.opt.ls_iterations = ls_iterations
        # humanoid.xml specifies PGS, which MJX does not have.
        model.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON
        self._fields = tuple(fields)
        try:
            self._model = mjx.put_model(model)
            self._blank_data = mjx.make_data(model)
        except NotImplementedError as error:
            raise Unsupported(str(error).partition("\n")[0].rstrip(".")) from None
        self._left_out = left_out(model)

    def init(self, qpos: jax.Array, qvel: jax.Array) -> PhysicsState:
        """Return the state at positions (nq,) and velocities (nv,), warm start 0."""
        return PhysicsState(qpos, qvel, jnp.zeros_like(qvel))

    def _data(self, state: PhysicsState) -> mjx.Data:
        return self._blank_data.replace(
            qpos=state.qpos, qvel=state.qvel, qacc_warmstart=state.qacc_warmstart
        )

    def _pick(self, data: mjx.Data) -> Fields:
        return {
            name: getattr(data._impl if name in _OF_IMPLEMENTATION else data, name)
            for name in self._fields
        }

    # MJX takes a second to trace this, and every reset needs it.
    @partial(jax.jit, static_argnums=0)
    @full_precision
    def kinematics(self, state: PhysicsState) -> Fields:
        """Return the fields at `state`, with all forces 0."""
        data = mjx.kinematics(self._model, self._data(state))
        data = mjx.com_pos(self._model, data)
        return self._pick(mjx.com_vel(self._model, data))

    @full_precision
    def step(
        self, state: PhysicsState, control: jax.Array, frame_skip: int
    ) -> tuple[PhysicsState, Fields]:
        """Advance `frame_skip` time steps under one control (nu,).

        Raises:
          Unsupported: if MJX would leave out a part of the model.
        """
        if self._left_out is not None:
            raise Unsupported(self._left_out)
        data = self._data(state).replace(ctrl=control)
        data = jax.lax.scan(
            lambda data, _: (mjx.step(self._model, data), None),
            data,
            length=frame_skip,
        )[0]
        state = PhysicsState(data.qpos, data.qvel, data.qacc_warmstart)
        if "cfrc_ext" in self._fields:
            data = mjx.rne_postconstraint(self._model, data)
        return state, self._pick(data)

"""MuJoCo physics in pure JAX: our own implementation, or MJX's."""

import logging
from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from gasil_envs.physics import dynamics
from gasil_envs.physics.batching import batch_last, in_tiles
from gasil_envs.physics.interface import Fields, PhysicsState
from gasil_envs.precision import full_precision

_LOGGER = logging.getLogger(__name__)

#: The solvers that `MjxPhysics` offers.
SOLVERS = ("small", "mjx")

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


def _left_out(model: mujoco.MjModel) -> str | None:
    """Return what MJX would leave out of a model, or None if nothing."""
    for what, names in _LEFT_OUT.items():
        if any(np.any(getattr(model, name)) for name in names):
            return what
    options = ("noslip_iterations", "disableactuator")
    return next((x for x in options if getattr(model.opt, x)), None)


def _refusal(what: str) -> ValueError:
    return ValueError(
        f"physics 'mjx' does not support this model: {what} (use physics 'mujoco')"
    )


class MjxPhysics:
    """Steps a MuJoCo model in JAX, with our own code or MJX's; see `interface.Physics`.

    Args:
      model: the model; its solver options are overwritten.
      fields: names of the ``mjData`` arrays to return.
      solver: "small" uses our own dynamics and Newton's method for small dense problems
        (`dynamics`). For a model that these do not support it falls back to "mjx" and
        logs a warning that says why. "mjx" uses MJX's own step.
      iterations: Newton iterations of either solver.
      ls_iterations: line-search steps of MJX's solver. Float32 never meets MuJoCo's
        tolerance, which is meant for float64, so that all of its 100 iterations would
        run. 4 and 8 give the same result (relative error against C MuJoCo 6e-7 on
        walker2d).

    Raises:
      ValueError: if MJX does not take the model.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        fields: Sequence[str] = (),
        solver: str = "small",
        iterations: int = 4,
        ls_iterations: int = 8,
    ):
        model.opt.iterations = iterations
        model.opt.ls_iterations = ls_iterations
        # humanoid.xml specifies PGS, which MJX does not have.
        model.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON
        self._fields = tuple(fields)
        reason = dynamics.unsupported(model, fields) if solver == "small" else None
        if reason is not None:
            _LOGGER.warning(
                "MJX's own step is used, some ten times slower than ours, because of a "
                "part of the model that ours lacks: %s",
                reason,
            )
        self._small: dynamics.Dynamics | None = None
        try:
            if solver == "small" and reason is None:
                self._small = dynamics.make(model, fields, iterations)
            else:
                self._mjx_model = mjx.put_model(model)
                self._blank_data = mjx.make_data(model)
        except NotImplementedError as error:
            raise _refusal(str(error).partition("\n")[0].rstrip(".")) from None
        self._left_out = _left_out(model)

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

    @full_precision
    def kinematics(self, state: PhysicsState) -> Fields:
        """Return the fields at `state`, with all forces 0."""
        if self._small is not None:
            return batch_last(partial(dynamics.kinematics, self._small))(state)
        return self._kinematics(state)

    # MJX takes a second to trace this, and every reset needs it.
    @partial(jax.jit, static_argnums=0)
    def _kinematics(self, state: PhysicsState) -> Fields:
        data = mjx.kinematics(self._mjx_model, self._data(state))
        data = mjx.com_pos(self._mjx_model, data)
        return self._pick(mjx.com_vel(self._mjx_model, data))

    @full_precision
    def step(
        self, state: PhysicsState, control: jax.Array, frame_skip: int
    ) -> tuple[PhysicsState, Fields]:
        """Advance `frame_skip` time steps under one control (nu,).

        Raises:
          ValueError: if MJX would leave out a part of the model.
        """
        if self._left_out is not None:
            raise _refusal(self._left_out)
        if self._small is not None:
            small = self._small

            def many(x: Any) -> Any:
                return dynamics.step(small, x[0], x[1], frame_skip)

            # Tiles take half as long again to compile, which a single simulation, for a
            # picture or an adapter, would not earn back.
            with jax.named_scope("physics"):
                return batch_last(many, in_tiles(many))((state, control))
        data = self._data(state).replace(ctrl=control)
        data = jax.lax.scan(
            lambda data, _: (mjx.step(self._mjx_model, data), None),
            data,
            length=frame_skip,
        )[0]
        state = PhysicsState(data.qpos, data.qvel, data.qacc_warmstart)
        if "cfrc_ext" in self._fields:
            data = mjx.rne_postconstraint(self._mjx_model, data)
        return state, self._pick(data)

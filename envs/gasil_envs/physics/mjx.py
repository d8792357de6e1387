"""MJX as MuJoCo ships it, as an engine of `interface.Physics`."""

import contextlib
import copy
import io
import logging
from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from gasil_envs.physics import candidates, collision, constraints, tree
from gasil_envs.physics.interface import Fields, PhysicsState
from gasil_envs.precision import full_precision

_LOGGER = logging.getLogger(__name__)

#: The fields that MJX keeps among what depends on its implementation.
_OF_IMPLEMENTATION = ("cinert", "cfrc_ext")

#: Parts of a model that neither MJX nor our physics has, and the arrays with them. MJX
#: leaves them out without a word.
_LEFT_OUT = {
    "nonlinear springs": ("jnt_stiffnesspoly", "tendon_stiffnesspoly"),
    "nonlinear damping": ("dof_dampingpoly", "tendon_dampingpoly"),
    "actuators with damping": ("actuator_damping", "actuator_dampingpoly"),
    "actuators with armature": ("actuator_armature",),
    "adhesion": ("geom_adhesion",),
    "moving surfaces": ("geom_surfacevel",),
    "plugins": ("nplugin",),
    "flexes": ("nflex",),
}
_ENABLE, _DISABLE = mujoco.mjtEnableBit, mujoco.mjtDisableBit
#: Flags that move nothing.
_WITHOUT_EFFECT = _ENABLE.mjENBL_ENERGY | _ENABLE.mjENBL_FWDINV
#: Names of numbers of a model, by which MJX, unlike C, leaves contacts out.
_MJX_NUMERICS = ("max_contact_points", "max_geom_pairs")


def left_out(model: mujoco.MjModel) -> str | None:
    """Return what both JAX engines would leave out of a model; None if nothing."""
    for what, names in _LEFT_OUT.items():
        if any(np.any(getattr(model, name)) for name in names):
            return what
    for option in ("noslip_iterations", "disableactuator"):
        if getattr(model.opt, option):
            return option
    flags = model.opt.enableflags & ~(_WITHOUT_EFFECT | _ENABLE.mjENBL_INVDISCRETE)
    for flag in _ENABLE.__members__.values():
        if flags & flag:
            return f"the flag {flag.name.removeprefix('mjENBL_').lower()}"
    if model.nactuator != model.nu:
        return "actuators with several controls"
    return None


def differences(model: mujoco.MjModel) -> list[str]:
    """Return the parts of a model in which MJX's numbers are not C MuJoCo's."""
    geoms, dim, *_ = candidates.candidates(model)
    kinds = model.geom_type[geoms].reshape(-1, 2)
    on_plane = kinds[:, 0] == mujoco.mjtGeom.mjGEOM_PLANE
    capsule = kinds == mujoco.mjtGeom.mjGEOM_CAPSULE
    numerics = [
        mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_NUMERIC, name) >= 0
        for name in _MJX_NUMERICS
    ]
    implicitfast = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    solimps = [model.geom_solimp, model.pair_solimp, model.jnt_solimp]
    solimps += [model.eq_solimp, model.dof_solimp]
    frictions = np.append(model.geom_friction[geoms, 0], model.pair_friction[:, 0])
    differences = {
        "friction of steep capsules on planes": (
            constraints.motion_normal(model, geoms) is None
            and (on_plane & capsule[:, 1] & (dim > 1)).any()
        ),
        "contacts of capsules that stay parallel": collision.stay_parallel(
            model, geoms[capsule.all(axis=1)]
        ),
        "contacts of cylinders, ellipsoids, boxes and meshes": (
            kinds[:, 1] > int(mujoco.mjtGeom.mjGEOM_CAPSULE)
        ).any(),
        "friction below 1e-5": (frictions < mujoco.mjMINMU).any(),
        "solimp of width 0": any((x[:, 2] <= mujoco.mjMINVAL).any() for x in solimps),
        "bodies that start deep in each other": collision.depth(model) > 1.0,
        "equalities of bodies": (model.eq_type <= int(mujoco.mjtEq.mjEQ_WELD)).any(),
        "turning of free bodies with implicitfast": (
            model.opt.integrator == implicitfast and tree.has_lone_bodies(model)
        ),
        f"contacts that {' or '.join(_MJX_NUMERICS)} leaves out": any(numerics),
    }
    named = [what for what, differs in differences.items() if differs]
    return named + tree.rounding(model)


def _mjx() -> Any:
    """Return the package; its import takes seconds, and few runs need it."""
    # It prints at its first import that its optional Warp backend is absent.
    with contextlib.redirect_stdout(io.StringIO()):
        from mujoco import mjx
    return mjx


class Unsupported(ValueError):
    """MJX does not take a model, because of `part`."""

    def __init__(self, part: str):
        super().__init__(
            f"physics 'mjx' does not support this model: {part} (use physics 'mujoco')"
        )
        self.part = part


class MjxPhysics:
    """Steps a MuJoCo model with MJX's own step; see `interface.Physics`.

    The model's solver options are overwritten: float32 never meets MuJoCo's tolerance,
    which is meant for float64, so that all of its 100 iterations would run. 8 and 8, or
    30 if impratio is above 1, are enough.
    """

    name = "mjx"

    def __init__(
        self,
        model: mujoco.MjModel,
        fields: Sequence[str] = (),
        iterations: int | None = None,
        ls_iterations: int | None = None,
    ):
        model.opt.iterations = iterations or (30 if model.opt.impratio > 1 else 8)
        model.opt.ls_iterations = ls_iterations or 8
        # humanoid.xml specifies PGS, which MJX does not have.
        model.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON
        self._fields = tuple(fields)
        what = left_out(model)
        if what is None and (model.geom_fluid[:, 0] > 0).any():
            what = "fluidshape ellipsoid"
        if what is not None:
            raise Unsupported(what)
        without = copy.copy(model)
        without.opt.enableflags &= ~_WITHOUT_EFFECT
        # Sensors move nothing, and MJX refuses many though they are disabled.
        without.opt.disableflags |= _DISABLE.mjDSBL_SENSOR
        without.sensor_type[:] = mujoco.mjtSensor.mjSENS_CLOCK
        mjx = _mjx()
        try:
            self._model = mjx.put_model(without)
            self._blank_data = mjx.make_data(without)
            qpos, qvel, control = map(jnp.zeros, (model.nq, model.nv, model.nu))
            state = PhysicsState(qpos, qvel, qvel)
            jax.eval_shape(partial(self.step, frame_skip=1), state, control)
        except Exception as error:  # MJX has many kinds of them.
            lines = str(error).strip().splitlines() or [""]
            raise Unsupported(lines[0].rstrip(".") or type(error).__name__) from None
        if differs := differences(model):
            _LOGGER.warning(
                "physics 'mjx' differs from C MuJoCo's in this model's %s",
                ", ".join(differs),
            )

    def _data(self, state: PhysicsState) -> Any:
        return self._blank_data.replace(
            qpos=state.qpos, qvel=state.qvel, qacc_warmstart=state.qacc_warmstart
        )

    def _pick(self, data: Any) -> Fields:
        return {
            name: getattr(data._impl if name in _OF_IMPLEMENTATION else data, name)
            for name in self._fields
        }

    # MJX takes a second to trace this, and every reset needs it.
    @partial(jax.jit, static_argnums=0)
    @full_precision
    def kinematics(self, state: PhysicsState) -> Fields:
        mjx = _mjx()
        data = mjx.kinematics(self._model, self._data(state))
        data = mjx.com_pos(self._model, data)
        return self._pick(mjx.com_vel(self._model, data))

    @full_precision
    def step(
        self, state: PhysicsState, control: jax.Array, frame_skip: int
    ) -> tuple[PhysicsState, Fields]:
        return self._step(state, control, frame_skip)

    # MJX takes seconds to trace this, which the check of the model needs too.
    @partial(jax.jit, static_argnums=(0, 3))
    def _step(
        self, state: PhysicsState, control: jax.Array, frame_skip: int
    ) -> tuple[PhysicsState, Fields]:
        mjx, data = _mjx(), self._data(state).replace(ctrl=control)
        data = jax.lax.scan(
            lambda data, _: (mjx.step(self._model, data), None), data, length=frame_skip
        )[0]
        state = PhysicsState(data.qpos, data.qvel, data.qacc_warmstart)
        if "cfrc_ext" in self._fields:
            data = mjx.rne_postconstraint(self._model, data)
        return state, self._pick(data)

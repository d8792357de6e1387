"""Our own physics in pure JAX, and which engine steps a model that it lacks."""

import logging
from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import mujoco

from gasil_envs.physics import dynamics, tendons, tree
from gasil_envs.physics.batching import batch_last, in_tiles
from gasil_envs.physics.interface import Fields, Physics, PhysicsState
from gasil_envs.physics.mjx import MjxPhysics, Unsupported, left_out
from gasil_envs.precision import full_precision

_LOGGER = logging.getLogger(__name__)


def unsupported(model: mujoco.MjModel) -> str | None:
    """Return why our physics does not take a model; None if it does."""
    return dynamics.unsupported(model) or left_out(model)


def ours_or_mjx(
    model: mujoco.MjModel,
    fields: Sequence[str] = (),
    iterations: int | None = None,
    ls_iterations: int | None = None,
) -> Physics:
    """Return our physics, or MJX's and a warning that says which part ours lacks."""
    reason = unsupported(model)
    if reason is None:
        return JaxPhysics(model, fields, iterations, ls_iterations)
    try:
        physics = MjxPhysics(model, fields, iterations, ls_iterations)
    except Unsupported as error:
        raise ValueError(
            f"physics 'jax' does not support this model: {reason}; nor does 'mjx': "
            f"{error.part} (use physics 'mujoco')"
        ) from None
    _LOGGER.warning(
        "physics 'mjx' is used, some ten times slower than 'jax', because of a part of "
        "the model that 'jax' lacks: %s",
        reason,
    )
    return physics


class JaxPhysics:
    """Steps a supported model with our dynamics and solver; see `interface.Physics`.

    Newton's method ends where it has converged, mostly after 2 to 8 iterations.
    """

    name = "jax"

    def __init__(
        self,
        model: mujoco.MjModel,
        fields: Sequence[str] = (),
        iterations: int | None = None,
        ls_iterations: int | None = None,
    ):
        self._dynamics = dynamics.make(
            model, fields, iterations or 100, ls_iterations or (4 if iterations else 16)
        )
        if self.warnings:
            _LOGGER.warning(
                "physics 'jax' may differ from C MuJoCo's by 1e-3 a step, more where "
                "stiff contacts oppose each other, in this model's %s",
                ", ".join(self.warnings),
            )

    @property
    def warnings(self) -> list[str]:
        """Return what differs: of the model, mostly what float32 does not resolve."""
        own, parts = self._dynamics, []
        if own.layout.stiffness > 3e3:
            parts.append(
                f"contacts, which are {own.layout.stiffness:.0e} times as stiff as "
                "what they move (by friction, impratio or solimp)"
            )
        if "cfrc_ext" in own.fields and tendons.strings(own.model).any():
            parts.append("cfrc_ext, which is without the forces of spatial tendons")
        return parts + tree.rounding(own.model)

    @full_precision
    def kinematics(self, state: PhysicsState) -> Fields:
        own = self._dynamics
        place = partial(dynamics.kinematics, own.model, own.fields)
        return batch_last(place)(state)

    @full_precision
    def step(
        self, state: PhysicsState, control: jax.Array, frame_skip: int
    ) -> tuple[PhysicsState, Fields]:

        def many(x: Any) -> Any:
            return dynamics.step(self._dynamics, x[0], x[1], frame_skip)

        # Tiles take half as long again to compile, which a single simulation, for a
        # picture or an adapter, would not earn back.
        with jax.named_scope("physics"):
            return batch_last(many, in_tiles(many))((state, control))

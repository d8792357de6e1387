"""The interface between environments and physics engines."""

from typing import Protocol

import jax
from flax import struct

#: Arrays of MuJoCo's ``mjData`` by their names, float32.
Fields = dict[str, jax.Array]


class PhysicsState(struct.PyTreeNode):
    """The complete state of a simulation: everything that the next step depends on."""

    qpos: jax.Array  # Positions, float32 (nq,).
    qvel: jax.Array  # Velocities, float32 (nv,).
    qacc_warmstart: jax.Array  # Initial guess of the constraint solver, float32 (nv,).


class Physics(Protocol):
    """Steps one model with pure functions, which work under `jax.jit` and `jax.vmap`.

    The constructor takes the names of the ``mjData`` arrays that are returned.
    """

    name: str  # jax, mjx or mujoco.

    def kinematics(self, state: PhysicsState) -> Fields:
        """Return the fields at `state`, with all forces 0."""

    def step(
        self, state: PhysicsState, control: jax.Array, frame_skip: int
    ) -> tuple[PhysicsState, Fields]:
        """Advance `frame_skip` time steps under one control (nu,).

        As in MuJoCo, the fields belong to the last evaluation of the dynamics, not to
        the new state. If the physics fails, the new state is not finite.
        """

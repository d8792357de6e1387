"""What an environment asks of a physics engine."""

from typing import Protocol

import jax
from flax import struct

#: Arrays of MuJoCo's ``mjData`` by their name there, float32.
Fields = dict[str, jax.Array]


class PhysicsState(struct.PyTreeNode):
    """All that a later step depends on, so that replacing it resets everything.

    Attributes:
      qpos: positions, float32 (nq,).
      qvel: velocities, float32 (nv,).
      qacc_warmstart: where the constraint solver starts, float32 (nv,).
    """

    qpos: jax.Array
    qvel: jax.Array
    qacc_warmstart: jax.Array


class Physics(Protocol):
    """Steps one model. Pure functions: jit them, and `jax.vmap` them for many.

    Which fields of ``mjData`` are given is chosen when it is built.
    """

    def init(self, qpos: jax.Array, qvel: jax.Array) -> PhysicsState:
        """The state at rest in the solver: (nq,), (nv,) -> `PhysicsState`."""

    def kinematics(self, state: PhysicsState) -> Fields:
        """The fields at `state`; forces are 0."""

    def step(
        self, state: PhysicsState, control: jax.Array, frame_skip: int
    ) -> tuple[PhysicsState, Fields]:
        """Advance `frame_skip` time steps under one control (nu,).

        As in MuJoCo, the fields belong to the last evaluation of the dynamics, not to
        the new state. Physics that fails gives a state that is not finite.
        """

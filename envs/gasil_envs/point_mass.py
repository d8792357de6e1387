"""The paper's 2D point mass (section 5.2), with its layout as data.

The action is the agent's velocity. Objects are collected once: blue +5, green +10,
orange distractors -5. An actuation cost proportional to the L2 norm of the action
discourages speed. The paper gives no coordinates. `Layout`'s defaults were found by a
search for a layout in which the paper's findings appear
(experiments/point_mass_layouts.py of commit 5c9b6ad): a blue object on each side of the
start, three green ones further up, and two distractors on each side of those.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from gasil_envs.base import Env, State


@dataclasses.dataclass(frozen=True)
class Layout:
    """The positions and rewards of all objects, in the box [-1, 1] x [-1, 1].

    An object is collected when the agent comes within `radius` of its centre. The
    agent's start is uniform within `start_spread` of `start` in each coordinate.
    """

    blue: tuple[tuple[float, float], ...] = ((-0.25, -0.12), (0.25, -0.12))
    green: tuple[tuple[float, float], ...] = ((-0.23, 0.28), (0.23, 0.28), (0.0, 0.58))
    orange: tuple[tuple[float, float], ...] = (
        (-0.64, 0.11),
        (0.64, 0.11),
        (-0.8, 0.5),
        (0.8, 0.5),
    )
    start: tuple[float, float] = (0.0, -0.2)
    start_spread: float = 0.1
    radius: float = 0.15
    max_speed: float = 0.05
    actuation_cost: float = 0.02
    blue_reward: float = 5.0
    green_reward: float = 10.0
    orange_reward: float = -5.0
    episode_length: int = 50


class PointMassState(struct.PyTreeNode):
    """The agent's position (2,), and which objects are collected, bool (objects,)."""

    position: jax.Array
    collected: jax.Array


class PointMass(Env):
    """A point that moves with a chosen velocity in a box and collects objects.

    Observation, float32 (2 + objects,): the position, then 1 for each object that
    is still there and 0 for each that is collected, in the order blue, green,
    orange. Action, float32 (2,): the velocity as a fraction of
    `Layout.max_speed`, limited to [-1, 1] in each coordinate. The reward is the
    sum over collected objects minus ``actuation_cost * ||action||_2``.
    """

    ends_early = False
    action_size = 2
    backend = "none"  # Of physics, which Brax's `Env` names.

    def __init__(self, layout: Layout | None = None):
        self.layout = layout = layout or Layout()
        # NumPy arrays become constants of the traced functions.
        self.objects = np.array(layout.blue + layout.green + layout.orange, np.float32)
        self.object_rewards = np.array(
            [layout.blue_reward] * len(layout.blue)
            + [layout.green_reward] * len(layout.green)
            + [layout.orange_reward] * len(layout.orange),
            np.float32,
        )
        self.episode_length = layout.episode_length
        self.observation_size = 2 + len(self.objects)

    def reset(self, rng: jax.Array) -> State:
        """Start near `Layout.start` with every object in place."""
        spread = self.layout.start_spread
        offset = jax.random.uniform(rng, (2,), jnp.float32, -spread, spread)
        pipeline_state = PointMassState(
            position=jnp.array(self.layout.start, jnp.float32) + offset,
            collected=jnp.zeros(self.objects.shape[0], bool),
        )
        zero = jnp.float32(0)
        return State(pipeline_state, self._observe(pipeline_state), zero, zero)

    def step(self, state: State, action: jax.Array) -> State:
        """Move the agent and collect the objects within reach."""
        action = jnp.clip(action, -1.0, 1.0)
        before = state.pipeline_state
        position = jnp.clip(before.position + self.layout.max_speed * action, -1.0, 1.0)
        distance = jnp.linalg.norm(position[None] - self.objects, axis=-1)
        reached = (distance <= self.layout.radius) & ~before.collected
        pipeline_state = PointMassState(position, before.collected | reached)
        reward = jnp.sum(jnp.where(reached, self.object_rewards, 0.0))
        cost = self.layout.actuation_cost * jnp.sqrt(jnp.sum(action**2))
        return state.replace(
            pipeline_state=pipeline_state,
            obs=self._observe(pipeline_state),
            reward=reward - cost,
            done=jnp.float32(0),
        )

    def _observe(self, state: PointMassState) -> jax.Array:
        return jnp.concatenate(
            [state.position, 1.0 - state.collected.astype(jnp.float32)]
        )

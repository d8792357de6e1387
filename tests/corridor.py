"""A discrete environment that agents learn in seconds: walk along a corridor."""

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs import State

LENGTH = 4


class Corridor:
    """Move left, stay or move right; the further right, the more a step is worth.

    The observation says where the agent is, one-hot. Episodes have 20 steps, and begin
    at one of two places, from which the best returns are 19 and 19.7.
    """

    observation_size = LENGTH
    num_actions = 3
    episode_length = 20
    ends_early = False

    def reset(self, rng):
        position = jax.random.randint(rng, (), 0, 2)
        zero = jnp.float32(0)
        return State(position, jax.nn.one_hot(position, LENGTH), zero, zero)

    def step(self, state, action):
        assert action.dtype == jnp.int32 and action.shape == ()
        position = jnp.clip(state.pipeline_state + action - 1, 0, LENGTH - 1)
        reward = (position / (LENGTH - 1)).astype(jnp.float32)
        observation = jax.nn.one_hot(position, LENGTH)
        return state.replace(pipeline_state=position, obs=observation, reward=reward)

    def draw(self, state, size):
        """A white square on black."""
        picture = np.zeros((size[1], size[0], 3), np.uint8)
        width = size[0] // LENGTH
        picture[:, int(state) * width : (int(state) + 1) * width] = 255
        return picture

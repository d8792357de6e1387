"""The interface of all environments here: Brax's `Env`, `State` and `Wrapper`.

They have the same fields and functions as the classes of ``brax.envs``, and each works
where the other is expected. They are written out because importing Brax, with all of
its physics, takes longer than everything else that a command needs to start.
"""

from typing import Any

import jax
from flax import struct


class State(struct.PyTreeNode):
    """The state of an environment."""

    pipeline_state: Any  # The state of its physics, any pytree.
    obs: jax.Array  # float32 (obs,), the observation.
    reward: jax.Array  # float32 (), the reward of the last step.
    done: jax.Array  # float32 (), 1 if the episode has ended, else 0.
    #: Arrays to report, by name.
    metrics: dict[str, jax.Array] = struct.field(default_factory=dict)
    #: All else that the environment and its wrappers keep, by name.
    info: dict[str, Any] = struct.field(default_factory=dict)


class Env:
    """An environment: pure functions of its states."""

    observation_size: Any  # Number of numbers in an observation.
    action_size: Any  # Dimension of an action.
    #: Number of discrete actions, of an environment without `action_size`.
    num_actions: Any
    #: Number of steps after which an episode is truncated, if it is.
    episode_length: Any

    def reset(self, rng: jax.Array) -> State:
        """Start an episode; consumes the key."""
        raise NotImplementedError

    def step(self, state: State, action: jax.Array) -> State:
        """Take one step."""
        raise NotImplementedError

    @property
    def unwrapped(self) -> Any:
        """The environment without wrappers."""
        return self


class Wrapper(Env):
    """An environment that changes what another one does."""

    def __init__(self, env: Any):
        self.env = env

    def reset(self, rng: jax.Array) -> State:
        return self.env.reset(rng)

    def step(self, state: State, action: jax.Array) -> State:
        return self.env.step(state, action)

    @property
    def unwrapped(self) -> Any:
        return self.env.unwrapped

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):  # Those of pickle and copy, before there is an env.
            raise AttributeError(name)
        return getattr(self.env, name)

"""Agents with a good-trajectory buffer: its settings, and what they do with it."""

from typing import Any, ClassVar

import jax
from flax import struct

from gasil_jax import buffer as good_trajectories
from gasil_jax.agents.interface import Agent
from gasil_jax.buffer import GoodTrajectories
from gasil_jax.config import count
from gasil_jax.context import Context, Metrics, Sizes


class Buffered(struct.PyTreeNode):
    """The state of an agent that has a buffer and nothing else."""

    buffer: GoodTrajectories


class BufferedAgent(Agent):
    """An agent that imitates the steps of the best episodes (paper, section 4.1).

    A subclass may have another state, with the buffer as its field `buffer`.

    Attributes:
      buffer_steps: capacity of the good-trajectory buffer, in steps.
      buffer_episodes: largest number of episodes in the good-trajectory buffer, besides
        its capacity in steps; None for no limit.
    """

    history_episodes: ClassVar[int] = 1

    buffer_steps: int = count(1000)
    buffer_episodes: int | None = count(None)

    def init(self, key: jax.Array, sizes: Sizes) -> Any:
        return Buffered(self.init_buffer(sizes))

    def remember(self, state: Any, context: Context) -> Any:
        return_ = context.rollout.discounted_return
        return state.replace(buffer=self.insert(state.buffer, context, return_))

    def init_buffer(self, sizes: Sizes) -> GoodTrajectories:
        """Return an empty buffer."""
        return good_trajectories.init_buffer(
            self.buffer_steps, sizes.observation, sizes.action
        )

    @jax.named_scope("good_trajectories")
    def insert(
        self, buffer: GoodTrajectories, context: Context, return_: jax.Array
    ) -> GoodTrajectories:
        """Return the buffer with the whole episodes that ended in a batch.

        An episode that ends with a step is ranked by `return_`, (time, env).
        """
        batch, history = context.rollout, context.history
        assert history is not None  # Ensured by `history_episodes`.
        return good_trajectories.insert(
            buffer,
            history,
            batch.ended,
            return_,
            length=batch.episode_length,
            max_episodes=self.buffer_episodes,
        )

    def buffer_metrics(self, buffer: GoodTrajectories) -> Metrics:
        """Return the metrics of a buffer."""
        return {
            "good_return": good_trajectories.mean_return(buffer),
            "good_steps": buffer.size,
        }

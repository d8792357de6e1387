"""Agents with a good-trajectory buffer: its settings, and what they do with it."""

from typing import Any, ClassVar

import jax

from gasil_jax import buffer as good_trajectories
from gasil_jax.agents.interface import Agent
from gasil_jax.buffer import GoodTrajectories
from gasil_jax.config import count, switch
from gasil_jax.context import Context, Metrics, Sizes
from gasil_jax.rollout import Rollout


class BufferedAgent(Agent):
    """An agent that imitates the steps of the best episodes (paper, section 4.1).

    Its state is the buffer, unless a subclass puts the buffer into another one.

    Attributes:
      buffer_steps: capacity of the good-trajectory buffer, in steps.
      buffer_episodes: largest number of episodes in the good-trajectory buffer, besides
        its capacity in steps; None for no limit.
      buffer_discounts: whether the good-trajectory buffer ranks episodes by their
        discounted return, as the paper does; otherwise by the undiscounted one.
    """

    history_episodes: ClassVar[int] = 1

    buffer_steps: int = count(1000)
    buffer_episodes: int | None = count(None)
    buffer_discounts: bool = switch(True)

    def init(self, key: jax.Array, sizes: Sizes) -> Any:
        return self.init_buffer(sizes)

    def remember(self, state: Any, context: Context) -> Any:
        return self.insert(state, context, self.ranked_by(context.rollout))

    def good_trajectories(self, state: Any) -> GoodTrajectories:
        return state

    def init_buffer(self, sizes: Sizes) -> GoodTrajectories:
        """Return an empty buffer."""
        return good_trajectories.init_buffer(
            self.buffer_steps, sizes.observation, sizes.action
        )

    def ranked_by(self, batch: Rollout) -> jax.Array:
        """Return the returns that the buffer ranks episodes by, (time, env)."""
        if self.buffer_discounts:
            return batch.discounted_return
        return batch.undiscounted_return

    @jax.named_scope("good_trajectories")
    def insert(
        self, buffer: GoodTrajectories, context: Context, return_: jax.Array
    ) -> GoodTrajectories:
        """Return the buffer with the whole episodes that ended in a batch.

        Args:
          buffer: the buffer before the batch.
          context: the iteration's data.
          return_: float32 (time, env), what an episode that ends with the step is
            ranked by.
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

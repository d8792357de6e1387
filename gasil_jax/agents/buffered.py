"""Agents with a good-trajectory buffer: its settings, and what they do with it."""

import functools
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from gasil_jax import good_trajectories, normalization
from gasil_jax.agents.interface import Agent
from gasil_jax.config import choice, count, number, switch
from gasil_jax.context import Context, Metrics, Sizes
from gasil_jax.good_trajectories import GoodTrajectories
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
      sample_by_return: whether good steps are drawn with weights exp(R / s), with R the
        return of their episode and s its standard deviation over the buffer's steps;
        otherwise uniformly.
      admission: which episodes may enter the good-trajectory buffer: all, as in the
        paper, or only those that are better than the mean of the episodes that ended in
        the same batch.
      ties: which of two episodes with the same return the buffer keeps: the oldest, as
        in the paper, or the newest.
      sharing_distance: episodes whose mean normalized observations are nearer than this
        share their return, so that the good-trajectory buffer holds several ways to
        succeed; 0 ranks each by its own return, as the paper does.
    """

    history_episodes: ClassVar[int] = 1

    buffer_steps: int = count(1000)
    buffer_episodes: int | None = count(None)
    buffer_discounts: bool = switch(True)
    sample_by_return: bool = switch(False)
    admission: str = choice("all", ("all", "better"))
    ties: str = choice("oldest", ("oldest", "newest"))
    sharing_distance: float = number(0.0, 0.0, traced=False)

    def init(self, key: jax.Array, sizes: Sizes) -> Any:
        """Return an empty buffer as the state."""
        return self.init_buffer(sizes)

    def remember(self, state: Any, context: Context) -> Any:
        """Insert the episodes that ended in a batch into the buffer."""
        return self.insert(state, context)

    def good_trajectories(self, state: Any) -> GoodTrajectories:
        """Return the buffer in a state."""
        return state

    @property
    def keeps_terminated(self) -> bool:
        """Whether the buffer keeps how its episodes ended."""
        return False

    def init_buffer(self, sizes: Sizes) -> GoodTrajectories:
        """Return an empty buffer."""
        return good_trajectories.init(
            self.buffer_steps,
            sizes.observation,
            sizes.action,
            keep_terminated=self.keeps_terminated,
        )

    def ranked_by(self, batch: Rollout) -> jax.Array:
        """Return the returns that the buffer ranks episodes by, (time, env)."""
        if self.buffer_discounts:
            return batch.discounted_return
        return batch.undiscounted_return

    @jax.named_scope("good_trajectories")
    def insert(self, buffer: GoodTrajectories, context: Context) -> GoodTrajectories:
        """Return the buffer with the whole episodes that ended in a batch."""
        return self.insert_ranked(buffer, context, self.ranked_by(context.rollout))

    def insert_ranked(
        self, buffer: GoodTrajectories, context: Context, return_: jax.Array
    ) -> GoodTrajectories:
        """Return the buffer with episodes that are ranked by a given return.

        Args:
          buffer: the buffer before the batch.
          context: the iteration's data.
          return_: float32 (time, env), the episode's return up to each step.
        """
        batch, history = context.rollout, context.history
        assert history is not None  # Ensured by `history_episodes`.
        if self.admission == "better":
            own = jnp.where(batch.completed, self.ranked_by(batch), jnp.nan)
            # The mean of equal returns may be a rounding below them.
            mean = jnp.nanmean(own)
            above = own > mean + 1e-6 * jnp.abs(mean)
            return_ = jnp.where(above, return_, jnp.nan)
        episodes = good_trajectories.ended_episodes(
            history,
            batch.ended,
            return_,
            length=batch.episode_length,
            terminated=batch.terminated if self.keeps_terminated else None,
        )
        ranked_by = None
        if self.sharing_distance > 0:
            ranked_by = good_trajectories.shared_returns(
                buffer,
                history,
                episodes,
                normalize=functools.partial(
                    normalization.normalize, context.normalizer
                ),
                distance=self.sharing_distance,
            )
        return good_trajectories.insert(
            buffer,
            history,
            episodes,
            max_episodes=self.buffer_episodes,
            newest=self.ties == "newest",
            ranked_by=ranked_by,
        )

    def sample(
        self, buffer: GoodTrajectories, key: jax.Array, num_samples: int
    ) -> tuple[jax.Array, jax.Array]:
        """Draw good observations (samples, obs) and actions (samples, action)."""
        return good_trajectories.sample(
            key, buffer, num_samples, by_return=self.sample_by_return
        )

    def buffer_metrics(self, buffer: GoodTrajectories) -> Metrics:
        """Return the metrics of a buffer."""
        return {
            "good_return": good_trajectories.mean_return(buffer),
            "good_steps": buffer.size,
        }

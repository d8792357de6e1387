"""The interface between the training loop and a reward model."""

from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from flax import struct

from gasil_jax.context import Context, Metrics, Sizes


class RewardModel(struct.PyTreeNode):
    """A model of the rewards that PPO and the agent learn from: its settings.

    A subclass declares its settings as an agent does (see `gasil_jax.config`). Models
    are chained: each gets the rewards that the one before it has made. The
    good-trajectory buffer always ranks episodes by the environment's own rewards.

    Attributes:
      name: the model's name, MODULE:CLASS.
      switch: of a model of the package, the setting that is true if an algorithm has
        it. A class of your own has none.
    """

    name: ClassVar[str]
    switch: ClassVar[str]

    def __init_subclass__(cls, **options: Any) -> None:
        """Name the class."""
        super().__init_subclass__(**options)
        cls.name = f"{cls.__module__}:{cls.__qualname__}"

    @property
    def keeps_next_observation(self) -> bool:
        """Whether the history must have the observation after each action."""
        return False

    @property
    def history_episodes(self) -> int:
        """Episodes of full length that the history must hold besides a batch."""
        return 0

    def init(self, key: jax.Array, sizes: Sizes) -> Any:
        """Return the model's state before the first batch; consumes the key."""
        return ()

    def update(
        self, state: Any, context: Context, key: jax.Array
    ) -> tuple[Any, Context, jax.Array, Metrics]:
        """Learn from a batch, and replace its rewards.

        Args:
          state: the model's state before the batch.
          context: the iteration's data, with the rewards before this model.
          key: random key; consumed.

        Returns:
          The state after the batch; the context with this model's rewards; whether the
          model could learn, bool (), false if an update was undone because it was not
          finite; and metrics.
        """
        return state, context, jnp.bool_(True), {}

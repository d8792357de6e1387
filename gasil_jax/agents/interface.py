"""The interface between the training loop and an agent."""

from collections.abc import Mapping
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from flax import struct

from gasil_envs import user_code
from gasil_jax.context import Context, Metrics, Sizes
from gasil_jax.ppo import ActorCritic


class Agent(struct.PyTreeNode):
    """PPO with a way of imitating: its settings, and pure functions of its state.

    A subclass declares its settings as fields, each with a function of
    `gasil_jax.config`. They become flags of the commands and fields of config.json. An
    agent is a pytree of its numbers: those declared with `number` are traced, so a
    sweep may give each run its own.

    The state is a pytree that the training loop carries. All of its numbers must always
    be finite: if an update makes a number that is not finite, the loop undoes the
    update. This class itself is plain PPO.

    Attributes:
      name: the agent's name; MODULE:CLASS for a class of your own.
      num_streams: number of reward streams. Each has its own value.
      uses_reward: whether PPO maximizes the environment's reward, alone or with others.
        If not, a run prints a note that settings of that reward have no effect.
      history_episodes: episodes of full length that the history must hold besides a
        batch; 0 if the agent needs no history.
    """

    name: ClassVar[str] = "ppo"
    num_streams: ClassVar[int] = 1
    uses_reward: ClassVar[bool] = True
    history_episodes: ClassVar[int] = 0

    def __init_subclass__(cls, **options: Any) -> None:
        """Name a class of one's own."""
        super().__init_subclass__(**options)
        if "name" not in cls.__dict__:
            cls.name = f"{cls.__module__}:{cls.__qualname__}"

    def check(self, sizes: Sizes) -> None:
        """Raise `ValueError`, before anything compiles, if the agent can't run."""

    def policy_network(self, sizes: Sizes) -> Any:
        """Return a Flax module for the policy, or None for the package's layers.

        It maps normalized observations, (..., obs), to the mean of actions, or to the
        logits of discrete ones, (..., action), and may only have parameters. It should
        start near 0, so that an untrained policy explores alike in every state.
        """
        return None

    def value_network(self, sizes: Sizes) -> Any:
        """Return a Flax module for the values, or None for the package's layers.

        It maps normalized observations, (..., obs), to values, (...), and may only have
        parameters.
        """
        return None

    def data(self) -> Any:
        """Return arrays that all runs of a program share, such as an expert's steps.

        They are read once, before anything compiles, and reach the agent's functions as
        `Context.data`. A device holds them once, and a checkpoint not at all.
        """
        return ()

    def init(self, key: jax.Array, sizes: Sizes) -> Any:
        """Return the state before the first batch; consumes the key."""
        return ()

    def remember(self, state: Any, context: Context) -> Any:
        """Return the state after storing data of a batch, such as good trajectories.

        If the update of this iteration is undone, the stored data stays.
        """
        return state

    def update_and_reward(
        self, state: Any, context: Context, key: jax.Array
    ) -> tuple[Any, jax.Array, Metrics]:
        """Learn from a batch, and return the rewards that PPO maximizes.

        Args:
          state: the state, with the batch remembered.
          context: the iteration's data.
          key: random key; consumed.

        Returns:
          The state; the rewards, float32 (time, env) or, for several streams, (time,
          env, stream); and metrics, one number each.
        """
        return state, context.rollout.reward, {}

    def update_policy(
        self, state: Any, actor_critic: ActorCritic, context: Context, key: jax.Array
    ) -> tuple[Any, ActorCritic, Metrics]:
        """Take further gradient steps on the policy and the values, after PPO's.

        Args:
          state: the state.
          actor_critic: the networks after PPO's update.
          context: the iteration's data.
          key: random key; consumed.

        Returns:
          The state, the networks, and metrics.
        """
        return state, actor_critic, {}

    def mix(
        self, state: Any, advantages: jax.Array, context: Context
    ) -> tuple[jax.Array, Metrics]:
        """Return the policy's advantage, (time, env), and metrics.

        Args:
          state: the state.
          advantages: the standardized advantages of the streams, (time, env, stream).
          context: the iteration's data.
        """
        return advantages[..., 0], {}


def call(part: Any, function: str, *arguments: Any) -> Any:
    """Call a function of an agent or a model of rewards, and return what it returns.

    Raises:
      ValueError: if that has other shapes or dtypes than the interface says. The loop
        would broadcast or convert it.
    """
    kind = "agent" if isinstance(part, Agent) else "model of rewards"
    what = f"{function} of {kind} {part.name!r}"
    outputs = getattr(part, function)(*arguments)
    context = next(x for x in arguments if isinstance(x, Context))
    reward = context.rollout.reward
    # Arrays of the shapes and dtypes that are expected, by name.
    like = {"advantage": reward} if function == "mix" else {"state": arguments[0]}
    if function == "update":
        like |= {"context": context, "learned": jnp.bool_(True)}
    if function == "update_and_reward":
        streams = [reward] * part.num_streams
        like["rewards"] = jnp.stack(streams, -1) if len(streams) > 1 else reward
    if function == "update_policy":
        like["actor_critic"] = arguments[1]
    names = [*like, *["metrics"] * (function != "remember")]
    returned = (outputs,) if len(names) == 1 else outputs
    if not isinstance(returned, tuple | list) or len(returned) != len(names):
        count = len(returned) if isinstance(returned, tuple | list) else 1
        raise ValueError(
            f"{what} returns {count} value{'s' * (count != 1)}: it must return "
            f"{len(names)}, {', '.join(names)}"
        )
    values = dict(zip(names, returned))
    if not isinstance(metrics := values.pop("metrics", {}), Mapping):
        raise ValueError(f"{what} returns metrics {metrics!r}: they must be a dict")
    # Leaves may be Python's numbers until their shapes are evaluated.
    with user_code.refused(f"{what} returns what is no array"):
        shapes = jax.eval_shape(lambda: (like, values))
    if change := user_code.first_change(*shapes):
        path, expected, given = change
        path = path.replace("['", "", 1).replace("']", "", 1)
        raise ValueError(
            f"{what}: the returned {path} is {given}: it must be {expected}"
        )
    return outputs

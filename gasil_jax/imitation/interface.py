"""The interface between the training loop and an imitation method."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from gasil_envs import own_code
from gasil_jax.config import Config, Hyperparameters
from gasil_jax.good_trajectories import GoodTrajectories, History
from gasil_jax.normalization import Normalizer
from gasil_jax.ppo import ActorCritic
from gasil_jax.rollout import Rollout

Metrics = dict[str, jax.Array]


class Context(struct.PyTreeNode):
    """The data of an iteration that an imitation method may use.

    Attributes:
      rollout: the batch, (time, env, ...); its rewards are decomposed and normalized if
        the config says so.
      history: the last steps of each environment, including the batch's.
      good_trajectories: the buffer, including the batch's ended episodes.
      normalizer: the normalizer of observations that the policy used in the batch.
      reward_scale: float32 (), the number that the rollout's rewards were divided by; 1
        if they are not normalized. Rewards in the history and returns in the buffer are
        not divided by it.
      hyperparameters: their values in this iteration.
      config: the static configuration.
      policy: (params, normalized observation) -> mean, log standard deviation.
      value: (params, normalized observation) -> value.
    """

    rollout: Rollout
    history: History
    good_trajectories: GoodTrajectories
    normalizer: Normalizer
    reward_scale: jax.Array
    hyperparameters: Hyperparameters
    config: Config = struct.field(pytree_node=False)
    policy: Callable[..., tuple[jax.Array, jax.Array]] = struct.field(pytree_node=False)
    value: Callable[..., jax.Array] = struct.field(pytree_node=False)


def check_without_expert(
    config: Config, observation_size: int, action_size: int
) -> None:
    """Check that no expert is given: the `check` of agents that do not use one.

    Raises:
      ValueError: if the config names an expert.
    """
    if config.expert is not None:
        raise ValueError(
            f"expert is {config.expert!r}: agent {config.agent!r} uses no expert, only "
            "agent 'gail' does"
        )


def one_advantage(
    state: Any, advantages: jax.Array, context: Context
) -> tuple[jax.Array, Metrics]:
    """Return the advantage of the only reward stream: the default `mix`."""
    return advantages[..., 0], {}


class Imitation(NamedTuple):
    """An imitation method: pure functions, and settings, for the training loop.

    The method's state is a pytree that the training loop carries. Its numbers must be
    finite from `init` on: an update after which one of them is not is undone.

    Attributes:
      init: (key, config, observation size, action size) -> state.
      update_and_reward: (state, context, key) -> state, rewards, metrics. Learns from
        the batch and returns the rewards that PPO maximizes: (time, env) or, for
        several streams, (time, env, stream). Each stream has its own value.
      update_policy: (state, actor_critic, context, key) -> state, actor_critic,
        metrics. Takes further gradient steps on the policy and the values after PPO's.
      check: (config, observation size, action size). Raises `ValueError`, before
        anything compiles, if the agent can't run with them; default
        `check_without_expert`.
      fields: names of the fields of `Config` and `Hyperparameters` that the method
        uses, besides those that PPO uses. A sweep over a field that is only used by
        other agents is refused. None if it is not known which fields the method uses.
      uses_reward: whether PPO maximizes the environment's reward, alone or with others.
        If not, a run prints a note that settings of that reward have no effect.
      hyperparameters: the class of the agent's hyperparameters: `Hyperparameters`, or
        a class derived from it that declares more.
      num_streams: number of reward streams.
      mix: (state, advantages, context) -> advantage, metrics. Combines the standardized
        advantages of the streams, (time, env, stream), into the policy's advantage,
        (time, env); default `one_advantage`, for a single stream.
    """

    init: Callable[[jax.Array, Config, int, int], Any]
    update_and_reward: Callable[
        [Any, Context, jax.Array], tuple[Any, jax.Array, Metrics]
    ]
    update_policy: Callable[
        [Any, ActorCritic, Context, jax.Array], tuple[Any, ActorCritic, Metrics]
    ]
    check: Callable[[Config, int, int], None] = check_without_expert
    fields: tuple[str, ...] | None = None
    uses_reward: bool = True
    hyperparameters: type[Hyperparameters] = Hyperparameters
    num_streams: int = 1
    mix: Callable[[Any, jax.Array, Context], tuple[jax.Array, Metrics]] = one_advantage


#: What the functions of an `Imitation` that train return, in order.
_OUTPUTS: Mapping[str, tuple[str, ...]] = {
    "update_and_reward": ("state", "rewards", "metrics"),
    "update_policy": ("state", "actor_critic", "metrics"),
    "mix": ("advantage", "metrics"),
}


def checked(agent: Imitation, name: str) -> Imitation:
    """Return an agent whose functions check what they return.

    So an error names the agent's function and not a line of the training loop.

    Args:
      agent: the agent.
      name: its name, for the message.

    Returns:
      The agent. Its functions raise `ValueError` if they return too few or too many
      values, metrics that are no dict, rewards or an advantage of a wrong shape, or a
      state or networks of other shapes or dtypes than they were given.

    Raises:
      ValueError: if the agent has several reward streams and no `mix`.
    """
    if agent.num_streams > 1 and agent.mix is one_advantage:
        raise ValueError(
            f"agent {name!r} has {agent.num_streams} reward streams: it must have a "
            "function mix that combines their advantages"
        )

    def call(function: str, *arguments: Any) -> Any:
        outputs, names = getattr(agent, function)(*arguments), _OUTPUTS[function]
        count = len(outputs) if isinstance(outputs, tuple | list) else 1
        if count != len(names):
            raise ValueError(
                f"{function} of agent {name!r} returns {count} "
                f"value{'s' * (count != 1)}: it must return {len(names)}, "
                f"{', '.join(names)}"
            )
        if not isinstance(outputs[-1], Mapping):
            raise ValueError(
                f"{function} of agent {name!r} returns metrics {outputs[-1]!r}: they "
                "must be a dict"
            )
        return outputs

    def check_leaves(function: str, what: str, value: Any, before: Any) -> None:
        # Undoing an update would broadcast other shapes and convert other dtypes.
        # Leaves may be Python's numbers until their shapes are evaluated.
        shapes = jax.eval_shape(lambda: (before, value))
        if change := own_code.first_change(*shapes):
            path, expected, given = change
            raise ValueError(
                f"{function} of agent {name!r}: the returned {what}{path} is {given}: "
                f"it must be {expected}, as before"
            )

    def check_shape(function: str, what: str, value: Any, expected: Any) -> None:
        if jnp.shape(value) != expected:
            raise ValueError(
                f"{function} of agent {name!r} returns {what} of shape "
                f"{jnp.shape(value)}: it must be {expected}"
            )

    def update_and_reward(state: Any, context: Context, key: jax.Array) -> Any:
        outputs = call("update_and_reward", state, context, key)
        check_leaves("update_and_reward", "state", outputs[0], state)
        rewards, expected = outputs[1], context.rollout.reward.shape
        if agent.num_streams > 1 or jnp.ndim(rewards) == 3:
            expected = (*expected, agent.num_streams)
        check_shape("update_and_reward", "rewards", rewards, expected)
        return outputs

    def update_policy(
        state: Any, actor_critic: ActorCritic, context: Context, key: jax.Array
    ) -> Any:
        outputs = call("update_policy", state, actor_critic, context, key)
        check_leaves("update_policy", "state", outputs[0], state)
        check_leaves("update_policy", "actor_critic", outputs[1], actor_critic)
        return outputs

    def mix(state: Any, advantages: jax.Array, context: Context) -> Any:
        outputs = call("mix", state, advantages, context)
        check_shape("mix", "an advantage", outputs[0], advantages.shape[:2])
        return outputs

    return agent._replace(
        update_and_reward=update_and_reward,
        update_policy=update_policy,
        mix=mix,
    )


def leave_policy(
    state: Any, actor_critic: ActorCritic, context: Context, key: jax.Array
) -> tuple[Any, ActorCritic, Metrics]:
    """Take no steps: the `update_policy` of methods that only shape rewards."""
    return state, actor_critic, {}

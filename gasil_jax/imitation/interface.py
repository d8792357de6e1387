"""What the training loop asks of a way of imitating."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
from flax import struct

from gasil_jax.config import Config, Hyperparameters
from gasil_jax.good_trajectories import GoodTrajectories, History
from gasil_jax.normalization import Normalizer
from gasil_jax.ppo import ActorCritic
from gasil_jax.rollout import Rollout

Metrics = dict[str, jax.Array]


class Context(struct.PyTreeNode):
    """What an imitation module sees of an iteration.

    Attributes:
      rollout: the batch, (time, env, ...), its reward normalized where it is.
      history: the last steps of each environment, the batch's in it.
      good_trajectories: the buffer, the batch's ended episodes in it.
      normalizer: of the observations, as the policy used it in the batch.
      reward_scale: (), what rewards were divided by; 1 where they are not normalized.
        The buffer's and the history's are not.
      hyperparameters: the floats.
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
    """Refuse an expert, which the agent would not look at: a `check`.

    Raises:
      ValueError: the configuration names one.
    """
    if config.expert is not None:
        raise ValueError(
            f"expert is {config.expert!r}: agent {config.agent!r} imitates none, "
            "agent 'gail' does"
        )


def one_stream(hyperparameters: Hyperparameters) -> tuple[float, ...]:
    """The weights of an agent that gives one reward: a `stream_weights`."""
    return (1.0,)


class Imitation(NamedTuple):
    """Pure functions; their state is a pytree that the loop carries.

    Attributes:
      init: (key, config, observation size, action size) -> state.
      update_and_reward: (state, context, key) -> state, rewards, metrics. Learns from
        the batch, and gives the rewards that PPO maximizes: (time, env), or
        (time, env, stream) of several streams, each with a value of its own.
      update_policy: (state, actor_critic, context, key) -> state, actor_critic,
        metrics. Gradient steps of its own on the policy and the values after PPO's.
      check: (config, observation size, action size), raises `ValueError` for what
        the agent can't run with, before anything compiles; default
        `check_without_expert`.
      fields: of `Config` and `Hyperparameters` those that it looks at, PPO's apart:
        a sweep of the others would change nothing. None where it does not say.
      stream_weights: hyperparameters -> the weight of each reward stream's standardized
        advantage in the policy's; default one stream of weight 1.
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
    stream_weights: Callable[[Hyperparameters], tuple[Any, ...]] = one_stream


def leave_policy(
    state: Any, actor_critic: ActorCritic, context: Context, key: jax.Array
) -> tuple[Any, ActorCritic, Metrics]:
    """An `update_policy` that takes no steps."""
    return state, actor_critic, {}

"""What agents and reward models get: the sizes of a run, the data of an iteration."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from gasil_envs import wrappers
from gasil_jax.config import Config
from gasil_jax.distributions import Distribution
from gasil_jax.errors import shown
from gasil_jax.normalization import Normalizer
from gasil_jax.rollout import History, Rollout

Metrics = dict[str, jax.Array]


class Sizes(NamedTuple):
    """The sizes of a run's arrays.

    Attributes:
      num_envs: number of environments.
      observation: dimension of an observation.
      action: dimension of an action, or number of discrete ones.
      history_steps: length of each environment's history; 0 if there is none.
      discrete: whether actions are discrete, and one-hot here.
    """

    num_envs: int
    observation: int
    action: int
    history_steps: int = 0
    discrete: bool = False


def sizes_of(env: Any, num_envs: int, history_steps: int = 0) -> Sizes:
    """Return the sizes of a run in an environment."""
    return Sizes(
        num_envs,
        env.observation_size,
        wrappers.action_size(env),
        history_steps,
        discrete=wrappers.is_discrete(env),
    )


class Context(struct.PyTreeNode):
    """The data of an iteration that agents and reward models may use.

    Attributes:
      rollout: the batch, (time, env, ...); its rewards are those that the reward models
        have made of the environment's so far.
      history: the last steps of each environment, including the batch's, as long as the
        agent and the reward models ask for; None if none does. Its rewards may be
        decomposed, but are not normalized.
      normalizer: the normalizer of observations that the policy used in the batch.
      reward_scale: float32 (), the number that the rollout's rewards were divided by; 1
        if they are not normalized.
      action_range: the lowest and the highest action of the environment, each a number
        or an array (action,); 0 and 1 where actions are discrete.
      config: the settings of the loop and of PPO, with their numbers in this iteration.
      policy: (params, normalized observation) -> the parameters of the actions'
        distribution.
      distribution: the distribution of actions, such as
        ``distribution.log_prob(parameters, action)``.
      value: (params, normalized observation (..., obs)) -> value, float32 (...).
      data: what the agent's `data` returns.
    """

    rollout: Rollout
    history: History | None
    normalizer: Normalizer
    reward_scale: jax.Array
    action_range: tuple[Any, Any]
    config: Config
    policy: Callable[..., Any] = struct.field(pytree_node=False)
    distribution: Distribution = struct.field(pytree_node=False)
    value: Callable[..., jax.Array] = struct.field(pytree_node=False)
    data: Any = ()


def merge_metrics(source: str, *groups: Metrics) -> Metrics:
    """Return groups of metrics as one, float32 () by name, if no name is twice."""
    merged: Metrics = {}
    for name, value in (pair for group in groups for pair in group.items()):
        what = f"metric {shown(name)} of {source}"
        if name in merged:
            raise ValueError(f"{what} has the name of another metric")
        if jnp.shape(value):
            raise ValueError(
                f"{what} has shape {jnp.shape(value)}: it must be one number"
            )
        merged[name] = jnp.asarray(value, jnp.float32)
    return merged

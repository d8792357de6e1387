"""Algorithm 1 of the paper: `init`, `iterate`, and `make_train`, their composition.

Everything is a pure function of a key: `jax.jit` it, `jax.vmap` it over keys or over
any leaf of `Hyperparameters`, shard it over devices, call it from other JAX code.
"""

import math
from typing import Any, Protocol

import jax
import jax.numpy as jnp
from flax import struct

from gasil_envs.precision import full_precision
from gasil_jax import (
    good_trajectories,
    normalization,
    ppo,
    reward_normalization,
    rollout,
    schedules,
)
from gasil_jax.config import Config, Hyperparameters, validate
from gasil_jax.imitation import AGENTS
from gasil_jax.imitation.interface import Context
from gasil_jax.networks import Policy, Value

Metrics = dict[str, jax.Array]


class TrainState(struct.PyTreeNode):
    """All that a run needs to go on, and nothing that it can do without.

    Attributes:
      params: {"policy": ..., "value": ...}.
      optimizer_state: of both, the same keys.
      normalizer: of observations.
      reward_normalizer: of rewards; None where they are not normalized.
      environments: the running episodes, (env, ...).
      history: the last steps of each environment, (env, steps, ...).
      good_trajectories: the buffer B of the paper.
      imitation: the state of the agent's way of imitating.
      hyperparameters: the floats that this run trains with.
      key: consumed by the next iteration.
      iteration: int32 (), iterations done.
    """

    params: Any
    optimizer_state: Any
    normalizer: normalization.Normalizer
    reward_normalizer: reward_normalization.RewardNormalizer | None
    environments: rollout.EnvironmentStates
    history: good_trajectories.History
    good_trajectories: good_trajectories.GoodTrajectories
    imitation: Any
    hyperparameters: Hyperparameters
    key: jax.Array
    iteration: jax.Array


def max_episode_steps(env: Any, config: Config) -> int:
    """Steps after which an episode is truncated, at the latest."""
    return config.max_episode_steps or int(getattr(env, "episode_length", 1000))


def _networks(env: Any, config: Config) -> tuple[Any, Any]:
    # Flax says of `apply` that it may give changed variables too: Any is narrower.
    return Policy(config.hidden_sizes, env.action_size), Value(config.hidden_sizes)


@full_precision
def init(
    env: Any,
    config: Config,
    key: jax.Array,
    hyperparameters: Hyperparameters | None = None,
) -> TrainState:
    """The state before the first iteration. The key is consumed."""
    if hyperparameters is None:
        hyperparameters = config.hyperparameters
    hyperparameters = jax.tree.map(
        lambda x: jnp.asarray(x, jnp.float32), hyperparameters
    )
    key, policy_key, value_key, env_key, imitation_key = jax.random.split(key, 5)
    observation_size, action_size = env.observation_size, env.action_size
    observation = jnp.zeros(observation_size)
    episode_steps = max_episode_steps(env, config)
    policy, value = _networks(env, config)
    params = {
        "policy": policy.init(policy_key, observation),
        "value": value.init(value_key, observation),
    }
    transform = ppo.optimizer(hyperparameters)
    return TrainState(
        params=params,
        optimizer_state={name: transform.init(params[name]) for name in params},
        normalizer=normalization.init(observation_size),
        reward_normalizer=(
            reward_normalization.init(config.num_envs)
            if config.normalize_rewards
            else None
        ),
        environments=rollout.init(
            env,
            env_key,
            config.num_envs,
            age_limit=episode_steps if config.stagger_episodes else None,
        ),
        history=good_trajectories.init_history(
            config.num_envs,
            config.num_steps,
            episode_steps,
            observation_size,
            action_size,
        ),
        good_trajectories=good_trajectories.init(
            config.buffer_steps, observation_size, action_size
        ),
        imitation=AGENTS[config.agent].init(
            imitation_key, config, observation_size, action_size
        ),
        hyperparameters=hyperparameters,
        key=key,
        iteration=jnp.int32(0),
    )


@full_precision
def iterate(env: Any, config: Config, state: TrainState) -> tuple[TrainState, Metrics]:
    """One iteration of Algorithm 1: a batch of experience and the updates from it.

    Returns the next state and a dict of float32 scalars. Means over the whole episodes
    that ended in the batch are NaN if none did.
    """
    imitate = AGENTS[config.agent]
    hp = schedules.at(config, state.hyperparameters, state.iteration)
    policy, value = (network.apply for network in _networks(env, config))
    key, act_key, imitate_key, ppo_key, policy_key = jax.random.split(state.key, 5)
    normalize = lambda observation: normalization.normalize(
        state.normalizer, observation
    )

    # Sample policy trajectories.
    environments, batch = rollout.collect(
        env,
        lambda observation: policy(state.params["policy"], normalize(observation)),
        state.environments,
        act_key,
        num_steps=config.num_steps,
        max_episode_steps=max_episode_steps(env, config),
        gamma=hp.gamma,
    )
    # Update the good trajectory buffer.
    history = good_trajectories.record(
        state.history,
        batch.observation,
        batch.action,
        # No return of an episode with a faulty step, or of one cut short, is one.
        jnp.where(batch.faulty | batch.cut_short, jnp.nan, batch.reward),
        batch.ended,
    )
    episodes = good_trajectories.ended_episodes(
        history, batch.ended, batch.discounted_return, batch.episode_length
    )
    buffer = good_trajectories.insert(
        state.good_trajectories, history, episodes, hp.max_buffer_steps
    )

    # The buffer ranks and keeps what the environment gives; what PPO maximizes is this.
    reward_normalizer, reward_scale = state.reward_normalizer, jnp.float32(1.0)
    reward_metrics = {}
    if reward_normalizer is not None:
        reward_normalizer = reward_normalization.update(
            reward_normalizer, batch.reward, batch.ended, hp.gamma
        )
        reward_scale = reward_normalization.scale(reward_normalizer)
        reward_metrics["reward_scale"] = reward_scale
        reward = reward_normalization.normalize(reward_normalizer, batch.reward)
        batch = batch.replace(reward=reward)

    # Sample good trajectories, update the discriminator by equation 8, and shape the
    # reward with it (section 4.3): what the agent imitates with does so.
    context = Context(
        rollout=batch,
        history=history,
        good_trajectories=buffer,
        normalizer=state.normalizer,
        reward_scale=reward_scale,
        hyperparameters=hp,
        config=config,
        policy=policy,
        value=value,
    )
    imitation, reward, imitation_metrics = imitate.update_and_reward(
        state.imitation, context, imitate_key
    )
    # Update the policy.
    observation = normalize(batch.observation)
    values = value(state.params["value"], observation)
    next_values = value(state.params["value"], normalize(batch.next_observation))
    advantage = ppo.generalized_advantage_estimation(
        reward,
        values,
        next_values,
        batch.terminated,
        batch.ended,
        gamma=hp.gamma,
        gae_lambda=hp.gae_lambda,
    )
    return_ = advantage + values
    normalized_advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
    flat = lambda x: x.reshape(-1, *x.shape[2:])
    params, optimizer_state, ppo_metrics = ppo.update(
        state.params,
        state.optimizer_state,
        ppo.Batch(
            observation=flat(observation),
            action=flat(batch.action),
            log_prob=flat(batch.log_prob),
            advantage=flat(normalized_advantage),
            return_=flat(return_),
        ),
        ppo_key,
        policy=policy,
        value=value,
        learning_rate=hp.learning_rate,
        config=config,
        hyperparameters=hp,
    )
    imitation, params, optimizer_state, policy_metrics = imitate.update_policy(
        imitation, params, optimizer_state, hp.learning_rate, context, policy_key
    )

    # An update that is not finite is as if it had not been.
    learned = (params, optimizer_state, imitation)
    healthy = rollout.is_finite(learned)
    params, optimizer_state, imitation = jax.tree.map(
        lambda new, old: jnp.where(healthy, new, old),
        learned,
        (state.params, state.optimizer_state, state.imitation),
    )
    state = TrainState(
        params=params,
        optimizer_state=optimizer_state,
        # Only now: within an iteration the policy that acts is the one that learns.
        normalizer=normalization.update(state.normalizer, batch.observation),
        reward_normalizer=reward_normalizer,
        environments=environments,
        history=history,
        good_trajectories=buffer,
        imitation=imitation,
        hyperparameters=state.hyperparameters,
        key=key,
        iteration=state.iteration + 1,
    )
    completed = batch.completed
    mean_of_completed = lambda x: (
        jnp.sum(jnp.where(completed, x, 0)) / jnp.sum(completed)
    )
    metrics = {
        "env_steps": state.iteration.astype(jnp.float32) * config.batch_steps,
        "episode_return": mean_of_completed(batch.episode_return),
        "episode_length": mean_of_completed(batch.episode_length),
        "episodes": jnp.sum(completed),
        "faulty_steps": jnp.sum(batch.faulty),
        "skipped_updates": ~healthy,
        "good_return": good_trajectories.mean_return(buffer),
        "good_steps": buffer.size,
        "explained_variance": 1.0
        - jnp.var(return_ - values) / (jnp.var(return_) + 1e-8),
        "learning_rate": hp.learning_rate,
        **reward_metrics,
        **ppo_metrics,
    }
    for own in (imitation_metrics, policy_metrics):
        if taken := metrics.keys() & own.keys():
            raise ValueError(
                f"metrics of agent {config.agent!r} have names that others have: "
                f"{', '.join(sorted(taken))}"
            )
        metrics |= own
    return state, {name: jnp.asarray(x, jnp.float32) for name, x in metrics.items()}


def check(env: Any, config: Config) -> None:
    """Raise `ValueError` for what can't run, before anything compiles."""
    if not hasattr(env, "reset"):
        raise ValueError(
            f"env is {env!r}: it must be an environment, as gasil_jax.make_env gives"
        )
    if jax.config.read("jax_enable_x64"):
        raise ValueError("jax_enable_x64 is True: training is in float32, unset it")
    validate(config, tuple(AGENTS))
    limit = getattr(env, "episode_length", math.inf)
    if (config.max_episode_steps or 0) > limit:
        raise ValueError(
            f"max_episode_steps is {config.max_episode_steps}: the environment's own "
            f"limit is {limit}"
        )
    AGENTS[config.agent].check(config, env.observation_size, env.action_size)


class Train(Protocol):
    """A whole run: a key, consumed, to the last state and metrics (iterations,)."""

    def __call__(
        self, key: jax.Array, hyperparameters: Hyperparameters | None = None
    ) -> tuple[TrainState, Metrics]:
        """Train; default hyperparameters are the configuration's."""


def make_train(env: Any, config: Config) -> Train:
    """A pure function that trains from nothing to `config.total_steps`.

    Args:
      env: one environment with Brax's interface (`gasil_jax.make_env`, or any of
        ``brax.envs``), not wrapped to reset itself.
      config: what to run.

    Returns:
      ``train(key, hyperparameters=None) -> (TrainState, Metrics)``. The key is
      consumed; metrics are (iterations,) each.

    Raises:
      ValueError: a bad configuration, before anything compiles.
    """
    check(env, config)

    def train(
        key: jax.Array, hyperparameters: Hyperparameters | None = None
    ) -> tuple[TrainState, Metrics]:
        return jax.lax.scan(
            lambda state, _: iterate(env, config, state),
            init(env, config, key, hyperparameters),
            length=config.num_iterations,
        )

    return train

"""Algorithm 1 of the paper: `init`, `iterate`, and `make_train`, their composition.

Everything is a pure function of a key: `jax.jit` it, `jax.vmap` it over keys or over
any leaf of `Hyperparameters`, shard it over devices, call it from other JAX code.
"""

from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
from flax import struct

from gasil_envs import wrappers
from gasil_envs.precision import full_precision
from gasil_jax import (
    checks,
    good_trajectories,
    learner,
    normalization,
    ppo,
    reward_decomposition,
    reward_normalization,
    rollout,
    schedules,
)
from gasil_jax.config import Config, Hyperparameters, validate_hyperparameters
from gasil_jax.imitation import find_agent
from gasil_jax.imitation.interface import Context, Imitation, checked
from gasil_jax.networks import Policy, Value
from gasil_jax.ppo import ActorCritic
from gasil_jax.rollout import Rollout

Metrics = dict[str, jax.Array]


class TrainState(struct.PyTreeNode):
    """The complete state of a run: everything that its next iteration depends on.

    Attributes:
      actor_critic: the policy and value networks, with their optimizers' states.
      normalizer: running mean and variance of observations.
      reward_decomposition: the network that decomposes rewards, and its state; None if
        rewards are not decomposed.
      reward_normalizer: running scale of rewards; None if they are not normalized.
      environments: the running episodes, (env, ...).
      history: the last steps of each environment, (env, steps, ...).
      good_trajectories: the good-trajectory buffer, B in the paper.
      imitation: the state of the agent's `Imitation`, such as its discriminator.
      hyperparameters: the run's hyperparameters, float32 () each, before schedules.
      key: random key of the next iteration.
      iteration: int32 (), number of iterations done.
    """

    actor_critic: ActorCritic
    normalizer: normalization.Normalizer
    reward_decomposition: reward_decomposition.Decomposition | None
    reward_normalizer: reward_normalization.RewardNormalizer | None
    environments: rollout.EnvironmentStates
    history: good_trajectories.History
    good_trajectories: good_trajectories.GoodTrajectories
    imitation: Any
    hyperparameters: Hyperparameters
    key: jax.Array
    iteration: jax.Array


def max_episode_steps(env: Any, config: Config) -> int:
    """Return the number of steps after which an episode is truncated."""
    return config.max_episode_steps or int(getattr(env, "episode_length", 1000))


@full_precision
def init(
    env: Any,
    config: Config,
    key: jax.Array,
    hyperparameters: Hyperparameters | None = None,
) -> TrainState:
    """Return the training state before the first iteration.

    Args:
      env: one environment with Brax's interface, not wrapped to reset itself.
      config: the agent and all sizes.
      key: random key; consumed.
      hyperparameters: scalars, which may be traced; default the config's.

    Raises:
      ValueError: if the config can't train in the environment, if the key is no single
        random key, or if a hyperparameter is out of its range and not traced.
    """
    checks.check(env, config)
    checks.check_key(key)
    if hyperparameters is None:
        hyperparameters = config.hyperparameters
    validate_hyperparameters(config, hyperparameters)
    # `Config` converts them to the class that the agent declares.
    hyperparameters = config.replace(hyperparameters=hyperparameters).hyperparameters
    hyperparameters = jax.tree.map(
        lambda x: jnp.asarray(x, jnp.float32), hyperparameters
    )
    key, policy_key, value_key, env_key, imitation_key, decomposition_key = (
        jax.random.split(key, 6)
    )
    sizes = (env.observation_size, env.action_size)
    history = _init_history(env, config)
    return TrainState(
        actor_critic=_init_actor_critic(
            env, config, hyperparameters, policy_key, value_key
        ),
        normalizer=normalization.init(env.observation_size),
        reward_decomposition=(
            reward_decomposition.init(
                decomposition_key, config, history, env.action_size
            )
            if config.decompose_rewards
            else None
        ),
        reward_normalizer=(
            reward_normalization.init(config.num_envs)
            if config.normalize_rewards
            else None
        ),
        environments=rollout.init(
            env,
            env_key,
            config.num_envs,
            age_limit=(
                max_episode_steps(env, config) if config.stagger_episodes else None
            ),
        ),
        history=history,
        # The config's buffer_steps is the size of the arrays. That of this run, which
        # may be traced, limits how many steps are filled.
        good_trajectories=good_trajectories.init(
            int(config.hyperparameters.buffer_steps), *sizes
        ),
        imitation=find_agent(config.agent).init(imitation_key, config, *sizes),
        hyperparameters=hyperparameters,
        key=key,
        iteration=jnp.int32(0),
    )


def _init_history(env: Any, config: Config) -> good_trajectories.History:
    return good_trajectories.init_history(
        config.num_envs,
        config.num_steps,
        max_episode_steps(env, config),
        env.observation_size,
        env.action_size,
        keep_next=config.decompose_rewards,
        num_episodes=(
            config.decomposition_history_episodes if config.decompose_rewards else 1
        ),
    )


def _networks(env: Any, config: Config) -> tuple[Any, Any]:
    # Typed as Any because Flax declares that `apply` may also return variables.
    return Policy(config.hidden_sizes, env.action_size), Value(config.hidden_sizes)


def _init_actor_critic(
    env: Any,
    config: Config,
    hyperparameters: Hyperparameters,
    policy_key: jax.Array,
    value_key: jax.Array,
) -> ActorCritic:
    policy, value = _networks(env, config)
    observation = jnp.zeros(env.observation_size)
    transform = ppo.optimizer(hyperparameters)
    num_streams = find_agent(config.agent).num_streams
    # The first value network uses the key itself, so that all agents initialize it
    # alike. `clone` allows this second use where JAX checks that keys are not reused.
    others = jax.random.split(jax.random.clone(value_key), num_streams)[1:]
    value_keys = [value_key, *others]
    policy_params = policy.init(policy_key, observation)
    policy_params["params"]["log_std"] += jnp.log(hyperparameters.initial_deviation)
    return ActorCritic(
        policy=learner.init(policy_params, transform),
        values=tuple(
            learner.init(value.init(key, observation), transform) for key in value_keys
        ),
    )


def _check_state(env: Any, config: Config, state: TrainState) -> None:
    """Raise `ValueError` where arrays would be broadcast, or steps lost, unnoticed."""
    if shape := jnp.shape(state.iteration):
        raise ValueError(
            f"state is a batch of {shape[0]} states: take one of them, or jax.vmap this"
        )
    validate_hyperparameters(config, state.hyperparameters)
    given = state.history.reward.shape
    needed = jax.eval_shape(lambda: _init_history(env, config)).reward.shape
    if given != needed:
        raise ValueError(
            f"state has a history of {given[1]} steps of {given[0]} environments: this "
            f"config needs {needed[1]} steps of {needed[0]}: make a new state with init"
        )
    parts = {
        "decompose_rewards": state.reward_decomposition,
        "normalize_rewards": state.reward_normalizer,
    }
    for name, part in parts.items():
        if getattr(config, name) != (part is not None):
            raise ValueError(
                f"{name} is {getattr(config, name)}, but the state was made with "
                f"{part is not None}: make a new state with init"
            )


@full_precision
def iterate(env: Any, config: Config, state: TrainState) -> tuple[TrainState, Metrics]:
    """Run one iteration of Algorithm 1: a batch of experience and the updates from it.

    Args:
      env: the environment that `init` was given.
      config: the config that `init` was given. Of its `hyperparameters` only the counts
        matter, as upper limits: the state has its own, which may be replaced.
      state: the state before the iteration.

    Returns:
      The next state, and metrics, float32 () each; means over the whole episodes that
      ended in the batch are NaN if none did.

    Raises:
      ValueError: if the state is a batch of states, has a hyperparameter that is not
        allowed, or is of a config with other sizes or rewards; if an agent's metric has
        a name that another metric has; or if one of the agent's functions returns too
        few or too many values, or a wrong shape or dtype.
    """
    _check_state(env, config, state)
    agent = checked(find_agent(config.agent), config.agent)
    hyperparameters = schedules.at(config, state.hyperparameters, state.iteration)
    key, act_key, imitate_key, ppo_key, policy_key, decompose_key = jax.random.split(
        state.key, 6
    )
    # Sample policy trajectories.
    environments, batch = sample_trajectories(
        env, config, state, act_key, hyperparameters
    )
    # Update the good-trajectory buffer.
    history, buffer = update_good_trajectories(config, state, batch, hyperparameters)
    # The buffer ranks episodes by the environment's own rewards. PPO and the agent
    # learn from rewards that may be decomposed and normalized.
    rewards, reward_metrics = learner_rewards(
        env,
        config,
        state,
        batch=batch,
        history=history,
        key=decompose_key,
        hyperparameters=hyperparameters,
    )
    context = make_context(
        env,
        config,
        state,
        rewards=rewards,
        buffer=buffer,
        hyperparameters=hyperparameters,
    )
    # Sample good trajectories, update the discriminator (equation 8) and shape the
    # reward with it (section 4.3); agents without a discriminator do other things here.
    imitation, streams, imitation_metrics = agent.update_and_reward(
        state.imitation, context, imitate_key
    )
    # Update the policy (equations 9 and 11).
    actor_critic, imitation, policy_metrics = update_policy(
        agent,
        state.actor_critic,
        imitation,
        rewards=streams,
        context=context,
        keys=(ppo_key, policy_key),
    )
    healthy, (actor_critic, imitation) = learner.keep_if_finite(
        (actor_critic, imitation), (state.actor_critic, state.imitation)
    )
    metrics: Metrics = {
        "env_steps": (state.iteration + 1).astype(jnp.float32) * config.batch_steps,
        "learning_rate": jnp.asarray(hyperparameters.learning_rate),
        "skipped_updates": ~(healthy & rewards.healthy),
        **rollout_metrics(batch, buffer),
        **reward_metrics,
    }
    state = state.replace(
        actor_critic=actor_critic,
        # Observations are normalized with the same numbers in acting and in learning,
        # so the normalizer is updated at the end.
        normalizer=normalization.update(
            state.normalizer,
            # Observations with a NaN are ignored.
            jnp.where(batch.faulty[..., None], jnp.nan, batch.observation),
        ),
        reward_decomposition=rewards.decomposition,
        reward_normalizer=rewards.normalizer,
        environments=environments,
        history=history,
        good_trajectories=buffer,
        imitation=imitation,
        key=key,
        iteration=state.iteration + 1,
    )
    return state, merge_metrics(
        config.agent, metrics, imitation_metrics, policy_metrics
    )


@jax.named_scope("rollout")
def sample_trajectories(
    env: Any,
    config: Config,
    state: TrainState,
    key: jax.Array,
    hyperparameters: Hyperparameters,
) -> tuple[rollout.EnvironmentStates, Rollout]:
    """Collect one batch of experience with the current policy.

    Args:
      env: one environment.
      config: sizes of the batch.
      state: with the policy and the running episodes.
      key: random key; consumed.
      hyperparameters: their values in this iteration.

    Returns:
      The running episodes after the batch, and the batch, (time, env, ...).
    """
    policy, _ = _networks(env, config)
    return rollout.collect(
        env,
        lambda observation: policy.apply(
            state.actor_critic.policy.params,
            normalization.normalize(state.normalizer, observation),
        ),
        state.environments,
        key,
        num_steps=config.num_steps,
        max_episode_steps=max_episode_steps(env, config),
        gamma=hyperparameters.gamma if config.buffer_discounts else 1.0,
    )


@jax.named_scope("good_trajectories")
def update_good_trajectories(
    config: Config, state: TrainState, batch: Rollout, hyperparameters: Hyperparameters
) -> tuple[good_trajectories.History, good_trajectories.GoodTrajectories]:
    """Insert the whole episodes that ended in a batch into the buffer.

    Args:
      config: its `buffer_episodes` limits the buffer.
      state: with the history and the buffer before the batch.
      batch: the batch, with the environment's own rewards.
      hyperparameters: its `buffer_steps` limits the buffer.

    Returns:
      The history with the batch recorded in it, and the buffer after the batch.
    """
    history = good_trajectories.record(
        state.history,
        batch.observation,
        batch.action,
        # A NaN marks an episode without a valid return: one with a faulty step, or one
        # that was cut short.
        jnp.where(batch.faulty | batch.cut_short, jnp.nan, batch.reward),
        batch.ended,
        batch.next_observation,
    )
    episodes = good_trajectories.ended_episodes(
        history, batch.ended, batch.discounted_return, batch.episode_length
    )
    return history, good_trajectories.insert(
        state.good_trajectories,
        history,
        episodes,
        max_steps=hyperparameters.buffer_steps,
        max_episodes=config.buffer_episodes,
    )


class Rewards(NamedTuple):
    """The rewards that PPO and the agent learn from, and the state of their models.

    Attributes:
      batch: the batch with these rewards, (time, env, ...).
      history: the history with these rewards, but not normalized.
      scale: float32 (), the number that the batch's rewards were divided by.
      decomposition: its state after the batch; None if rewards are not decomposed.
      normalizer: its state after the batch; None if rewards are not normalized.
      healthy: bool (), false if the update of the decomposition was not finite and was
        undone.
    """

    batch: Rollout
    history: good_trajectories.History
    scale: jax.Array
    decomposition: reward_decomposition.Decomposition | None
    normalizer: reward_normalization.RewardNormalizer | None
    healthy: jax.Array


@jax.named_scope("rewards")
def learner_rewards(
    env: Any,
    config: Config,
    state: TrainState,
    *,
    batch: Rollout,
    history: good_trajectories.History,
    key: jax.Array,
    hyperparameters: Hyperparameters,
) -> tuple[Rewards, Metrics]:
    """Decompose and normalize a batch's rewards, each if the config says so.

    Args:
      env: the environment, for its range of actions.
      config: the config.
      state: the state before the batch.
      batch: the batch, with the environment's own rewards.
      history: the history, with the batch recorded in it.
      key: random key; consumed.
      hyperparameters: their values in this iteration.

    Returns:
      The rewards, and metrics.
    """
    decomposition, healthy = None, jnp.bool_(True)
    metrics: Metrics = {}
    if state.reward_decomposition is not None:
        decomposition, batch, healthy, metrics = reward_decomposition.decompose(
            state.reward_decomposition,
            batch,
            history,
            state.normalizer,
            key,
            config=config,
            hyperparameters=hyperparameters,
            action_range=wrappers.action_range(env),
        )
        # The NaNs that mark episodes without a valid return must stay.
        no_return = jnp.isnan(history.reward)
        history = history.replace(
            reward=jnp.where(no_return, jnp.nan, decomposition.reward)
        )
    normalizer, scale = None, jnp.float32(1.0)
    if state.reward_normalizer is not None:
        normalizer = reward_normalization.update(
            state.reward_normalizer, batch.reward, batch.ended, hyperparameters.gamma
        )
        clip = hyperparameters.reward_clip
        scale = reward_normalization.scale(normalizer)
        clipped = reward_normalization.clipped(normalizer, batch.reward, clip)
        reward = reward_normalization.normalize(normalizer, batch.reward, clip)
        batch = batch.replace(reward=reward)
        metrics = {**metrics, "reward_scale": scale, "clipped_rewards": clipped}
    rewards = Rewards(batch, history, scale, decomposition, normalizer, healthy)
    return rewards, metrics


def make_context(
    env: Any,
    config: Config,
    state: TrainState,
    *,
    rewards: Rewards,
    buffer: good_trajectories.GoodTrajectories,
    hyperparameters: Hyperparameters,
) -> Context:
    """Return the data of an iteration that the agent's functions get.

    Args:
      env: the environment, for the sizes of the networks.
      config: the config.
      state: the state before the iteration.
      rewards: the batch and the history with the rewards to learn from.
      buffer: the buffer after the batch.
      hyperparameters: their values in this iteration.
    """
    policy, value = _networks(env, config)
    return Context(
        rollout=rewards.batch,
        history=rewards.history,
        good_trajectories=buffer,
        normalizer=state.normalizer,
        reward_scale=rewards.scale,
        hyperparameters=hyperparameters,
        config=config,
        policy=policy.apply,
        value=value.apply,
    )


@jax.named_scope("advantages")
def advantages(
    actor_critic: ActorCritic,
    rewards: jax.Array,
    context: Context,
    *,
    agent: Imitation,
    imitation: Any,
) -> tuple[ppo.Batch, Metrics]:
    """Return PPO's batch, with one advantage mixed from those of all reward streams.

    Args:
      actor_critic: the networks, with a value for each stream.
      rewards: float32 (time, env) for one stream, or (time, env, stream).
      context: the iteration's data.
      agent: its `mix` combines the streams' standardized advantages.
      imitation: the agent's state.

    Returns:
      The batch, (steps, ...), and metrics: those of `mix`, and "explained_variance",
      the share of the returns' variance that the values explain, averaged over streams.
    """
    batch = context.rollout
    if rewards.ndim == 2:
        rewards = rewards[..., None]
    observation = normalization.normalize(context.normalizer, batch.observation)
    values, advantage = ppo.evaluate_streams(
        actor_critic,
        rewards,
        observation,
        normalization.normalize(context.normalizer, batch.next_observation),
        batch.terminated,
        batch.ended,
        value=context.value,
        hyperparameters=context.hyperparameters,
    )
    returns = advantage + values
    mixed, metrics = agent.mix(imitation, ppo.standardize(advantage), context)
    flat = lambda x: x.reshape(-1, *x.shape[2:])
    residual = jnp.var(returns - values, axis=(0, 1))
    explained = 1.0 - residual / (jnp.var(returns, axis=(0, 1)) + 1e-8)
    return ppo.Batch(
        observation=flat(observation),
        action=flat(batch.action),
        log_prob=flat(batch.log_prob),
        advantage=flat(mixed),
        returns=flat(returns),
    ), merge_metrics(
        context.config.agent, {"explained_variance": jnp.mean(explained)}, metrics
    )


@jax.named_scope("update_policy")
def update_policy(
    agent: Imitation,
    actor_critic: ActorCritic,
    imitation: Any,
    *,
    rewards: jax.Array,
    context: Context,
    keys: tuple[jax.Array, jax.Array],
) -> tuple[ActorCritic, Any, Metrics]:
    """Update the policy and the values by PPO, then by the agent's `update_policy`.

    Args:
      agent: the agent.
      actor_critic: the networks before the update.
      imitation: the agent's state.
      rewards: float32 (time, env) for one stream, or (time, env, stream).
      context: the iteration's data.
      keys: random keys of PPO and of the agent's steps; both are consumed.

    Returns:
      The networks and the agent's state after the update, and metrics.
    """
    ppo_key, own_key = keys
    batch, advantage_metrics = advantages(
        actor_critic, rewards, context, agent=agent, imitation=imitation
    )
    actor_critic, ppo_metrics = ppo.update(
        actor_critic,
        batch,
        ppo_key,
        policy=context.policy,
        value=context.value,
        config=context.config,
        hyperparameters=context.hyperparameters,
    )
    imitation, actor_critic, own_metrics = agent.update_policy(
        imitation, actor_critic, context, own_key
    )
    metrics = merge_metrics(
        context.config.agent, ppo_metrics, advantage_metrics, own_metrics
    )
    return actor_critic, imitation, metrics


def rollout_metrics(
    batch: Rollout, buffer: good_trajectories.GoodTrajectories
) -> Metrics:
    """Return the metrics of a batch and of the buffer after it.

    Means over the whole episodes that ended in the batch are NaN if none did.

    Args:
      batch: the batch, (time, env, ...).
      buffer: the buffer after the batch.
    """
    completed = batch.completed
    mean = lambda x: jnp.sum(jnp.where(completed, x, 0)) / jnp.sum(completed)
    return {
        "episode_return": mean(batch.episode_return),
        "episode_length": mean(batch.episode_length),
        "episodes": jnp.sum(completed),
        "faulty_steps": jnp.sum(batch.faulty),
        "good_return": good_trajectories.mean_return(buffer),
        "good_steps": buffer.size,
    }


def merge_metrics(agent: str, metrics: Metrics, *more: Metrics) -> Metrics:
    """Return several groups of metrics as one, float32 scalars by name.

    Raises:
      ValueError: if two metrics have the same name, or one is not a single number.
    """
    for own in more:
        if taken := metrics.keys() & own.keys():
            raise ValueError(
                f"metrics of agent {agent!r} have names that other metrics have: "
                f"{', '.join(sorted(taken))}"
            )
        metrics = {**metrics, **own}
    for name, value in metrics.items():
        if shape := jnp.shape(value):
            raise ValueError(
                f"metric {name!r} of agent {agent!r} has shape {shape}: it must be one "
                "number"
            )
    return {name: jnp.asarray(x, jnp.float32) for name, x in metrics.items()}


class Train(Protocol):
    """The type of the function that `make_train` returns."""

    def __call__(
        self, key: jax.Array, hyperparameters: Hyperparameters | None = None
    ) -> tuple[TrainState, Metrics]:
        """Return the last state, and metrics (iterations,); consumes the key."""


def make_train(env: Any, config: Config) -> Train:
    """Return a pure function that trains from scratch for `config.total_steps`.

    Args:
      env: one environment with Brax's interface (`gasil_jax.make_env`, or any of
        ``brax.envs``), not wrapped to reset itself.
      config: the agent and its settings.

    Returns:
      ``train(key, hyperparameters=None) -> (TrainState, Metrics)``. The key is
      consumed; the default hyperparameters are the config's; metrics are float32
      (iterations,) each.

    Raises:
      ValueError: if the config can't train in the environment; nothing is compiled.
    """
    checks.check_environment(env)
    checks.check(env, config)

    def train(
        key: jax.Array, hyperparameters: Hyperparameters | None = None
    ) -> tuple[TrainState, Metrics]:
        return jax.lax.scan(
            lambda state, _: iterate(env, config, state),
            init(env, config, key, hyperparameters),
            length=config.num_iterations,
        )

    return train

"""Algorithm 1 of the paper: `init`, `train_step`, and `make_train`, their composition.

Everything is a pure function of a key: `jax.jit` it, `jax.vmap` it over keys or over
any hyperparameter, shard it over devices, call it from other JAX code.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
from flax import struct

from gasil_envs import user_code, wrappers
from gasil_envs.precision import full_precision
from gasil_jax import (
    checks,
    distributions,
    learner,
    normalization,
    ppo,
    rollout,
    schedules,
)
from gasil_jax.agents.interface import Checked
from gasil_jax.algorithms import Algorithm, check_numbers
from gasil_jax.buffer import History, init_history, record
from gasil_jax.context import Context, Metrics, sizes_of
from gasil_jax.distributions import Distribution
from gasil_jax.errors import shown
from gasil_jax.networks import Value
from gasil_jax.ppo import ActorCritic
from gasil_jax.rollout import Rollout


class TrainState(struct.PyTreeNode):
    """The complete state of a run: everything that its next iteration depends on.

    Attributes:
      actor_critic: the policy and value networks, with their optimizers' states.
      normalizer: running mean and variance of observations.
      environments: the running episodes, (env, ...).
      history: the last steps of each environment, (env, steps, ...); None if neither
        the agent nor a model of rewards needs them.
      rewards: the state of each model of rewards.
      agent: the state of the agent, such as its discriminator and its good-trajectory
        buffer.
      hyperparameters: the run's own numbers by name, float32 () each, before schedules.
      key: random key of the next iteration.
      iteration: int32 (), number of iterations done.
    """

    actor_critic: ActorCritic
    normalizer: normalization.Normalizer
    environments: rollout.EnvironmentStates
    history: History | None
    rewards: tuple[Any, ...]
    agent: Any
    hyperparameters: dict[str, jax.Array]
    key: jax.Array
    iteration: jax.Array


def max_episode_steps(env: Any) -> int:
    """Return the environment's limit, after which an episode is truncated, or 1000."""
    return int(getattr(env, "episode_length", 1000))


@full_precision
def init(
    env: Any,
    algorithm: Algorithm,
    key: jax.Array,
    hyperparameters: Mapping[str, Any] | None = None,
) -> TrainState:
    """Return the training state before the first iteration.

    Args:
      env: one environment with Brax's interface, not wrapped to reset itself.
      algorithm: how to learn.
      key: random key; consumed.
      hyperparameters: values that replace numbers of the algorithm, by name, such as
        ``{"alpha": 0.2}``; they may be traced.

    Raises:
      ValueError: if the algorithm can't train in the environment, if the key is no
        single random key, or if a number is out of its range and not traced.
    """
    checks.check(env, algorithm)
    checks.check_key(key)
    own = {} if hyperparameters is None else hyperparameters
    check_numbers(algorithm, own)
    return first_state(env, algorithm.replace(**own), key)


def first_state(env: Any, algorithm: Algorithm, key: jax.Array) -> TrainState:
    """Return the same state as `init`, without checking the arguments.

    So a stored run can be loaded where it could not be trained, for example because its
    expert's file is gone.

    Args:
      env: one environment.
      algorithm: with the run's own numbers, which may be traced.
      key: random key; consumed.
    """
    numbers = {
        name: jnp.asarray(value, jnp.float32)
        for name, value in algorithm.hyperparameters.items()
    }
    key, policy_key, value_key, env_key, agent_key, rewards_key = jax.random.split(
        key, 6
    )
    config = algorithm.config
    return TrainState(
        actor_critic=_init_actor_critic(
            env,
            algorithm,
            numbers["initial_std"],
            policy_key=policy_key,
            value_key=value_key,
        ),
        normalizer=normalization.init(env.observation_size),
        environments=rollout.init(
            env,
            env_key,
            config.num_envs,
            age_limit=max_episode_steps(env) if config.stagger_episodes else None,
        ),
        **_init_memory(env, algorithm, agent_key, rewards_key=rewards_key),
        hyperparameters=numbers,
        key=key,
        iteration=jnp.int32(0),
    )


def _init_memory(
    env: Any, algorithm: Algorithm, agent_key: jax.Array, *, rewards_key: jax.Array
) -> dict[str, Any]:
    """Return the history and the states of the agent and of the models of rewards."""
    history = _init_history(env, algorithm)
    history_steps = 0 if history is None else history.reward.shape[1]
    sizes = sizes_of(env, algorithm.config.num_envs, history_steps)
    models = algorithm.rewards
    keys = _keys(rewards_key, len(models))
    return {
        "history": history,
        "rewards": tuple(
            model.init(key, sizes) for model, key in zip(models, keys, strict=True)
        ),
        "agent": algorithm.agent.init(agent_key, sizes),
    }


def _keys(key: jax.Array, count: int) -> list[jax.Array]:
    """Return a key for each of several parts; the first one is the key itself.

    So what the first part draws does not depend on how many there are. `clone` allows
    this second use where JAX checks that keys are not reused.
    """
    return [key, *jax.random.split(jax.random.clone(key), max(count, 1))[1:]][:count]


def _init_history(env: Any, algorithm: Algorithm) -> History | None:
    """Return an empty history, as long as the longest that a part asks for."""
    agent, models, config = algorithm.agent, algorithm.rewards, algorithm.config
    episodes = [agent.history_episodes, *(model.history_episodes for model in models)]
    if max(episodes) == 0:
        return None
    return init_history(
        config.num_envs,
        config.num_steps,
        max_episode_steps(env),
        observation_size=env.observation_size,
        action_size=wrappers.action_size(env),
        keep_next=any(model.keeps_next_observation for model in models),
        num_episodes=max(episodes),
    )


def _networks(env: Any, algorithm: Algorithm) -> tuple[Any, Any, Distribution]:
    """Return the policy's network, the value's, and the distribution of actions."""
    # Typed as Any because Flax declares that `apply` may also return variables.
    agent, config = algorithm.agent, algorithm.config
    widths, components = config.hidden_sizes, config.policy_components
    distribution = distributions.of(env, components)
    layers = (config.activation, config.layer_norm)
    sizes = sizes_of(env, config.num_envs)
    own_policy, own_value = agent.policy_network(sizes), agent.value_network(sizes)
    policy = distribution.network(
        widths, sizes.action, *layers, own=own_policy, components=components
    )
    return policy, own_value or Value(widths, *layers), distribution


def _init_actor_critic(
    env: Any,
    algorithm: Algorithm,
    initial_std: jax.Array,
    *,
    policy_key: jax.Array,
    value_key: jax.Array,
) -> ActorCritic:
    policy, value, distribution = _networks(env, algorithm)
    observation = jnp.zeros(env.observation_size)
    transform = ppo.optimizer(algorithm.config)
    policy_params = policy.init(policy_key, observation)
    policy_params = distribution.explore(policy_params, initial_std)
    trained = learner.init(policy_params, transform)
    return ActorCritic(
        policy=trained if policy.own is None else trained.replace(network=policy),
        values=tuple(
            learner.init(value.init(key, observation), transform)
            for key in _keys(value_key, algorithm.agent.num_streams)
        ),
    )


def _check_state(env: Any, algorithm: Algorithm, state: TrainState) -> None:
    """Raise `ValueError` if the state's arrays do not fit the algorithm.

    JAX would broadcast such arrays, or leave out steps, without an error.
    """
    checks.check_state(state)
    check_numbers(algorithm, state.hyperparameters)
    key = jax.random.key(0)
    needed = jax.eval_shape(lambda: _init_memory(env, algorithm, key, rewards_key=key))
    number = jax.ShapeDtypeStruct((), jnp.float32)
    needed["hyperparameters"] = dict.fromkeys(algorithm.hyperparameters, number)
    lengths = jax.ShapeDtypeStruct((algorithm.config.num_envs,), jnp.int32)
    needed["environments.episode_length"] = lengths
    given = {name: getattr(state, name) for name in ("history", "rewards", "agent")}
    given["hyperparameters"] = dict.fromkeys(state.hyperparameters, number)
    given["environments.episode_length"] = state.environments.episode_length
    if change := user_code.first_change(needed, given):
        path, expected, actual = change
        part, rest = path.removeprefix("['").split("']", 1)
        raise ValueError(
            f"state.{part}{rest} is {actual}: this algorithm needs {expected}: make a "
            "new state with init"
        )


@full_precision
def train_step(
    env: Any, algorithm: Algorithm, state: TrainState, *, data: Any = None
) -> tuple[TrainState, Metrics]:
    """Run one iteration of Algorithm 1: a batch of experience and the updates from it.

    Args:
      env: the environment that `init` was given.
      algorithm: the algorithm that `init` was given. Its numbers do not matter: the
        state has its own, which may be replaced.
      state: the state before the iteration.
      data: what `algorithm.agent.data()` returns; if it is not given, it is read while
        this is traced, and is a constant of the program.

    Returns:
      The next state, and metrics, float32 () each; means over the whole episodes that
      ended in the batch are NaN if none did.

    Raises:
      ValueError: if the state is a batch of states, has a hyperparameter that is not
        allowed, or is of an algorithm with other sizes or rewards; if an agent's metric
        has a name that another metric has; or if one of the agent's functions returns
        too few or too many values, or a wrong shape or dtype.
    """
    _check_state(env, algorithm, state)
    data = algorithm.agent.data() if data is None else data
    algorithm = schedules.at(algorithm, state.hyperparameters, state.iteration)
    keys = Keys(*jax.random.split(state.key, 6))
    experience = collect(env, algorithm, state, keys=keys, data=data)
    return learn(algorithm, state, experience, keys=keys)


class Keys(NamedTuple):
    """The random keys of an iteration; each is consumed once.

    Attributes:
      state: the key of the next state.
      act: draws the policy's actions and the environments' new starts.
      agent: for the agent's `update_and_reward`.
      ppo: shuffles PPO's minibatches.
      policy: for the agent's `update_policy`.
      rewards: for the models of rewards.
    """

    state: jax.Array
    act: jax.Array
    agent: jax.Array
    ppo: jax.Array
    policy: jax.Array
    rewards: jax.Array


class Experience(NamedTuple):
    """What is known of a batch before the agent and the policy learn from it.

    Attributes:
      batch: the batch, (time, env, ...), with the environment's own rewards.
      context: the data that the agent gets.
      environments: the running episodes after the batch.
      history: the history after the batch, with the environment's own rewards.
      rewards: the states of the models of rewards after the batch.
      healthy: bool (), false if a model's update was not finite and was undone.
      metrics: metrics of the models of rewards.
    """

    batch: Rollout
    context: Context
    environments: rollout.EnvironmentStates
    history: History | None
    rewards: tuple[Any, ...]
    healthy: jax.Array
    metrics: Metrics


def collect(
    env: Any, algorithm: Algorithm, state: TrainState, *, keys: Keys, data: Any
) -> Experience:
    """Sample policy trajectories, and make the rewards to learn from.

    Args:
      env: one environment.
      algorithm: with its numbers in this iteration.
      state: the state before the iteration.
      keys: the iteration's keys, of which `act` and `rewards` are consumed.
      data: the agent's data.
    """
    config = algorithm.config
    environments, batch = sample_trajectories(env, algorithm, state, key=keys.act)
    history = None if state.history is None else _record(state.history, batch)
    policy, value, distribution = _networks(env, algorithm)
    context = Context(
        rollout=batch,
        history=history,
        normalizer=state.normalizer,
        reward_scale=jnp.float32(1.0),
        action_range=wrappers.action_range(env),
        config=config,
        policy=policy.apply,
        distribution=distribution,
        value=value.apply,
        data=jax.tree.map(jnp.asarray, data),
    )
    metrics: Metrics = {}
    states, healthy = [], jnp.bool_(True)
    model_keys = _keys(keys.rewards, len(algorithm.rewards))
    with jax.named_scope("rewards"):
        for model, before, key in zip(algorithm.rewards, state.rewards, model_keys):
            after, context, is_sound, own = model.update(before, context, key)
            states.append(after)
            healthy &= is_sound
            name = f"reward model {type(model).__name__}"
            metrics = merge_metrics(name, metrics, own)
    return Experience(
        batch, context, environments, history, tuple(states), healthy, metrics
    )


def learn(
    algorithm: Algorithm, state: TrainState, experience: Experience, *, keys: Keys
) -> tuple[TrainState, Metrics]:
    """Update the agent and the policy from a batch.

    Args:
      algorithm: with its numbers in this iteration.
      state: the state before the iteration.
      experience: the batch, from `collect`.
      keys: the iteration's keys, of which those that `collect` leaves are consumed.

    Returns:
      The next state, and metrics.
    """
    agent, config = Checked(algorithm.agent), algorithm.config
    batch, context = experience.batch, experience.context
    # Update the good-trajectory buffer, which ranks episodes by the environment's own
    # rewards.
    remembered = agent.remember(state.agent, context)
    # Sample good trajectories, update the discriminator (equation 8) and shape the
    # reward with it (section 4.3); agents without a discriminator do other things here.
    agent_state, streams, agent_metrics = agent.update_and_reward(
        remembered, context, keys.agent
    )
    # Update the policy (equations 9 and 11).
    actor_critic, agent_state, policy_metrics = update_policy(
        agent,
        state.actor_critic,
        agent_state,
        rewards=streams,
        context=context,
        keys=(keys.ppo, keys.policy),
    )
    healthy, (actor_critic, agent_state) = learner.keep_if_finite(
        (actor_critic, agent_state), (state.actor_critic, remembered)
    )
    metrics: Metrics = {
        "env_steps": (state.iteration + 1).astype(jnp.float32) * config.batch_steps,
        "learning_rate": jnp.asarray(config.learning_rate),
        "skipped_updates": ~(healthy & experience.healthy),
        **rollout_metrics(batch),
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
        environments=experience.environments,
        history=experience.history,
        rewards=experience.rewards,
        agent=agent_state,
        key=keys.state,
        iteration=state.iteration + 1,
    )
    return state, merge_metrics(
        f"agent {algorithm.agent.name!r}",
        metrics,
        experience.metrics,
        agent_metrics,
        policy_metrics,
    )


@jax.named_scope("rollout")
def sample_trajectories(
    env: Any, algorithm: Algorithm, state: TrainState, *, key: jax.Array
) -> tuple[rollout.EnvironmentStates, Rollout]:
    """Collect one batch of experience with the current policy.

    Args:
      env: one environment.
      algorithm: with its numbers in this iteration.
      state: with the policy and the running episodes.
      key: random key; consumed.

    Returns:
      The running episodes after the batch, and the batch, (time, env, ...).
    """
    config = algorithm.config
    policy, _, distribution = _networks(env, algorithm)
    return rollout.collect(
        env,
        lambda observation: policy.apply(
            state.actor_critic.policy.params,
            normalization.normalize(state.normalizer, observation),
        ),
        state.environments,
        key,
        distribution=distribution,
        num_steps=config.num_steps,
        max_episode_steps=max_episode_steps(env),
        gamma=config.gamma,
    )


@jax.named_scope("good_trajectories")
def _record(history: History, batch: Rollout) -> History:
    """Return the history with a batch recorded in it."""
    return record(
        history,
        batch.observation,
        batch.action,
        # A NaN marks an episode without a valid return: one with a faulty step, or one
        # that was cut short.
        reward=jnp.where(batch.faulty | batch.cut_short, jnp.nan, batch.reward),
        ended=batch.ended,
        next_observation=batch.next_observation,
    )


@jax.named_scope("advantages")
def advantages(
    actor_critic: ActorCritic,
    rewards: jax.Array,
    context: Context,
    *,
    agent: Checked,
    agent_state: Any,
) -> tuple[ppo.Batch, Metrics]:
    """Return PPO's batch, with one advantage mixed from those of all reward streams.

    Args:
      actor_critic: the networks, with a value for each stream.
      rewards: float32 (time, env) for one stream, or (time, env, stream).
      context: the iteration's data.
      agent: its `mix` combines the streams' standardized advantages.
      agent_state: the agent's state.

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
        next_observation=normalization.normalize(
            context.normalizer, batch.next_observation
        ),
        terminated=batch.terminated,
        ended=batch.ended,
        value=context.value,
        config=context.config,
    )
    returns = advantage + values
    mixed, metrics = agent.mix(agent_state, ppo.standardize(advantage), context)

    def flat(x: jax.Array) -> jax.Array:
        return x.reshape(-1, *x.shape[2:])

    residual = jnp.var(returns - values, axis=(0, 1))
    explained = 1.0 - residual / (jnp.var(returns, axis=(0, 1)) + 1e-8)
    return ppo.Batch(
        observation=flat(observation),
        action=flat(batch.action),
        log_prob=flat(batch.log_prob),
        advantage=flat(mixed),
        returns=flat(returns),
    ), merge_metrics(
        f"agent {agent.name!r}", {"explained_variance": jnp.mean(explained)}, metrics
    )


@jax.named_scope("update_policy")
def update_policy(
    agent: Checked,
    actor_critic: ActorCritic,
    agent_state: Any,
    *,
    rewards: jax.Array,
    context: Context,
    keys: tuple[jax.Array, jax.Array],
) -> tuple[ActorCritic, Any, Metrics]:
    """Update the policy and the values by PPO, then by the agent's `update_policy`.

    Args:
      agent: the agent.
      actor_critic: the networks before the update.
      agent_state: the agent's state.
      rewards: float32 (time, env) for one stream, or (time, env, stream).
      context: the iteration's data.
      keys: random keys of PPO and of the agent's steps; both are consumed.

    Returns:
      The networks and the agent's state after the update, and metrics.
    """
    ppo_key, own_key = keys
    batch, advantage_metrics = advantages(
        actor_critic, rewards, context, agent=agent, agent_state=agent_state
    )
    actor_critic, ppo_metrics = ppo.update(
        actor_critic,
        batch,
        ppo_key,
        policy=context.policy,
        distribution=context.distribution,
        value=context.value,
        config=context.config,
    )
    agent_state, actor_critic, own_metrics = agent.update_policy(
        agent_state, actor_critic, context, own_key
    )
    metrics = merge_metrics(
        f"agent {agent.name!r}", ppo_metrics, advantage_metrics, own_metrics
    )
    return actor_critic, agent_state, metrics


def rollout_metrics(batch: Rollout) -> Metrics:
    """Return the metrics of a batch, (time, env, ...).

    Means over the whole episodes that ended in the batch are NaN if none did.
    """
    completed = batch.completed

    def mean(x: jax.Array) -> jax.Array:
        return jnp.sum(jnp.where(completed, x, 0)) / jnp.sum(completed)

    return {
        "episode_return": mean(batch.episode_return),
        "episode_length": mean(batch.episode_length),
        "episodes": jnp.sum(completed),
        "faulty_steps": jnp.sum(batch.faulty),
    }


def merge_metrics(source: str, metrics: Metrics, *more: Metrics) -> Metrics:
    """Return several groups of metrics as one, float32 scalars by name.

    Args:
      source: what computed the metrics, for the error message, such as "agent 'ppo'".
      metrics: the first group.
      *more: the other groups.

    Raises:
      ValueError: if two metrics have the same name, or one is not a single number.
    """
    for own in more:
        if taken := metrics.keys() & own.keys():
            raise ValueError(
                f"metrics of {source} have names that other metrics have: "
                f"{', '.join(sorted(taken))}"
            )
        metrics = {**metrics, **own}
    numbers: dict[str, jax.Array] = {}
    for name, value in metrics.items():
        what = f"metric {shown(name)} of {source}"
        if not isinstance(name, str):
            raise ValueError(f"{what}: its name must be a string")
        try:
            numbers[name] = jnp.asarray(value, jnp.float32)
        except (TypeError, ValueError):
            raise ValueError(
                f"{what} is {shown(value)}: it must be one number"
            ) from None
        if shape := numbers[name].shape:
            raise ValueError(f"{what} has shape {shape}: it must be one number")
    return numbers


class Train(Protocol):
    """The type of the function that `make_train` returns."""

    def __call__(
        self,
        key: jax.Array,
        hyperparameters: Mapping[str, Any] | None = None,
        data: Any = None,
    ) -> tuple[TrainState, Metrics]:
        """Return the last state, and metrics (iterations,); consumes the key."""


def make_train(env: Any, algorithm: Algorithm) -> Train:
    """Return a pure function that trains from scratch for `total_steps`.

    Args:
      env: one environment with Brax's interface (`gasil_jax.make_env`, or any of
        ``brax.envs``), not wrapped to reset itself.
      algorithm: how to learn: an agent, models of rewards, and the config.

    Returns:
      ``train(key, hyperparameters=None, data=None) -> (TrainState, Metrics)``. The key
      is consumed; hyperparameters are values that replace numbers of the algorithm, by
      name, such as ``{"alpha": 0.2}``; data is as in `train_step`; metrics are float32
      (iterations,) each.

    Raises:
      ValueError: if the algorithm can't train in the environment; nothing is compiled.
    """
    checks.check_environment(env)
    checks.check(env, algorithm)

    def train(
        key: jax.Array,
        hyperparameters: Mapping[str, Any] | None = None,
        data: Any = None,
    ) -> tuple[TrainState, Metrics]:
        return jax.lax.scan(
            lambda state, _: train_step(env, algorithm, state, data=data),
            init(env, algorithm, key, hyperparameters),
            length=algorithm.config.num_iterations,
        )

    return train

"""Algorithm 1 of the paper: `init`, `train_step`, and `make_train`, their composition.

Everything is a pure function of a key: `jax.jit` it, `jax.vmap` it over keys or over
any hyperparameter, shard it over devices, call it from other JAX code.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from gasil_envs import wrappers
from gasil_envs.precision import full_precision
from gasil_jax import checks, distributions, learner, normalization, ppo, rollout
from gasil_jax.agents.interface import call
from gasil_jax.algorithms import Algorithm, check_numbers
from gasil_jax.config import validate_key, validate_state
from gasil_jax.context import Context, Metrics, merge_metrics, sizes_of
from gasil_jax.distributions import Distribution
from gasil_jax.networks import Value
from gasil_jax.ppo import ActorCritic
from gasil_jax.rollout import History, Rollout


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


def make_train(
    env: Any, algorithm: Algorithm
) -> Callable[..., tuple[TrainState, Metrics]]:
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
            _begin(env, algorithm, key, hyperparameters),
            length=algorithm.config.num_iterations,
        )

    return train


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
    return _begin(env, algorithm, key, hyperparameters)


def _begin(
    env: Any,
    algorithm: Algorithm,
    key: jax.Array,
    hyperparameters: Mapping[str, Any] | None,
) -> TrainState:
    validate_key(key)
    own = {} if hyperparameters is None else hyperparameters
    check_numbers(algorithm, own)
    return first_state(env, algorithm.replace(**own), key)


@full_precision
def first_state(env: Any, algorithm: Algorithm, key: jax.Array) -> TrainState:
    """Return the same state as `init`, without checking the arguments.

    So a stored run can be loaded where it could not be trained, for example because its
    expert's file is gone.
    """
    agent, config, models = algorithm.agent, algorithm.config, algorithm.rewards
    numbers = {
        name: jnp.asarray(value, jnp.float32)
        for name, value in algorithm.hyperparameters.items()
    }
    key, policy_key, value_key, env_key, agent_key, rewards_key = jax.random.split(
        key, 6
    )
    age_limit = rollout.max_episode_steps(env) if config.stagger_episodes else None
    history = _init_history(env, algorithm)
    history_steps = 0 if history is None else history.reward.shape[1]
    sizes = sizes_of(env, config.num_envs, history_steps)
    return TrainState(
        actor_critic=_init_actor_critic(
            env, algorithm, numbers["initial_std"], keys=(policy_key, value_key)
        ),
        normalizer=normalization.init(env.observation_size),
        environments=rollout.init(env, env_key, config.num_envs, age_limit=age_limit),
        history=history,
        rewards=tuple(
            model.init(model_key, sizes)
            for model, model_key in zip(models, _keys(rewards_key, len(models)))
        ),
        agent=agent.init(agent_key, sizes),
        hyperparameters=numbers,
        key=key,
        iteration=jnp.int32(0),
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
      state: the state before the iteration, of one run.
      data: what `algorithm.agent.data()` returns; if it is not given, it is read while
        this is traced, and is a constant of the program.

    Returns:
      The next state, and metrics, float32 () each; means over the whole episodes that
      ended in the batch are NaN if none did.

    Raises:
      ValueError: if the state is a batch of states, or if one of the agent's functions
        returns what it must not; the message names the function.
    """
    validate_state(state)
    data = algorithm.agent.data() if data is None else data
    algorithm = algorithm.at(state.hyperparameters, state.iteration)
    keys = Keys(*jax.random.split(state.key, 6))
    experience = collect(env, algorithm, state, keys=keys, data=data)
    return learn(algorithm, experience, keys=keys)


class Keys(NamedTuple):
    """The random keys of an iteration; each is consumed once."""

    state: jax.Array  # of the next state
    act: jax.Array  # draws actions and the environments' new starts
    agent: jax.Array  # for the agent's `update_and_reward`
    ppo: jax.Array  # shuffles PPO's minibatches
    policy: jax.Array  # for the agent's `update_policy`
    rewards: jax.Array  # for the models of rewards


class Experience(NamedTuple):
    """What is known of a batch before the agent and the policy learn from it."""

    state: TrainState  # after the batch; networks and agent are still the old ones
    steps: Rollout  # (time, env, ...), with the environment's own rewards
    context: Context  # what the agent gets, with the rewards of the models
    healthy: jax.Array  # bool (), false if a model's update was undone
    metrics: Metrics  # of the models of rewards


def collect(
    env: Any, algorithm: Algorithm, state: TrainState, *, keys: Keys, data: Any
) -> Experience:
    """Sample policy trajectories, and make the rewards to learn from."""
    policy, value, distribution = _networks(env, algorithm)
    with jax.named_scope("rollout"):
        environments, batch = rollout.collect(
            env,
            lambda observation: policy.apply(
                state.actor_critic.policy.params,
                normalization.normalize(state.normalizer, observation),
            ),
            state.environments,
            keys.act,
            distribution=distribution,
            num_steps=algorithm.config.num_steps,
            max_episode_steps=rollout.max_episode_steps(env),
            gamma=algorithm.config.gamma,
        )
    history = None if state.history is None else rollout.record(state.history, batch)
    context = Context(
        rollout=batch,
        history=history,
        normalizer=state.normalizer,
        reward_scale=jnp.float32(1.0),
        action_range=wrappers.action_range(env),
        config=algorithm.config,
        policy=policy.apply,
        distribution=distribution,
        value=value.apply,
        data=jax.tree.map(jnp.asarray, data),
    )
    metrics: Metrics = {}
    rewards, healthy = [], jnp.bool_(True)
    model_keys = _keys(keys.rewards, len(algorithm.rewards))
    with jax.named_scope("rewards"):
        for model, before, key in zip(algorithm.rewards, state.rewards, model_keys):
            after, context, is_finite, own = call(model, "update", before, context, key)
            rewards.append(after)
            healthy &= is_finite
            metrics = merge_metrics(f"model of rewards {model.name!r}", metrics, own)
    state = state.replace(
        environments=environments, history=history, rewards=tuple(rewards)
    )
    return Experience(state, batch, context, healthy, metrics)


def learn(
    algorithm: Algorithm, experience: Experience, *, keys: Keys
) -> tuple[TrainState, Metrics]:
    """Update the agent and the policy from a batch."""
    agent, config = algorithm.agent, algorithm.config
    state, steps, context, healthy, model_metrics = experience
    # Update the good-trajectory buffer, which ranks episodes by the environment's own
    # rewards.
    remembered = call(agent, "remember", state.agent, context)
    # Sample good trajectories, update the discriminator (equation 8) and shape the
    # reward with it (section 4.3); agents without a discriminator do other things here.
    agent_state, rewards, agent_metrics = call(
        agent, "update_and_reward", remembered, context, keys.agent
    )
    # Update the policy (equations 9 and 11), by PPO and then by the agent's own steps.
    with jax.named_scope("update_policy"):
        advantages, returns, value_metrics = ppo.advantages(
            state.actor_critic, rewards, context
        )
        advantage, mix_metrics = call(agent, "mix", agent_state, advantages, context)
        batch = ppo.batch_of(context, advantage, returns)
        actor_critic, ppo_metrics = ppo.update(
            state.actor_critic, batch, keys.ppo, context
        )
        agent_state, actor_critic, policy_metrics = call(
            agent, "update_policy", agent_state, actor_critic, context, keys.policy
        )
    is_finite, (actor_critic, agent_state) = learner.keep_if_finite(
        (actor_critic, agent_state), (state.actor_critic, remembered)
    )
    metrics = merge_metrics(
        f"agent {agent.name!r}",
        {
            "env_steps": (state.iteration + 1).astype(jnp.float32) * config.batch_steps,
            "learning_rate": jnp.asarray(config.learning_rate),
            "skipped_updates": ~(is_finite & healthy),
        },
        rollout.metrics(steps),
        agent_metrics,
        ppo_metrics,
        value_metrics,
        mix_metrics,
        policy_metrics,
    )
    metrics = merge_metrics("a model of rewards", metrics, model_metrics)
    return state.replace(
        actor_critic=actor_critic,
        # Observations are normalized with the same numbers in acting and in learning,
        # so the normalizer is updated at the end. Those with a NaN are ignored.
        normalizer=normalization.update(
            state.normalizer,
            jnp.where(steps.faulty[..., None], jnp.nan, steps.observation),
        ),
        agent=agent_state,
        key=keys.state,
        iteration=state.iteration + 1,
    ), metrics


def _init_actor_critic(
    env: Any, algorithm: Algorithm, initial_std: jax.Array, *, keys: Any
) -> ActorCritic:
    policy, value, distribution = _networks(env, algorithm)
    policy_key, value_key = keys
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


def _init_history(env: Any, algorithm: Algorithm) -> History | None:
    """Return an empty history, as long as the longest that a part asks for."""
    models, config = algorithm.rewards, algorithm.config
    asked = [algorithm.agent.history_episodes, *(x.history_episodes for x in models)]
    if max(asked) == 0:
        return None
    return rollout.init_history(
        config.num_envs,
        config.num_steps,
        rollout.max_episode_steps(env),
        observation_size=env.observation_size,
        action_size=wrappers.action_size(env),
        keep_next=any(model.keeps_next_observation for model in models),
        num_episodes=max(asked),
    )


def _networks(env: Any, algorithm: Algorithm) -> tuple[Any, Any, Distribution]:
    """Return the policy's network, the value's, and the distribution of actions."""
    # Typed as Any because Flax declares that `apply` may also return variables.
    agent, config = algorithm.agent, algorithm.config
    distribution = distributions.of(env, config.policy_components)
    layers = (config.activation, config.layer_norm)
    sizes = sizes_of(env, config.num_envs)
    policy = distribution.network(
        config.hidden_sizes,
        sizes.action,
        *layers,
        own=agent.policy_network(sizes),
        components=config.policy_components,
    )
    value = agent.value_network(sizes) or Value(config.hidden_sizes, *layers)
    return policy, value, distribution


def _keys(key: jax.Array, count: int) -> list[jax.Array]:
    """Return a key for each of several parts; the first one is the key itself.

    So what the first part draws does not depend on how many there are. `clone` allows
    this second use where JAX checks that keys are not reused.
    """
    return [key, *jax.random.split(jax.random.clone(key), max(count, 1))[1:]][:count]

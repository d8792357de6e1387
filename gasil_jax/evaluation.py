"""Evaluate the policy of a training state in complete episodes."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gasil_envs import wrappers
from gasil_envs.precision import full_precision
from gasil_jax import checks, policy, rollout
from gasil_jax.algorithms import Algorithm
from gasil_jax.config import Range, validate_key, validate_switch
from gasil_jax.errors import refusal, shown

_COUNT = Range(1, 2**31 - 1, whole=True)


@full_precision
def evaluate(
    env: Any,
    algorithm: Algorithm,
    state: Any,
    *,
    key: jax.Array,
    num_episodes: int,
    deterministic: bool = True,
) -> dict[str, jax.Array]:
    """Run complete episodes with the policy of one training state; a pure function.

    Returns are sums of the environment's true reward, undelayed and undiscounted.

    Args:
      env: one environment.
      algorithm: the algorithm of the run.
      state: the training state of one run, not of a batch.
      key: random key; consumed.
      num_episodes: number of episodes, which run in parallel.
      deterministic: whether to act with the policy's mean; else actions are drawn.

    Returns:
      "episode_return", float32, and "episode_length", int32, (num_episodes,) each.

    Raises:
      ValueError: if the state is a batch of states, if the key is no single random key,
        or if the number of episodes is not a whole number, 1 or more.
    """
    return run_episodes(
        env,
        policy.from_state(state, env),
        key,
        num_episodes=num_episodes,
        num_steps=rollout.max_episode_steps(env),
        deterministic=deterministic,
    )


@full_precision
def run_episodes(
    env: Any,
    act: Callable[..., jax.Array],
    key: jax.Array,
    *,
    num_episodes: int,
    num_steps: int,
    deterministic: bool = True,
) -> dict[str, jax.Array]:
    """Do what `evaluate` does, with a policy ``act(observation, key)`` -> action.

    Episodes are truncated after `num_steps` steps.
    """
    checks.check_environment(env)
    validate_key(key)
    if num_episodes not in _COUNT:
        raise refusal("num_episodes", num_episodes, _COUNT)
    validate_switch("deterministic", deterministic)
    if not callable(act):
        raise refusal("act", act, "a function of observations and a key")
    shape = (int(num_episodes), *wrappers.zero_action(env).shape)
    reset_key, act_key = jax.random.split(key)

    def step(carry: Any, key: jax.Array) -> Any:
        states, running, return_, length = carry
        observation = states.obs
        action = act(observation, None if deterministic else key)
        given = getattr(action, "shape", None)
        if given != shape:
            returned = shown(action) if given is None else f"an array of shape {given}"
            raise ValueError(f"act returns {returned}: it must be of shape {shape}")
        states = jax.vmap(env.step)(states, action)
        reward = states.info.get("true_reward", states.reward)
        sound = wrappers.step_is_sound(observation, states)
        # As in training, a step of failed physics ends the episode with reward 0.
        return_ = return_ + jnp.where(running & sound, reward, 0.0)
        length = length + running
        ended = (states.done > 0) | wrappers.truncated(states)
        running = running & ~ended & sound
        return (states, running, return_, length), None

    states = jax.vmap(env.reset)(jax.random.split(reset_key, num_episodes))
    start = (
        # As in training, no episode ends with its reset.
        states.replace(done=jnp.zeros_like(states.done)),
        jnp.ones(num_episodes, bool),
        jnp.zeros(num_episodes),
        jnp.zeros(num_episodes, jnp.int32),
    )
    keys = jax.random.split(act_key, num_steps)
    _, _, return_, length = jax.lax.scan(step, start, keys)[0]
    return {"episode_return": return_, "episode_length": length}


def evaluate_in_gymnasium(
    gymnasium_id: str,
    act: Callable[[np.ndarray], np.ndarray],
    *,
    num_episodes: int,
    seed: int = 0,
    num_steps: int | None = None,
) -> dict[str, np.ndarray]:
    """Run complete episodes, one after the other, in Gymnasium, with MuJoCo in C.

    Args:
      gymnasium_id: name of the task, such as "Walker2d-v5".
      act: observation -> action, as from `numpy_policy.load`.
      num_episodes: number of episodes.
      seed: seed of the first episode; each next episode has the next seed.
      num_steps: steps after which an episode is truncated; default the task's own.

    Returns what `evaluate` does.
    """
    import gymnasium  # Here alone: it takes long.

    env = gymnasium.make(gymnasium_id, max_episode_steps=num_steps)
    returns, lengths = [], []
    for episode in range(num_episodes):
        observation, _ = env.reset(seed=seed + episode)
        total, length, running = 0.0, 0, True
        while running:
            observation, reward, terminated, truncated, _ = env.step(act(observation))
            total, length = total + float(reward), length + 1
            running = not (terminated or truncated)
        returns.append(total)
        lengths.append(length)
    env.close()
    return {"episode_return": np.array(returns), "episode_length": np.array(lengths)}

"""Wrappers that compose with every Brax-style environment.

Each keeps its own state in ``State.info`` and leaves the keys of the wrappers
below it alone. Order, innermost first: `ActionNoise`, `EpisodeLimit` (it decides when
an episode ends), `RewardDelay` (it must see that end), `DelayPhase`,
`ObservationNoise`, `AutoReset`.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gasil_envs.base import Env, State, Wrapper

#: C MuJoCo's mjMAXVAL: a larger number means that the simulation has failed.
_LARGEST = 1e10


def truncated(state: State) -> jax.Array:
    """Return whether the episode was cut off in this step, bool, the shape of ``done``.

    It is false if the environment has no ``info["truncation"]``.
    """
    return state.info.get("truncation", jnp.zeros_like(state.done)) > 0


def is_sound(x: jax.Array) -> jax.Array:
    """Return whether each number is finite and below 1e10 in size, bool, x's shape."""
    return jnp.abs(x) < _LARGEST  # False for NaN.


def step_is_sound(observation: jax.Array, stepped: State) -> jax.Array:
    """Return whether the physics of a step is sound, bool (...).

    It has failed if `is_sound` is false for any number in the observations before and
    after it, in the reward (given, true or held back), in ``done`` or in the
    truncation.
    """
    sound = is_sound(observation).all(axis=-1) & is_sound(stepped.obs).all(axis=-1)
    for number in (stepped.reward, stepped.done, *map(stepped.info.get, _OF_STEP)):
        if number is not None:
            sound &= is_sound(number)
    return sound


def action_range(env: Any) -> tuple[Any, Any]:
    """Return the lowest and the highest number of an action as a vector.

    Brax's environments have -1 and 1; discrete actions are one-hot vectors.
    """
    default = (0.0, 1.0) if is_discrete(env) else (-1.0, 1.0)
    return getattr(env, "action_range", default)


def is_discrete(env: Any) -> bool:
    """Return whether an environment's step gets an int32 () below `num_actions`."""
    return hasattr(env, "num_actions")


def action_size(env: Any) -> int:
    """Return the length of an action as a vector; discrete ones are one-hot."""
    return env.num_actions if is_discrete(env) else env.action_size


def zero_action(env: Any) -> jax.Array:
    """Return the action that is all 0, as the environment's step gets it."""
    return jnp.int32(0) if is_discrete(env) else jnp.zeros(env.action_size)


def resets_slowly(env: Any) -> bool:
    """Return whether a reset takes about as long as a step: with Brax's own physics."""
    return hasattr(env, "pipeline_init")


def _refuse_taken(state: State, *names: str) -> None:
    """Raise `ValueError` if an environment's info has one of a wrapper's names."""
    for name in names:
        if name in state.info:
            raise ValueError(f"info[{name!r}] is used by a wrapper: rename yours")


class ActionNoise(Wrapper):
    """Add noise to the actions of an environment.

    A vector gets Gaussian noise of the deviation `scale` in units of half its range; a
    discrete action is replaced, with the probability `scale`, by a random one.
    """

    def __init__(self, env: Any, scale: float):
        super().__init__(env)
        self._scale = scale

    def reset(self, rng: jax.Array) -> State:
        env_key, key = jax.random.split(rng)
        state = self.env.reset(env_key)
        _refuse_taken(state, "action_noise_key")
        return state.replace(info={**state.info, "action_noise_key": key})

    def step(self, state: State, action: jax.Array) -> State:
        key, first, second = jax.random.split(state.info["action_noise_key"], 3)
        if is_discrete(self.env):
            other = jax.random.randint(first, (), 0, self.env.num_actions)
            is_other = jax.random.bernoulli(second, self._scale)
            action = jnp.where(is_other, other, action)
        else:
            low, high = action_range(self.env)
            noise = jax.random.normal(first, action.shape)
            action = action + self._scale * 0.5 * (high - low) * noise
        info = {**state.info, "action_noise_key": key}
        return self.env.step(state.replace(info=info), action)


class UnitActions(Wrapper):
    """Make -1 and 1 the lowest and the highest action of an environment.

    An untrained policy's actions have some deviation 1, which explores no range that is
    much wider, and only the ends of one that is much narrower.
    """

    action_range = (-1.0, 1.0)

    def __init__(self, env: Any):
        super().__init__(env)
        low, high = (np.asarray(x, np.float32) for x in action_range(env))
        self._middle, self._half = 0.5 * (high + low), 0.5 * (high - low)

    def step(self, state: State, action: jax.Array) -> State:
        return self.env.step(state, self._middle + self._half * action)


class EpisodeLimit(Wrapper):
    """End an episode after `episode_length` steps.

    If `terminal` is true, an episode that reaches this limit counts as terminated, not
    as truncated. The state after a reset has ``done`` 0, even if the environment's own
    reset sets it to 1.

    Adds ``info["steps"]`` (int32) and ``info["truncation"]`` (float32, 1 where the
    limit and not the environment ended the episode, or where the environment sets it).
    """

    def __init__(self, env: Env, episode_length: int, terminal: bool = False):
        super().__init__(env)
        self.episode_length = episode_length
        self._terminal = terminal

    @property
    def unwrapped(self) -> Env:
        """The environment without wrappers; it need not be a subclass of `Env`."""
        return getattr(self.env, "unwrapped", self.env)

    def reset(self, rng: jax.Array) -> State:
        state = self.env.reset(rng)
        _refuse_taken(state, "steps")
        info = {**state.info, "steps": jnp.int32(0), "truncation": jnp.float32(0)}
        return state.replace(done=jnp.zeros_like(state.done), info=info)

    def step(self, state: State, action: jax.Array) -> State:
        steps = state.info["steps"] + 1
        # An environment without truncation must not keep the last step's value.
        info = {**state.info, "truncation": jnp.float32(0)}
        state = self.env.step(state.replace(info=info), action)
        at_limit = (steps >= self.episode_length).astype(jnp.float32)
        # Truncation alone ends an episode too.
        ended = jnp.maximum(at_limit, truncated(state).astype(jnp.float32))
        own = state.info.get("truncation", jnp.float32(0))
        cut_off = at_limit * (1.0 - state.done) * (not self._terminal)
        truncation = jnp.maximum(own, cut_off)
        info = {**state.info, "steps": steps, "truncation": truncation}
        return state.replace(done=jnp.maximum(state.done, ended), info=info)


class RewardDelay(Wrapper):
    """Give the accumulated reward every `delay` steps and at the episode's end.

    Paper, section 5.4. An episode's sum of rewards is the same as without delay.
    ``info["true_reward"]`` is the reward of each step without delay, which evaluations
    use; if the environment sets it, its value is kept.
    """

    def __init__(self, env: Env, delay: int):
        super().__init__(env)
        self.delay = delay
        first = jax.eval_shape(env.reset, jax.random.key(0))
        _refuse_taken(first, "held_reward", "delay_steps")
        self._gives_true_reward = "true_reward" in first.info

    def _true_reward(self, state: State) -> jax.Array:
        return state.info["true_reward"] if self._gives_true_reward else state.reward

    def reset(self, rng: jax.Array) -> State:
        state = self.env.reset(rng)
        info = {
            **state.info,
            "true_reward": self._true_reward(state),
            "held_reward": jnp.zeros_like(state.reward),
            "delay_steps": jnp.int32(0),
        }
        return state.replace(info=info)

    def step(self, state: State, action: jax.Array) -> State:
        held, steps = state.info["held_reward"], state.info["delay_steps"] + 1
        state = self.env.step(state, action)
        held = held + state.reward
        give = (steps % self.delay == 0) | (state.done > 0)
        info = {
            **state.info,
            "true_reward": self._true_reward(state),
            "held_reward": jnp.where(give, 0.0, held),
            "delay_steps": steps,
        }
        return state.replace(reward=jnp.where(give, held, 0.0), info=info)


class DelayPhase(Wrapper):
    """Append the phase of a `RewardDelay` to the observation.

    The phase is the share of the delay that has passed since the last payout, at least
    0 and below 1.
    """

    @property
    def observation_size(self) -> int:
        return self.env.observation_size + 1

    def _with_phase(self, state: State) -> State:
        steps = state.info["delay_steps"] % self.env.delay
        phase = (steps / self.env.delay).astype(state.obs.dtype)
        return state.replace(obs=jnp.append(state.obs, phase))

    def reset(self, rng: jax.Array) -> State:
        return self._with_phase(self.env.reset(rng))

    def step(self, state: State, action: jax.Array) -> State:
        state = state.replace(obs=state.obs[:-1])  # The environment's own.
        return self._with_phase(self.env.step(state, action))


class ObservationNoise(Wrapper):
    """Add independent Gaussian noise to every observation (paper, section 5.3).

    Physics and reward do not see it; ``info["true_observation"]`` is without noise.
    """

    def __init__(self, env: Env, standard_deviation: float):
        super().__init__(env)
        self.standard_deviation = standard_deviation

    def _noisy(self, state: State, key: jax.Array) -> State:
        key, noise_key = jax.random.split(key)
        noise = jax.random.normal(noise_key, state.obs.shape, state.obs.dtype)
        return state.replace(
            obs=state.obs + self.standard_deviation * noise,
            info={**state.info, "noise_key": key, "true_observation": state.obs},
        )

    def reset(self, rng: jax.Array) -> State:
        env_key, noise_key = jax.random.split(rng)
        state = self.env.reset(env_key)
        _refuse_taken(state, "noise_key", "true_observation")
        return self._noisy(state, noise_key)

    def step(self, state: State, action: jax.Array) -> State:
        noise_key = state.info["noise_key"]
        # An environment may use its last observation, so it gets the one without noise.
        state = state.replace(obs=state.info["true_observation"])
        return self._noisy(self.env.step(state, action), noise_key)


class FaultyStepEnds(Wrapper):
    """End an episode in which the physics fails; for use with other libraries.

    The step has reward 0 and the observation of the step before. If an episode's first
    observation is not sound, it is zeros, and the episode ends with its first step. The
    rollout of `gasil_jax` does the same, but there the observation after a failed step
    is zeros.
    """

    def reset(self, rng: jax.Array) -> State:
        """Start an episode; adds ``info["unsound_start"]``, a bool."""
        state = self.env.reset(rng)
        _refuse_taken(state, "unsound_start")
        sound = is_sound(state.obs).all()
        info = {**state.info, "unsound_start": ~sound}
        return state.replace(obs=jnp.where(sound, state.obs, 0.0), info=info)

    def step(self, state: State, action: jax.Array) -> State:
        stepped = self.env.step(state, action)
        sound = step_is_sound(state.obs, stepped) & ~state.info["unsound_start"]

        def zero(x: jax.Array) -> jax.Array:
            return jnp.where(sound, x, jnp.zeros_like(x))

        info = {k: zero(x) if k in _OF_STEP else x for k, x in stepped.info.items()}
        info["unsound_start"] = jnp.zeros_like(state.info["unsound_start"])
        return stepped.replace(
            obs=jnp.where(sound, stepped.obs, state.obs),
            reward=zero(stepped.reward),
            done=jnp.where(sound, stepped.done, jnp.ones_like(stepped.done)),
            info=info,
        )


class AutoReset(Wrapper):
    """Start the next episode when one has ended, from a random state.

    This is for tools of Brax and Playground; `gasil_jax` resets in its own rollout.
    ``info["final_observation"]`` is the observation that the episode ended with, from
    which the value of a truncated episode is bootstrapped.
    """

    def reset(self, rng: jax.Array) -> State:
        key, reset_key = jax.random.split(rng)
        state = self.env.reset(reset_key)
        info = {**state.info, "reset_key": key, "final_observation": state.obs}
        return state.replace(info=info)

    def step(self, state: State, action: jax.Array) -> State:
        key, reset_key = jax.random.split(state.info["reset_key"])
        info = dict(state.info)
        del info["reset_key"], info["final_observation"]
        # `done` is still that of the last step.
        stepped = self.env.step(state.replace(info=info, done=0.0 * state.done), action)
        fresh = self.env.reset(reset_key)
        done = stepped.done > 0

        def select(a: Any, b: Any) -> Any:
            return jax.tree.map(lambda x, y: jnp.where(done, x, y), a, b)

        kept = {k: v for k, v in stepped.info.items() if k in _LAST_STEP_INFO}
        return stepped.replace(
            pipeline_state=select(fresh.pipeline_state, stepped.pipeline_state),
            obs=select(fresh.obs, stepped.obs),
            info={
                **select(fresh.info, stepped.info),
                **kept,
                "reset_key": key,
                "final_observation": stepped.obs,
            },
        )


# Numbers in info that belong to a step.
_OF_STEP = ("truncation", "true_reward", "held_reward")
# Entries of info about the episode's last step, which a reset must not overwrite.
_LAST_STEP_INFO = ("truncation", "true_reward")

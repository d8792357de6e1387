"""PPO of this package beside rejax's and purejaxrl's, for `benchmark`.

All train with the same sizes on the same environments, in this process. The peers are
imported from where they are installed; none of their code is here. They were written
for gymnax before 1.0, so they get its environments through gymnax' own wrapper for old
programs. Returns are of the policies as they act: ours and purejaxrl's of the episodes
that end in the last tenth of training; rejax' of 128 episodes afterwards, since it
keeps none of training.
"""

import functools
import importlib.util
import pathlib
import time
import types
from collections.abc import Callable, Iterator
from typing import Any

import brax.envs
import jax
import jax.numpy as jnp
import numpy as np

import gasil_envs
import gasil_jax
from gasil_jax.errors import InputError

ENVS = ("CartPole-v1", "Breakout-MinAtar", "hopper")
_NUM_ENVS, _NUM_STEPS, _EPOCHS, _MINIBATCHES, _WIDTH = 32, 64, 10, 32, 64
_INSTALL = {
    "rejax": "python -m pip install rejax gymnax six",
    "purejaxrl": "add the folder purejaxrl of a checkout of "
    "github.com/luchris429/purejaxrl to PYTHONPATH, and python -m pip install distrax "
    "gymnax six navix",
}


#: Training, key -> result; and the mean return of its last policy, (seeds,), of a batch
#: of results.
Trained = tuple[Callable[[jax.Array], Any], Callable[[Any], np.ndarray]]


def _is_brax(name: str) -> bool:
    return name == "hopper"


class _Brax:
    """Brax's hopper with the spring backend, as an environment of old gymnax."""

    def __init__(self, name: str, **_: Any):
        self.env = brax.envs.create(name, backend="spring", episode_length=1000)
        self.default_params = types.SimpleNamespace(max_steps_in_episode=1000)

    def reset(self, key: jax.Array, params: Any = None) -> tuple[Any, Any]:
        """Return an observation and a state."""
        state = self.env.reset(key)
        return state.obs, state

    def step(
        self, key: jax.Array, state: Any, action: jax.Array, params: Any = None
    ) -> tuple[Any, ...]:
        """Return observation, state, reward, whether the episode ended, and more."""
        state = self.env.step(state, action)
        return state.obs, state, state.reward, state.done > 0.5, {}

    def observation_space(self, params: Any = None) -> Any:
        """Return the space of observations."""
        return self._box(jnp.inf, self.env.observation_size)

    def action_space(self, params: Any = None) -> Any:
        """Return the space of actions."""
        return self._box(1.0, self.env.action_size)

    def _box(self, limit: float, size: int) -> Any:
        from gymnax.environments import spaces

        return spaces.Box(low=-limit, high=limit, shape=(size,))


def _gymnax(name: str) -> tuple[Any, Any]:
    import gymnax
    from gymnax.wrappers.compat import LegacyStepAPIWrapper

    env, params = gymnax.make(name)
    return _not_copied(LegacyStepAPIWrapper(env)), params


def _not_copied(env: Any) -> Any:
    """Return an environment that is its own deep copy, which rejax makes."""
    env.__deepcopy__ = lambda memo: env
    return env


def _ours(name: str, total_steps: int) -> Trained:
    if _is_brax(name):
        env = brax.envs.get_environment(name, backend="spring")
    else:
        env = gasil_envs.make(f"gymnax:{name}")
    algorithm = gasil_jax.algorithm(
        "ppo",
        total_steps=total_steps,
        num_envs=_NUM_ENVS,
        batch_steps=_NUM_ENVS * _NUM_STEPS,
        num_epochs=_EPOCHS,
        minibatch_size=_NUM_ENVS * _NUM_STEPS // _MINIBATCHES,
        hidden_sizes=(_WIDTH, _WIDTH),
        normalize_rewards=_is_brax(name),
    )
    train = gasil_jax.make_train(env, algorithm)
    return train, lambda result: _of_last_tenth(result[1]["episode_return"])


def _of_last_tenth(returns: Any) -> np.ndarray:
    """Return the mean over the last tenth of (seeds, iterations, ...), without NaNs."""
    returns = np.asarray(returns)
    last = returns[:, -max(1, returns.shape[1] // 10) :]
    return np.nanmean(last.reshape(len(last), -1), axis=1)


def _rejax(name: str, total_steps: int) -> Trained:
    from rejax import PPO
    from rejax.evaluate import evaluate

    if _is_brax(name):
        env, params = _not_copied(_Brax(name)), None
    else:
        env, params = _gymnax(name)
    algorithm = PPO.create(
        env=env,
        env_params=params,
        total_timesteps=total_steps,
        eval_freq=total_steps,
        skip_initial_evaluation=True,
        num_envs=_NUM_ENVS,
        num_steps=_NUM_STEPS,
        num_epochs=_EPOCHS,
        num_minibatches=_MINIBATCHES,
        normalize_observations=True,
        normalize_rewards=_is_brax(name),
        learning_rate=3e-4,
        max_grad_norm=0.5,
        agent_kwargs={
            "activation": "tanh",
            "hidden_layer_sizes": (_WIDTH, _WIDTH),
        },
    )

    def score(result: Any) -> jax.Array:
        act = algorithm.make_act(result[0])
        limit = 1000 if params is None else params.max_steps_in_episode
        return evaluate(act, jax.random.PRNGKey(1), env, params, 128, limit)[1].mean()

    # It would evaluate at the end; here only training is timed.
    train = algorithm.replace(eval_callback=lambda *_: ()).train
    return train, lambda result: np.asarray(jax.vmap(score)(result))


def _purejaxrl(name: str, total_steps: int) -> Trained:
    module = "ppo_continuous_action" if _is_brax(name) else "ppo"
    spec = importlib.util.find_spec(module)
    assert spec is not None and spec.origin is not None
    # The file for continuous actions has the width as a number, 256.
    source = pathlib.Path(spec.origin).read_text().replace("256", str(_WIDTH))
    names: dict[str, Any] = {"__name__": "purejaxrl"}
    exec(compile(source, spec.origin, "exec"), names)
    names["BraxGymnaxWrapper"] = _Brax
    names["gymnax"] = types.SimpleNamespace(make=_gymnax)
    train = names["make_train"](
        {
            "LR": 3e-4,
            "NUM_ENVS": _NUM_ENVS,
            "NUM_STEPS": _NUM_STEPS,
            "TOTAL_TIMESTEPS": total_steps,
            "UPDATE_EPOCHS": _EPOCHS,
            "NUM_MINIBATCHES": _MINIBATCHES,
            "GAMMA": 0.99,
            "GAE_LAMBDA": 0.95,
            "CLIP_EPS": 0.2,
            "ENT_COEF": 0.0 if _is_brax(name) else 0.01,
            "VF_COEF": 0.5,
            "MAX_GRAD_NORM": 0.5,
            "ACTIVATION": "tanh",
            "ENV_NAME": name,
            "ANNEAL_LR": True,
            "NORMALIZE_ENV": True,
        }
    )

    def returns(result: Any) -> np.ndarray:
        info = result["metrics"]
        ended = info["returned_episode"]
        returned = jnp.where(ended, info["returned_episode_returns"], jnp.nan)
        return _of_last_tenth(returned)

    return train, returns


_PACKAGES = {"ours": _ours, "rejax": _rejax, "purejaxrl": _purejaxrl}


def check() -> None:
    """Raise `InputError`, which says what to install, if a peer is missing.

    Nothing is imported: that would start JAX.
    """
    for name, module in (("rejax", "rejax"), ("purejaxrl", "ppo_continuous_action")):
        if importlib.util.find_spec(module) is None:
            raise InputError(f"{name} is not installed: {_INSTALL[name]}")


def programs(
    name: str, seeds: int, iterations: int
) -> Iterator[tuple[str, Callable[[], Any], float, int, np.ndarray]]:
    """Yield each package's name, training, seconds of compiling, steps and returns.

    The returns are those of the trained policies, (seeds,).
    """
    total_steps = iterations * _NUM_ENVS * _NUM_STEPS
    for package, make in _PACKAGES.items():
        keys = jax.random.split(jax.random.PRNGKey(0), seeds)
        one, returns = make(name, total_steps)
        train = jax.jit(jax.vmap(one))
        began = time.perf_counter()
        compiled = train.lower(keys).compile()
        seconds = time.perf_counter() - began
        run = functools.partial(compiled, keys)
        yield package, run, seconds, seeds * total_steps, returns(run())

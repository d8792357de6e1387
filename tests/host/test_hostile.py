"""The functions for Python take every value rightly, or refuse it in one line."""

import itertools
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
from hostile_values import drawn, is_real, is_whole

import gasil_jax
from gasil_jax import algorithms, config, evaluation, numpy_policy
from gasil_jax.agents import AGENTS
from gasil_jax.policy import from_state
from gasil_jax.sweeps import fitting, saved_states

ENV = gasil_jax.make_env("point_mass")
SMALL = gasil_jax.algorithm(num_envs=4, batch_steps=64, minibatch_size=16)
POLICY = gasil_jax.load_policy("zoo:walker2d-delayed")
ZOO_SEED = numpy_policy.about("zoo:walker2d-delayed")["seed"]
ENVIRONMENTS = "point_mass hopper walker2d halfcheetah swimmer ant humanoid".split()


class AcceptedError(Exception):
    """Training would begin."""


def fit(**arguments):
    with mock.patch.object(fitting.driver, "drive", side_effect=AcceptedError):
        try:
            gasil_jax.fit(ENV, SMALL, **arguments)
        except AcceptedError:
            pass


def setting(name, agent):
    def use(value):
        algorithm = gasil_jax.algorithm(agent).replace(**{name: value})
        algorithms.check(algorithm)
        if name in algorithm.hyperparameters:
            assert jnp.asarray(value, jnp.float32).shape == ()

    return use


def hyperparameter(value):
    with mock.patch.object(gasil_jax.train, "first_state"):
        gasil_jax.init(ENV, SMALL, jax.random.key(0), {"alpha": value})


def episodes(**arguments):
    given = {"num_episodes": 1, "num_steps": 1, **arguments}
    act = lambda observation, key: jnp.zeros((*observation.shape[:-1], 2))
    key = given.pop("key", jax.random.key(0))
    return jax.eval_shape(lambda: evaluation.run_episodes(ENV, act, key, **given))


def reward(seed=None, **arguments):
    with mock.patch.object(saved_states.run_folder, "read", side_effect=AcceptedError):
        try:
            gasil_jax.load_reward("no", seed, **arguments)
        except AcceptedError:
            pass


def is_key(value):
    if not isinstance(value, np.ndarray | jax.Array):
        return False
    typed = jnp.issubdtype(value.dtype, jax.dtypes.prng_key)
    return value.shape == () if typed else value.dtype == np.uint32


def is_seed_list(value):
    listed = isinstance(value, list | tuple | range) or (
        isinstance(value, np.ndarray | jax.Array)
        and jnp.issubdtype(value.dtype, np.integer)
        and value.ndim == 1
    )
    if not listed:
        return is_whole(value, 1, 2**20, in_array=True)
    seeds = np.asarray(value).tolist() if hasattr(value, "dtype") else [*value]
    each = all(is_whole(x, 0, 2**32 - 1) and np.ndim(x) == 0 for x in seeds)
    return each and len({int(x) for x in seeds}) == len(seeds) > 0


def is_one_of(*names):
    return lambda value: isinstance(value, str) and value in names


def is_environment(value):
    return isinstance(value, str) and (value in ENVIRONMENTS or ":" in value)


def is_zoo_seed(value):
    return value is None or is_whole(value, ZOO_SEED, ZOO_SEED)


def is_bool(value):
    return isinstance(value, bool)


def is_absent(value):
    return value is None


def of_settings():
    """Yield every number and switch of every agent, with what it allows."""
    for agent, kind in AGENTS.items():
        if agent == "gail":  # Its expert comes first.
            continue
        for name, allowed in (
            config.ranges(gasil_jax.Config) | config.ranges(kind)
        ).items():
            default = gasil_jax.algorithm(agent).settings[name]
            if name in ("total_steps", "num_envs", "batch_steps", "minibatch_size"):
                continue  # They depend on one another.
            if allowed.whole:
                valid = lambda x, default=default: (
                    is_whole(x, in_array=True) or x is default is None
                )
            else:
                valid = lambda x, a=allowed: is_real(
                    x, a.low, min(a.high, 3.4e38), a.excludes_low, in_array=True
                )
            yield name, setting(name, agent), valid
        for name in ("normalize_rewards", "decompose_rewards", "stagger_episodes"):
            yield name, setting(name, agent), is_bool


#: Name of the value in the message, a function of it, and whether it is allowed.
CASES = [
    *of_settings(),
    ("bonus", setting("bonus", "gasil"), is_one_of("softplus")),
    ("agent", gasil_jax.algorithm, is_one_of(*AGENTS)),
    ("alpha", hyperparameter, lambda x: is_real(x, in_array=True)),
    ("env", lambda x: gasil_jax.preset(x, "ppo"), is_environment),
    ("agent", lambda x: gasil_jax.preset("hopper", x), is_one_of(*AGENTS)),
    ("preset", lambda x: gasil_jax.preset("hopper", "ppo", x), is_one_of("tuned")),
    *[
        (
            name,
            lambda x, name=name: gasil_jax.preset("hopper", "ppo", **{name: x}),
            valid,
        )
        for name, valid in (
            ("reward_delay", is_whole),
            ("action_size", lambda x: x is None or is_whole(x)),
        )
    ],
    ("env", gasil_jax.make_env, is_one_of(*ENVIRONMENTS)),
    *[
        (
            name,
            lambda x, name=name: gasil_jax.make_env("point_mass", **{name: x}),
            valid,
        )
        for name, valid in (
            ("reward_delay", is_whole),
            ("obs_noise", is_real),
            ("action_noise", is_real),
            ("physics", is_one_of("jax", "mjx", "mujoco")),
            ("terminal_limits", is_bool),
            ("observe_phase", lambda x: x is False),  # Without a delay.
            ("max_episode_steps", lambda x: x is None or is_whole(x, 1, 100)),
        )
    ],
    *[
        (name, lambda x, name=name: fit(**{name: x}), valid)
        for name, valid in (
            ("seeds", is_seed_list),
            ("evaluate_every", lambda x: x is None or is_whole(x, high=1e308)),
            ("evaluate_episodes", lambda x: is_whole(x, high=1e308)),
            ("checkpoint_every", is_absent),  # It needs a folder.
            ("resume", lambda x: x is False),
        )
    ],
    *[
        (name, lambda x, name=name: episodes(**{name: x}), valid)
        for name, valid in (
            ("num_episodes", is_whole),
            ("num_steps", is_whole),
            ("deterministic", is_bool),
            ("key", is_key),
        )
    ],
    *[
        (name, lambda x, name=name: reward(**{name: x}), valid)
        for name, valid in (
            ("seed", lambda x: x is None or is_whole(x, -1e308, 1e308)),
            ("point", lambda x: x is None or is_whole(x, -1e308, 1e308)),
            ("which", is_one_of("last", "best")),
        )
    ],
    ("callback", lambda x: fit(callback=x), lambda x: x is None or callable(x)),
    ("key", lambda x: POLICY(np.zeros(17), x), lambda x: x is None or is_key(x)),
    ("state", lambda x: gasil_jax.train_step(ENV, SMALL, x), lambda x: False),
    ("state", lambda x: from_state(x, ENV), lambda x: False),
    ("env", lambda x: gasil_jax.make_train(x, SMALL), lambda x: False),
    ("algorithm", lambda x: gasil_jax.make_train(ENV, x), lambda x: False),
    (
        "index",
        lambda x: gasil_jax.member({"a": np.zeros(4)}, x),
        lambda x: is_whole(x, -4, 3, in_array=True),
    ),
    *[
        (name, use, lambda x: False)
        for load in (gasil_jax.load_policy, numpy_policy.load)
        for name, use in (("path", load),)
    ],
    *[
        (
            "seed",
            lambda x, load=load: load("zoo:walker2d-delayed", x),
            is_zoo_seed,
        )
        for load in (gasil_jax.load_policy, numpy_policy.load)
    ],
    ("name", numpy_policy.about, lambda x: False),
]


def named(name, value, refused):
    """A path or a policy of the zoo may stand for itself."""
    return (
        name in refused or " ".join(str(value).split()).removeprefix("zoo:") in refused
    )


def faults(values):
    """Return what is wrong in how the functions take values, in words."""
    wrong = []
    for (name, use, valid), value in zip(itertools.cycle(CASES), values):
        try:
            use(value)
            refused = None
        except (ValueError, IndexError) as error:
            refused = str(error)
        except Exception as error:
            wrong.append((name, type(value), f"{type(error).__name__}: {error}"))
            continue
        if valid(value) != (refused is None):
            wrong.append((name, type(value), repr(value)[:60], refused or "accepted"))
        elif refused is not None and ("\n" in refused or len(refused) > 2000):
            wrong.append((name, type(value), "not in one line", refused[:300]))
        elif refused is not None and not named(name, value, refused):
            wrong.append((name, type(value), "not named", refused[:300]))
    return wrong


def test_every_value_is_taken_rightly_or_refused_in_a_line():
    assert not faults(drawn(3 * len(CASES)))

"""Values, command lines and files of any kind are taken, or refused in a line."""

import builtins
import io
import json
import math
import pickle
import re
import shutil
import warnings
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from altered_archives import altered
from brax.envs import State
from brax.envs.wrappers import training
from refusals import refused, rows
from small_training import FLAGS

import gasil_jax
from gasil_envs import wrappers
from gasil_jax import (
    algorithms,
    evaluate,
    evaluation,
    numpy_policy,
    plot,
    render,
    run,
    sweep,
)
from gasil_jax.agents import expert
from gasil_jax.policy import from_state

ENV = gasil_jax.make_env("point_mass")
SMALL = gasil_jax.algorithm(num_envs=4, batch_steps=64, minibatch_size=16)
KEY = jax.random.key(0)


class Bad:
    """An object of which nothing can be asked."""

    def _refuse(self, *_):
        raise RuntimeError("of me nothing\ncan be asked")

    __repr__ = __bool__ = __len__ = __float__ = __index__ = __array__ = _refuse
    __eq__ = __hash__ = __iter__ = __contains__ = __fspath__ = __call__ = _refuse


class Short:
    """An environment whose observations are shorter than it says."""

    observation_size, action_size = 3, 1

    def reset(self, rng):
        return State(None, jnp.zeros(2), jnp.float32(0), jnp.float32(0))

    def step(self, state, action):
        return state


#: What is never a setting, and no name of anything.
NEVER = [
    *(-1, -(10**400), math.nan, np.float32("inf"), "", "a\nb", "\x00", "\udcff"),
    *("x" * 9999, b"x", [[]], ("a",), {"a": 1}, {1}, 1j, ..., object(), Bad(), Bad),
    *(ValueError("a\nb"), np.array([]), np.array("3"), np.datetime64("2020-01-01")),
    *(jnp.zeros((0, 3)), jax.random.split(KEY)),
]
NUMBERS = [None, True, np.True_, "3", [1]]
#: What else each function refuses, by the name of its value.
SETTINGS = {
    "gamma": [*NUMBERS, 1.5],
    "learning_rate": [*NUMBERS, 0, 1e300],
    "num_envs": [*NUMBERS, 0, 0.5, 2**62, 2**2000],
    "buffer_steps": [*NUMBERS, 0, 0.5, 2**62],
    "hidden_sizes": [3, (2**62,), [3], (None,), (True,), (0,), [64, 64]],
    "alpha_schedule": [3, None, ((1,),), ((0, True),), lambda s: None, (2e6, 0.0)],
    "learning_rate_schedule": [((1, 0.5), (0, 1)), ((0, -1),), lambda: 1.0],
    "normalize_rewards": [None, 1, "on", np.True_],
    "minibatch_size": [60],
    "bonus": NUMBERS,
}
ENVIRONMENT = {
    "reward_delay": [*NUMBERS, 0, 0.5],
    "obs_noise": NUMBERS,
    "physics": [3, None, "mjxx"],
    "terminal_limits": [1, None],
    "max_episode_steps": [0, True, "3"],
}
FIT = {
    "seeds": [*NUMBERS[:4], [], 0, 0.5, [1, 1], [-1], [2**32], 2**21],
    "evaluate_every": [*NUMBERS[1:], 0, 0.5],
    "evaluate_episodes": [*NUMBERS, 0, 0.5],
    "checkpoint_every": [*NUMBERS[1:], 0, 128],
    "resume": [None, 1, "on", True],
    "folder": [3, [], "/proc/none"],
    "callback": [3, "x"],
    "points": [3, [], [3], "alpha"],
}
EPISODES = {
    "num_episodes": [*NUMBERS, 0],
    "deterministic": [1, None],
    "key": [0, 0.5, None],
}
PARTS = {
    "agent": [3, None, gasil_jax.PPO],
    "rewards": [3, None, [], (gasil_jax.Normalize,), gasil_jax.Normalize()],
    "config": [3, gasil_jax.Config, SMALL],
}


def act(observation, key):
    return jnp.zeros((*observation.shape[:-1], 2))


def check(**parts):
    algorithms.check(gasil_jax.Algorithm(**{"agent": gasil_jax.PPO(), **parts}))


def episodes(**given):
    given = {"num_episodes": 1, "num_steps": 1, "key": KEY, **given}
    evaluation.run_episodes(ENV, act, **given)


def of(table, function):
    """Return the cases of a function that takes the values of a table by name."""
    return [(x, lambda y, x=x: function(**{x: y}), more) for x, more in table.items()]


CASES = [
    *of(SETTINGS, lambda **x: algorithms.check(SMALL.replace(**x))),
    *of(ENVIRONMENT, lambda **x: gasil_jax.make_env("point_mass", **x)),
    *of(FIT, lambda **x: gasil_jax.fit(ENV, SMALL, **x)),
    *of(EPISODES, episodes),
    *of(PARTS, check),
    *of({"which": ["first", 3]}, lambda **x: gasil_jax.load_reward("no", **x)),
    ("alpha", lambda x: gasil_jax.init(ENV, SMALL, KEY, {"alpha": x}), ["3", True]),
    ("hyperparameters", lambda x: gasil_jax.init(ENV, SMALL, KEY, x), [0, SMALL]),
    ("agent", gasil_jax.algorithm, [3, None, "gasill"]),
    ("env", lambda x: gasil_jax.preset(x, "ppo"), [3, None, "walker"]),
    ("preset", lambda x: gasil_jax.preset("hopper", "ppo", x), [3, None, "tuend"]),
    ("reward_delay", lambda x: gasil_jax.preset("ant", "ppo", reward_delay=x), [2.5]),
    ("env", gasil_jax.make_env, [3, None, "hoper", "brax:", ":", "a:b"]),
    ("state", lambda x: gasil_jax.train_step(ENV, SMALL, x), [3, None]),
    ("state", lambda x: from_state(x, ENV), [3, None]),
    ("env", lambda x: gasil_jax.make_train(x, SMALL), [3, None, "hopper", Short]),
    ("algorithm", lambda x: gasil_jax.make_train(ENV, x), [3, None, "ppo"]),
    ("key", gasil_jax.make_train(ENV, SMALL), [0, 0.5, None]),
    ("index", lambda x: gasil_jax.member({"a": np.zeros(4)}, x), ["0", 0.5, 4, -5]),
    ("path", gasil_jax.load_policy, [3, None, "zoo:x"]),
    ("name", numpy_policy.about, ["x", None, 3]),
]


def is_allowed(name, value):
    """Return whether what is never a setting may be the value of another name."""
    kinds = {"folder": str, "path": str, "index": int, "hyperparameters": dict}
    return isinstance(value, {"callback": Callable, **kinds}.get(name, ()))


@pytest.mark.parametrize(
    ("name", "use", "more"), CASES, ids=lambda x: x if isinstance(x, str) else ""
)
def test_what_is_wrong_is_refused_in_a_line_by_name(name, use, more):
    for value in [*(x for x in NEVER if not is_allowed(name, x)), *more]:
        with pytest.raises((ValueError, IndexError)) as refusal:
            use(value)
        told = str(refusal.value)
        assert "\n" not in told and len(told) < 2000
        shown = " ".join(str(value).split()) if isinstance(value, str) else name
        assert name in told or shown.removeprefix("zoo:")[:50] in told


def test_numbers_of_any_library_are_taken():
    for value in (0.5, np.float32(0.5), np.array(0.5), jnp.float32(0.5)):
        algorithms.check(SMALL.replace(gamma=value, alpha=value))
    for value in (4, np.int64(4), np.uint8(4)):
        algorithms.check(SMALL.replace(num_envs=value))
    check = lambda gamma: algorithms.check(SMALL.replace(gamma=gamma)) or gamma
    jax.eval_shape(check, -1.0)  # Traced values pass unlooked at.


@pytest.mark.parametrize(
    ("use", "message"),
    [
        *[
            (lambda env=env: gasil_jax.make_train(env, gasil_jax.algorithm()), message)
            for env, message in (
                (Short(), "env 'Short': the obs of its reset has shape (2,): it must"),
                (wrappers.RewardDelay(Short(), 5), "env 'Short': the obs of its reset"),
                (wrappers.AutoReset(ENV), "env is wrapped in AutoReset"),
                (training.AutoResetWrapper(ENV), "env is wrapped in AutoReset"),
            )
        ],
        *[
            (lambda act=act: episodes_of(act), message)
            for act, message in (
                (3, "act is 3: it must be a function of observations and a key"),
                (lambda seen, key: None, "act returns None: it must be of shape (3, 2"),
                (lambda seen, key: jnp.zeros(2), "returns an array of shape (2,): it"),
            )
        ],
    ],
)
def test_what_does_not_fit_is_refused(use, message):
    with pytest.raises(ValueError, match=re.escape(message)) as refusal:
        use()
    assert "\n" not in str(refusal.value)


def episodes_of(act):
    evaluation.run_episodes(ENV, act, KEY, num_episodes=3, num_steps=1)


#: Each program with a line that can't run: its folder can't be made or found.
LINES = [
    (run, "--env ant --agent ppo+sil --reward-delay 20 --hidden-sizes 8 8 --out no"),
    (run, "--resume --out no --total-steps 1e6 --checkpoint-every 5"),
    (sweep, "--env point_mass --grid alpha=0.1,0.2 buffer_steps=10,20 --out no"),
    (sweep, "--env point_mass --random 4 --shard 1/2 --out no"),
    (evaluate, "no/run --episodes 3 --checkpoint best --point 0"),
    (render, "no/run --out no.gif --steps 10 --seed 0"),
    (plot, "no/run no/other --out no.png"),
]
WORDS = [
    *("", "-", "--", "---", "=", "--=", "-1", "1e999", "nan", "é", "\udcff", "\x00"),
    *("a\nb", "x" * 5000, "9" * 5000, "0x10", "1_000", "1/0", "[", "{}", "%s", "@file"),
    *("--help=", "--out", "--env", "--seeds=", "--grid", "alpha=", "=1", "alpha=a"),
    *("minari:", "zoo:x", "brax:", "a:", "a:b", "--no-seeds", "--version=3", "-h1"),
    *("--resume", "--seeds", "--alpha=-1", "--gamma=x", "--num-envs=0", "--env=\n"),
]


def test_an_altered_command_line_ends_in_one_line(capsys, monkeypatch):
    monkeypatch.chdir("/proc")  # Where nothing can be written.
    for program, line in LINES:
        words = line.split()
        for number, word in enumerate(WORDS):
            at = 1 + number % len(words)
            refused(capsys, program, *words[:at], word, *words[at:])
        for at in range(len(words)):
            refused(capsys, program, *words[:at], *words[at + 1 :])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The folder of a sweep of two points."""
    out = tmp_path_factory.mktemp("whole") / "out"
    flags = [*FLAGS, "--agent", "ppo", "--max-episode-steps", "10"]
    assert sweep.main([*flags, "--grid", "gamma=0.9,0.99", "--out", str(out)]) == 0
    return out


#: A file, where in it, and the value that stands there instead of its own.
DAMAGES = """
config.json | seeds | [-1]
config.json | seeds | [1099511627776]
config.json | seeds | [1, 1]
config.json | points | []
config.json | points | [{"alhpa": 1.0}]
config.json | points | [{"batch_steps": 0}]
config.json | settings gravity | 3
config.json | settings obs_noise | "loud"
config.json | recording log | "wandb"
config.json | algorithm agent | "gasill"
config.json | algorithm alpa | 1
config.json | algorithm imitation_weight | 0.5
config.json | algorithm gamma | "high"
config.json | algorithm gamma | -1
config.json | algorithm hidden_sizes | {"a": 1}
config.json | env | "hoper"
program.json | runs | [[0, 0]]
program.json | runs | [[9, 0], [1, 0]]
program.json | labels | {}
program.json | labels seed | [5, 6]
program.json | labels point | ["a", "b"]
program.json | experiments | [3, 4]
training.json | iterations | true
training.json | train_seconds | null
training.json | evaluation_seconds | []
training.json | versions jax | 3
summary.json | best_by_mean | "first"
training.json | device | gone
"""
KINDS = ("null", "3", "[]", '"x"')
DESCRIBED = ("config.json", "program.json", "training.json", "summary.json")
KEYS = ("seeds", "points", "algorithm", "settings")


@pytest.mark.parametrize(
    ("name", "path", "value"),
    [
        *[(name, "", kind) for name in DESCRIBED for kind in KINDS],
        *[("config.json", key, "null") for key in KEYS],
        *rows(DAMAGES),
        *[("config.json", None, x) for x in ("", "[" * 100_000, "\x80\x04N.", "\xff")],
    ],
)
def test_a_damaged_file_is_told_in_a_line(name, path, value, folder, tmp_path, capsys):
    """Those that a command does not need change nothing."""
    out = shutil.copytree(folder, tmp_path / "out")
    file = next(out.rglob(name))
    if path is None:
        file.write_bytes(value.encode("latin1"))
    else:
        content = {"all": json.loads(file.read_text())}
        inner, (*keys, last) = content, ("all", *path.split())
        for key in keys:
            inner = inner[key]
        if value == "gone":
            del inner[last]
        else:
            inner[last] = json.loads(value)
        file.write_text(json.dumps(content["all"]))
    told = [refused(capsys, evaluate, out)]
    if name != "summary.json":
        told.append(refused(capsys, plot, out, "--out", tmp_path / "x.png"))
        told.append(refused(capsys, sweep, "--resume", "--out", out))
    assert path is not None or all(f"{name} is damaged: " in line for line in told)


def saved(kind, *arguments, **arrays):
    file = io.BytesIO()
    kind(file, *arguments, **arrays)
    return file.getvalue()


class Bomb:
    """An object whose unpickling leaves a mark."""

    def __reduce__(self):
        return (exec, ("import builtins; builtins.exploded = True",))


POLICY = {
    "seeds": np.arange(2),
    "final_return": np.array([1.0, np.nan]),
    "mean": np.zeros((2, 3), np.float32),
    "scale": np.ones((2, 3), np.float32),
    "log_std": np.zeros((2, 1), np.float32),
    "low": np.full(1, -1, np.float32),
    "high": np.ones(1, np.float32),
    "kernel_0": np.ones((2, 3, 4), np.float32),
    "bias_0": np.zeros((2, 4), np.float32),
    "kernel_1": np.ones((2, 4, 1), np.float32),
    "bias_1": np.zeros((2, 1), np.float32),
}
EXPERT = {"observation": np.ones((5, 3)), "action": np.zeros((5, 1))}
ODD = [
    *(np.zeros((5, 1), complex), np.full((5, 1), b"1"), np.zeros((5, 1), "m8[s]")),
    *(np.zeros((5, 1), bool), np.full((5, 1), 1e300), np.full((5, 1), np.nan)),
    *(np.zeros((5, 1, 1)), np.zeros((5, 0)), np.zeros((4, 1)), np.array([Bomb()])),
]
CONTENTS = [
    *(b"", b"PK\x03\x04 not a zip", pickle.dumps(Bomb()), saved(np.save, np.ones(3))),
    *[saved(np.savez, **EXPERT | {"action": x}) for x in ODD],
    saved(np.savez, **EXPERT)[:300],
    saved(np.savez, observation=np.ones(3)),
]


def act_of(path):
    weights = numpy_policy.read(path)
    action = numpy_policy.make(weights)(np.zeros_like(weights["mean"]))
    assert action.shape == (1,) and np.isfinite(action).all()


def load(path):
    for array in expert.load(str(path)):
        assert array.ndim == 2 and np.isfinite(array).all()


@pytest.mark.parametrize("content", CONTENTS)
def test_a_foreign_archive_is_refused_and_never_unpickled(content, tmp_path):
    path = tmp_path / "x.npz"
    path.write_bytes(content)
    for use in (act_of, load):
        with pytest.raises(ValueError, match=r"must be an|not a saved po") as refusal:
            use(path)
        assert "\n" not in str(refusal.value) and str(path) in str(refusal.value)
    assert not hasattr(builtins, "exploded")


@pytest.mark.parametrize("name", ["seeds", "final_return", "mean", "scale", "kernel_0"])
def test_a_file_of_policies_without_one_of_its_arrays_is_refused(name, tmp_path):
    np.savez(tmp_path / "policy.npz", **{x: y for x, y in POLICY.items() if x != name})
    with pytest.raises(ValueError, match=rf"is not a saved policy \({name} is missing"):
        gasil_jax.load_policy(tmp_path)


@pytest.mark.slow
def test_a_randomly_altered_expert_is_read_or_refused(tmp_path):
    told = 0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for number, content in enumerate(altered(EXPERT, 350)):
            path = tmp_path / f"{number}.npz"
            path.write_bytes(content)
            try:
                load(path)
            except ValueError as error:
                told += 1
                assert str(path) in str(error) and "\n" not in str(error)
    assert 150 < told < 330


def test_a_policy_of_another_byte_order_acts(tmp_path):
    swapped = {name: x.astype(x.dtype.newbyteorder()) for name, x in POLICY.items()}
    np.savez(tmp_path / "policy.npz", **swapped)
    np.savez(tmp_path / "plain.npz", **POLICY)
    observation = np.ones(3, np.float32)
    expected = gasil_jax.load_policy(tmp_path / "plain.npz")(observation)
    assert gasil_jax.load_policy(tmp_path)(observation) == expected
    assert numpy_policy.load(tmp_path)(observation) == expected

"""Values, command lines and files of any kind are taken, or refused in a line."""

import builtins
import io
import json
import math
import pickle
import shutil
import tempfile
from collections.abc import Callable

import gymnasium  # noqa: F401
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs import State
from brax.envs.wrappers import training  # noqa: F401
from corridor import Corridor
from flax import linen as nn
from refusals import refused, rows
from small_training import FLAGS

import gasil_jax
from gasil_envs import make as make_env  # noqa: F401
from gasil_envs import wrappers  # noqa: F401
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
    *(-1, -(10**400), math.nan, np.float32("inf"), "", "a\nb", "\udcff", "x" * 9999),
    *(b"x", [[]], {"a": 1}, 1j, ..., Bad(), Bad, np.array("3"), jnp.zeros((0, 3))),
]
NUMBERS = [None, True, np.True_, "3", [1]]
#: What else each function refuses, by the name of its value.
SETTINGS = {
    "gamma": [*NUMBERS, 1.5],
    "learning_rate": [*NUMBERS, 0, 1e300],
    "num_envs": [*NUMBERS, 0, 0.5, 2**62, 2**2000],
    "hidden_sizes": [3, (2**62,), [3], (None,), (True,), (0,), [64, 64]],
    "alpha_schedule": [3, None, ((1,),), ((0, True),), lambda s: None, (2e6, 0.0)],
    "learning_rate_schedule": [((1, 0.5), (0, 1)), ((0, -1),), lambda: 1.0],
    "normalize_rewards": [None, 1, "on", np.True_],
    "minibatch_size": [60],
    "bonus": NUMBERS,
}
ENVIRONMENT = {
    "reward_delay": [*NUMBERS, 0, 0.5],
    "max_episode_steps": [0, True, "3", 51],
    "obs_noise": NUMBERS,
    "physics": [3, None, "mjxx"],
    "terminal_limits": [1, None],
    "observe_phase": [1, None],
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
PARTS = {
    "agent": [3, None, gasil_jax.PPO],
    "rewards": [3, None, [], (gasil_jax.Normalize,), gasil_jax.Normalize()],
    "config": [3, gasil_jax.Config, SMALL],
}


def check(**parts):
    algorithms.check(gasil_jax.Algorithm(**{"agent": gasil_jax.PPO(), **parts}))


def episodes(act=lambda seen, key: jnp.zeros((*seen.shape[:-1], 2)), **given):
    given = {"num_episodes": 3, "num_steps": 1, "key": KEY, **given}
    evaluation.run_episodes(ENV, act, **given)


def of(table, function):
    """Return the cases of a function that takes the values of a table by name."""
    return [(x, lambda y, x=x: function(**{x: y}), more) for x, more in table.items()]


CASES = [
    *of(SETTINGS, lambda **x: algorithms.check(SMALL.replace(**x))),
    *of(ENVIRONMENT, lambda **x: gasil_jax.make_env("point_mass", **x)),
    *of(FIT, lambda **x: gasil_jax.fit(ENV, SMALL, **x)),
    *of({"num_episodes": [*NUMBERS, 0], "deterministic": [1, None]}, episodes),
    *of(PARTS, check),
    *of({"which": ["first", 3]}, lambda **x: gasil_jax.load_reward("no", **x)),
    ("alpha", lambda x: gasil_jax.init(ENV, SMALL, KEY, {"alpha": x}), ["3", True]),
    ("hyperparameters", lambda x: gasil_jax.init(ENV, SMALL, KEY, x), [0, SMALL]),
    ("agent", gasil_jax.algorithm, [3, None, "gasill"]),
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
        gasil_jax.make_env("point_mass", reward_delay=value, obs_noise=value)
    check = lambda gamma: algorithms.check(SMALL.replace(gamma=gamma)) or gamma
    jax.eval_shape(check, -1.0)  # Traced values pass unlooked at.


class BothActions(Corridor):
    action_size = 3


class NoActions(Corridor):
    num_actions = property(lambda self: self.missing)


class Twice(gasil_jax.Agent):
    """Its metric has the name of another one."""

    def update_and_reward(self, state, context, key):
        return state, context.rollout.reward, {"episode_return": 0.5}


class OwnPolicy(gasil_jax.PPO):
    def policy_network(self, sizes):
        return nn.Dense(sizes.action)


def make_train(env, agent=None, **settings):
    algorithm = gasil_jax.Algorithm(agent or gasil_jax.PPO()).replace(**settings)
    jax.eval_shape(gasil_jax.make_train(env, algorithm), KEY)


def with_numbers(numbers):
    train = gasil_jax.make_train(ENV, SMALL)
    jax.eval_shape(lambda key: train(key, numbers), KEY)


def two_states():
    init = jax.vmap(lambda key: gasil_jax.init(ENV, SMALL, key))
    return jax.eval_shape(lambda: init(jax.random.split(KEY)))


def taught(env, **pairs):
    """Train with an expert of these pairs."""
    with tempfile.TemporaryDirectory() as folder:
        np.savez(f"{folder}/x.npz", **pairs)
        make_train(env, gasil_jax.GAIL(expert=f"{folder}/x.npz"))


def step(state):
    jax.eval_shape(lambda state: gasil_jax.train_step(ENV, SMALL, state), state)


#: Python that uses the package in a way that does not fit, and what is told.
UNFIT = r"""
make_train(Short()) | env 'Short': the obs of its reset has shape \(2,\): it must
make_train(wrappers.RewardDelay(Short(), 5)) | env 'Short': the obs of its reset
make_train(wrappers.AutoReset(ENV)) | env is wrapped in AutoReset
make_train(training.AutoResetWrapper(ENV)) | env is wrapped in AutoReset
make_train(gymnasium.make("CartPole-v1")) | has no observation_size: .* Brax's inter
make_train(BothActions()) | has action_size and num_actions: it must have one
make_train(NoActions()) | has no action_size \(or num_actions
make_train(ENV, Twice()) | 'episode_return' of agent '.*:Twice' has the name of another
make_train(Corridor(), policy_components=4) | is 4: it must be 1, .* are discrete
make_train(ENV, OwnPolicy(), policy_components=4) | has a policy_network of its own
make_train(ENV, gasil_jax.GASIL(), bonus="softmax") | bonus 'softmax' is unk.*softplus
taught(ENV, observation=np.ones((9, 3)), action=np.ones((9, 2))) | of size 3 and actions
taught(Corridor(), observation=np.eye(4), action=[0, 3, 0, 0]) | to 3 as actions: the en
taught(ENV, observation=np.ones((2, 11)), action=[0, 1]) | as actions: .* vectors of
SMALL.replace(expert="a.npz") | expert is a setting of gail, not of ppo
SMALL.replace(reward_clip=1.0) | reward_clip has no effect: normalize_rewards is off
SMALL.replace(alhpa=0.1) | 'alhpa' is unknown: did you mean 'alpha'
with_numbers({"gamma": 1.5}) | gamma is 1.5
with_numbers({"learning_rate": 1e-60}) | 1e-60: it must be more than 0 in float32
with_numbers({"alpha": np.ones(3)}) | alpha has shape \(3,\): .*vmap
with_numbers({"buffer_steps": 1}) | buffer_steps is not traced
jax.eval_shape(with_numbers, {"alpha": jnp.ones(3)}) | alpha has shape
gasil_jax.init(ENV, SMALL.replace(num_envs=3), KEY) | num_envs is 3, which does not divi
step(two_states()) | batch of 2 states: .*jax.vmap this
from_state(two_states(), ENV) | state is a batch of 2 states
gasil_jax.member({"a": np.zeros(2), "b": 1}, 0) | states is .*: it must be arrays with
make_env("sparse:u_maze_noisy", action_noise=0.1) | 0: sparse:u_maze_noisy has its own
make_env("sparse:key_grid", action_noise=1.5) | 1.5: .* at most 1, a share, for sparse
make_env("point_mass", reward_dellay=2) | 'reward_dellay' .* mean 'reward_delay'
make_env("point_mass", observe_phase=True) | observe_phase is True: it needs a reward_d
make_env("Hopper-v5") | did you mean 'hopper'
gasil_jax.fit(ENV, SMALL, checkpoint_every=64) | is 64: it needs a folder
gasil_jax.fit(ENV, SMALL, resume=True) | resume is True: it needs a folder
gasil_jax.fit(ENV, SMALL, folder="/") | folder is .* not empty
gasil_jax.fit(ENV, SMALL, points=[{"imitation_weight": 1.0}]) | of ppo.gasil-adaptive, n
gasil_jax.fit(ENV, SMALL, points=[{"num_epochs": 2}]) | num_epochs is not traced
episodes(3) | act is 3: it must be a function of observations and a key
episodes(lambda seen, key: None) | act returns None: it must be of shape \(3, 2
episodes(lambda seen, key: jnp.zeros(2)) | returns an array of shape \(2,\): it
"""


@pytest.mark.parametrize(("use", "message"), rows(UNFIT))
def test_what_does_not_fit_is_refused(use, message):
    with pytest.raises(ValueError, match=message) as refusal:
        eval(use)
    assert "\n" not in str(refusal.value)


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
    grid = ("--agent", "ppo", "--grid", "gamma=0.9,0.99")
    assert sweep.main([*FLAGS, *grid, "--out", str(out)]) == 0
    return out


#: A file, where in it, and the value that stands there instead of its own.
DAMAGES = """
config.json |  | 3
config.json | seeds | null
config.json | seeds | [1, 1]
config.json | points | [{"alhpa": 1.0}]
config.json | settings gravity | 3
config.json | recording log | "wandb"
config.json | algorithm agent | "gasill"
config.json | algorithm gamma | -1
config.json | algorithm hidden_sizes | {"a": 1}
config.json | env | "hoper"
program.json |  | []
program.json | runs | [[9, 0], [1, 0]]
program.json | labels seed | [5, 6]
program.json | experiments | [3, 4]
training.json |  | "x"
training.json | iterations | true
training.json | train_seconds | null
training.json | device | gone
summary.json |  | null
summary.json | best_by_mean | "first"
"""


@pytest.mark.parametrize(
    ("name", "path", "value"),
    [
        *rows(DAMAGES),
        *[("config.json", None, x) for x in ("", "[" * 100_000, "\xff")],
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


@pytest.mark.parametrize("name", ["seeds", "mean", "kernel_0"])
def test_a_file_of_policies_without_one_of_its_arrays_is_refused(name, tmp_path):
    arrays = dict(np.load(numpy_policy.ZOO / "hopper.npz"))
    del arrays[name]
    np.savez(tmp_path / "policy.npz", **arrays)
    with pytest.raises(ValueError, match=rf"is not a saved policy \({name} is missing"):
        gasil_jax.load_policy(tmp_path)

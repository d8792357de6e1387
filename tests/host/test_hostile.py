"""Values, command lines and files of any kind are taken, or refused in a line."""

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
from gasil_jax.host import output_file
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
    "hidden_sizes": [3, (2**62,), [3], (None,), (True,), (0,)],
    "alpha_schedule": [3, None, ((1,),), ((0, True),), lambda s: None, lambda: 1.0],
    "normalize_rewards": [None, 1, "on", np.True_],
}
ENVIRONMENT = {
    "reward_delay": [*NUMBERS, 0, 0.5],
    "obs_noise": NUMBERS,
    "physics": [3, None, "mjxx"],
    "terminal_limits": [1, None],
    "max_episode_steps": [0, True, "3"],
}
FIT = {
    "seeds": [*NUMBERS[:4], [], 0, 0.5, [1, 1], [2**32], 2**21],
    "evaluate_every": [*NUMBERS[1:], 0, 0.5],
    "evaluate_episodes": [*NUMBERS, 0, 0.5],
    "checkpoint_every": [*NUMBERS[1:], 0],
    "resume": [None, 1, "on"],
    "folder": [3, []],
    "callback": [3, "x"],
    "points": [3, [], [3], "alpha"],
}
EPISODES = {
    "num_episodes": [*NUMBERS, 0],
    "deterministic": [1, None],
    "key": [0, 0.5, None],
}
PARTS = {
    "agent": [3, None],
    "rewards": [3, None, [], (gasil_jax.Normalize,)],
    "config": [3, gasil_jax.Config],
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
    ("hyperparameters", lambda x: gasil_jax.init(ENV, SMALL, KEY, x), [0, "alpha"]),
    ("agent", gasil_jax.algorithm, [3, None, "gasill"]),
    ("env", lambda x: gasil_jax.preset(x, "ppo"), [3, None]),
    ("preset", lambda x: gasil_jax.preset("hopper", "ppo", x), [3, None, "tuend"]),
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
        with pytest.raises((ValueError, IndexError)) as refused:
            use(value)
        told = str(refused.value)
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
    ("env", "message"),
    [
        (Short(), "env 'Short': the obs of its reset has shape (2,): it must have"),
        (wrappers.RewardDelay(Short(), 5), "env 'Short': the obs of its reset has"),
        (wrappers.AutoReset(ENV), "env is wrapped in AutoReset"),
        (training.AutoResetWrapper(ENV), "env is wrapped in AutoReset"),
    ],
)
def test_an_environment_that_does_not_fit_is_refused(env, message):
    with pytest.raises(ValueError, match=re.escape(message)) as refusal:
        gasil_jax.make_train(env, gasil_jax.algorithm())
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("act", "why"),
    [
        (3, "act is 3: it must be a function of observations and a key"),
        (lambda observation, key: None, "act returns None: it must be of shape (3, 2)"),
        (lambda observation, key: jnp.zeros(2), "returns an array of shape (2,): it"),
    ],
)
def test_a_policy_that_returns_no_actions_is_refused(act, why):
    with pytest.raises(ValueError, match=re.escape(why)):
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


def refused(capsys, program, words):
    """Run a command line that ends in one line, and return that."""
    assert program.main(words) == 2, words
    printed = capsys.readouterr()
    told = [x for x in printed.err.splitlines() if x.startswith("error: ")]
    others = set(printed.err.splitlines()) - set(told)
    assert all(x.startswith(("note: ", "warning: ")) for x in others), printed.err
    assert len(told) == 1 and len(told[0]) < 2000 and printed.out == "", words
    return told[0]


def test_an_altered_command_line_ends_in_one_line(capsys, monkeypatch):
    monkeypatch.chdir("/proc")  # Where nothing can be written.
    for program, line in LINES:
        words = line.split()
        for number, word in enumerate(WORDS):
            at = 1 + number % len(words)
            refused(capsys, program, [*words[:at], word, *words[at:]])
        for at in range(len(words)):
            refused(capsys, program, words[:at] + words[at + 1 :])


@pytest.mark.slow
def test_a_randomly_altered_command_line_ends_in_one_line(capsys, monkeypatch):
    monkeypatch.chdir("/proc")
    draw = np.random.default_rng(0)
    for number in range(60 * len(LINES)):
        program, line = LINES[number % len(LINES)]
        words = line.split()
        for _ in range(2):
            at, kind = int(draw.integers(len(words))), draw.integers(4)
            if kind == 0:
                words.insert(at, WORDS[draw.integers(len(WORDS))])
            elif kind == 1:
                words.insert(at, words[draw.integers(len(words))])
            else:
                place = int(draw.integers(len(words[at]) + 1))
                other = "" if kind == 2 else chr(draw.integers(48, 127))
                words[at] = words[at][:place] + other + words[at][place + 1 :]
        if {"-h", "--help", "--help-all", "--version"}.isdisjoint(words):
            refused(capsys, program, words)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--evaluate-every 0", "evaluate_every is 0: it must be from 1"),
        ("--evaluate-every x", "evaluate_every is 'x': it must be a whole number"),
        ("--evaluate-every 9 --evaluate-episodes 0", "evaluate_episodes is 0: it must"),
        ("--evaluate-episodes 3", "evaluate_episodes is 3: it needs evaluate_every"),
        ("--evaluate-every 9 --evaluate-episodes 1e12", "GB of memory"),
        ("--seeds 9" + 400 * "9", "seeds is 99999"),
        (f"--out {300 * 'x'}", "too long"),
        (f"--alpha {5000 * 'x'}", f"alpha is '{30 * 'x'}"),
        (f"--{5000 * 'x'}", "is unknown"),
        ("--num-env 3", "did you mean --num-envs"),
    ],
)
def test_bad_options_are_one_line(words, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for program, more in ((run, ()), (sweep, ("--grid", "gamma=0.9,0.99"))):
        given = [*FLAGS, "--out", "out", *words.split(), *more]
        assert message in refused(capsys, program, given)
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(ValueError, match="too long"):
        # A file is first written under a name that is longer by some 40 bytes.
        output_file.make_parent(tmp_path / f"{'x' * 240}.gif")
    assert refused(capsys, evaluate, [300 * "x"])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The folder of a sweep of two points."""
    out = tmp_path_factory.mktemp("whole") / "out"
    flags = [*FLAGS, "--agent", "ppo", "--max-episode-steps", "10"]
    assert sweep.main([*flags, "--grid", "gamma=0.9,0.99", "--out", str(out)]) == 0
    return out


def edit(*path, value=None):
    """Return a function that replaces a value in what a JSON file holds."""

    def edited(content):
        inner = content
        for key in path[:-1]:
            inner = inner[key]
        inner[path[-1]] = value
        return content

    return edited


DAMAGES = [
    *[
        (name, lambda _, x=x: x)
        for name in ("config.json", "program.json", "training.json", "summary.json")
        for x in (None, 3, [], "x")
    ],
    *[("config.json", edit(x)) for x in ("seeds", "points", "algorithm", "settings")],
    *[
        ("config.json", edit(*path, value=x))
        for *path, x in (
            *(("seeds", [-1]), ("seeds", [2**40]), ("seeds", "two"), ("seeds", [1, 1])),
            *(("points", []), ("points", [3]), ("points", [{"alhpa": 1.0}])),
            *(("points", [{"batch_steps": 0}]), ("settings", "gravity", 3)),
            *(("settings", "obs_noise", "loud"), ("recording", "log", "wandb")),
            *(("recording", "keep_checkpoints", "all"), ("algorithm", "agent", 3)),
            *(("algorithm", "agent", "gasill"), ("algorithm", "alpa", 1)),
            *(("algorithm", "imitation_weight", 0.5), ("algorithm", "gamma", "high")),
            *(("algorithm", "gamma", -1), ("algorithm", "hidden_sizes", {"a": 1})),
            *(("algorithm", "normalize_rewards", 1), ("env", "hoper")),
        )
    ],
    *[
        ("program.json", edit(*path, value=x))
        for *path, x in (
            *(("runs", [[0, 0]]), ("runs", [[9, 0], [1, 0]]), ("runs", [3])),
            *(("labels", {}), ("labels", "seed", [5, 6]), ("labels", "seed", [0])),
            *(("labels", "point", ["a", "b"]), ("experiments", [3, 4])),
        )
    ],
    *[("training.json", edit(x, value="x")) for x in ("iterations", "versions")],
    ("summary.json", edit("best_by_mean", value="first")),
    ("summary.json", edit("best_by_mean", value=7)),
]


@pytest.mark.parametrize(("name", "damage"), DAMAGES)
def test_a_damaged_file_is_told_in_a_line(name, damage, folder, tmp_path, capsys):
    """Those that a command does not need change nothing."""
    out = shutil.copytree(folder, tmp_path / "out")
    path = next(out.rglob(name))
    path.write_text(json.dumps(damage(json.loads(path.read_text()))))
    needs = {"summary.json": [evaluate]}.get(name, [evaluate, plot, sweep])
    for program in needs:
        words = [str(out), "--out", str(tmp_path / "x.png")]
        words = words[:1] if program is evaluate else words
        resumed = ["--resume", "--out", str(out)]
        refused(capsys, program, resumed if program is sweep else words)


@pytest.mark.parametrize(
    "content", [b"", b"[" * 100_000, b"\x80\x04N.", b"{}", b"\xff"]
)
def test_what_is_no_description_is_refused(content, tmp_path, capsys):
    (tmp_path / "config.json").write_bytes(content)
    resumed = ["--resume", "--out", str(tmp_path)]
    for program, words in ((evaluate, [str(tmp_path)]), (run, resumed)):
        assert "config.json is damaged: " in refused(capsys, program, words)


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
    import builtins

    path = tmp_path / "x.npz"
    path.write_bytes(content)
    for use in (act_of, load):
        with pytest.raises(ValueError, match=r"must be an|not a saved po") as refusal:
            use(path)
        assert "\n" not in str(refusal.value) and str(path) in str(refusal.value)
    assert not hasattr(builtins, "exploded")


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

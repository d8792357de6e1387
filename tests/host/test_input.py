"""Any input either runs or is refused in one line before anything compiles."""

import contextlib
import dataclasses
import io
import itertools
import json
import math
import pickle
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs import State
from brax.envs import Wrapper as BraxWrapper
from brax.envs.wrappers import training
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import gasil_jax
from gasil_envs import wrappers
from gasil_jax import algorithms, evaluate, evaluation, merge, npz, run, sweep
from gasil_jax.agents import AGENTS, expert
from gasil_jax.errors import InputError
from gasil_jax.host import output_file, run_folder
from gasil_jax.host.environments import Settings, check
from gasil_jax.rewards import REWARD_MODELS


def names(kind):
    """Return the fields that are numbers or tuples of numbers."""
    return [
        f.name
        for f in dataclasses.fields(kind)
        if not isinstance(f.default, str) and f.name != "expert"
    ]


#: Each option, with an agent that has it.
OPTIONS = {name: agent for agent, kind in AGENTS.items() for name in names(kind)}
OPTIONS |= dict.fromkeys(
    [
        *names(gasil_jax.Config),
        *(name for model in REWARD_MODELS for name in (model.switch, *names(model))),
        *names(Settings),
        "seeds",
        "first_seed",
        "devices",
        "checkpoint_every",
        "keep_checkpoints",
        "evaluate_every",
        "evaluate_episodes",
    ],
    "ppo",
)
SMALL = gasil_jax.algorithm(num_envs=4, batch_steps=64, minibatch_size=16)
NEVER_VALID = st.one_of(
    st.sampled_from(["-1", "-0.5", "nan", "inf", "-inf", "", "true", "1e999", "0x10"]),
    st.text(
        st.characters(categories=["L", "S"], codec="ascii"), min_size=1, max_size=8
    ),
    st.integers(max_value=-1).map(str),
    st.floats(max_value=-1e-9).map(str),
)


@settings(max_examples=300, deadline=None, derandomize=True)
@given(name=st.sampled_from([*OPTIONS]), value=NEVER_VALID)
def test_a_value_that_is_never_valid_is_refused(name, value):
    out, err = io.StringIO(), io.StringIO()
    argument = f"--{name.replace('_', '-')}={value}"
    task = ("--env", "hopper", "--agent", OPTIONS[name])
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            # A folder that can't be made stops the run should all else be accepted.
            status = run.main([*task, argument, "--out", "/proc/no/run"])
        except SystemExit as exit_:
            pytest.fail(f"{argument} exits with {exit_.code}")
    assert status == 2, argument
    message = err.getvalue()
    assert out.getvalue() == "" and len(message.splitlines()) == 1, message
    assert name in message.replace("-", "_"), (argument, message)


@settings(
    max_examples=200,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.too_slow],
)
@given(words=st.lists(st.text(max_size=12), max_size=6))
def test_words_without_meaning_are_refused(words):
    err = io.StringIO()
    if any(word in ("-h", "--help") for word in words):
        return
    with contextlib.redirect_stderr(err):
        assert run.main(words) == 2
    assert len(err.getvalue().splitlines()) == 1


SIZES = st.integers(-1, 9)
ANY_FLOAT = st.one_of(
    st.floats(0, 1),
    st.sampled_from([0.0, -1.0, math.nan, math.inf, 1e-30, 1e30, 2.0]),
)


@st.composite
def small_algorithms(draw):
    """Draw small algorithms, about one in four valid."""
    # GAIL needs an expert.
    agent = draw(st.sampled_from([x for x in gasil_jax.agents.AGENTS if x != "gail"]))
    algorithm = gasil_jax.algorithm(agent, normalize_rewards=draw(st.booleans()))
    factor = draw(st.integers(1, 4))
    num_envs = draw(st.sampled_from([1, 2, 3]))
    drawn = {
        "total_steps": draw(st.integers(1, 100)),
        "num_envs": num_envs,
        "batch_steps": draw(st.sampled_from([num_envs * factor * 4, 7])),
        "minibatch_size": draw(st.sampled_from([1, 4, num_envs])),
        "num_epochs": draw(st.integers(1, 2)),
        "hidden_sizes": tuple(draw(st.lists(st.integers(1, 5), max_size=2))),
        "discriminator_hidden_sizes": tuple(
            draw(st.lists(st.integers(0, 5), max_size=1))
        ),
        "discriminator_minibatch_size": draw(st.integers(1, 70)),
        "buffer_steps": draw(st.integers(1, 60)),
        "sil_buffer_steps": draw(st.integers(1, 60)),
        "sil_minibatch_size": draw(st.integers(1, 70)),
        "alpha_schedule": draw(
            st.sampled_from([(), ((0.0, 0.0), (9.0, 1.0)), ((5, -1),)])
        ),
    } | {
        name: draw(ANY_FLOAT)
        for name in algorithm.hyperparameters
        if draw(st.integers(0, 9)) == 0
    }
    own = algorithm.settings
    return algorithm.replace(**{name: x for name, x in drawn.items() if name in own})


def accepted(algorithm):
    try:
        algorithms.check(algorithm)
    except ValueError as error:
        names = [*algorithm.settings]
        assert any(re.search(rf"\b{name}\b", str(error)) for name in names), error
        assert "\n" not in str(error)
        return False
    return True


@settings(max_examples=500, deadline=None, derandomize=True)
@given(algorithm=small_algorithms())
def test_a_refused_algorithm_names_the_setting(algorithm):
    accepted(algorithm)


def schedules_at_fault():
    yield from (3, None, "a", [(0.0, 1.0)], ((1,),), ((0, True),), ((0, 2**2000),))
    yield from (lambda s: s * math.nan, lambda s: -1.0, lambda s: None, lambda: 1.0)
    yield lambda s: np.ones(3)


WRONG = [
    *[("gamma", x) for x in (None, [1], True, np.True_, 1j, math.nan, 2**2000, {})],
    *[("learning_rate", x) for x in (0.0, -1e300, 10**400, np.zeros((2, 2)))],
    ("num_envs", np.zeros((2, 2))),
    *[("hidden_sizes", x) for x in (3, (2**62,), [3], ("a",), (None,), (True,))],
    *[
        (name, x)
        for name in ("num_envs", "total_steps", "buffer_steps")
        for x in (2**62, 2**2000, True, 1.0, "3", [], 0, math.nan)
    ],
    *[("alpha_schedule", x) for x in schedules_at_fault()],
    ("alpha", 1e300),
    ("expert", 3),
    ("normalize_rewards", 1),
]


@pytest.mark.parametrize(("name", "value"), WRONG)
def test_a_value_of_any_type_is_refused_by_name(name, value):
    agent = "gail" if name == "expert" else "ppo+gasil"
    with pytest.raises(ValueError, match=name) as refusal:
        algorithms.check(gasil_jax.algorithm(agent).replace(**{name: value}))
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *[("agent", x) for x in (3, None, "", "ppo", gasil_jax.PPO)],
        *[("rewards", x) for x in (3, None, [], (3,), (gasil_jax.Normalize,))],
        *[("config", x) for x in (3, None, gasil_jax.Config)],
    ],
)
def test_a_part_of_any_type_is_refused_by_name(name, value):
    parts = {"agent": gasil_jax.PPO(), name: value}
    with pytest.raises(ValueError, match=f"^{name} is ") as refusal:
        algorithms.check(gasil_jax.Algorithm(**parts))
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("value", [0, 3, [], "alpha"])
def test_hyperparameters_of_any_type_are_refused(value):
    env, key = gasil_jax.make_env("point_mass"), jax.random.key(0)
    with pytest.raises(
        ValueError, match=r"hyperparameters is .*: it must be numbers b"
    ):
        gasil_jax.init(env, SMALL, key, value)


@pytest.mark.parametrize("agent", [3, None, [], "", "gasill"])
def test_an_agent_of_any_type_is_refused_by_name(agent):
    with pytest.raises(ValueError, match=r"^agent '.*' is unknown: ") as refusal:
        gasil_jax.algorithm(agent)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("name", OPTIONS)
def test_a_whole_number_beyond_all_floats_is_refused(name, capsys):
    for sign in ("", "-"):
        value = f"--{name.replace('_', '-')}={sign}{400 * '9'}"
        task = ("--env", "point_mass", "--agent", OPTIONS[name])
        assert run.main([*task, value, "--out", "/proc/no/run"]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert name in line.replace("-", "_")


@pytest.mark.parametrize(
    "value",
    [10**400, -(10**400), 0, None, "3", True],
    ids=lambda value: str(value)[:4],
)
def test_a_count_that_is_none_is_refused_by_name(value):
    env, key = gasil_jax.make_env("point_mass"), jax.random.key(0)
    for name, call in (
        ("reward_delay", lambda: gasil_jax.preset("hopper", "ppo", reward_delay=value)),
        ("evaluate_every", lambda: gasil_jax.fit(env, SMALL, evaluate_every=value)),
        (
            "num_episodes",
            lambda: evaluation.run_episodes(
                env, None, key, num_episodes=value, num_steps=1
            ),
        ),
        (
            "key",
            lambda: evaluation.run_episodes(
                env, None, value, num_episodes=1, num_steps=1
            ),
        ),
        ("path", lambda: gasil_jax.load_policy(value)),
    ):
        is_default = name == "evaluate_every" and value is None
        is_path = name == "path" and isinstance(value, str)
        if not is_default and not is_path:
            with pytest.raises(ValueError, match=f"^{name} is "):
                call()


@pytest.mark.parametrize(
    ("act", "why"),
    [
        (3, "act is 3: it must be a function of observations and a key"),
        (None, "act is None: it must be a function"),
        (lambda observation, key: None, "act returns None: it must be of shape (3, 2)"),
        (lambda observation, key: "x", "act returns 'x': it must be of shape (3, 2)"),
        (lambda observation, key: jnp.zeros(2), "returns an array of shape (2,): it"),
    ],
)
def test_a_policy_that_returns_no_actions_is_refused(act, why):
    env = gasil_jax.make_env("point_mass")
    with pytest.raises(ValueError, match=re.escape(why)):
        evaluation.run_episodes(
            env, act, jax.random.key(0), num_episodes=3, num_steps=1
        )


@pytest.mark.parametrize("act", [3, None, "x"])
def test_a_policy_that_cannot_be_called_is_refused_in_gymnasium(act):
    with pytest.raises(ValueError, match=f"act is {act!r}: it must be a function of"):
        evaluate.evaluate_in_gymnasium("Hopper-v5", act, num_episodes=1)


@pytest.mark.parametrize("env", [3, None, "hopper"])
def test_episodes_are_run_in_an_environment_alone(env):
    act, key = lambda observation, key: observation, jax.random.key(0)
    with pytest.raises(ValueError, match=f"env is {env!r}, which has no reset: it mu"):
        evaluation.run_episodes(env, act, key, num_episodes=1, num_steps=1)


@pytest.mark.parametrize(
    ("name", "nearest"), [("num_env", "num_envs"), ("Alpha", "alpha")]
)
def test_a_name_that_is_no_setting_is_refused_with_the_nearest(name, nearest):
    message = f"setting '{name}' is unknown: did you mean '{nearest}'"
    with pytest.raises(ValueError, match=message):
        gasil_jax.algorithm().replace(**{name: 3})


def test_what_is_no_single_random_key_is_refused():
    env = gasil_jax.make_env("point_mass")
    train = gasil_jax.make_train(env, gasil_jax.algorithm())
    for seed in (0, 0.5, None):
        with pytest.raises(ValueError, match=rf"key is {seed}: it must be like jax"):
            train(seed)
    with pytest.raises(ValueError, match=r"key has shape \(2,\): it must be a single"):
        train(jax.random.split(jax.random.key(0)))
    jax.eval_shape(train, jax.random.PRNGKey(0))


def test_traced_values_pass_unlooked_at():
    def check(gamma):
        algorithms.check(
            gasil_jax.algorithm(gamma=gamma, alpha_schedule=lambda s: gamma)
        )
        return gamma

    jax.eval_shape(check, -1.0)


@settings(
    max_examples=3,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.filter_too_much, HealthCheck.too_slow],
)
@given(algorithm=small_algorithms().filter(accepted))
def test_an_accepted_algorithm_completes_an_iteration(algorithm):
    env = gasil_jax.make_env("point_mass", reward_delay=2)
    init = lambda key: gasil_jax.init(env, algorithm, key)
    first = jax.jit(lambda key: gasil_jax.train_step(env, algorithm, init(key)))
    state, _ = first(jax.random.key(0))
    assert int(state.iteration) == 1
    for leaf in jax.tree.leaves((state.actor_critic, state.agent)):
        assert np.isfinite(leaf).all()


@settings(max_examples=200, deadline=None, derandomize=True)
@given(delay=st.integers(-2, 2), noise=ANY_FLOAT)
def test_settings_are_refused_or_made(delay, noise):
    chosen = Settings(reward_delay=delay, obs_noise=noise)
    try:
        check("point_mass", chosen)
    except ValueError as error:
        assert "reward_delay" in str(error) or "obs_noise" in str(error)
        return
    env = gasil_jax.make_env("point_mass", reward_delay=delay, obs_noise=noise)
    assert env.observation_size > 0


def test_an_environment_that_resets_itself_is_refused():
    env = gasil_jax.make_env("point_mass")
    brax = BraxWrapper(training.AutoResetWrapper(env))
    for wrapped, name in ((wrappers.AutoReset(env), "AutoReset"), (brax, "AutoReset")):
        with pytest.raises(ValueError, match=f"env is wrapped in {name}"):
            gasil_jax.make_train(wrapped, gasil_jax.algorithm())
    gasil_jax.make_train(BraxWrapper(env), gasil_jax.algorithm())


class Short:
    """An environment whose observations are shorter than it says."""

    observation_size, action_size = 3, 1

    def reset(self, rng):
        return State(None, jnp.zeros(2), jnp.float32(0), jnp.float32(0))

    def step(self, state, action):
        return state


@pytest.mark.parametrize(
    ("env", "message"),
    [
        ("hopper", "env is 'hopper', which has no reset"),
        (Short, "env is the class Short: it must be an instance"),
        (
            Short(),
            "env 'Short': the obs of its reset has shape (2,): it must have shape (3,)",
        ),
        (wrappers.RewardDelay(Short(), 5), "env 'Short': the obs of its reset has"),
    ],
)
def test_what_is_no_environment_is_refused(env, message):
    with pytest.raises(ValueError, match=re.escape(message)) as refusal:
        gasil_jax.make_train(env, gasil_jax.algorithm())
    assert "\n" not in str(refusal.value)


class Bomb:
    """An object whose unpickling leaves a mark."""

    def __reduce__(self):
        return (exec, ("import builtins; builtins.exploded = True",))


def saved(kind, *arguments, **arrays):
    file = io.BytesIO()
    kind(file, *arguments, **arrays)
    return file.getvalue()


WHOLE = saved(
    np.savez_compressed,
    observation=np.random.default_rng(0).normal(size=(50, 3)),
    action=np.zeros((50, 1)),
)


@pytest.mark.parametrize(
    "content",
    [
        WHOLE[: len(WHOLE) // 2],
        WHOLE[:300] + b"xxxx" + WHOLE[304:],
        saved(np.save, np.zeros(3)),
        saved(np.savez, observation=np.zeros((3, 2))),
        *[
            saved(np.savez, observation=np.zeros((3, 2)), action=action)
            for action in (
                np.zeros((3, 1), complex),
                np.full((3, 1), b"1"),
                np.full((3, 1), "1"),
                np.zeros((3, 1), "datetime64[s]"),
                np.zeros((3, 1), bool),
                np.full((3, 1), 1e300),
                np.full((3, 1), np.nan),
                np.zeros((3, 1, 1)),
                np.zeros((3, 0)),
                np.zeros((2, 1)),
            )
        ],
        b"",
        b"PK\x03\x04 not a zip",
        b"\x80\x04N.",
        pickle.dumps({"observation": [1]}),
    ],
)
def test_a_foreign_demonstration_file_is_refused(content, tmp_path):
    path = tmp_path / "expert.npz"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"must be an \.npz file") as refusal:
        expert.load(str(path))
    assert "\n" not in str(refusal.value)


def test_a_file_with_an_altered_byte_is_read_or_refused(tmp_path):
    path = tmp_path / "expert.npz"
    arrays = {name: np.ones((2, 1)) for name in ("observation", "action")}
    whole, refused = saved(np.savez, **arrays), 0
    for position, value in itertools.product(range(len(whole)), (1, 64, 255)):
        altered = bytearray(whole)
        altered[position] ^= value
        path.write_bytes(altered)
        try:
            npz.read(path)
        except ValueError as error:
            refused += 1
            assert "\n" not in str(error)
    assert refused > 100


def test_an_array_that_nobody_needs_may_be_of_any_kind(tmp_path):
    path = tmp_path / "expert.npz"
    arrays = {name: np.ones((2, 1)) for name in ("observation", "action")}
    np.savez(path, **arrays, notes=np.array([{}]))
    observation, _ = expert.load(str(path))
    np.testing.assert_array_equal(observation, arrays["observation"])


def test_a_demonstration_file_is_never_unpickled(tmp_path):
    import builtins

    path = tmp_path / "bomb.npz"
    bomb = np.array([Bomb()], dtype=object)
    np.savez(path, observation=bomb, action=bomb)
    with pytest.raises(ValueError, match="must be an"):
        expert.load(str(path))
    assert not hasattr(builtins, "exploded")


GOOD = {
    "env": "point_mass",
    "seeds": 1,
    "first_seed": 0,
    "settings": {},
    "algorithm": {"agent": "ppo+gasil"},
}


def with_algorithm(**values):
    return json.dumps(GOOD | {"algorithm": GOOD["algorithm"] | values})


@pytest.mark.parametrize(
    "content",
    [
        "",
        "[]",
        "{}",
        "\x80\x04N.",
        json.dumps(GOOD | {"seeds": "two"}),
        json.dumps(GOOD | {"settings": {"gravity": 3}}),
        json.dumps(GOOD | {"algorithm": []}),
        json.dumps(GOOD | {"algorithm": {}}),
        json.dumps(GOOD | {"algorithm": {"agnt": "ppo"}}),
        with_algorithm(agent=3),
        with_algorithm(agent="gasill"),
        with_algorithm(alpa=1),
        with_algorithm(imitation_weight=0.5),
        with_algorithm(alpha="high"),
        with_algorithm(alpha=-1),
        with_algorithm(hidden_sizes={"a": 1}),
        with_algorithm(alpha_schedule=3),
        with_algorithm(normalize_rewards=1),
        with_algorithm(reward_clip=5.0),
        json.dumps(GOOD | {"settings": {"obs_noise": "loud"}}),
        json.dumps(GOOD | {"settings": []}),
        json.dumps(GOOD | {"env": None}),
        json.dumps(GOOD | {"seeds": 2**40}),
        json.dumps(GOOD | {"first_seed": -1}),
        json.dumps(GOOD | {"keep_checkpoints": "all"}),
        json.dumps(GOOD | {"log": "wandb"}),
        json.dumps(GOOD | {"points": [3]}),
        "[" * 100_000,
    ],
)
def test_a_foreign_run_folder_is_refused(content, tmp_path, capsys):
    (tmp_path / "config.json").write_text(content)
    for main, arguments in (
        (evaluate.main, [str(tmp_path)]),
        (run.main, ["--resume", "--out", str(tmp_path)]),
    ):
        assert main(arguments) == 2
        error = capsys.readouterr().err
        assert len(error.splitlines()) == 1
        assert "is damaged, or another program wrote it" in error


def test_an_unknown_preset_of_a_run_is_refused(tmp_path, capsys):
    options = {"keep_checkpoints": 2, "log": [], "preset": "tuend"}
    (tmp_path / "config.json").write_text(json.dumps(GOOD | options))
    assert run.main(["--env", "point_mass", "--resume", "--out", str(tmp_path)]) == 2
    assert capsys.readouterr().err.startswith("error: preset 'tuend' is unknown: did")


def test_a_run_folder_of_another_state_is_refused(tmp_path, capsys):
    from gasil_jax.host import checkpoint

    (tmp_path / "config.json").write_text(json.dumps(GOOD))
    assert evaluate.main([str(tmp_path)]) == 2
    assert "no whole checkpoint" in capsys.readouterr().err
    checkpoint.write(tmp_path / "checkpoints", 1, {"x": np.zeros(2)}, {})
    assert evaluate.main([str(tmp_path)]) == 2
    assert "holds another state" in capsys.readouterr().err
    assert run_folder.read(tmp_path)["env"] == "point_mass"


@pytest.mark.parametrize(
    ("point", "summary", "message"),
    [
        ({"alpha": 1.0}, {"best_by_mean": "first"}, "best_by_mean is 'first': it must"),
        ({"alpha": 1.0}, {}, "best_by_mean is missing"),
        ({"alpha": 1.0}, [], "it is []: it must be an object"),
        ({"alhpa": 1.0}, {"best_by_mean": 0}, "points: 'alhpa' can't vary"),
        ({"batch_steps": 0}, {"best_by_mean": 0}, "points: batch_steps is 0"),
    ],
)
def test_a_foreign_sweep_folder_is_refused(point, summary, message, tmp_path, capsys):
    described = GOOD | {"points": [point], "shard": None}
    (tmp_path / "config.json").write_text(json.dumps(described))
    (tmp_path / "summary.json").write_text(json.dumps(summary))
    assert evaluate.main([str(tmp_path)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line


def test_a_file_name_that_is_too_long_is_refused(tmp_path, capsys):
    for main, arguments in (
        (run.main, ["--env", "point_mass", "--out", 300 * "x"]),
        (run.main, ["--resume", "--out", 300 * "x"]),
        (sweep.main, ["--env", "point_mass", "--out", 300 * "x", "--shard", "1/2"]),
        (merge.main, [300 * "x"]),
    ):
        assert main(arguments) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert "too long" in line and "xxx" in line
    with pytest.raises(InputError, match="too long"):
        # A file is first written under a name that is longer by some 40 bytes.
        output_file.make_parent(tmp_path / f"{'x' * 240}.gif")
    assert list(tmp_path.iterdir()) == []

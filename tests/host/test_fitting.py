"""`gasil_jax.fit` trains as the command line does."""

import dataclasses
import json
import os
import signal

import brax.envs
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import small_training
from refusals import refused
from test_checkpoints import assert_same
from test_resume import program_of

import gasil_jax
from gasil_jax import evaluate, plot, render, run
from gasil_jax.host import checkpoint, saved
from gasil_jax.host.interruption import Interrupted

# Iterations, the longest of a chunk, and the algorithm of both ways to train.
ITERATIONS, CHUNK = 100, 2
PPO = gasil_jax.algorithm("ppo", **small_training.SETTINGS)
SHORT, PPO = PPO, PPO.replace(total_steps=ITERATIONS * 128)
FLAGS = (
    *(*small_training.FLAGS, "--agent", "ppo", "--preset", "paper"),
    "--no-normalize-rewards",
    *("--total-steps", str(ITERATIONS * 128), "--stagger-episodes"),
)
EVALUATED = {"evaluate_every": 40 * 128, "evaluate_episodes": 2}
TABLES = ("metrics.csv", "evaluations.csv")
# Pictures are drawn, and not written, which takes long.
pytestmark = pytest.mark.usefixtures("figures")


@pytest.fixture(scope="module")
def env():
    return gasil_jax.make_env("point_mass")


@pytest.fixture(scope="module")
def own(env):
    """An environment that is not as `make_env` returned it."""
    return brax.envs.Wrapper(env)


@pytest.fixture(scope="module")
def commanded(tmp_path_factory):
    """The folder of the same training by the command line."""
    out = tmp_path_factory.mktemp("commanded") / "out"
    evaluated = ("--evaluate-every", str(40 * 128), "--evaluate-episodes", "2")
    assert run.main([*FLAGS, *evaluated, "--seeds", "2", "--out", str(out)]) == 0
    return out


@pytest.fixture(scope="module")
def fitted(env, commanded, tmp_path_factory):
    """The result of `fit`, its folder, and what its callback was given."""
    folder, seen = tmp_path_factory.mktemp("fitted") / "out", []
    arguments = {"seeds": 2, "folder": folder, "callback": seen.append, **EVALUATED}
    return gasil_jax.fit(env, PPO, **arguments), folder, seen


def assert_equal_folders(first, second):
    """Compare tables, results and policies, to the last digit."""
    for name in TABLES:
        one, other = (program_of(x) / name for x in (first, second))
        assert one.read_bytes() == other.read_bytes()
    for name in ("results.csv", "policy.npz"):
        assert (first / name).read_bytes() == (second / name).read_bytes()


def test_it_gives_the_numbers_of_the_command_line(fitted, commanded):
    result, folder, seen = fitted
    assert_equal_folders(folder, commanded)
    assert {x.name for x in folder.iterdir()} == {x.name for x in commanded.iterdir()}
    first, second = (
        json.loads((x / "config.json").read_text()) for x in (folder, commanded)
    )
    assert (first.pop("preset"), second.pop("preset")) == (None, "paper")
    assert first == second and first["only_python"] is None

    curves = np.load(commanded / "curves.npz")
    for name, values in result.metrics.items():
        np.testing.assert_array_equal(values, curves[name][0])
    for name, values in result.evaluations.items():
        np.testing.assert_array_equal(values, curves[f"evaluation_{name}"][0])
    assert result.metrics["policy_loss"].shape == (2, ITERATIONS)
    assert result.evaluations["mean"].shape == (2, 4)
    np.testing.assert_array_equal(result.states.iteration, [ITERATIONS] * 2)
    assert_same(result.states, saved.load(commanded)[-1])
    with pytest.raises(ValueError, match="of agent 'ppo': it has no discriminator"):
        gasil_jax.load_reward(folder)

    sizes = [progress.metrics["policy_loss"].shape[1] for progress in seen]
    assert sum(sizes) == ITERATIONS and max(sizes) <= CHUNK
    assert [progress.iteration for progress in seen] == list(np.cumsum(sizes))
    assert seen[-1].env_steps == ITERATIONS * 128
    scores = [progress.evaluation for progress in seen if progress.evaluation]
    assert [x["env_steps"][0] // 128 for x in scores] == [40, 80, 100]
    np.testing.assert_allclose(
        [x["mean"] for x in scores], result.evaluations["mean"].T[1:], rtol=1e-6
    )


def test_it_stops_early_and_goes_on(env, commanded, tmp_path, capsys):
    """What stops it is a state, which is still there when training has gone on."""
    states, late, out = [], [], tmp_path / "out"

    def callback(progress):
        late.append(dataclasses.replace(progress))
        states.append(progress.states)
        return progress.iteration >= 50

    arguments = {"seeds": [0, 1], "folder": out, "checkpoint_every": 20 * 128}
    first = gasil_jax.fit(env, PPO, callback=callback, **arguments, **EVALUATED)
    assert first.metrics["policy_loss"].shape == (2, 50)
    assert first.evaluations["mean"].shape == (2, 2)
    assert [int(x.iteration[1]) for x in states][-2:] == [48, 50]
    with pytest.raises(RuntimeError, match=r"iteration \d+ are gone: read"):
        late[0].states  # noqa: B018
    assert_same(states[-1], first.states)
    root = program_of(out) / "checkpoints"
    assert checkpoint.latest(root)[0].iteration == 50

    with pytest.raises(ValueError, match=r"folder is .* with resume=True"):
        gasil_jax.fit(env, PPO, **arguments)
    for changed, why in (
        (PPO.replace(gamma=0.9), r"gamma was 0.99, is 0.9; .*evaluate_every was 5120"),
        (PPO.replace(clip_epsilon_schedule=lambda steps: 1.0), "is 'a function'"),
        (gasil_jax.algorithm("gasil"), "agent was ppo, is gasil"),
    ):
        with pytest.raises(ValueError, match=why):
            gasil_jax.fit(env, changed, resume=True, **arguments)
    # A program that is interrupted continues like one that was stopped.
    interrupt = lambda progress: os.kill(os.getpid(), signal.SIGTERM)
    with pytest.raises(Interrupted) as interrupted:
        gasil_jax.fit(
            env, PPO, resume=True, callback=interrupt, **arguments, **EVALUATED
        )
    assert "resume=True" in interrupted.value.__notes__[0]
    (root / "00000099.partial" / "state").mkdir(parents=True)
    # A command goes on with it, and `fit` again where a command was stopped.
    assert run.main(["--resume", "--out", str(out)]) == 0
    assert_equal_folders(out, commanded)
    assert not list(root.glob("*.partial"))
    capsys.readouterr()
    again = gasil_jax.fit(env, PPO, resume=True, **arguments, **EVALUATED)
    assert capsys.readouterr().err == ""
    assert_same(again.states, saved.load(commanded)[-1])
    assert_equal_folders(out, commanded)


def test_more_seeds_and_points_are_trained_and_no_others(env, tmp_path):
    """What is there is not trained again, and longer training continues."""
    folder = tmp_path / "out"

    def fit(total_steps=256, **arguments):
        algorithm, calls = SHORT.replace(total_steps=total_steps), []
        callback = lambda x: calls.append(x.metrics["policy_loss"].shape)
        given = {"folder": folder, "resume": True, "callback": callback}
        return gasil_jax.fit(env, algorithm, **given, **arguments), calls

    rates = [{"learning_rate": x} for x in (1e-3, 1e-2)]
    first, calls = fit(seeds=[4, 2], points=rates[:1])
    assert calls == [(2, 1)] * 2
    # Seeds in another order keep their numbers.
    result, calls = fit(seeds=[2, 4], points=rates[:1])
    assert calls == []
    flipped = jax.tree.map(lambda x: x[:, ::-1], first.states)
    assert_same(result.states, flipped)
    np.testing.assert_array_equal(
        np.load(folder / "policy.npz")["log_std"],
        flipped.actor_critic.policy.params["params"]["log_std"][0],
    )
    # A point more, and then a seed: always two runs, of which one program is compiled.
    for seeds in ([2, 4], [2, 4, 7]):
        result, calls = fit(seeds=seeds, points=rates[1:])
        assert calls == [(2, 1)] * 2
    assert result.metrics["policy_loss"].shape == (2, 3, 2)
    for name, values in first.metrics.items():
        np.testing.assert_array_equal(result.metrics[name][0, :2], values[0, ::-1])
    assert len(list((folder / "programs").iterdir())) == 3
    config = json.loads((folder / "config.json").read_text())
    assert (config["points"], config["seeds"]) == (rates, [2, 4, 7])
    # All of it longer.
    longer, calls = fit(total_steps=384, seeds=[2, 4, 7])
    assert calls == [(2, 1)] * 3
    for name, values in result.metrics.items():
        np.testing.assert_array_equal(longer.metrics[name][..., :2], values)
    assert longer.states.iteration.tolist() == [[3] * 3] * 2
    with pytest.raises(ValueError, match="total_steps was 384"):
        fit(seeds=[2, 4, 7])
    with pytest.raises(ValueError, match=r"seeds were \[2, 4, 7\]"):
        fit(total_steps=384, seeds=[2, 4])


def test_points_are_trained_beside_each_other(env):
    """Each as without the other one, to rounding, and the callback sees them all."""
    seen, points = [], [{"learning_rate": 1e-3}, {"learning_rate": 1e-2, "gamma": 0.9}]
    callback = lambda progress: seen.append(progress.metrics["policy_loss"].shape[0])
    result = gasil_jax.fit(
        env, SHORT, seeds=1, points=[*points, points[0]], callback=callback
    )
    assert set(seen) == {2}
    # As many members, so that they share a program. Its numbers may be arrays.
    one = SHORT.replace(learning_rate=np.float64(1e-2), gamma=jnp.float32(0.9))
    one = gasil_jax.fit(env, one, seeds=2)
    close = lambda x, y: np.testing.assert_allclose(x[1], y[:1], rtol=1e-3, atol=1e-4)
    jax.tree.map(close, result.metrics, one.metrics)
    params = lambda states: states.actor_critic.policy.params
    jax.tree.map(close, params(result.states), params(one.states))
    assert result.metrics["policy_loss"].shape == (2, 1, 2)
    assert not np.allclose(*result.metrics["policy_loss"], rtol=1e-3)


def test_what_no_command_line_can_name_is_read_where_it_can_be(own, tmp_path, capsys):
    gasil = gasil_jax.algorithm(
        "gasil", **small_training.SETTINGS, **small_training.DISCRIMINATOR
    )
    out, why = tmp_path / "out", "an environment that is not from gasil_jax.make_env"
    stop, seeds = lambda progress: True, [3, 5]
    begun = gasil_jax.fit(own, gasil, seeds=seeds, callback=stop, folder=out)
    assert json.loads((out / "config.json").read_text())["only_python"] == why
    assert gasil_jax.load_policy(out)(np.zeros(own.observation_size)).shape == (2,)
    # What ended in one iteration alone is no curve: it has all of it in the end.
    whole = gasil_jax.fit(own, gasil, seeds=seeds, folder=out, resume=True)
    losses, first = (x.metrics["policy_loss"] for x in (whole, begun))
    np.testing.assert_array_equal(losses[:, : first.shape[1]], first)
    assert plot.main([str(out), "--out", str(tmp_path / "curves.png")]) == 0
    assert "PointMass, gasil" in capsys.readouterr().out
    for command, *words in (
        (evaluate, str(out)),
        (render, str(out)),
        (run, "--resume", f"--out={out}"),
    ):
        message = refused(capsys, command, *words)
        assert why in message and "use gasil_jax.fit, gasil_jax.load_policy" in message

    # With what only Python has, the states and the reward are read.
    given = {"env": own, "algorithm": gasil}
    assert_same(saved.load(out, **given)[-1], whole.states)
    at = np.ones(own.observation_size)
    stored = gasil_jax.load_policy(out, 5, point=0, **given)
    np.testing.assert_allclose(stored(at), gasil_jax.load_policy(out, 5)(at), rtol=1e-6)
    reward = gasil_jax.load_reward(out, seed=5, **given)
    steps = np.ones((4, own.observation_size)), np.zeros((4, 2))
    one = gasil_jax.member(whole.states, 1)
    expected = gasil.agent.reward(one.agent, one.normalizer)(*map(jnp.float32, steps))
    np.testing.assert_allclose(reward(*steps), expected, rtol=1e-6)
    with pytest.raises(ValueError, match="with what no command line can name"):
        gasil_jax.load_reward(out, env=own)
    with pytest.raises(ValueError, match=r"run is .*env 'PointMass' is unknown"):
        gasil_jax.load_reward(out, algorithm=gasil)

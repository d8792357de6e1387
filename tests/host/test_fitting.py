"""`gasil_jax.fit` trains as the command line does."""

import dataclasses
import json
import os
import shutil
import signal

import brax.envs
import jax
import numpy as np
import pytest
import small_training

import gasil_jax
from gasil_jax import Decompose, Normalize, evaluate, plot, render, run
from gasil_jax.errors import InputError
from gasil_jax.host import checkpoint, metrics_files, run_folder, run_options
from gasil_jax.host.interruption import Interrupted

# Iterations, the longest of a chunk, and the algorithm of both ways to train.
ITERATIONS, CHUNK = 100, 2
PPO = gasil_jax.algorithm("ppo", **small_training.SETTINGS)
PPO = PPO.replace(total_steps=ITERATIONS * 128)
FLAGS = (
    *(*small_training.FLAGS, "--agent", "ppo", "--preset", "paper"),
    "--no-normalize-rewards",
    *("--total-steps", str(ITERATIONS * 128), "--stagger-episodes"),
)
EVALUATED = {"evaluate_every": 40 * 128, "evaluate_episodes": 2}
BEGUN = {"folder": "begun", "resume": True, "evaluate_every": 128}


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


def test_it_continues_what_a_command_began_but_no_sweep(env, tmp_path):
    options = run_options.parse(
        run_options.Options, [*FLAGS, "--evaluate-every", "128"], "x"
    )
    once = PPO.replace(total_steps=128)
    options = dataclasses.replace(options, config=once.config)
    for name, more in (("run", {}), ("sweep", {"points": [{}]})):
        (tmp_path / name).mkdir()
        run_options.write_config(options, tmp_path / name, **more)
    arguments = {"seeds": 1, "resume": True, "evaluate_every": 128}
    before = (tmp_path / "sweep" / "config.json").read_text()
    with pytest.raises(ValueError, match="a sweep: continue it with"):
        gasil_jax.fit(env, once, folder=tmp_path / "sweep", **arguments)
    assert (tmp_path / "sweep" / "config.json").read_text() == before
    gasil_jax.fit(env, once, folder=tmp_path / "run", **arguments)
    stored = run_folder.read(tmp_path / "run")
    assert (stored["preset"], stored["evaluate_episodes"]) == ("paper", None)


def same(result, folder):
    """Compare a result's tables with those of a folder, to the last digit."""
    for found, name in (
        (result.metrics, "metrics.csv"),
        (result.evaluations, "evaluations.csv"),
    ):
        expected = metrics_files.read_metrics(folder / name, {"seed": [0, 1]})
        assert set(found) == set(expected)
        for column in expected:
            np.testing.assert_array_equal(found[column], expected[column])


def test_it_gives_the_numbers_of_the_command_line(env, commanded, capsys):
    seen = []
    result = gasil_jax.fit(env, PPO, seeds=2, callback=seen.append, **EVALUATED)
    same(result, commanded)
    assert result.metrics["policy_loss"].shape == (2, ITERATIONS)
    assert result.evaluations["mean"].shape == (2, 4)
    np.testing.assert_array_equal(result.states.iteration, [ITERATIONS] * 2)
    assert capsys.readouterr().err == ""

    sizes = [progress.metrics["policy_loss"].shape[1] for progress in seen]
    assert sum(sizes) == ITERATIONS and max(sizes) <= CHUNK
    assert [progress.iteration for progress in seen] == list(np.cumsum(sizes))
    assert seen[-1].env_steps == ITERATIONS * 128
    scores = [progress.evaluation for progress in seen if progress.evaluation]
    assert [x["env_steps"][0] // 128 for x in scores] == [40, 80, 100]
    np.testing.assert_allclose(
        [x["mean"] for x in scores], result.evaluations["mean"].T[1:], rtol=1e-6
    )


def test_without_a_discriminator_there_is_no_reward(commanded):
    with pytest.raises(ValueError, match="of agent 'ppo': it has no discriminator"):
        gasil_jax.load_reward(commanded)


def test_it_stops_early_and_goes_on(env, commanded, tmp_path):
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
    for last, result in zip(*map(jax.tree.leaves, (states[-1], first.states))):
        if not jax.dtypes.issubdtype(last.dtype, jax.dtypes.prng_key):
            np.testing.assert_array_equal(last, result)
    assert checkpoint.latest(out / "checkpoints")[0].iteration == 50

    with pytest.raises(ValueError, match=r"folder is .*: give resume=True"):
        gasil_jax.fit(env, PPO, **arguments)
    with pytest.raises(ValueError, match=r"gamma was 0.99, is 0.9: only total_steps"):
        gasil_jax.fit(env, PPO.replace(gamma=0.9), resume=True, **arguments)
    with pytest.raises(ValueError, match="evaluate_every was 5120, is None"):
        gasil_jax.fit(env, PPO, resume=True, **arguments)
    # A program that is interrupted continues like one that was stopped.
    interrupt = lambda progress: os.kill(os.getpid(), signal.SIGTERM)
    with pytest.raises(Interrupted) as interrupted:
        gasil_jax.fit(
            env, PPO, resume=True, callback=interrupt, **arguments, **EVALUATED
        )
    assert "resume=True" in interrupted.value.__notes__[0]
    same(gasil_jax.fit(env, PPO, resume=True, **arguments, **EVALUATED), commanded)
    policies = [np.load(folder / "policy.npz") for folder in (out, commanded)]
    for name in policies[1]:
        np.testing.assert_array_equal(*(arrays[name] for arrays in policies))
    assert gasil_jax.load_policy(out)(np.zeros(env.observation_size)).shape == (2,)
    # Without its checkpoints it would begin anew, and replace the policy.
    shutil.rmtree(out / "checkpoints")
    with pytest.raises(ValueError, match="holds the results of training that has end"):
        gasil_jax.fit(env, PPO, resume=True, **arguments, **EVALUATED)
    np.testing.assert_array_equal(
        np.load(out / "policy.npz")["mean"], policies[1]["mean"]
    )


def test_points_are_trained_beside_each_other(env):
    """Each as without the other one, to rounding, and the callback sees them all."""
    algorithm, seen = PPO.replace(total_steps=4 * 128), []
    points = [{"learning_rate": 1e-3}, {"learning_rate": 1e-2, "gamma": 0.9}]
    callback = lambda progress: seen.append(progress.metrics["policy_loss"].shape[0])
    result = gasil_jax.fit(env, algorithm, seeds=3, points=points, callback=callback)
    assert set(seen) == {6}
    # As many members, so that they share a program.
    one = gasil_jax.fit(env, algorithm.replace(**points[1]), seeds=6)
    for name, values in one.metrics.items():
        together = result.metrics[name]
        assert together.shape == (2, 3, 4)
        np.testing.assert_allclose(together[1], values[:3], rtol=1e-3, atol=1e-4)
    params = lambda states: jax.tree.leaves(states.actor_critic.policy.params)
    for x, y in zip(params(result.states), params(one.states), strict=True):
        assert x.shape[:2] == (2, 3)
        np.testing.assert_allclose(x[1], y[:3], rtol=1e-3, atol=1e-4)
    assert not np.allclose(*result.metrics["policy_loss"], rtol=1e-3)


def test_checkpoints_without_evaluations_are_no_reason_to_begin_anew(own, tmp_path):
    description, root = tmp_path / "fit.json", tmp_path / "checkpoints"

    def fit(**arguments):
        # It stops after a chunk.
        once = lambda progress: True
        return gasil_jax.fit(own, PPO, folder=tmp_path, callback=once, **arguments)

    before = fit().metrics["policy_loss"].shape[1]
    (root / "00000099.partial" / "state").mkdir(parents=True)
    saved = sorted(root.rglob("*"))
    described = json.loads(description.read_text())
    del described["sha256"]
    description.write_text(json.dumps(described | EVALUATED))
    with pytest.raises(InputError, match=f"0000000{before} .* no evaluations_size"):
        fit(resume=True, **EVALUATED)
    assert sorted(root.rglob("*")) == saved

    description.write_text(json.dumps(described))
    assert fit(resume=True).metrics["policy_loss"].shape[1] > before
    # What a killed process had half written is deleted.
    assert saved[0] in root.iterdir() and not list(root.glob("*.partial"))


def test_its_folder_is_a_runs_folder(env, commanded, tmp_path, capsys):
    out = tmp_path / "out"
    # It ends early, before any evaluation; the command trains the rest.
    begun = {"callback": lambda progress: True, **EVALUATED}
    gasil_jax.fit(env, PPO, seeds=2, folder=out, **begun)
    assert json.loads((out / "summary.json").read_text())["final_return_mean"] is None
    assert run.main(["--resume", "--out", str(out)]) == 0
    rows = [x / "metrics.csv" for x in (out, commanded)]
    assert rows[0].read_text() == rows[1].read_text()
    # The command adds nothing to what `fit` writes, and says the same of it.
    whole = tmp_path / "whole"
    gasil_jax.fit(env, PPO, seeds=2, folder=whole, **EVALUATED)
    assert {x.name for x in whole.iterdir()} == {x.name for x in commanded.iterdir()}
    contents = [json.loads((x / "config.json").read_text()) for x in (whole, commanded)]
    differing = {name for name in contents[1] if contents[0][name] != contents[1][name]}
    assert differing == {"out", "preset", "sha256"}
    assert contents[0].keys() == contents[1].keys()
    summaries = [json.loads((x / "summary.json").read_text()) for x in (whole, out)]
    for name in ("env", "agent", "final_return", "final_evaluation"):
        assert summaries[0][name] == summaries[1][name]
    for command, path in (
        (plot, tmp_path / "curves.png"),
        (evaluate, tmp_path / "scores.csv"),
        (render, tmp_path / "film.gif"),
    ):
        assert command.main([str(whole), "--out", str(path)]) == 0
        assert path.stat().st_size > 0
    assert "point_mass, ppo" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({}, "the environment is not one that gasil_jax.make_env returned"),
        ({"seeds": [4, 2]}, "the seeds do not follow one another"),
        (
            {"algorithm": PPO.replace(clip_epsilon_schedule=lambda steps: 1.0)},
            "function has no JSON form",
        ),
        (
            {"algorithm": dataclasses.replace(PPO, rewards=(Normalize(), Decompose()))},
            "options can't name the agent or the models of rewards",
        ),
    ],
)
def test_what_no_run_can_describe_is_plotted(env, own, changes, why, tmp_path, capsys):
    out = tmp_path / "out"
    arguments = {"algorithm": PPO, **changes, "folder": out}
    once = lambda progress: progress.iteration >= 30
    gasil_jax.fit(env if changes else own, callback=once, **arguments)
    assert not (out / "config.json").exists()
    assert (out / "learning_curve.png").exists()
    assert plot.main([str(out), "--out", str(tmp_path / "curves.png")]) == 0
    assert "PointMass, ppo" in capsys.readouterr().out
    for command in (evaluate, render):
        assert command.main([str(out)]) == 2
        (message,) = capsys.readouterr().err.splitlines()
        assert why in message and "use it with gasil_jax.plot" in message


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"seeds": 0}, "seeds is 0: it must be from 1"),
        ({"seeds": []}, r"seeds is \[\]: it must be a number of seeds"),
        ({"seeds": None}, "seeds is None: it must be a number of seeds"),
        ({"seeds": True}, "seeds is True: it must be a number of seeds"),
        ({"seeds": jax.numpy.zeros(2, int)}, r"seeds is \[0, 0\]: it must be a number"),
        ({"seeds": [1, 1]}, "different whole numbers"),
        ({"seeds": [-1]}, "different whole numbers"),
        ({"evaluate_every": 0}, "evaluate_every is 0: it must be a whole number"),
        ({"evaluate_episodes": 1.5}, "evaluate_episodes is 1.5"),
        ({"checkpoint_every": 128}, "checkpoint_every is 128: it needs a folder"),
        ({"resume": True}, "resume is True: it needs a folder"),
        ({"algorithm": PPO.replace(gamma=-1)}, "gamma is -1"),
        ({"folder": "/proc/none"}, "folder is /proc/none"),
        ({"folder": 3}, "folder is 3: it must be a string or a pathlib.Path"),
        ({"folder": "full"}, "folder is .* not empty"),
        (BEGUN | {"evaluate_every": None}, "evaluate_every was 128, is None"),
        (BEGUN | {"evaluate_every": 256}, "evaluate_every was 128, is 256: only total"),
        (BEGUN | {"evaluate_episodes": 3}, "evaluate_episodes was 10, is 3: only tot"),
        ({"points": []}, r"points is \[\]: it must be a list of at least one dict"),
        ({"points": [{"alpha": 1.0}]}, "alpha is a setting of .*, not of ppo"),
        ({"points": [{}], "folder": "new"}, "folder is new: a folder holds one point"),
        (BEGUN | {"seeds": 2}, r"seeds was \(0,\), is \(0, 1\): only total_steps"),
    ],
)
def test_what_is_wrong_is_refused_by_name(own, changes, why, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").touch()
    (tmp_path / "begun").mkdir()
    described = {"seeds": [0], "evaluate_every": 128, "evaluate_episodes": 10}
    why_no_run = "the environment is not one that gasil_jax.make_env returned"
    described |= {"why_no_run": why_no_run, "env": "PointMass", "agent": "ppo"}
    (tmp_path / "begun" / "fit.json").write_text(json.dumps(described))
    with pytest.raises(ValueError, match=why):
        gasil_jax.fit(own, **{"algorithm": PPO, **changes})


def test_a_command_says_why_it_can_t_continue_what_no_options_describe(
    tmp_path, capsys
):
    described = {"why_no_run": "x", "env": "Own", "agent": "ppo", "seeds": [0]}
    (tmp_path / "fit.json").write_text(json.dumps(described))
    assert run.main(["--resume", "--out", str(tmp_path)]) == 2
    assert "a folder of gasil_jax.fit that" in capsys.readouterr().err

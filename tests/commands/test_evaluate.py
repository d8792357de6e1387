"""Saving, loading and scoring a run's policies."""

import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from refusals import refused
from small_training import drawn_policies, table

import gasil_jax
from gasil_jax import evaluate, evaluation, numpy_policy, policy
from gasil_jax.host import checkpoint

# With the other tests that use it, so that it is trained once.
on_trained = pytest.mark.xdist_group("commands")


@on_trained
def test_one_seed_scores_as_with_all_and_every_episode_is_written(
    trained, tmp_path, capsys
):
    folder, out = str(trained.folder), tmp_path / "new" / "scores.csv"
    flags = ["--episodes", "3", "--stochastic"]
    assert evaluate.main([folder, *flags, "--out", str(out)]) == 0
    header, *lines, over_seeds, where = capsys.readouterr().out.splitlines()
    assert header.split()[0] == "seed" and where == f"in {out}"
    assert over_seeds.startswith("return ")
    assert over_seeds.endswith("(interquartile mean over 3 seeds)")
    rows = table(out)
    assert [(row["seed"], row["episode"]) for row in rows] == [
        (seed, episode) for seed in "567" for episode in "012"
    ]
    for line, seed in zip(lines, "567", strict=True):
        returns = [float(row["episode_return"]) for row in rows if row["seed"] == seed]
        assert line.split()[:2] == [seed, "3"]
        assert line.split()[2] == f"{np.mean(returns):.2f}"
    assert {row["episode_length"] for row in rows} == {"50"}
    assert evaluate.main([folder, *flags, "--seed", "6"]) == 0
    assert capsys.readouterr().out.splitlines()[1] == lines[1]
    # Nothing is written over.
    told = refused(capsys, evaluate, folder, "--out", out)
    assert "which exists: name a new file" in told


@on_trained
def test_the_best_checkpoint_is_scored_or_refused(trained, tmp_path, capsys):
    """A damaged one is not replaced by another, which has other numbers."""
    out = shutil.copytree(trained.folder, tmp_path / "out")
    assert evaluate.main([str(out), "--checkpoint", "best", "--episodes", "1"]) == 0
    (root,) = out.glob("programs/*/checkpoints")
    best = checkpoint.best(root).folder
    (best / "state" / "_METADATA").write_text("{}")
    capsys.readouterr()
    told = refused(capsys, evaluate, out, "--checkpoint", "best")
    assert f"{best} is damaged: state/_METADATA is not what was written" in told


def test_gymnasiums_episodes_have_the_runs_limit():
    rest = lambda observation: np.zeros(2)
    for limit, length in ((7, 7), (None, 1000)):
        scores = evaluation.evaluate_in_gymnasium(
            "Swimmer-v5", rest, num_episodes=1, num_steps=limit
        )
        assert scores["episode_length"] == [length]


def test_scores_are_those_of_a_plain_loop():
    env = gasil_jax.make_env("point_mass", reward_delay=7)
    algorithm = gasil_jax.algorithm("ppo", hidden_sizes=(16, 8))
    state = gasil_jax.member(drawn_policies(env, algorithm, 1, whole=True), 0)
    given = {"key": jax.random.key(3), "num_episodes": 3}
    evaluate_ = lambda **x: evaluation.evaluate(env, algorithm, state, **given, **x)
    scored = jax.jit(evaluate_)()
    act = numpy_policy.make(policy.weights(state, env))
    reset, step = jax.jit(env.reset), jax.jit(env.step)
    key, _ = jax.random.split(jax.random.key(3))
    for i, reset_key in enumerate(jax.random.split(key, 3)):
        running, total, length = reset(reset_key), 0.0, 0
        while not running.done:
            running = step(running, jnp.asarray(act(np.asarray(running.obs))))
            total += float(running.info["true_reward"])
            length += 1
        np.testing.assert_allclose(scored["episode_return"][i], total, rtol=1e-3)
        assert int(scored["episode_length"][i]) == length == 50
    drawn = jax.jit(lambda: evaluate_(deterministic=False))()
    assert not np.allclose(drawn["episode_return"], scored["episode_return"])

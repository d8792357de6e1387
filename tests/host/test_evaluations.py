"""Policies are evaluated during training."""

import os
import shutil
import signal

import numpy as np
import pytest
from small_training import FLAGS, table
from test_resume import program_of

import gasil_jax
from gasil_jax import run
from gasil_jax.evaluation import evaluate as evaluate_directly
from gasil_jax.host import checkpoint, saved
from gasil_jax.host.evaluations import Evaluation, evaluation_key

ITERATIONS, EPISODES = 22, 3
SEEDS = (5, 6, 7)
# Three members on two devices: one is padding.
SMALL = (
    *(*FLAGS, "--agent", "ppo", "--seeds", "3", "--first-seed", "5", "--devices", "2"),
    *("--total-steps", str(ITERATIONS * 128), "--reward-delay", "7"),
    *("--learning-rate", "0.01"),
    *("--checkpoint-every", str(8 * 128), "--keep-checkpoints", "99"),
)
# Rounded up to five iterations.
EVALUATED = ("--evaluate-every", "600", "--evaluate-episodes", str(EPISODES))
TOLERANCE = {"rtol": 2e-3, "atol": 2e-4}
# Pictures are drawn, and not written, which takes long.
pytestmark = pytest.mark.usefixtures("figures")


@pytest.fixture(scope="module")
def evaluated(tmp_path_factory):
    """The folder of a run with evaluations."""
    out = tmp_path_factory.mktemp("evaluated") / "out"
    assert run.main([*SMALL, *EVALUATED, "--out", str(out)]) == 0
    return out


def rows(out):
    return table(program_of(out) / "evaluations.csv")


def assert_same_tables(first, second):
    for name in ("evaluations.csv", "metrics.csv"):
        one, other = (program_of(x) / name for x in (first, second))
        assert one.read_bytes() == other.read_bytes()


def means(out):
    """Return the mean score over seeds for each iteration."""
    by_iteration = {}
    for row in rows(out):
        iteration = int(row["env_steps"]) // 128
        by_iteration.setdefault(iteration, []).append(float(row["mean"]))
    return {iteration: np.mean(x) for iteration, x in by_iteration.items()}


def test_every_seed_has_a_row_for_each_evaluation_and_the_last_policy_is_scored(
    evaluated,
):
    scores = rows(evaluated)
    names = ["point", "seed", "env_steps", "mean", "min", "max", "length"]
    assert list(scores[0]) == names
    assert [(int(row["env_steps"]), int(row["seed"])) for row in scores] == [
        (iteration * 128, seed)
        for iteration in (0, 5, 10, 15, 20, 22)
        for seed in SEEDS
    ]
    for row in scores:
        low, mean, high = (float(row[name]) for name in ("min", "mean", "max"))
        assert low <= mean <= high and row["length"] == "50"


def test_training_is_the_same_without_evaluation(evaluated, tmp_path, capsys):
    out, alone = evaluated, tmp_path / "alone"
    assert run.main([*SMALL, "--out", str(alone)]) == 0
    tables_ = [program_of(x) / "metrics.csv" for x in (out, alone)]
    assert tables_[0].read_bytes() == tables_[1].read_bytes()
    assert not (program_of(alone) / "evaluations.csv").exists()
    assert "evaluation" not in (alone / "results.csv").read_text()
    assert "evaluation " not in capsys.readouterr().out


def test_the_scores_are_those_of_evaluate(evaluated):
    env, algorithm, seeds, states = saved.load(evaluated)
    for index, (seed, row) in enumerate(zip(seeds, rows(evaluated)[-3:], strict=True)):
        of_seed = env, algorithm, gasil_jax.member(states, index)
        key = evaluation_key(seed, ITERATIONS)
        scores = evaluate_directly(*of_seed, key=key, num_episodes=EPISODES)
        returns = np.asarray(scores["episode_return"])
        direct = [returns.mean(), returns.min(), returns.max()]
        written = [float(row[name]) for name in ("mean", "min", "max")]
        np.testing.assert_allclose(written, direct, **TOLERANCE)


def test_a_resumed_run_scores_the_same_again(evaluated, tmp_path):
    whole, out = evaluated, tmp_path / "out"
    shutil.copytree(whole, out)
    # As if it had been killed after the checkpoint in the middle of two evaluations.
    (program_of(out) / "training.json").unlink()
    for path in (program_of(out) / "checkpoints").iterdir():
        if int(path.name) > 8:
            shutil.rmtree(path)
    assert run.main(["--resume", "--out", str(out)]) == 0
    assert_same_tables(out, whole)
    assert (out / "results.csv").read_bytes() == (whole / "results.csv").read_bytes()


def test_a_run_that_is_stopped_before_it_trains_scores_each_policy_once(
    evaluated, tmp_path, monkeypatch
):
    whole, out = evaluated, tmp_path / "out"
    score = Evaluation.score

    def interrupted(self, states, done):
        if done == 0:
            os.kill(os.getpid(), signal.SIGTERM)
        return score(self, states, done)

    with monkeypatch.context() as patch:
        patch.setattr(Evaluation, "score", interrupted)
        status = run.main([*SMALL, *EVALUATED, "--out", str(out)])
    assert status == 128 + signal.SIGTERM
    assert [row["env_steps"] for row in rows(out)[::3]][:1] == ["0"]
    assert run.main(["--resume", "--out", str(out)]) == 0
    assert_same_tables(out, whole)


def test_the_best_checkpoint_is_that_of_the_best_evaluation(evaluated):
    root, by_iteration = program_of(evaluated) / "checkpoints", means(evaluated)
    del by_iteration[0]  # Of the untrained policy there is no checkpoint.
    best = max(by_iteration, key=by_iteration.__getitem__)
    assert checkpoint.best(root).iteration == best
    # Those that are due as ever, without a score, and one for each best so far.
    scores = {
        int(path.name): checkpoint.read(path).record["score"] for path in root.iterdir()
    }
    so_far = {
        iteration
        for iteration, mean in by_iteration.items()
        if mean == max(x for i, x in by_iteration.items() if i <= iteration)
    }
    assert set(scores) == {8, 16, ITERATIONS} | so_far
    for iteration, score in scores.items():
        assert score == pytest.approx(by_iteration.get(iteration))
    _, _, _, states = saved.load(evaluated, "best")
    assert set(np.asarray(states.iteration)) == {best}

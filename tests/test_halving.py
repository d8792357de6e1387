"""Successive halving: the better points train longer, in whatever processes."""

import csv
import json
import math
import os
import signal
import subprocess
import sys

import numpy as np
import pytest
from test_resume import finish, wait_for
from test_sweep import SMALL

from gasil_jax import command_line, evaluate, halving, run, run_folder
from gasil_jax.interruption import Interrupted

pytest.importorskip("optuna")


def test_rungs_multiply():
    assert halving.rungs(1000, 60, 4) == [60, 240, 960, 1000]
    assert halving.rungs(1000, 250, 4) == [250, 1000]
    for first, reduction in ((0, 4), (1000, 4), (10, 1)):
        with pytest.raises(command_line.InputError, match="must be"):
            halving.rungs(1000, first, reduction)


def simulate(quality, reduction, rungs):
    """One process, where a point's score is what it is at every rung."""
    scores, order = {}, []
    while True:
        for least in (reduction, 1):
            chosen = halving.candidates(scores, rungs, len(quality), reduction, least)
            index = next(chosen, None)
            if index is not None:
                break
        else:
            return scores, order
        reached = scores.setdefault(index, {})
        reached[rungs[len(reached)]] = quality[index]
        order.append(index)


@pytest.mark.parametrize("seed", range(4))
def test_the_best_climb_whatever_the_order(seed):
    quality = list(np.random.default_rng(seed).permutation(16).astype(float))
    scores, order = simulate(quality, 4, [10, 40, 160])
    best = np.argsort(quality)[::-1]
    assert all(10 in scores[i] for i in range(16))
    assert all(40 in scores[i] for i in best[:4])
    assert max(scores[best[0]]) == 160
    # Of 16 a handful that came early is more than four, and of those one or two.
    assert 4 <= sum(40 in x for x in scores.values()) <= 7
    assert sum(160 in x for x in scores.values()) <= 2
    # The first goes on when four can be compared, not when the last one has begun.
    assert len(set(order[:4])) == 4 and len(set(order[:5])) == 4


def test_few_points_or_none_that_is_finite():
    scores, _ = simulate([1.0, math.nan, 2.0], 4, [10, 40, 160])
    assert [max(scores[i]) for i in range(3)] == [10, 10, 160]
    scores, _ = simulate([math.nan, math.nan], 4, [10, 40, 160])
    assert [max(scores[i]) for i in range(2)] == [10, 10]


def test_the_score_of_a_task_whose_episodes_end_together():
    returns = np.full((2, 31), np.nan)
    returns[:, [7, 15, 23]] = [[1.0, 2.0, 3.0], [2.0, 3.0, 5.0]]
    metrics = {"episode_return": returns, "skipped_updates": np.zeros((2, 31))}
    assert halving._score(metrics) == 4.0
    returns[1] = np.nan
    assert math.isnan(halving._score(metrics))


def test_processes_share_a_study(tmp_path):
    points = [{"alpha": 0.1 * i, "buffer_steps": 10 + i % 2} for i in range(3)]
    del points[1]["buffer_steps"]
    one, two = (halving.Study(tmp_path, points) for _ in range(2))
    for index, (study, score) in enumerate([(one, 5.0), (two, 3.0), (one, math.nan)]):
        study.begin(index)
        two.begin(index)  # after a restart
        study.report(index, 100, score)
    one.report(0, 400, 7.0)
    assert two.scores()[0] == {100: 5.0, 400: 7.0} and two.scores()[1] == {100: 3.0}
    for study in (one, two):
        study.close(400)
    summary = halving.write(tmp_path, points, two, last=400, seeds=5)
    assert summary["best"] == 0 and summary["env_steps"] == 5 * (400 + 100 + 100)
    rows = list(csv.DictReader((tmp_path / "results.csv").open()))
    assert [row["state"] for row in rows] == ["finished", "paused", "diverged"]
    assert [row["mean_return"] for row in rows] == ["7.0", "3.0", ""]
    assert [row["buffer_steps"] for row in rows] == ["10", "", "10"]
    import optuna

    journal = optuna.storages.journal.JournalFileBackend(
        str(tmp_path / "optuna.journal")
    )
    storage = optuna.storages.JournalStorage(journal)
    study = optuna.load_study(study_name=None, storage=storage)
    assert [trial.state.name for trial in study.trials] == [
        "COMPLETE",
        "PRUNED",
        "FAIL",
    ]
    assert study.best_params == points[0]


@pytest.fixture
def stubbed(tmp_path, monkeypatch):
    """`climb` of two points whose training is a function of its interruption."""

    def climb(trained):
        arguments = [*SMALL, "--total-steps", "1024", "--grid", "alpha=0.1,1"]
        arguments += ["--first-rung", "512", "--reduction", "2", "--out", str(tmp_path)]
        options = run.parse(halving.Options, arguments, "x")
        monkeypatch.setattr(halving, "_batches", lambda *_: lambda index: None)
        monkeypatch.setattr(
            halving, "_train", lambda _, index, *more: trained(index, more[-1])
        )
        return halving.climb(options, None, [{"alpha": 0.1}, {"alpha": 1.0}], tmp_path)

    return climb


def test_a_point_that_another_has_just_taken_keeps_the_study_open(
    stubbed, tmp_path, monkeypatch
):
    monkeypatch.setattr(halving, "_is_free", lambda place: True)
    taken = tmp_path / "points" / "1"
    taken.mkdir(parents=True)
    order = []
    score = lambda index, interruption: order.append(index) or float(index)
    with run_folder.lock(taken):
        assert stubbed(score) is None
    study = stubbed(score)
    assert order == [0, 0, 1, 1]
    assert study.scores()[1] == {512: 1.0, 1024: 1.0}


def test_a_signal_while_a_rung_ends_is_not_forgotten(stubbed):
    seen = []

    def train(index, interruption):
        seen.append(interruption.signal)
        if interruption.signal is not None:
            raise Interrupted(interruption.signal)
        os.kill(os.getpid(), signal.SIGTERM)
        return 0.0

    with pytest.raises(Interrupted):
        stubbed(train)
    assert seen == [None, signal.SIGTERM]


def test_points_climb_and_go_on_in_another_process(tmp_path):
    """One program; the last point's first step is beyond float32."""
    out = tmp_path / "out"
    command = [sys.executable, "-m", "gasil_jax.halving", *SMALL, "--seeds", "2"]
    command += ["--total-steps", str(240 * 256), "--reduction", "2"]
    command += ["--first-rung", str(60 * 256), "--out", str(out)]
    command += ["--grid", "learning_rate=3e-4,1e-3,1e30"]
    begin = lambda: subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    child = begin()
    second = out / "points" / "1" / "metrics.csv"
    wait_for(lambda: second.exists() and second.stat().st_size > 5000, child)
    child.send_signal(signal.SIGTERM)
    status, _, err = finish(child)
    assert status == 128 + signal.SIGTERM, err
    assert "go on with the same command" in err
    first = out / "points" / "0" / "metrics.csv"
    before = first.read_bytes()
    status, printed, err = finish(begin())
    assert status == 0, err
    assert first.read_bytes() == before
    assert "in " + str(out) in printed
    summary = json.loads((out / "summary.json").read_text())
    states = [row["state"] for row in summary["points"]]
    assert sorted(states) == ["diverged", "finished", "paused"]
    assert states[2] == "diverged"
    for index, row in enumerate(summary["points"]):
        metrics = np.loadtxt(
            out / "points" / str(index) / "metrics.csv",
            delimiter=",",
            skiprows=1,
            usecols=(0, 1),
        )
        # Each seed every iteration once, up to where the point stopped.
        steps = np.arange(1, row["env_steps"] // 256 + 1) * 256.0
        for seed in (0, 1):
            np.testing.assert_array_equal(metrics[metrics[:, 0] == seed, 1], steps)
    _, _, seeds, states = evaluate.load(out)
    assert seeds == [0, 1]
    np.testing.assert_array_equal(states.iteration, [240, 240])
    np.testing.assert_allclose(
        states.hyperparameters.learning_rate, (3e-4, 1e-3)[summary["best"]]
    )
    rungs = {60 * 256, 120 * 256, 240 * 256}
    assert {row["env_steps"] for row in summary["points"]} <= rungs
    assert summary["points"][2]["env_steps"] == 60 * 256
    command += ["--gamma", "0.5"]
    status, _, err = finish(begin())
    assert status == 2 and "gamma was 0.99, is 0.5" in err

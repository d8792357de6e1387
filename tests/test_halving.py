"""Successive halving: the better points train longer, in whatever processes."""

import csv
import json
import math
import signal
import subprocess
import sys

import numpy as np
import pytest
from test_resume import finish, wait_for
from test_sweep import SMALL

from gasil_jax import command_line, halving

pytest.importorskip("optuna")


def test_rungs_multiply():
    assert halving.rungs(1000, 60, 4) == [60, 240, 960, 1000]
    assert halving.rungs(1000, 250, 4) == [250, 1000]
    for first, reduction in ((0, 4), (1000, 4), (10, 1)):
        with pytest.raises(command_line.InputError, match="must be"):
            halving.rungs(1000, first, reduction)


def test_a_point_goes_on_if_it_is_among_the_best_so_far(tmp_path):
    """Seen by two processes that share the file."""
    points = [{"alpha": float(i), "buffer_steps": 10 + i % 2} for i in range(8)]
    scores = [5.0, 3.0, 4.0, 9.0, 1.0, 6.0, 8.0, math.nan]
    one, two = (halving.Study(tmp_path, points, 100, 2) for _ in range(2))
    reached = {}
    for index, score in enumerate(scores):
        study = (one, two)[index % 2]
        assert study.trial(index) is None and not study.is_done(index)
        study.begin(index)
        study.begin(index)  # after a restart
        seen = [s for s in scores[: index + 1] if math.isfinite(s)]
        # The better half of those that were there by then, one at least.
        place = sorted(seen, reverse=True)[max(1, len(seen) // 2) - 1]
        goes_on = study.goes_on(index, 100, score)
        assert goes_on == (score >= place), index
        if goes_on:
            study.end(index, 400, score)
        reached[index] = 400 if goes_on else 100
    assert all(one.is_done(i) and two.is_done(i) for i in range(8))
    assert {i: one.trial(i).last_step for i in range(8)} == reached
    assert one.trial(3).params == points[3]
    summary = halving.write(tmp_path, points, two, seeds=5)
    assert summary["best"] == 3
    assert summary["env_steps"] == 5 * sum(reached.values())
    rows = list(csv.DictReader((tmp_path / "results.csv").open()))
    assert [float(row["alpha"]) for row in rows] == list(map(float, range(8)))
    assert rows[7]["state"] == "stopped" and rows[7]["mean_return"] == ""


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
    assert states[0] == "finished" and states[2] == "stopped"
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
    rungs = {60 * 256, 120 * 256, 240 * 256}
    assert {row["env_steps"] for row in summary["points"]} <= rungs
    assert summary["points"][2]["env_steps"] == 60 * 256
    command += ["--gamma", "0.5"]
    status, _, err = finish(begin())
    assert status == 2 and "gamma was 0.99, is 0.5" in err

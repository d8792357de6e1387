"""Sweeps run, grow or are refused; a point's results are those of a single run."""

import json
import os
import pathlib
import re
import signal

import jax
import numpy as np
import pytest
from refusals import refused, rows
from small_training import FLAGS, table

import gasil_jax
from gasil_jax import plot, run, sweep
from gasil_jax.cli import options as options_
from gasil_jax.cli.options import SweepOptions
from gasil_jax.errors import InputError
from gasil_jax.host import points, saved, training
from gasil_jax.host.members import Members
from gasil_jax.host.points import PAPER_RANGES
from gasil_jax.host.sweep import read as read_sweep

pytestmark = pytest.mark.xdist_group("commands")


def points_of(*arguments):
    words = ["--env", "point_mass", *arguments]
    return list(options_.read(SweepOptions, words, "x")[1].points)


def test_a_grid_is_every_combination():
    assert points_of("--grid", "buffer_steps=1e3") == [{"buffer_steps": 1000}]
    assert points_of("--grid", "alpha=0.1,1", "discriminator-updates=1,5,1") == [
        {"alpha": 0.1, "discriminator_updates": 1},
        {"alpha": 0.1, "discriminator_updates": 5},
        {"alpha": 1.0, "discriminator_updates": 1},
        {"alpha": 1.0, "discriminator_updates": 5},
    ]


def test_random_points_are_distinct_and_of_the_papers_ranges(monkeypatch):
    names = "learning_rate learning_rate_decay gamma gae_lambda clip_epsilon alpha"
    many = [f"{name}=0.1,0.2,0.3,0.4,0.5,0.6" for name in names.split()]
    # Combinations are drawn, not listed: there may be too many.
    with monkeypatch.context() as patch:
        patch.setattr(points, "itertools", None)
        drawn = points_of("--random", "20", "--grid", *many)
    assert len({tuple(point.items()) for point in drawn}) == 20
    drawn = points_of("--random", "16")
    assert len({tuple(point.items()) for point in drawn}) == 16
    for point in drawn:
        assert set(point) == set(PAPER_RANGES)
        assert all(value in PAPER_RANGES[name] for name, value in point.items())
    # So a sweep can grow by more of them.
    assert points_of("--random", "4") == drawn[:4]


def test_points_from_a_file(tmp_path):
    path = tmp_path / "points.json"
    path.write_text('[{"alpha": 1, "buffer_steps": 500}, {"learning_rate": 1e-4}]')
    own = options_.read(SweepOptions, ["--env", "point_mass", "--random", "1"], "x")[1]
    default = own.algorithm.settings
    # A point that does not name a value has the sweep's own.
    assert points_of("--points-file", str(path)) == [
        {"alpha": 1.0, "buffer_steps": 500, "learning_rate": default["learning_rate"]},
        {
            "alpha": default["alpha"],
            "buffer_steps": default["buffer_steps"],
            "learning_rate": 1e-4,
        },
    ]
    for text, message in (
        ("[" * 100_000, "is damaged"),
        ("[3]", "is damaged: its content is 3"),
        ("[]", "it must list a point or more"),
        ('[{"alhpa": 1}]', "did you mean 'alpha'"),
        ('[{"buffer_steps": 1.5}]', "buffer_steps is 1.5: it must be a whole number"),
    ):
        path.write_text(text)
        with pytest.raises(InputError, match=message):
            points_of("--points-file", str(path))


def test_a_sweep_from_end_to_end(swept):
    out, told, printed = swept
    assert "x 4 runs" in told
    assert "warning: numbers that were not finite in seeds [5, 6]" in told
    # While it trains, once.
    assert told.count("warning: an update was undone because a number in it") == 1
    best, speed, following = printed.splitlines()
    value = r"-?\d+\.\d"
    sentence = rf"point 0, learning_rate=0.0003: mean {value}, interq\w+ mean {value}$"
    assert re.match(f"best mean: {sentence}", best), best
    assert re.match(r"[\d,]+ steps/s on .*, in out$", speed), speed
    commands = "python -m gasil_jax.evaluate out; python -m gasil_jax.plot out; "
    assert following.startswith(f"next: {commands}python -m gasil_jax.render out ")

    rows = table(out / "results.csv")
    assert [(row["point"], row["seed"]) for row in rows] == [
        (point, seed) for point in "01" for seed in "56"
    ]
    assert [row["learning_rate"] for row in rows[::2]] == ["0.0003", "1e+30"]
    # The point beyond float32 did not harm the other.
    diverged = [int(row["skipped_updates"]) > 0 for row in rows]
    assert diverged == [False, False, True, True]
    summary = json.loads((out / "summary.json").read_text())
    assert summary["best_by_mean"] == 0
    assert [point["diverged_seeds"] for point in summary["points"]] == [0, 2]
    assert summary["device_count"] == jax.local_device_count()
    for name in ("learning_curve.png", "sweep.png", "hyperparameters.png"):
        assert (out / name).read_bytes().startswith(b"\x89PNG")
    curves = np.load(out / "curves.npz")
    assert {"env_steps", "approx_kl", "bonus"} < set(curves)
    for name in curves:
        assert curves[name].shape == (2, 2, 3 if "evaluation" in name else 4), name
    assert curves["evaluation_env_steps"][1, 1].tolist() == [0, 512, 1024]
    assert summary["evaluation_seconds"] > 0
    final = curves["evaluation_mean"][..., -1]
    written = [float(row["final_evaluation"]) for row in rows]
    np.testing.assert_allclose(written, final.ravel(), rtol=1e-6)
    for point, mean in zip(summary["points"], final.mean(axis=1), strict=True):
        assert point["final_evaluation"] == pytest.approx(mean)
        assert point["final_length"] == 50.0


def test_points_equal_single_runs(trained, swept):
    single, curves = (np.load(x.folder / "curves.npz") for x in (trained, swept))
    for name in curves:
        expected = single[name][0, :2]
        np.testing.assert_allclose(curves[name][0], expected, rtol=1e-3, atol=1e-3)
    _, algorithm, seeds, states = saved.load(swept.folder, point=0)
    assert seeds == [5, 6] and algorithm.agent.discriminator_updates == 3
    _, _, _, expected = saved.load(trained.folder)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b[:2], rtol=1e-3, atol=1e-3),
        states.actor_critic.params,
        expected.actor_critic.params,
    )


@pytest.fixture
def planned(monkeypatch):
    """What sweeps would train in a test, where they end before it."""
    every = []

    def prepare(requested, programs, *_, **__):
        every.append((requested, programs))
        raise InputError("enough")

    monkeypatch.setattr(training, "prepare", prepare)
    return every


def begun(folder, *arguments):
    """Write what a sweep has written when it is killed at once."""
    folder.mkdir()
    words = [*FLAGS, *arguments]
    options_.read(SweepOptions, words, "x")[1].write(folder)
    return ["--resume", "--out", str(folder)]


#: What a sweep was begun with, what it is continued with, and its points' alpha, or
#: alpha and gamma. The sweep's own gamma is 0.98; equal runs are one.
GROWN = """
--grid alpha=0.5 | --seeds 1 | 0.5
--grid alpha=0.5 | --grid alpha=0.1 | 0.5, 0.1
--grid alpha=0.5 gamma=0.9,0.98 | --grid alpha=0.5,2 | 0.5 0.9, 0.5 0.98, 2 0.98
--grid alpha=0.5 | --grid gamma=0.9,0.98 alpha=0.5 | 0.5 0.98, 0.5 0.9
--points-file a.json | --grid alpha=0.5 | 0.7, 0.5
"""


@pytest.mark.parametrize(("before", "more", "expected"), rows(GROWN))
def test_a_sweep_continues_and_grows(
    before, more, expected, tmp_path, monkeypatch, planned
):
    monkeypatch.chdir(tmp_path)
    file = tmp_path / "a.json"
    file.write_text('[{"alpha": 0.7}]')
    again = begun(tmp_path / "s", *before.split())
    # Its config.json has the points as well.
    file.unlink()
    assert sweep.main([*again, *more.split()]) == 2
    ((requested, programs),) = planned
    points = [[float(x) for x in point.split()] for point in expected.split(",")]
    assert [list(x.values()) for x in requested.points] == points
    assert all(list(x) == ["alpha", "gamma"][: len(x)] for x in requested.points)
    assert sum(len(each.runs) for each in programs) == len(points)


def test_other_settings_and_a_folder_of_something_else_are_refused(
    tmp_path, capsys, planned
):
    again = begun(tmp_path / "s", "--grid", "alpha=1")
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "text.tex").touch()
    grid = [*FLAGS, "--grid", "alpha=1"]
    for words, message in (
        ([*again, "--gamma", "0.9"], "gamma was 0.98, is 0.9"),
        ([*grid, "--out", str(tmp_path / "s")], "is not empty"),
        ([*grid, "--out", str(tmp_path / "thesis")], "is not empty"),
    ):
        assert message in refused(capsys, sweep, *words)
    assert not planned
    # A sweep without a name does not look into the folder that it starts in.
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path / "s")
        assert sweep.main(grid) == 2
    assert len(planned) == 1


def test_an_interrupted_sweep_continues(tmp_path, monkeypatch, capsys, figures):
    long = (*FLAGS, "--agent", "ppo", "--total-steps", str(60 * 128), "--seeds", "2")
    grid = ("--grid", "gamma=0.9,0.99", "num_epochs=1,2")
    whole, out = tmp_path / "whole", tmp_path / "interrupted"
    assert sweep.main([*long, *grid, "--out", str(whole)]) == 0
    train = Members.train

    def interrupt(program, at_least, arguments):
        """Send SIGTERM in a program's chunk that ends there or later."""

        def interrupted(self, advance, states, first, count):
            number = self.config.num_epochs - 1
            if number == program and first + count >= at_least:
                os.kill(os.getpid(), signal.SIGTERM)
            return train(self, advance, states, first, count)

        with monkeypatch.context() as patch:
            patch.setattr(Members, "train", interrupted)
            assert sweep.main(arguments) == 128 + signal.SIGTERM
        assert f"gasil_jax.sweep --resume --out {out}" in capsys.readouterr().err
        assert not (out / "results.csv").exists()

    # In the last chunk of a program, and so before the next one has begun.
    interrupt(0, 60, [*long, *grid, "--out", str(out)])
    (first,) = (out / "programs").iterdir()
    # In the second program, after some chunks.
    interrupt(1, 30, ["--resume", "--out", str(out)])
    seconds = (first / "training.json").read_bytes()
    assert sweep.main(["--resume", "--out", str(out)]) == 0
    for name in ("results.csv", "policy.npz"):
        assert (out / name).read_bytes() == (whole / name).read_bytes(), name
    # The first program was finished, and is left as it was.
    assert (first / "training.json").read_bytes() == seconds


def test_several_agents_are_points_of_one_sweep(tmp_path, monkeypatch, capsys, figures):
    monkeypatch.chdir(tmp_path)
    agents = ("--agent", "ppo,ppo+sil", "--devices", "2")
    own = ("--sil-coefficient", "0.3", "--gamma", "0.9", "--total-steps", "512")
    assert run.main([*FLAGS, *agents, *own, "--out", "out"]) == 0
    rows = table("out/results.csv")
    assert [row["agent"] for row in rows] == ["ppo", "ppo+sil"]
    stored = read_sweep(pathlib.Path("out"))
    # Each has its own preset, and of what is given what it has.
    for each in stored.algorithms:
        preset = gasil_jax.preset("point_mass", each.agent.name)
        same = "learning_rate", "gae_lambda"
        assert [each.settings[x] for x in same] == [preset.settings[x] for x in same]
        assert each.settings["gamma"] == 0.9
    assert stored.others[0].settings["sil_coefficient"] == 0.3
    # What only one of them measures is not known of the other.
    curves = np.load("out/curves.npz")
    only = [x for x in curves.files if np.isnan(curves[x][0]).all()]
    assert only and np.isfinite(curves["policy_loss"]).all()
    # They grow by points, in the same programs.
    assert sweep.main(["--resume", "--out", "out", "--grid", "gamma=0.8"]) == 0
    assert len(read_sweep(pathlib.Path("out")).points) == 4
    assert plot.main(["out", "--out", "x.png"]) == 0
    told = capsys.readouterr()
    assert "point_mass, ppo " in told.out and "point_mass, ppo+sil " in told.out
    for words, why in (
        (("--agent", "ppo,ppo"), "agent has 'ppo' twice"),
        (("--resume", "--agent", "ppo"), "agent was ppo,ppo+sil, is ppo"),
        (("--agent", "ppo,gail", "--grid", "gamma=1", "agent=x"), "as --agent A,B"),
        (("--agent", "ppo,gasil", "--grid", "alpha=1"), "not of ppo. What can vary"),
    ):
        out = "out" if "--resume" in words else "new"
        assert sweep.main([*FLAGS, *words, "--out", out]) == 2
        assert why in capsys.readouterr().err

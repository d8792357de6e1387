"""Missing runs are trained, continue where they were stopped, and are stored."""

import dataclasses
import multiprocessing
import os
import signal
import threading
import time

import jax
import numpy as np
import pytest

import gasil_jax
from experiments import __main__, engine
from experiments.engine import Program, Setup
from experiments.figures import FIGURES, Curve, Figure
from experiments.search import Search
from experiments.store import Run, Store
from gasil_jax.config import Config
from gasil_jax.host.interruption import Interrupted
from gasil_jax.sweeps.shards import Shard

SMALL = {"batch_steps": 256, "num_envs": 4, "num_epochs": 1, "hidden_sizes": (8,)}
SMALL |= {"discriminator_hidden_sizes": (8,), "total_steps": 1024}


def run(seed=0, **changes):
    return Run("point_mass", Config(agent="ppo").replace(**{**SMALL, **changes}), seed)


RUNS = [run(0), run(1), run(0, learning_rate=1e-4)]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """One program of three runs, and its setup."""
    setup = Setup(
        tmp_path_factory.mktemp("runs"), source={"commit": "c", "clean": True}
    )
    (program,) = engine.programs(RUNS, "mjx")
    return program, setup, engine.train(program, setup)


def test_runs_share_a_program_that_differ_in_floats_and_seeds_alone():
    other = [
        run(hidden_sizes=(4,)),
        run(num_envs=2),
        dataclasses.replace(run(), reward_delay=20),
        dataclasses.replace(run(), env="hopper"),
    ]
    programs = engine.programs([*RUNS, *other], "mjx")
    assert sorted(len(program.runs) for program in programs) == [1, 1, 1, 1, 3]
    folders = {program.folder(engine.pathlib.Path()) for program in programs}
    assert len(folders) == 5
    # The order in which runs are missing is no part of what a program is.
    (same,) = engine.programs(RUNS[::-1], "mjx")
    assert same.folder(engine.pathlib.Path()) in folders
    assert Program(same.runs, "mujoco").folder(engine.pathlib.Path()) not in folders


def test_parts_are_all_runs_once_whatever_is_there_already():
    runs = [run(seed) for seed in range(10)]
    parts = [engine.part_of(runs, Shard(number, 3)) for number in (1, 2, 3)]
    assert sorted(x.seed for part in parts for x in part) == list(range(10))
    assert {len(part) for part in parts} == {3, 4}
    assert engine.part_of(runs[::-1], Shard(1, 3)) == parts[0][::-1]
    assert engine.part_of(runs, Shard(1, 1)) == runs


def test_a_record_is_what_make_train_gives(trained):
    _, _, records = trained
    assert set(records) == set(RUNS)
    env = gasil_jax.make_env("point_mass")
    for each, kept in records.items():
        train = jax.jit(gasil_jax.make_train(env, each.config))
        _, metrics = train(jax.random.key(each.seed))
        assert kept.env_steps.tolist() == [256, 512, 768, 1024]
        for name in ("episode_return", "episode_length"):
            np.testing.assert_allclose(getattr(kept, name), metrics[name], rtol=2e-3)
        assert kept.provenance["commit"] == "c" and kept.provenance["clean"]
        assert kept.provenance["physics"] == "mjx" and kept.provenance["device"]
        assert np.isnan(kept.final_evaluation)


def test_what_is_trained_is_not_trained_again(trained, monkeypatch):
    program, setup, records = trained
    monkeypatch.setattr(gasil_jax.train, "iterate", None)
    evaluated = dataclasses.replace(
        setup, evaluate=2, source={"commit": "d", "clean": None}
    )
    again = engine.train(program, evaluated)
    for each, kept in again.items():
        before = records[each].episode_return
        np.testing.assert_array_equal(kept.episode_return, before)
        assert np.isfinite(kept.final_evaluation)
        # The provenance names everything that the program was trained with.
        assert kept.provenance["commit"] == "c, then d"
        assert kept.provenance["clean"] is None


def test_rows_are_means_over_equal_parts_of_training():
    returns = np.arange(120.0)
    returns[[0, 1, 2]], returns[5] = np.nan, np.nan
    metrics = {"env_steps": np.arange(1, 121), "episode_return": returns}
    kept = engine.record(metrics | {"evaluation_return": returns + 1}, 1.0, {})
    assert len(kept.env_steps) == engine.ROWS and kept.env_steps[-1] == 120
    assert np.isnan(kept.episode_return[0]) and kept.episode_return[1] == 3.5
    np.testing.assert_array_equal(kept.evaluation_return, kept.episode_return + 1)
    assert np.isnan(kept.episode_length).all()


def test_runs_side_by_side_are_those_of_one_program(trained, tmp_path):
    _, _, records = trained
    store, setup = Store(tmp_path / "store"), Setup(tmp_path / "runs")
    unknown = run(agent="pppo")
    with pytest.raises(ChildProcessError, match=r"1 of 3 runs failed, see .*\.log"):
        engine.train_missing([unknown, *RUNS[:2]], store, setup, 2)
    log = Program((unknown,), "mjx").folder(tmp_path / "runs").with_suffix(".log")
    assert "agent 'pppo' is unknown" in log.read_text()
    assert store.missing([unknown, *RUNS[:2]]) == [unknown]
    for each in RUNS[:2]:
        trained, other = store[each].episode_return, records[each].episode_return
        np.testing.assert_allclose(trained, other, rtol=2e-3)


def test_a_signal_ends_all_processes_and_they_have_saved(tmp_path):
    runs = [run(seed, total_steps=10**9) for seed in range(3)]
    store, setup = Store(tmp_path / "store"), Setup(tmp_path / "runs")

    def interrupt():
        while len(list(tmp_path.glob("runs/*/metrics.csv"))) < 2:
            time.sleep(0.2)
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=interrupt, daemon=True).start()
    with pytest.raises(Interrupted):
        engine.train_missing(runs, store, setup, 2)
    assert not multiprocessing.active_children()
    assert len(list(tmp_path.glob("runs/*/checkpoints/0*/manifest.json"))) == 2


@pytest.fixture
def toy(monkeypatch):
    """A figure of two small curves on the point mass."""
    changes = {**SMALL, "total_steps": 512}
    curve = Curve(Search("point_mass", "ppo"), seeds=2, preset=True, changes=changes)
    other = dataclasses.replace(curve, changes={**curve.changes, "learning_rate": 1e-4})
    figure = Figure("Toy", "None.", {"a": {"x": curve, "y": other}}, favourite="x")
    monkeypatch.setitem(FIGURES, "mujoco", figure)
    return figure


def test_a_figure_is_trained_from_end_to_end_and_in_parts(toy, tmp_path, capsys):
    note = __main__.Page("mujoco", Store(tmp_path), figure=toy).note
    assert note == "{{table}}"
    for part in ("1/2", "2/2"):
        folders = ("--runs", str(tmp_path / "runs"))
        results = tmp_path / part[0]
        arguments = ("mujoco", *folders, "--results", str(results), "--part", part)
        assert __main__.main([*arguments, "--devices", "1"]) == 0
        assert (
            len(
                Store(results / "runs").missing(
                    toy.requested(Store(results), Store(results))
                )
            )
            == 2
        )
        assert "Not trained yet: 2 of 4 runs." in (results / "mujoco.md").read_text()
    assert (
        __main__.main(
            ["merge", str(tmp_path / "2"), "--results", str(results.parent / "1")]
        )
        == 0
    )
    assert "2 of 2 runs are new" in capsys.readouterr().out
    arguments = ("mujoco", "--results", str(tmp_path / "1"), "--list")
    assert __main__.main([*arguments]) == 0
    assert "mujoco: 0 runs are missing" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("nonsense",), "experiment 'nonsense' is unknown: did you mean"),
        (
            ("mujoco", "--only", "hoper"),
            "only 'hoper' is unknown: did you mean 'hopper'",
        ),
        (("mujoco", "--part", "3/2"), "part is '3/2'"),
        (("mujoco", "--processes", "0"), "processes is 0"),
        (("mujoco", "--processes", "2", "--devices", "2"), "devices is 2"),
        (("mujoco", "--quick", "--results", "x"), "results is x: --quick writes below"),
        (("merge", "/proc/none"), "folder is /proc/none: it must have TASK.npz"),
        (("report", "--help-me"), "Unrecognized options: --help-me"),
        (("benchmark", "--tables", "speed"), "tables has 'speed': allowed physics"),
        (("benchmark", "--repeats", "0"), "repeats is 0: it must be 1 or more"),
        (("benchmark", "--out", "x.csv"), "out is x.csv: it must end in .json"),
        (("point_mass_layouts", "--layouts", "-1"), "layout is -1"),
        (("point_mass_layouts", "--seeds", "1"), "seeds is 1"),
        (("point_mass_moments", "--animate", "-1"), "animate is -1"),
        (("point_mass_moments", "--out", "/proc/x"), "out is /proc/x/point_mass_mom"),
    ],
)
def test_bad_input_is_one_line_and_status_2(arguments, message, capsys):
    assert __main__.main([*arguments]) == 2
    error = capsys.readouterr().err
    assert message in error and len(error.splitlines()) == 1


def test_without_a_name_the_figures_are_listed(capsys):
    assert __main__.main([]) == 0
    printed = capsys.readouterr().out
    assert all(name in printed for name in (*FIGURES, "merge", "benchmark"))

"""Missing runs are trained, continue where they were stopped, and are stored."""

import contextlib
import dataclasses
import multiprocessing
import os
import signal
import threading

import numpy as np
import pytest

import gasil_jax
from experiments import __main__, engine
from experiments.curves import Curve, Figure
from experiments.engine import Setup
from experiments.figures import FIGURES
from experiments.store import Record, Store, read
from gasil_jax.errors import InputError
from gasil_jax.host import interruption
from gasil_jax.host.members import Members
from gasil_jax.host.runs import Run

SMALL = {"batch_steps": 256, "num_envs": 4, "num_epochs": 1, "hidden_sizes": (8,)}
SMALL |= {"total_steps": 12 * 256}


def run(seed=0, **changes):
    return Run("point_mass", gasil_jax.algorithm("ppo", **{**SMALL, **changes}), seed)


RUNS = [run(0), run(1), run(0, learning_rate=1e-4)]


def told(monkeypatch, commit, clean):
    """As if the checkout were at this commit."""
    monkeypatch.setattr(engine, "source", lambda _: {"commit": commit, "clean": clean})


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """One program of three runs, and their records."""
    setup = Setup(tmp_path_factory.mktemp("runs"), evaluate_episodes=2)
    (program,) = engine.unfinished(RUNS, setup)
    with pytest.MonkeyPatch.context() as monkeypatch:
        told(monkeypatch, "c", True)
        return setup, program, engine.train(program, setup)


def test_shards_are_all_runs_once_and_none_moves_when_others_join():
    runs = [run(seed) for seed in range(60)]
    shards = [engine.select_by_key(runs, number, 3) for number in (1, 2, 3)]
    assert sorted(x.seed for shard in shards for x in shard) == list(range(60))
    assert all(10 < len(shard) < 30 for shard in shards)
    for number, shard in enumerate(shards, start=1):
        assert engine.select_by_key(runs[:40], number, 3) == [
            x for x in shard if x.seed < 40
        ]
    assert engine.select_by_key(runs, 1, 1) == runs


def test_a_record_is_what_fit_gives(trained):
    """Which trains as `make_train` does: test_members.py."""
    _, _, records = trained
    assert set(records) == set(RUNS)
    rates = [{}, {"learning_rate": 1e-4}]
    scored = {"evaluate_every": 512, "evaluate_episodes": 2}
    env, algorithm = gasil_jax.make_env("point_mass"), RUNS[0].algorithm
    fitted = gasil_jax.fit(env, algorithm, seeds=2, points=rates, **scored)
    for each, record in records.items():
        at = int(each.algorithm != algorithm), each.seed
        assert record.env_steps.tolist() == [256 * i for i in range(1, 13)]
        for name in ("episode_return", "episode_length"):
            expected = fitted.metrics[name][at]
            np.testing.assert_allclose(getattr(record, name), expected, rtol=1e-5)
        assert record.provenance["commit"] == "c" and record.provenance["clean"]
        assert record.provenance["physics"] == "jax" and record.provenance["device"]
        # At most ten evaluations are spread over training.
        assert record.evaluation_steps.tolist() == [512 * i for i in range(1, 7)]
        scores = fitted.evaluations["mean"][at][1:]
        np.testing.assert_allclose(record.evaluation_return, scores, rtol=1e-5)


def test_what_is_trained_is_not_trained_again(trained, monkeypatch, tmp_path):
    setup, _, records = trained
    monkeypatch.setattr(Members, "compile", None)
    store = Store(tmp_path)
    # Unless that is asked for, training in the scratch folder is not continued.
    with pytest.raises(InputError, match=r"holds training of these runs.*--resume"):
        engine.train_missing(RUNS, store, setup)
    resumed = dataclasses.replace(setup, resume=True)
    engine.train_missing(RUNS, store, resumed)
    for each in RUNS:
        before, again = records[each], Store(tmp_path)[each]
        for name in ("episode_return", "evaluation_steps", "evaluation_return"):
            np.testing.assert_allclose(
                getattr(again, name), getattr(before, name), 5e-6
            )
        assert again.provenance == before.provenance


def test_rows_are_means_over_equal_parts_of_training():
    returns = np.arange(120.0)
    returns[[0, 1, 2]], returns[5] = np.nan, np.nan
    nan = np.full(120, np.nan)
    metrics = {"env_steps": np.arange(1, 121), "episode_return": returns}
    record = engine.record(metrics | {"episode_length": nan}, {}, {})
    assert len(record.env_steps) == engine.ROWS and record.env_steps[-1] == 120
    assert np.isnan(record.episode_return[0]) and record.episode_return[1] == 3.5
    assert np.isnan(record.episode_length).all()
    assert len(record.evaluation_steps) == len(record.evaluation_return) == 0


@contextlib.contextmanager
def beside(waiting):
    """Advance a generator ten times a second until the block ends, in a thread."""
    ended = threading.Event()

    def advance():
        for _ in waiting:
            if ended.wait(0.1):
                return

    thread = threading.Thread(target=advance)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


@pytest.fixture
def toy(monkeypatch):
    """A figure of two small curves on the point mass."""
    changes = {**SMALL, "total_steps": 512}
    curve = Curve("point_mass", "ppo", seeds=4, changes=changes)
    other = dataclasses.replace(curve, changes={**changes, "gamma": 0.9})
    figure = Figure("Toy", "None.", {"a": {"x": curve, "y": other}}, favourite="x")
    monkeypatch.setitem(FIGURES, "matrix", figure)
    return figure


def test_a_figure_is_trained_from_end_to_end_and_in_shards(toy, tmp_path, capsys):
    missing = []
    for shard in ("1/2", "2/2"):
        folders = ("--runs", str(tmp_path / "runs"), "--evaluate-episodes", "0")
        results = tmp_path / shard[0]
        arguments = ("matrix", *folders, "--results", str(results), "--shard", shard)
        assert __main__.main([*arguments, "--devices", "1"]) == 0
        stored = Store(results / "runs")
        missing.append(set(stored.missing(toy.requested(stored))))
    assert missing[0] and missing[1] and not missing[0] & missing[1]
    words = f"Not trained yet: {len(missing[1])} of 8 runs."
    assert words in (results / "matrix.md").read_text()
    # The results of both machines are those of one.
    runs = read(tmp_path / "2" / "runs" / "point_mass.npz")
    assert Store(tmp_path / "1" / "runs").add(runs) == len(runs) == len(missing[0])
    assert __main__.main(["matrix", "--results", f"{tmp_path}/1", "--list"]) == 0
    assert "matrix: 0 runs are missing" in capsys.readouterr().out


@pytest.mark.parametrize("name", ["matrix", "delayed_rewards", "sparse_causes"])
def test_the_page_of_a_small_version_can_be_written(name, tmp_path):
    """As if all of its runs were trained already."""
    results = tmp_path / "quick" / "results"
    store, made = Store(results / "runs"), {"physics": "jax", "versions": None}
    record = Record(*[np.arange(1.0, 11.0)] * 3, made | {"commit": "", "device": ""})
    runs = __main__._small(FIGURES[name], ()).requested(store)
    store.add(dict.fromkeys(runs, record))
    assert __main__.main([name, "--quick", "--runs", str(tmp_path)]) == 0
    assert "![" in (results / f"{name}.md").read_text()


TWO_CORES = pytest.mark.skipif(
    len(os.sched_getaffinity(0)) < 2, reason="needs two cores"
)


@TWO_CORES
def test_processes_end_and_save_when_their_parent_is_interrupted(
    tmp_path, capsys, monkeypatch
):
    changes = {**SMALL, "total_steps": 20 * 256}
    curve = Curve("point_mass", "ppo", changes, seeds=1)
    monkeypatch.setitem(FIGURES, "matrix", Figure("Toy", "", {"a": {"x": curve}}))
    folders = ["--runs", f"{tmp_path}/runs", "--results", f"{tmp_path}"]
    command = ["matrix", *folders, "--evaluate-episodes", "0"]
    logs = lambda: [x.read_text() for x in tmp_path.glob("runs/*/*.log")]
    children = []

    def interrupt():
        while not any(": compiling" in log for log in logs()):
            yield
        children.extend(multiprocessing.active_children())
        # A cluster sends its signal to all, and then the process gets it twice.
        for pid in (children[0].pid, os.getpid()):
            os.kill(pid, signal.SIGTERM)

    with beside(interrupt()):
        status = __main__.main([*command, "--processes", "2"])
    assert status == 128 + signal.SIGTERM
    assert capsys.readouterr().err.splitlines() == [
        interruption.ANSWER,
        "interrupted by SIGTERM; all that was done is saved",
        "continue with: the same command and --resume",
    ]
    assert children and not children[0].is_alive()
    assert len(list(tmp_path.glob("runs/*/*/checkpoints/0*/manifest.json"))) == 1
    assert not list(tmp_path.glob("runs/*/*/training.json"))
    assert __main__.main([*command, "--resume"]) == 0
    assert "Not trained yet" not in (tmp_path / "matrix.md").read_text()


def test_programs_have_at_most_so_many_members_and_searches_are_not_evaluated():
    runs = [run(seed) for seed in range(5)] + [run(seed) for seed in (1000, 1001)]
    every = engine.unfinished(runs, Setup(members=2))
    assert sorted(len(program.runs) for program in every) == [1, 2, 2, 2]
    assert {x for program in every for x in program.runs} == set(runs)
    for program in every:
        assert len({run.seed >= 1000 for run in program.runs}) == 1

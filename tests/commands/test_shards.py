"""A sweep is a store of runs: in shards, copied or grown, each run is trained once."""

import json
import shutil
import signal
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refused

import gasil_jax
from gasil_jax import sweep
from gasil_jax.cli import options as options_
from gasil_jax.cli import run as training_of_commands
from gasil_jax.cli.options import SweepOptions
from gasil_jax.errors import InputError
from gasil_jax.host import programs, ray_launcher
from gasil_jax.host.interruption import Interrupted
from gasil_jax.host.points import completed
from gasil_jax.host.programs import Training
from gasil_jax.host.sweep import Sweep, parse_shard
from gasil_jax.host.tables import TableWriter


@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    updates=st.lists(st.integers(1, 9), min_size=1, max_size=6, unique=True),
    num_seeds=st.integers(1, 4),
    count=st.integers(1, 24),
)
def test_shards_hold_each_run_once(updates, num_seeds, count):
    points = [{"discriminator_updates": 1 + n // 3, "alpha": n / 9} for n in updates]
    requested = Sweep("point_mass", gasil_jax.algorithm(), range(num_seeds), points)
    runs = list(requested.runs.values())
    every = [(number, count) for number in range(1, count + 1)]
    if count > len(runs):
        with pytest.raises(InputError, match=f"{len(runs)} runs"):
            requested.part(*every[0])
        return
    parts = [requested.part(*shard) for shard in every]
    sizes = [len(part) for part in parts]
    assert max(sizes) - min(sizes) <= 1
    whole = programs.group(runs)
    assert [run for part in parts for run in part] == [r for p in whole for r in p.runs]
    # No more is compiled than cutting must cost.
    seen = [program for part in parts for program in programs.group(part)]
    assert len(seen) <= len(whole) + count - 1


def test_points_that_differ_in_traced_numbers_alone_share_a_program(tmp_path):
    points = [
        {"discriminator_updates": 20, "alpha": 0.1},
        {"gamma": 0.9},
        {"num_epochs": 3},
        # The same run as the sweep's own.
        {"alpha": 0.3},
    ]
    algorithm = gasil_jax.algorithm(alpha=0.3)
    every = completed([{}, *points], algorithm)
    assert len(every) == 4
    requested = Sweep("point_mass", algorithm, [7, 8], every)
    first, *others = requested.unfinished(tmp_path)
    assert first.labels == {"point": (0, 0, 2, 2), "seed": (7, 8, 7, 8)}
    numbers = [(x["alpha"], x["gamma"]) for x in first.hyperparameters]
    assert numbers == [(0.3, 0.99)] * 2 + [(0.3, 0.9)] * 2
    assert [x.labels["point"] for x in others] == [(1, 1), (3, 3)]
    assert [x.algorithm for x in others] == [
        algorithm.replace(discriminator_updates=20, alpha=0.1),
        algorithm.replace(num_epochs=3),
    ]


# Pictures are drawn, and not written, which takes most of the time here.
pytestmark = pytest.mark.usefixtures("figures")

GRID = ("alpha=0.1,1", "discriminator_updates=1,2")
SMALL = (
    *("--env", "point_mass", "--total-steps", "300", "--batch-steps", "100"),
    *("--num-envs", "4", "--minibatch-size", "50", "--seeds", "3", "--gamma", "0.99"),
)


def trained_for(seconds, num_members):
    """What is stored of how a program was trained, for so many seconds a member."""
    trained = {"iterations": 3, "env_steps": 300 * num_members, "versions": {}}
    took = {"compile_seconds": 1.0, "train_seconds": seconds * num_members}
    on = {"device": "1 x cpu", "device_count": 1}
    return Training(**trained, **took, **on, evaluation_seconds=None)


def train(folder, shard=None, *arguments, grid=GRID):
    """Write the files of a trained sweep, with metrics that tell members apart."""
    words = [*SMALL, "--grid", *grid, *arguments]
    requested = options_.read(SweepOptions, words, "x")[1]
    runs = requested.part(*parse_shard(shard or "1/1"))
    folder.mkdir(parents=True, exist_ok=True)
    requested.write(folder)
    for program in requested.unfinished(folder, runs):
        write(program)
    return requested


def write(program):
    with program.opened():
        write_metrics(program)
        program.finish(trained_for(0.5, len(program.runs)))


def write_metrics(program):
    writer = TableWriter(program.path / "metrics.csv", program.labels)
    steps = np.array([100.0, 200.0, 300.0])
    agents = [run.algorithm.agent for run in program.runs]
    value = [200.0 * x.alpha + 20 * x.discriminator_updates for x in agents]
    value = (np.array(value) + program.seeds)[:, None] + steps
    zero = np.zeros_like(value)
    returns = np.where(value % 100 == 61, np.nan, value)
    metrics = {"env_steps": zero + steps, "episode_return": returns}
    skipped = np.where(value == 342.0, 1.0, 0.0)
    metrics |= {"episode_length": zero + 7.0, "skipped_updates": skipped}
    writer.write(metrics | {"faulty_steps": zero})
    writer.close()


TABLES = ("results.csv", "curves.npz")


def continued(folder, *arguments):
    return sweep.main(["--resume", "--out", str(folder), *arguments])


def test_tables_of_shards_are_those_of_the_whole_sweep(tmp_path, capsys):
    """Five shards of twelve members divide points and programs."""
    count = 5
    whole, shared, apart = (tmp_path / x for x in ("whole", "shared", "apart"))
    train(whole)
    assert continued(whole) == 0
    expected = json.loads((whole / "summary.json").read_text())
    assert expected["points"][1]["mean"] is None  # never ended
    assert [point["diverged_seeds"] for point in expected["points"]] == [1, 0, 0, 1]
    assert expected["env_steps_per_second"] == pytest.approx(600)
    for number in range(1, count + 1):
        train(shared, f"{number}/{count}")
        train(tmp_path / f"{number}", f"{number}/{count}")
        # Where each host has its own disk, the programs are copied into one folder.
        shutil.copytree(tmp_path / f"{number}", apart, dirs_exist_ok=True)
    capsys.readouterr()
    for out in (shared, apart):
        assert continued(out) == 0
        assert "600 steps/s on 1 x cpu" in capsys.readouterr().out
        for name in TABLES:
            assert (out / name).read_bytes() == (whole / name).read_bytes(), name
        summary = json.loads((out / "summary.json").read_text())
        assert summary["points"] == expected["points"]


def test_missing_and_damaged_and_doubled_runs(tmp_path, capsys, jobs_to_train):
    requested = train(tmp_path / "a")
    train(tmp_path / "b", "1/5")
    # Equal results of a run are one.
    shutil.copytree(tmp_path / "b", tmp_path / "a", dirs_exist_ok=True)
    assert continued(tmp_path / "a") == 0
    (other,) = requested.stored(tmp_path / "b")[:1]
    path = tmp_path / "a" / "programs" / other.path.name / "metrics.csv"
    kept = path.read_text()
    path.write_text(kept.replace(",7,", ",8,"))
    capsys.readouterr()
    message = refused(capsys, sweep, "--resume", "--out", tmp_path / "a")
    assert "another program have different results for seed" in message
    # Two seeds' rows are exchanged; a table has a column more than the others.
    rows = kept.splitlines()
    for changed, message in (
        ([rows[0], rows[2], rows[1], *rows[3:]], "its rows are not in order"),
        ([f"{rows[0]},mine", *(f"{x},1" for x in rows[1:])], "different results"),
    ):
        path.write_text("\n".join([*changed, ""]))
        assert message in refused(capsys, sweep, "--resume", "--out", tmp_path / "a")
    shutil.rmtree(path.parent)
    assert continued(tmp_path / "a") == 0 and not jobs_to_train


@pytest.fixture
def jobs_to_train(monkeypatch):
    """The programs that are trained in a test, where that is interrupted at once."""
    jobs_to_train = []

    def interrupted_at_once(env, needed, *_, **__):
        if needed:
            jobs_to_train.extend(needed)
            raise Interrupted(signal.SIGTERM)
        return []

    monkeypatch.setattr(
        training_of_commands.training, "train_programs", interrupted_at_once
    )
    return jobs_to_train


STOPPED = 128 + signal.SIGTERM


def test_a_shard_continues(tmp_path, capsys, jobs_to_train):
    requested = train(tmp_path, "1/2")
    more = ["--env", "point_mass", "--grid", *GRID, "--out", str(tmp_path)]
    same = [*SMALL, *more, "--shard", "1/2"]
    assert sweep.main([*same, "--gamma", "0.9"]) == 2
    assert "gamma was 0.99, is 0.9" in capsys.readouterr().err
    # Nothing is left to do. With --resume the sweep's own settings are used.
    resumed = ["--resume", "--out", str(tmp_path), "--shard", "1/2"]
    for command in (same, resumed):
        assert sweep.main(command) == 0
        told = capsys.readouterr().out
        assert "shard 1/2 is done" in told and "6 of 12 runs" in told
    # An unfinished program is trained with the shard's members alone.
    (begun,) = requested.trained(tmp_path)
    (begun.path / "training.json").unlink()
    for command in (same, resumed):
        assert sweep.main(command) == STOPPED
        assert jobs_to_train.pop() == begun and not jobs_to_train
        # The command that is printed when it is interrupted.
        how = f"gasil_jax.sweep --shard 1/2 --resume --out {tmp_path}"
        assert how in capsys.readouterr().err
    # With other settings than those of the first it is no part of the same sweep.
    begin = [*more, "--shard", "2/2", "--seeds", "3"]
    assert sweep.main(begin) == 2
    assert "num_envs was 4" in capsys.readouterr().err
    # A cluster that runs a job again may do so before the job has begun.
    assert sweep.main([*begin, "--out", str(tmp_path / "other"), "--resume"]) == STOPPED
    assert sum(len(job.runs) for job in jobs_to_train) == 6


def test_a_launcher_resumes_shards_only_on_request(tmp_path, capsys, monkeypatch):
    launched = []
    monkeypatch.setattr(
        ray_launcher, "run_on_ray", lambda program, jobs, devices: launched.append(jobs)
    )
    out = tmp_path / "out"
    train(out)
    more = [*SMALL, "--grid", *GRID, "--launcher", "ray", "--shards", "2"]
    assert sweep.main([*more, "--out", str(out)]) == 2
    assert "what is in it with --resume" in capsys.readouterr().err
    assert not launched
    resumed = ["--resume", "--launcher", "ray", "--shards", "2", "--out", str(out)]
    for command in ([*more, "--resume", "--out", str(out)], resumed):
        assert sweep.main(command) == 0
        jobs = launched.pop()
        assert list(jobs) == ["shard 1/2", "shard 2/2"]
        for name, arguments in jobs.items():
            assert arguments.count("--resume") == 1
            assert sweep.main(arguments) == 0
            assert f"{name} is done" in capsys.readouterr().out
    # A job continues when it is run again, even if the launch was the first.
    (tmp_path / "new").mkdir()
    assert sweep.main([*more, "--out", str(tmp_path / "new")]) == 2
    assert "12 of 12 runs are missing" in capsys.readouterr().err
    assert all("--resume" in arguments for arguments in launched[-1].values())


def test_a_launcher_that_is_not_installed_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(InputError, match=r"gasil_jax\[ray\]"):
        ray_launcher.run_on_ray("x", {}, None)

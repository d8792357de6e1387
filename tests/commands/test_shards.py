"""A sweep is a store of runs: in shards, merged or grown, each run is trained once."""

import json
import shutil
import signal
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.figure import Figure

import gasil_jax
from gasil_jax import merge, sweep
from gasil_jax.errors import InputError
from gasil_jax.host import metrics_files, run_options
from gasil_jax.host.environments import Settings
from gasil_jax.host.interruption import Interrupted
from gasil_jax.sweeps import assembly, launch, programs, saved_states, shards, tables
from gasil_jax.sweeps.plan import Plan, programs_of
from gasil_jax.sweeps.runs import Run


def plan_of(points, seeds, algorithm=None):
    algorithm = algorithm or gasil_jax.algorithm()
    return Plan("point_mass", Settings(), algorithm, points, seeds)


@settings(max_examples=200, deadline=None, derandomize=True)
@given(
    updates=st.lists(st.integers(1, 9), min_size=1, max_size=6, unique=True),
    num_seeds=st.integers(1, 4),
    count=st.integers(1, 24),
)
def test_shards_hold_each_run_once(updates, num_seeds, count):
    points = [{"discriminator_updates": 1 + n // 3, "alpha": n / 9} for n in updates]
    plan = plan_of(points, range(num_seeds))
    runs = list(plan.runs.values())
    every = [(number, count) for number in range(1, count + 1)]
    if count > len(runs):
        with pytest.raises(InputError, match=f"{len(runs)} members"):
            plan.part(*every[0])
        return
    parts = [plan.part(*shard) for shard in every]
    sizes = [len(part) for part in parts]
    assert max(sizes) - min(sizes) <= 1
    whole = programs.group(runs)
    assert [run for part in parts for run in part] == [r for p in whole for r in p.runs]
    # No more is compiled than cutting must cost.
    seen = [program for part in parts for program in programs.group(part)]
    assert len(seen) <= len(whole) + count - 1


def test_points_that_differ_in_traced_numbers_alone_share_a_program():
    points = [
        {"discriminator_updates": 5, "alpha": 1.0},
        {"discriminator_updates": 20, "alpha": 0.1},
        {"discriminator_updates": 5, "gamma": 0.9},
        {"num_epochs": 3},
        # The same run as the first one's.
        {"alpha": 1.0},
    ]
    algorithm = gasil_jax.algorithm(alpha=0.3)
    plan = plan_of(points, [7, 8], algorithm)
    first, *others = programs.group(plan.runs.values())
    assert plan.labels(first) == {"point": (0, 0, 2, 2), "seed": (7, 8, 7, 8)}
    numbers = [(x["alpha"], x["gamma"]) for x in first.hyperparameters]
    assert numbers == [(1.0, 0.99)] * 2 + [(0.3, 0.9)] * 2
    assert [plan.labels(x)["point"] for x in others] == [(1, 1), (3, 3)]
    assert [x.algorithm for x in others] == [
        algorithm.replace(discriminator_updates=20, alpha=0.1),
        algorithm.replace(num_epochs=3),
    ]


def test_a_program_of_a_version_with_fewer_settings_is_read(tmp_path):
    """What it lacks has its default, so that its runs are those of this version."""
    runs = tuple(Run("point_mass", gasil_jax.algorithm("ppo"), seed) for seed in (3, 4))
    stored = programs.Program(runs, tmp_path / "now", {"seed": (3, 4)})
    with stored.opened():
        pass
    listed = json.loads((stored.path / "program.json").read_text())
    (experiment,) = listed["experiments"]
    del experiment["algorithm"]["entropy_coefficient"], listed["sha256"]
    (stored.path / "program.json").write_text(json.dumps(listed))
    (read,) = programs.read(tmp_path)
    assert read.runs == runs


GRID = ("alpha=0.1,1", "discriminator_updates=1,2")
SMALL = (
    *("--env", "point_mass", "--total-steps", "300", "--batch-steps", "100"),
    *("--num-envs", "4", "--minibatch-size", "50", "--seeds", "3", "--gamma", "0.99"),
)


def trained_for(seconds, num_members):
    """What is stored of how a program was trained, for so many seconds a member."""
    return {
        "env_steps": 300 * num_members,
        "compile_seconds": 1.0,
        "train_seconds": seconds * num_members,
        "device": "1 x cpu",
        "device_count": 1,
        "versions": {},
    }


def train(folder, shard=None, *arguments, grid=GRID):
    """Write the files of a trained sweep, with metrics that tell members apart."""
    options = run_options.parse(
        sweep.Options, [*SMALL, "--grid", *grid, *arguments], "x"
    )
    plan = sweep.make_plan(options)
    runs = plan.part(*shards.parse(shard or "1/1"))
    folder.mkdir(parents=True, exist_ok=True)
    run_options.write_config(options, folder, points=plan.points)
    for program in programs.group(runs):
        stored = program.below(programs_of(folder), plan.labels(program))
        with stored.opened():
            write_metrics(stored)
            stored.finish(trained_for(0.5, len(program.runs)))
    return plan


def write_metrics(stored):
    writer = metrics_files.MetricsWriter(stored.path / "metrics.csv", stored.labels)
    steps = np.array([100.0, 200.0, 300.0])
    value = np.array(
        [
            [
                10.0 * (20 * run.algorithm.agent.alpha)
                + 20 * run.algorithm.agent.discriminator_updates
                + run.seed
            ]
            for run in stored.runs
        ]
    )
    value = value + steps
    zero = np.zeros_like(value)
    writer.write(
        {
            "env_steps": zero + steps,
            "episode_return": np.where(value % 100 == 61, np.nan, value),
            "episode_length": zero + 7.0,
            "skipped_updates": np.where(value == 342.0, 1.0, 0.0),
        }
    )
    writer.close()


TABLES = ("results.csv", "curves.npz", "sweep.png", "hyperparameters.png")


@pytest.mark.parametrize("count", [1, 5, 12])
def test_tables_of_shards_are_those_of_the_whole_sweep(
    count, tmp_path, capsys, monkeypatch
):
    """Five shards of twelve members divide points and programs."""
    if count != 5:  # The pictures, most of the time, are rendered once.
        monkeypatch.setattr(Figure, "savefig", lambda _, path, **__: path.touch())
    whole = tmp_path / "whole"
    plan = train(whole)
    expected = tables.write(whole, tables.read(plan, plan.trained(whole)))
    assert expected["points"][1]["mean"] is None  # never ended
    assert [point["diverged_seeds"] for point in expected["points"]] == [1, 0, 0, 1]
    assert expected["env_steps_per_second"] == pytest.approx(600)
    folders = [tmp_path / f"{number}" for number in range(1, count + 1)]
    for number, folder in enumerate(folders, start=1):
        train(tmp_path / "shared", f"{number}/{count}")
        train(folder, f"{number}/{count}")
    assert merge.main([str(tmp_path / "shared")]) == 0
    assert "600 steps/s on 1 x cpu" in capsys.readouterr().out
    # From folders of their own, too; and merging again is nothing new.
    apart = tmp_path / "apart"
    for _ in range(2):
        assert merge.main([*map(str, folders), "--out", str(apart)]) == 0
    # The united sweep is one like any other.
    assert sweep.main(["--resume", "--out", str(apart)]) == 0
    for out in (tmp_path / "shared", apart):
        for name in TABLES:
            assert (out / name).read_bytes() == (whole / name).read_bytes(), name
        summary = json.loads((out / "summary.json").read_text())
        assert summary["points"] == expected["points"]
        saved = saved_states.find(saved_states.run_folder.read(out), 1)
        seeds = [x.seeds[i] for x, indices in saved for i in indices]
        assert sorted(seeds) == [0, 1, 2]


def refused(capsys, *arguments):
    """Return the one line with which a merge is refused."""
    assert merge.main([str(x) for x in arguments]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    return line


def test_different_sweeps_are_not_merged(tmp_path, capsys):
    first, second, out = tmp_path / "first", tmp_path / "second", tmp_path / "out"
    assert "folders is empty" in refused(capsys)
    assert "does not exist" in refused(capsys, out)
    train(first, "1/2")
    assert "6 of 12 runs are missing, the first of point" in refused(capsys, first)
    both = (first, second, "--out", out)
    for changes, message in (
        (("--gamma", "0.9"), "gamma was 0.99, is 0.9"),
        (("--total-steps", "400"), "total_steps was 300, is 400"),
        (("--reward-delay", "2"), "reward_delay was 1, is 2"),
    ):
        train(second, "2/2", *changes)
        assert message in refused(capsys, *both)
        shutil.rmtree(second)
    plan = train(second, "2/2")
    assert "several folders need --out" in refused(capsys, first, second)
    # Begun and killed; then cut short while it was copied.
    folder = plan.trained(second)[0].path
    training, metrics = folder / "training.json", folder / "metrics.csv"
    kept, rows = training.read_text(), metrics.read_bytes().splitlines(keepends=True)
    training.unlink()
    assert "runs are missing" in refused(capsys, *both)
    training.write_text(kept)
    for part in (rows[:-1], rows[:5], []):
        metrics.write_bytes(b"".join(part))
        assert "metrics.csv is damaged" in refused(capsys, *both)
    metrics.write_bytes(b"".join(rows))
    listed = folder / "program.json"
    kept = listed.read_text()
    content = json.loads(kept)
    del content["sha256"]
    content["labels"]["seed"].pop()
    for text in (
        *("{", '{"experiments": [], "runs": []}', kept.replace("0.99", "0.98")),
        *(json.dumps(content), json.dumps(content | {"labels": {}})),
    ):
        listed.write_text(text)
        assert "program.json is damaged" in refused(capsys, *both)
    listed.write_text(kept)
    # Never onto anything else.
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "results.csv").touch()
    assert "not empty" in refused(capsys, *both[:3], tmp_path / "thesis")
    (tmp_path / "run").mkdir()
    of_a_run = run_options.parse(run_options.Options, SMALL, "x")
    run_options.write_config(of_a_run, tmp_path / "run")
    assert "a run: it must be of a sweep" in refused(
        capsys, *both[:3], tmp_path / "run"
    )
    assert not out.exists()
    assert merge.main([str(x) for x in both]) == 0


def test_two_different_results_of_a_run_are_refused_and_two_equal_ones_are_one(
    tmp_path, capsys
):
    plan = train(tmp_path / "a")
    train(tmp_path / "b", "1/5")
    both = [str(tmp_path / "a"), str(tmp_path / "b"), "--out", str(tmp_path / "out")]
    assert merge.main(both) == 0
    shutil.rmtree(tmp_path / "out")
    metrics = plan.trained(tmp_path / "b")[0].path / "metrics.csv"
    metrics.write_text(metrics.read_text().replace(",7,", ",8,"))
    capsys.readouterr()
    assert "and another program have different results" in refused(capsys, *both)
    assert not (tmp_path / "out").exists()


def test_sweeps_with_different_experts_are_not_merged(tmp_path, capsys):
    """On each host the expert's file may be another one."""
    path, out = tmp_path / "expert.npz", tmp_path / "out"
    folders = [tmp_path / "1", tmp_path / "2"]
    for number, steps in ((1, 5), (2, 6)):
        np.savez(path, observation=np.ones((steps, 4)), action=np.ones((steps, 2)))
        more = ("--agent", "gail", "--expert", str(path))
        train(folders[number - 1], f"{number}/2", *more)
    line = refused(capsys, *folders, "--out", out)
    assert f"expert is '{path}', whose trajectories are not those" in line
    assert not out.exists()
    shutil.rmtree(folders[0])
    train(folders[0], "1/2", *more)
    assert merge.main([*map(str, folders), "--out", str(out)]) == 0


def swapped(rows):
    """Exchange the rows of two seeds."""
    return [rows[0], rows[2], rows[1], *rows[3:]]


def renamed(rows):
    """Change the seed of a row."""
    point, _, rest = rows[1].split(",", 2)
    return [rows[0], f"{point},7,{rest}", *rows[2:]]


def unlabelled(rows):
    return [rows[0].replace("seed", "sead"), *rows[1:]]


def longer(rows):
    return [f"{rows[0]},mine", *(f"{row},1" for row in rows[1:])]


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (swapped, "metrics.csv is damaged: its rows are not in order"),
        (renamed, "metrics.csv is damaged: its rows are not in order"),
        (unlabelled, "metrics.csv is damaged: it has no column seed"),
        (longer, "was trained with other metrics than point 0, seed 0: "),
    ],
)
def test_tables_of_other_members_or_metrics_are_not_merged(
    change, why, tmp_path, capsys
):
    train(tmp_path / "parts", "1/2")
    plan = train(tmp_path / "parts", "2/2")
    path = plan.trained(tmp_path / "parts")[-1].path / "metrics.csv"
    path.write_text("\n".join([*change(path.read_text().splitlines()), ""]))
    out = tmp_path / "out"
    line = refused(capsys, tmp_path / "parts", "--out", out)
    assert line.startswith("error: ") and why in line
    assert not out.exists()


@pytest.fixture
def jobs_to_train(monkeypatch):
    """The jobs that are trained in a test, where training is interrupted at once."""
    jobs_to_train = []

    def interrupted_at_once(options, env, jobs, **_):
        if jobs:
            jobs_to_train.extend(jobs)
            raise Interrupted(signal.SIGTERM)

    monkeypatch.setattr(assembly, "train", interrupted_at_once)
    return jobs_to_train


STOPPED = 128 + signal.SIGTERM


def test_a_sweep_grows_by_points_and_by_seeds(tmp_path, capsys, jobs_to_train):
    plan = train(tmp_path)
    again = ["--resume", "--out", str(tmp_path)]
    assert sweep.main(again) == 0
    rows = (tmp_path / "results.csv").read_text().splitlines()
    assert len(rows) == 1 + 12 and not jobs_to_train
    # Only what is missing is trained.
    more = [*again, "--grid", "alpha=0.1,0.5", "--seeds", "4"]
    assert sweep.main(more) == STOPPED
    members = [(p, s) for j in jobs_to_train for p, s in zip(*j.labels.values())]
    points = [*plan.points, {"alpha": 0.1}, {"alpha": 0.5}]
    # {"alpha": 0.1} has the sweep's own discriminator_updates, which is no point yet.
    assert sorted(members) == [
        *((point, 3) for point in range(4)),
        *((point, seed) for point in (4, 5) for seed in range(4)),
    ]
    grown = plan_of(points, range(4), plan.algorithm)
    for job in jobs_to_train:
        with job.opened():
            write_metrics(job)
            job.finish(trained_for(1.0, 1))
    # The folder keeps its own description until training has begun.
    assert len(grown.missing(grown.trained(tmp_path))) == 0
    assert sweep.main(more) == 0
    assert len((tmp_path / "results.csv").read_text().splitlines()) == 1 + 24
    assert sweep.main(again) == 0
    assert len((tmp_path / "results.csv").read_text().splitlines()) == 1 + 24
    capsys.readouterr()
    assert sweep.main([*again, "--seeds", "3"]) == 2
    assert "seeds was 4, is 3" in capsys.readouterr().err
    assert sweep.main([*again, "--gamma", "0.9"]) == 2
    assert "gamma was 0.99, is 0.9" in capsys.readouterr().err


def test_a_sweep_without_a_name_does_not_look_into_the_folder_it_starts_in(
    tmp_path, monkeypatch, capsys
):
    train(tmp_path)
    monkeypatch.chdir(tmp_path)
    planned = []

    def prepare(options, jobs):
        planned.extend(run for job in jobs for run in job.runs)
        raise InputError("enough")

    monkeypatch.setattr(assembly, "prepare", prepare)
    assert sweep.main([*SMALL, "--grid", *GRID]) == 2
    assert "enough" in capsys.readouterr().err and len(planned) == 12


def test_sweeps_of_other_points_and_seeds_become_one(tmp_path):
    folders = [tmp_path / name for name in ("a", "b", "c")]
    train(folders[0], grid=("alpha=0.1,1",))
    train(folders[1], grid=("alpha=0.5",))
    train(folders[2], None, "--first-seed", "3", grid=("alpha=0.5,0.1,1",))
    out = tmp_path / "out"
    assert merge.main([*map(str, folders), "--out", str(out)]) == 0
    rows = [x.split(",")[:3] for x in (out / "results.csv").read_text().splitlines()]
    assert rows[1:] == [
        [str(point), str(seed), alpha]
        for point, alpha in enumerate(("0.1", "1.0", "0.5"))
        for seed in range(6)
    ]


def test_a_shard_is_resumed_only_on_request(tmp_path, capsys, jobs_to_train):
    plan = train(tmp_path, "1/2")
    more = ["--env", "point_mass", "--grid", *GRID, "--out", str(tmp_path)]
    same = [*SMALL, *more, "--shard", "1/2"]
    assert sweep.main([*same, "--gamma", "0.9"]) == 2
    assert "gamma was 0.99, is 0.9" in capsys.readouterr().err
    # The sweep's own settings are used, and nothing is left to do.
    resumed = ["--resume", "--out", str(tmp_path), "--shard", "1/2"]
    for command in (same, resumed):
        assert sweep.main(command) == 0
        told = capsys.readouterr().out
        assert "shard 1/2 is done" in told and "6 of 12 runs" in told
    # An unfinished program is trained with the shard's members alone. The command is
    # the one that is printed when it is interrupted.
    (begun,) = plan.trained(tmp_path)
    (begun.path / "training.json").unlink()
    assert sweep.main(same) == 2
    assert f"training has begun in {begun.path}" in capsys.readouterr().err
    assert sweep.main(resumed) == STOPPED
    (job,) = jobs_to_train
    assert job == begun
    how = f"gasil_jax.sweep --shard 1/2 --resume --out {tmp_path}"
    assert how in capsys.readouterr().err
    jobs_to_train.clear()
    # With other settings than those of the first it is no part of the same sweep.
    begin = [*more, "--shard", "2/2", "--seeds", "3"]
    assert sweep.main(begin) == 2
    assert "num_envs was 4" in capsys.readouterr().err
    # A cluster that runs a job again may do so before the job has begun.
    begin += ["--out", str(tmp_path / "other"), "--resume"]
    assert sweep.main(begin) == STOPPED
    assert sum(len(job.runs) for job in jobs_to_train) == 6


def test_a_shard_keeps_out_of_other_folders(tmp_path, capsys, jobs_to_train):
    more = [*SMALL, "--grid", *GRID, "--shard", "1/2", "--out"]
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "text.tex").touch()
    assert sweep.main([*more, str(tmp_path / "thesis")]) == 2
    assert "is not empty" in capsys.readouterr().err
    (tmp_path / "run").mkdir()
    of_a_run = run_options.parse(run_options.Options, SMALL, "x")
    run_options.write_config(of_a_run, tmp_path / "run")
    assert sweep.main([*more, str(tmp_path / "run")]) == 2
    assert "a run: continue it with python -m gasil_jax.run" in capsys.readouterr().err
    assert not jobs_to_train


def test_two_processes_do_not_train_the_same_program(tmp_path, capsys):
    plan = train(tmp_path)
    begun = plan.trained(tmp_path)[0]
    (begun.path / "training.json").unlink()
    with begun.opened():
        assert sweep.main(["--resume", "--out", str(tmp_path)]) == 2
    assert f"{begun.path}, which process" in capsys.readouterr().err


def test_shards_need_no_file_of_points_once_one_has_begun(
    tmp_path, capsys, jobs_to_train
):
    path, out = tmp_path / "points.json", tmp_path / "out"
    path.write_text('[{"alpha": 0.1}, {"num_epochs": 3}]')
    more = [*SMALL, "--out", str(out), "--points-file"]
    members = lambda: jobs_to_train.pop().labels
    assert sweep.main([*more, str(path), "--shard", "1/2"]) == STOPPED
    assert members() == {"point": (0, 0, 0), "seed": (0, 1, 2)}
    path.unlink()
    assert sweep.main([*more, str(tmp_path / "other.json"), "--shard", "2/2"]) == 2
    assert "other.json, which can't be read" in capsys.readouterr().err
    assert sweep.main([*more, str(path), "--shard", "2/2"]) == STOPPED
    assert members() == {"point": (1, 1, 1), "seed": (0, 1, 2)}


def test_a_launcher_resumes_shards_only_on_request(tmp_path, capsys, monkeypatch):
    launched = []
    monkeypatch.setattr(
        launch, "run_on_ray", lambda program, jobs, devices: launched.append(jobs)
    )
    out = tmp_path / "out"
    train(out)
    more = [*SMALL, "--grid", *GRID, "--launcher", "ray", "--shards", "2"]
    assert sweep.main([*more, "--out", str(out)]) == 2
    assert "the run in it with --resume" in capsys.readouterr().err
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
    assert sweep.main([*more, "--out", str(tmp_path / "new")]) == 2
    assert "12 of 12 runs are missing" in capsys.readouterr().err
    assert all("--resume" in arguments for arguments in launched[-1].values())


def test_a_launcher_that_is_not_installed_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(InputError, match=r"gasil_jax\[ray\]"):
        launch.run_on_ray("x", {}, None)

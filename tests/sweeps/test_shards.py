"""Shards of a sweep hold each member once, and merge into the same tables."""

import json
import shutil
import signal
import sys
import textwrap

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import gasil_jax
from gasil_jax import merge, sweep
from gasil_jax.errors import InputError
from gasil_jax.host import metrics_files, run_folder, run_options
from gasil_jax.host.interruption import Interrupted
from gasil_jax.sweeps import assembly, launch, shards, tables, trained_programs


@settings(max_examples=200, deadline=None, derandomize=True)
@given(
    updates=st.lists(st.integers(1, 3), min_size=1, max_size=6),
    num_seeds=st.integers(1, 4),
    count=st.integers(1, 24),
)
def test_shards_hold_each_member_once(updates, num_seeds, count):
    points = [{"discriminator_updates": n, "alpha": 0.1} for n in updates]
    whole = shards.programs(gasil_jax.algorithm(), points, range(num_seeds))
    total = len(points) * num_seeds
    every = [shards.Shard(number, count) for number in range(1, count + 1)]
    if count > total:
        with pytest.raises(InputError, match=f"{total} members"):
            shards.cut_evenly(whole, every[0])
        return
    parts = [shards.cut_evenly(whole, shard) for shard in every]
    sizes = [sum(len(program.members) for program in part) for part in parts]
    assert max(sizes) - min(sizes) <= 1
    seen = [program for part in parts for program in part]
    members = [(p.number, p.algorithm, member) for p in seen for member in p.members]
    assert members == [(p.number, p.algorithm, m) for p in whole for m in p.members]
    # No more is compiled than cutting must cost.
    assert len(seen) <= len(whole) + count - 1


def test_points_that_differ_in_traced_numbers_alone_share_a_program():
    points = [
        {"discriminator_updates": 5, "alpha": 1.0},
        {"discriminator_updates": 20, "alpha": 0.1},
        {"discriminator_updates": 5, "gamma": 0.9},
        {"num_epochs": 3},
    ]
    algorithm = gasil_jax.algorithm(alpha=0.3)
    first, *others = shards.programs(algorithm, points, [7, 8])
    assert first.members == ((0, 7), (0, 8), (2, 7), (2, 8))
    numbers = [(x["alpha"], x["gamma"]) for x in first.hyperparameters]
    assert numbers == [(1.0, 0.99)] * 2 + [(0.3, 0.9)] * 2
    assert first.algorithm == algorithm.replace(discriminator_updates=5)
    assert [x.members for x in others] == [((1, 7), (1, 8)), ((3, 7), (3, 8))]
    assert [x.algorithm for x in others] == [
        algorithm.replace(discriminator_updates=20),
        algorithm.replace(num_epochs=3),
    ]
    (second,) = shards.cut_evenly([first], shards.Shard(2, 2))
    assert second.members == ((2, 7), (2, 8))
    assert second.hyperparameters == first.hyperparameters[2:]


GRID = ("alpha=0.1,1", "discriminator_updates=1,2")
SMALL = (
    *("--env", "point_mass", "--total-steps", "300", "--batch-steps", "100"),
    *("--num-envs", "4", "--minibatch-size", "50", "--seeds", "3", "--gamma", "0.99"),
)


def train(folder, shard=None, *arguments):
    """Write the files of a trained sweep, with metrics that tell members apart."""
    part = ("--shard", shard) if shard else ()
    options = run_options.parse(
        sweep.Options, [*SMALL, "--grid", *GRID, *arguments, *part], "x"
    )
    folder = folder if shard is None else shards.parse(shard).folder(folder)
    folder.mkdir(parents=True)
    points, programs = sweep.plan(options)
    if shard is not None:
        programs = shards.cut_evenly(programs, shards.parse(shard))
    run_options.write_config(options, folder, points=points)
    for program in programs:
        program_folder = program.folder(folder)
        program_folder.mkdir(parents=True)
        labels = dict(zip(trained_programs.LABELS, zip(*program.members)))
        writer = metrics_files.MetricsWriter(program_folder / "metrics.csv", labels)
        steps = np.array([100.0, 200.0, 300.0])
        value = np.array([[10.0 * i + seed] for i, seed in program.members]) + steps
        zero = np.zeros_like(value)
        writer.write(
            {
                "env_steps": zero + steps,
                "episode_return": np.where(value % 100 == 12, np.nan, value),
                "skipped_updates": np.where(value == 220.0, 1.0, 0.0),
            }
        )
        writer.close()
        trained_programs.write_training(
            folder,
            program,
            env_steps=300 * len(program.members),
            compile_seconds=1.0,
            train_seconds=0.5 * len(program.members),
            device="1 x cpu",
            device_count=1,
        )
    return trained_programs.TrainedPrograms(folder, programs), points


TABLES = ("results.csv", "curves.npz", "sweep.png", "hyperparameters.png")


@pytest.mark.parametrize("count", [1, 5, 12])
def test_merged_tables_are_those_of_the_whole_sweep(count, tmp_path, capsys):
    """Five shards of twelve members divide points and programs."""
    trained, points = train(tmp_path / "whole")
    results = tables.read(points, range(3), [trained])
    expected = tables.write(tmp_path / "whole", results)
    assert expected["points"][1]["mean"] is None  # never ended
    assert [point["diverged_seeds"] for point in expected["points"]] == [0, 0, 1, 0]
    assert expected["env_steps_per_second"] == pytest.approx(600)
    parts = tmp_path / "parts"
    for number in range(1, count + 1):
        train(parts, f"{number}/{count}")
    assert merge.main([str(parts)]) == 0
    assert "600 steps/s on 1 x cpu" in capsys.readouterr().out
    # From where they were copied to, too; and merging again is nothing new.
    apart = [str(path) for path in sorted((parts / "shards").iterdir())]
    for _ in range(2):
        assert merge.main([*apart, "--out", str(tmp_path / "apart")]) == 0
    # There is nothing to continue, and the tables must stay.
    assert sweep.main(["--resume", "--out", str(tmp_path / "apart")]) == 2
    assert "the tables of shards in other folders" in capsys.readouterr().err
    for out in (parts, tmp_path / "apart"):
        for name in TABLES:
            whole = (tmp_path / "whole" / name).read_bytes()
            assert (out / name).read_bytes() == whole, name
        summary = json.loads((out / "summary.json").read_text())
        assert summary["points"] == expected["points"]
        described = run_folder.read(out)
        assert described["shard"] is None and described["points"] == tuple(points)


def test_shards_of_different_sweeps_are_not_merged(tmp_path, capsys):
    def refused(*arguments):
        assert merge.main([str(x) for x in arguments]) == 2
        error = capsys.readouterr().err
        assert len(error.splitlines()) == 1
        return error

    out = tmp_path / "out"
    assert "folders is empty" in refused()
    assert "which holds no shards" in refused(out)
    first, _ = train(out, "1/3")
    train(out, "3/3")
    assert "missing: shards 2/3" in refused(out)
    train(out, "2/3", "--gamma", "0.9")
    second = out / "shards" / "2-of-3"
    assert "gamma was 0.99, is 0.9" in refused(out)
    shutil.rmtree(second)
    train(out, "2/3", "--total-steps", "400")
    assert "total_steps was" in refused(out)
    shutil.rmtree(second)
    trained, _ = train(out, "2/3")
    assert "several folders need --out" in refused(first.folder, second)
    assert "1/3 is given twice" in refused(out, copy(first.folder), "--out", tmp_path)
    # Begun and killed; then cut short while it was copied.
    program_folder = trained.programs[0].folder(second)
    training = program_folder / "training.json"
    kept = training.read_text()
    training.unlink()
    assert "not finished: shards 2/3" in refused(out)
    training.write_text(kept)
    metrics = program_folder / "metrics.csv"
    content = metrics.read_bytes()
    rows = content.splitlines(keepends=True)
    for part in (rows[:-1], rows[: 1 + len(trained.programs[0].members)], []):
        metrics.write_bytes(b"".join(part))
        assert "metrics.csv is damaged" in refused(out)
    metrics.write_bytes(content)
    # Never onto another sweep or anything else.
    whole = tmp_path / "whole"
    train(whole)
    assert "holds other files" in refused(out, "--out", whole)
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "results.csv").touch()
    assert "holds other files" in refused(out, "--out", tmp_path / "thesis")
    (tmp_path / "run").mkdir()
    of_a_run = run_options.parse(run_options.Options, SMALL, "x")
    run_options.write_config(of_a_run, tmp_path / "run")
    assert "holds other files" in refused(out, "--out", tmp_path / "run")
    assert not (out / "results.csv").exists()
    assert merge.main([str(out)]) == 0
    train(out, "1/2")
    assert "shards of 2 and of 3" in refused(out)


def test_shards_with_different_experts_are_not_merged(tmp_path, capsys):
    """On each host the expert's file may be another one."""
    path, out = tmp_path / "expert.npz", tmp_path / "out"
    for number, steps in ((1, 5), (2, 6)):
        np.savez(path, observation=np.ones((steps, 4)), action=np.ones((steps, 2)))
        train(out, f"{number}/2", "--agent", "gail", "--expert", str(path))
    assert merge.main([str(out)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"expert is '{path}', whose trajectories are not those" in line
    assert not (out / "results.csv").exists()
    shutil.rmtree(out / "shards" / "1-of-2")
    train(out, "1/2", "--agent", "gail", "--expert", str(path))
    assert merge.main([str(out)]) == 0


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
        (longer, "was trained with other metrics than point 0, seed 0: mine"),
    ],
)
def test_tables_of_other_members_or_metrics_are_not_merged(
    change, why, tmp_path, capsys
):
    train(tmp_path / "parts", "1/2")
    trained, _ = train(tmp_path / "parts", "2/2")
    path = trained.programs[0].folder(trained.folder) / "metrics.csv"
    path.write_text("\n".join([*change(path.read_text().splitlines()), ""]))
    out = tmp_path / "out"
    assert merge.main([str(tmp_path / "parts"), "--out", str(out)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: ") and line.endswith(why)
    assert not out.exists()


def test_tables_are_written_anew_when_all_shards_have_gone_on(tmp_path, capsys):
    for shard in ("1/2", "2/2"):
        train(tmp_path, shard)
    assert merge.main([str(tmp_path)]) == 0
    path = tmp_path / "config.json"
    merged = path.read_text()
    for earlier, status in (("200", 0), ("400", 2)):
        changed = merged.replace('"total_steps": 300', f'"total_steps": {earlier}')
        assert changed != merged
        path.write_text(changed)
        assert merge.main([str(tmp_path)]) == status
    assert "total_steps was 400, is 300" in capsys.readouterr().err


def copy(folder):
    return shutil.copytree(folder, folder.parent.parent.parent / "copy")


def test_whole_and_sharded_sweeps_keep_out_of_each_others_folders(tmp_path, capsys):
    train(tmp_path / "whole")
    train(tmp_path / "parts", "1/2")
    train(tmp_path / "parts", "2/2")
    assert merge.main([str(tmp_path / "parts")]) == 0
    more = ["--env", "point_mass", "--grid", *GRID, "--out"]
    assert sweep.main([*more, str(tmp_path / "whole"), "--shard", "1/2"]) == 2
    assert "not in shards" in capsys.readouterr().err
    assert sweep.main(["--resume", "--out", str(tmp_path / "parts")]) == 2
    assert "continue each of them with --shard and --resume" in capsys.readouterr().err
    for again in (["--shard", "1/3"], ["--launcher", "local", "--shards", "3"]):
        assert sweep.main([*more, str(tmp_path / "parts"), *again]) == 2
        assert "is cut into 2 shards" in capsys.readouterr().err


@pytest.fixture
def jobs_to_train(monkeypatch):
    """The jobs that are trained in a test, where training is interrupted at once."""
    jobs_to_train = []

    def interrupted_at_once(options, env, jobs, **_):
        jobs_to_train.extend(job for job in jobs if not job.finished)
        raise Interrupted(signal.SIGTERM)

    monkeypatch.setattr(assembly, "train", interrupted_at_once)
    return jobs_to_train


def test_a_shard_is_resumed_only_on_request(tmp_path, capsys, jobs_to_train):
    trained, _ = train(tmp_path, "1/2")
    folder = trained.folder
    more = ["--env", "point_mass", "--grid", *GRID, "--out", str(tmp_path)]
    same = [*more, "--shard", "1/2"]
    assert sweep.main(same) == 2
    error = capsys.readouterr().err
    assert f"{folder}, which is not empty: " in error and "with --resume" in error
    assert len(error.splitlines()) == 1
    assert sweep.main([*same, "--resume", "--gamma", "0.9"]) == 2
    assert "gamma was 0.99, is 0.9" in capsys.readouterr().err
    # The shard's own settings are used, and nothing is left to do.
    of_the_sweep = ["--resume", "--out", str(tmp_path), "--shard", "1/2"]
    resumed = ([*same, "--resume"], of_the_sweep, ["--resume", "--out", str(folder)])
    for command in resumed:
        assert sweep.main(command) == 0
        assert "shard 1/2 is done" in capsys.readouterr().out
    # An unfinished program is trained with the shard's members alone. The second
    # command is the one that the first one prints when it is interrupted.
    program = trained.programs[-1]
    (program.folder(folder) / "training.json").unlink()
    for command in resumed:
        assert sweep.main(command) == 128 + signal.SIGTERM
        job = jobs_to_train.pop()
        assert job.folder == program.folder(folder)
        assert job.program.members == program.members
        assert f"gasil_jax.sweep --resume --out {folder}" in capsys.readouterr().err
    assert not jobs_to_train
    # With other settings than those of the first it is no part of the same sweep.
    begin = [*more, "--shard", "2/2", "--resume", "--seeds", "3"]
    assert sweep.main(begin) == 2
    error = capsys.readouterr().err
    assert "2-of-2 is of another sweep than" in error and "num_envs was 4" in error
    # A cluster that runs a job again may do so before the job has begun.
    begin += ["--out", str(tmp_path / "other")]
    assert sweep.main(begin) == 128 + signal.SIGTERM
    assert sum(len(job.program.members) for job in jobs_to_train) == 6


def test_shards_need_no_file_of_points_once_one_has_begun(
    tmp_path, capsys, jobs_to_train, monkeypatch
):
    launched = []
    monkeypatch.setitem(launch.LAUNCHERS, "local", lambda *jobs: launched.append(jobs))
    path, out = tmp_path / "points.json", tmp_path / "out"
    path.write_text('[{"alpha": 0.1}, {"num_epochs": 3}]')
    more = [*SMALL, "--out", str(out), "--points-file"]
    assert sweep.main([*more, str(path), "--shard", "1/2"]) == 128 + signal.SIGTERM
    assert jobs_to_train.pop().program.members == ((0, 0), (0, 1), (0, 2))
    path.unlink()
    launcher = ["--launcher", "local", "--shards", "2", "--resume"]
    for part in (["--shard", "2/2"], launcher):
        assert sweep.main([*more, str(tmp_path / "other.json"), *part]) == 2
        assert "other.json, which can't be read" in capsys.readouterr().err
    assert sweep.main([*more, str(path), "--shard", "2/2", "--gamma", "0.9"]) == 2
    assert "is of another sweep" in capsys.readouterr().err
    assert not jobs_to_train
    assert sweep.main([*more, str(path), "--shard", "2/2"]) == 128 + signal.SIGTERM
    (job,) = jobs_to_train
    assert job.program.members == ((1, 0), (1, 1), (1, 2))
    assert job.program.algorithm.config.num_epochs == 3
    assert sweep.main([*more, str(path), *launcher]) == 2
    assert "not finished: shards 1/2, 2/2" in capsys.readouterr().err
    assert len(launched) == 1


def test_the_first_shard_has_no_expert_to_compare(tmp_path, monkeypatch, jobs_to_train):
    hashed = []
    original = run_folder.expert_hash

    def expert_hash(algorithm):
        hashed.append(algorithm)
        return original(algorithm)

    monkeypatch.setattr(run_folder, "expert_hash", expert_hash)
    more = [*SMALL, "--grid", *GRID, "--out", str(tmp_path), "--shard"]
    for part, count in (("1/2", 1), ("2/2", 3)):
        assert sweep.main([*more, part]) == 128 + signal.SIGTERM
        # Each is written to config.json.
        assert len(hashed) == count


def test_a_launcher_resumes_shards_only_on_request(tmp_path, capsys, monkeypatch):
    launched = []
    monkeypatch.setitem(
        launch.LAUNCHERS, "local", lambda program, jobs, devices: launched.append(jobs)
    )
    out = tmp_path / "out"
    for number in ("1/2", "2/2"):
        train(out, number)
    more = ["--env", "point_mass", "--grid", *GRID, "--launcher", "local"]
    more += ["--seeds", "3", "--shards", "2"]
    assert sweep.main([*more, "--out", str(out)]) == 2
    assert "continue them with --resume" in capsys.readouterr().err
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "text.tex").touch()
    for resume in ([], ["--resume"]):
        assert sweep.main([*more, *resume, "--out", str(tmp_path / "thesis")]) == 2
        error = capsys.readouterr().err
        assert "is not empty" in error and "--resume" not in error
    assert not launched
    assert sweep.main([*more, "--resume", "--out", str(out)]) == 0
    (jobs,) = launched
    assert list(jobs) == ["shard 1/2", "shard 2/2"]
    for name, arguments in jobs.items():
        assert arguments.count("--resume") == 1
        assert sweep.main(arguments) == 0
        assert f"{name} is done" in capsys.readouterr().out
    # A job continues when it is run again, even if the launch was the first.
    assert sweep.main([*more, "--out", str(tmp_path / "new")]) == 2
    assert "must hold shards" in capsys.readouterr().err
    assert all("--resume" in arguments for arguments in launched[-1].values())


@pytest.fixture
def program(tmp_path, monkeypatch):
    """A module that ends as its second argument says; its first one is a folder."""
    (tmp_path / "job.py").write_text(
        textwrap.dedent(
            """
            import os, pathlib, signal, sys, time
            folder, what = pathlib.Path(sys.argv[1]), sys.argv[2]
            tries = len(list(folder.iterdir()))
            (folder / f"{what}-{tries}").touch()
            if what == "killed" and tries < 2:
                os.kill(os.getpid(), signal.SIGKILL)
            if what == "waits":
                signal.signal(signal.SIGTERM, lambda *_: (folder / "signalled").touch())
                os.kill(os.getppid(), signal.SIGTERM)
                signal.pause()
            sys.exit(2 if what == "refused" else 0)
            """
        )
    )
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    return "job"


def test_a_launched_job_runs_again_after_its_process_died(program, tmp_path):
    folders = {}
    for name in ("killed", "refused", "fine"):
        folders[name] = tmp_path / name
        folders[name].mkdir()
    jobs = {name: [str(folder), name] for name, folder in folders.items()}
    with pytest.raises(ChildProcessError, match=r"^refused \(status 2\) failed"):
        launch.run_locally(program, jobs, None)
    ran = {name: len(list(folder.iterdir())) for name, folder in folders.items()}
    assert ran == {"killed": 3, "refused": 1, "fine": 1}
    # Nothing is left to continue.
    with pytest.raises(InputError, match=r"^refused \(status 2\): bad input"):
        launch.run_locally(program, {"refused": jobs["refused"]}, None)


def test_a_signal_reaches_the_job_and_ends_the_launch(program, tmp_path):
    folder = tmp_path / "waits"
    folder.mkdir()
    with pytest.raises(Interrupted) as interrupted:
        launch.run_locally(program, {"waits": [str(folder), "waits"]}, None)
    assert interrupted.value.signal == signal.SIGTERM
    assert (folder / "signalled").exists()


def test_a_launcher_that_is_not_installed_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(InputError, match=r"gasil_jax\[ray\]"):
        launch.check("ray")

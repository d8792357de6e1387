"""What a folder holds is continued, united with another one, and never guessed."""

import dataclasses
import json
import shutil

import jax
import numpy as np
import pytest
from small_training import FLAGS, SETTINGS
from test_checkpoints import assert_same, flip_a_bit
from test_resume import finish, program_of, start

import gasil_jax
from gasil_jax import evaluate, plot, run
from gasil_jax.errors import InputError
from gasil_jax.host import json_files, points, programs, results, saved
from gasil_jax.host.programs import Training
from gasil_jax.host.sweep import Sweep, read

PPO = gasil_jax.algorithm("ppo", **SETTINGS)
SMALL = (*FLAGS, "--agent", "ppo")


@pytest.fixture(scope="module")
def parent(tmp_path_factory):
    """The parent of `first`, of seeds 0 and 1, and `second`, of seeds 1 and 2."""
    parent = tmp_path_factory.mktemp("folders")
    for name, first in (("first", "0"), ("second", "1")):
        seeds = ("--seeds", "2", "--first-seed", first)
        assert run.main([*SMALL, *seeds, "--out", str(parent / name)]) == 0
    return parent


@pytest.fixture
def united(parent, tmp_path):
    """A folder to which the programs of another one were copied."""
    out = shutil.copytree(parent / "first", tmp_path / "out")
    shutil.copytree(
        parent / "second" / "programs", out / "programs", dirs_exist_ok=True
    )
    return out


def test_a_united_folder_misses_nothing(parent, united, tmp_path, capsys):
    """Whatever programs hold a run, it counts once."""
    assert run.main(["--resume", "--seeds", "3", "--out", str(united)]) == 0
    assert "compiling" not in capsys.readouterr().err
    assert len(list((united / "programs").iterdir())) == 2
    rows = [x.split(",") for x in (united / "results.csv").read_text().split()[1:]]
    assert [row[1] for row in rows] == ["0", "1", "2"]
    for name in ("first", "second"):
        for row in (parent / name / "results.csv").read_text().split()[1:]:
            assert row.split(",") in rows
    _, _, seeds, states = saved.load(united)
    assert seeds == [0, 1, 2]
    both = [saved.load(parent / name)[-1] for name in ("first", "second")]
    take = lambda x, y: jax.numpy.concatenate([x, y[1:]])
    assert_same(states, jax.tree.map(take, *both))
    with np.load(united / "policy.npz") as file:
        assert file["seeds"].tolist() == seeds
    capsys.readouterr()
    assert evaluate.main([str(united)]) == 0
    assert len(capsys.readouterr().out.splitlines()) == 5
    assert sum(len(x.indices) for x in saved.find(united, None)[2]) == 3


def test_two_results_of_one_run_are_refused(united, capsys):
    path = next(
        x
        for x in united.glob("programs/*/metrics.csv")
        if ",2," in x.read_text()  # The seeds 1 and 2.
    )
    header, first, rest = path.read_text().split("\n", 2)
    cells = first.strip().split(",")
    cells[3] = str(float(cells[3] or 0.0) + 1.0)
    path.write_text("\n".join([header, ",".join(cells), rest]))
    assert run.main(["--resume", "--seeds", "3", "--out", str(united)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "have different results for seed 1 of" in line


def test_a_program_of_which_some_runs_are_asked_for(parent, tmp_path, capsys):
    """Where it is finished they are there; otherwise they are trained anew."""
    out = tmp_path / "out"
    shutil.copytree(parent / "second" / "programs", out / "programs")
    short = read(parent / "second")
    one = dataclasses.replace(short, seeds=[2])
    one.write(out)
    assert one.unfinished(out) == []
    assert run.main(["--resume", "--out", str(out)]) == 0
    assert "compiling" not in capsys.readouterr().err
    rows = (parent / "second" / "results.csv").read_text().split()
    assert (out / "results.csv").read_text().split() == [rows[0], rows[2]]
    with pytest.raises(InputError, match="this point was trained with others"):
        saved.load(out, "best")
    # The other member's training is unknown here, so it can't go on.
    longer = dataclasses.replace(one, algorithm=one.algorithm.replace(total_steps=384))
    (program,) = longer.unfinished(out)
    assert program.seeds == (2,) and not program.path.exists()
    assert "is not continued" in capsys.readouterr().err
    # Programs of more steps are other runs.
    less = dataclasses.replace(short, algorithm=one.algorithm.replace(total_steps=128))
    assert less.stored(out) == [] and len(less.unfinished(out)) == 1


def test_a_damaged_best_checkpoint_is_refused(parent, tmp_path, capsys):
    out = shutil.copytree(parent / "first", tmp_path / "out")
    (folder,) = (program_of(out) / "checkpoints").iterdir()
    shutil.copytree(folder, folder.with_name("00000001"))
    flip_a_bit(folder)
    manifest = folder.with_name("00000001") / "manifest.json"
    content = json.loads(manifest.read_text())
    content["record"]["score"] -= 1.0
    manifest.write_text(json.dumps(content))
    for damage in (lambda: None, lambda: (folder / "manifest.json").unlink()):
        damage()
        assert evaluate.main([str(out), "--checkpoint", "best"]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith("error: ") and "00000002 is damaged" in line


def test_two_processes_resume_one_folder_at_once(tmp_path):
    """One trains, and the other one is told so, or finds everything done."""
    longer = (*SMALL, "--total-steps", str(200 * 128))
    out, alone = tmp_path / "out", tmp_path / "alone"
    children = [start(out, *longer, "--resume") for _ in range(2)]
    assert run.main([*longer, "--out", str(alone)]) == 0
    ended = [finish(child) for child in children]
    statuses = sorted(status for status, _, _ in ended)
    assert statuses in ([0, 0], [0, 2]), ended
    for status, _, err in ended:
        last = err.splitlines()[-1]
        assert status == 0 or "is writing to: name another folder or wait" in last
    for name in ("results.csv", "policy.npz"):
        assert (out / name).read_bytes() == (alone / name).read_bytes()


def test_a_grid_that_lacks_an_axis_has_the_sweeps_own_value(tmp_path):
    first = Sweep("point_mass", PPO, [0, 1], points=[{"gamma": 0.9}, {"gamma": 0.8}])
    first.write(tmp_path)
    second = [{"gae_lambda": 0.5}, {"gamma": 0.9}, {"gamma": PPO.config.gamma}]
    other = points.completed(second, PPO)
    own = {"gamma": PPO.config.gamma, "gae_lambda": PPO.config.gae_lambda}
    assert other == tuple(own | x for x in second)
    asked = Sweep("point_mass", PPO, [0, 1, 2], points=other)
    grown = asked.continued_from(tmp_path)
    expected = [{"gamma": 0.9}, {"gamma": 0.8}, second[0], {}]
    assert [*grown.points] == [own | x for x in expected]
    # Equal runs are one: the program has each of them once.
    (program,) = grown.unfinished(tmp_path)
    assert len(program.runs) == 12 == len(set(program.runs))
    whole = PPO.replace(gamma=1)
    same = Sweep("point_mass", whole, [0], points=[{"gamma": 1}, {"gamma": 1.0}])
    assert len(points.completed(same.points, whole)) == 1
    (program,) = same.unfinished(tmp_path)
    assert len(program.runs) == 1


def test_labels_that_contradict_the_runs_are_refused(parent, tmp_path, capsys):
    out = shutil.copytree(parent / "first", tmp_path / "out")
    path = program_of(out) / "program.json"
    content = json.loads(path.read_text())
    content["labels"]["seed"] = [1, 0]
    path.write_text(json.dumps(content))
    for command, *words in ((plot, str(out)), (run, "--resume", f"--out={out}")):
        assert command.main([*words]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert "program.json is damaged: its labels are not those of its runs" in line


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"iterations": "two"}, "iterations is 'two': it must be a whole number"),
        ({"iterations": True}, "iterations is True: it must be a whole number"),
        ({"train_seconds": None}, "train_seconds is None: it must be a finite number"),
        ({"evaluation_seconds": []}, r"evaluation_seconds is \[\]: it must be a fin"),
        ({"versions": {"jax": 3}}, "versions.jax is 3: it must be a string or null"),
    ],
)
def test_a_description_has_its_types(changes, why, parent, tmp_path):
    path = program_of(parent / "first") / "training.json"
    content = json_files.read(path, Training)
    assert content["iterations"] == 2
    (tmp_path / "x.json").write_text(json.dumps(content | changes))
    with pytest.raises(InputError, match=rf"x\.json is damaged: {why}"):
        json_files.read(tmp_path / "x.json", Training)
    del content["device"]
    (tmp_path / "x.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match="device is missing"):
        json_files.read(tmp_path / "x.json", Training)


def test_the_first_run_that_is_missing_is_named(parent):
    stored = read(parent / "first")
    more = dataclasses.replace(stored, seeds=[0, 1, 2])
    with pytest.raises(InputError, match="1 of 3 runs are missing, the first of point"):
        results.read(more, more.trained(parent / "first"))


def test_a_sweeps_points_are_those_of_its_programs():
    every = [{"num_epochs": x, "gamma": y} for x in (1, 2) for y in (0.9, 0.99)]
    asked = Sweep("point_mass", PPO, [0, 1], points=every)
    grouped = programs.group(asked.runs.values())
    assert [len(x.runs) for x in grouped] == [4, 4]
    assert [x.algorithm.config.num_epochs for x in grouped] == [1, 2]

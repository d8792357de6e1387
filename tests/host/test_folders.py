"""What a folder holds is continued, united with another one, and never guessed."""

import dataclasses
import shutil

import jax
import numpy as np
import pytest
from small_training import FLAGS, SETTINGS
from test_checkpoints import assert_same

import gasil_jax
from gasil_jax import evaluate, run
from gasil_jax.errors import InputError
from gasil_jax.host import saved
from gasil_jax.host.sweep import read

PPO = gasil_jax.algorithm("ppo", **SETTINGS)
SMALL = (*FLAGS, "--agent", "ppo")
# Pictures are drawn, and not written, which takes long.
pytestmark = pytest.mark.usefixtures("figures")


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

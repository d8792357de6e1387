"""Folders of any name, disks that lack something, and what happens when one is full."""

import errno
import fcntl
import os
import re
import resource
import shutil
from unittest import mock

import jax
import numpy as np
import pytest
from small_training import FLAGS, SETTINGS
from test_resume import program_of

import gasil_jax
from gasil_jax import run
from gasil_jax.host import checkpoint, folders, output_file, saved, tables

#: What means something to a shell, to patterns, to URLs or to options, and a byte that
#: is no text in any encoding.
NAME = "--x sweep[lr=1e-3]a*?{b}line\nline$#%20 é " + os.fsdecode(b"\xff")
PPO = gasil_jax.algorithm("ppo", **SETTINGS)
SMALL = (*FLAGS, "--agent", "ppo", "--preset", "paper", "--no-normalize-rewards")
# Pictures are drawn, and not written, which takes long.
pytestmark = pytest.mark.usefixtures("figures")


@pytest.fixture(scope="module")
def env():
    return gasil_jax.make_env("point_mass")


def test_a_disk_without_locks_and_flushes_keeps_everything_and_is_told(
    tmp_path, monkeypatch, capsys
):
    for function, number in (
        ((fcntl, "flock"), errno.ENOLCK),
        ((os, "fsync"), errno.EINVAL),
    ):
        lacking = mock.Mock(side_effect=OSError(number, os.strerror(number)))
        monkeypatch.setattr(*function, lacking)
    out = tmp_path / "out"
    assert run.main([*SMALL, "--out", str(out)]) == 0
    told = f"{out} can't be locked (No locks available): make"
    assert capsys.readouterr().err.count(told) == 1
    states = saved.load(out)[-1]
    np.testing.assert_array_equal(states.iteration, [PPO.config.num_iterations])
    assert (out / "policy.npz").exists() and (out / "summary.json").exists()
    # It is told once.
    with folders.lock(out):
        assert capsys.readouterr().err == ""


def test_rows_that_could_not_be_written_are_not_written_later(tmp_path):
    path = tmp_path / "metrics.csv"
    writer = tables.TableWriter(path, {"seed": [0]}, columns=("env_steps",))
    full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    writer._file.flush = mock.Mock(side_effect=full)
    with pytest.raises(output_file.WriteError, match="left on device: make room"):
        writer.write({"env_steps": np.ones((1, 1))})
    # Python would write them once there is room.
    assert writer._file.closed


def failing(monkeypatch, fails):
    """Make `checkpoint.save` fail for the states for which `fails` returns true."""
    save = checkpoint.save

    def maybe(folder, state):
        if fails(state):
            raise OSError(errno.ENOSYS, os.strerror(errno.ENOSYS))
        save(folder, state)

    monkeypatch.setattr(checkpoint, "save", maybe)


def test_checkpoints_that_cannot_be_written_are_told_before_training(
    tmp_path, monkeypatch, capsys
):
    failing(monkeypatch, lambda state: True)
    out = tmp_path / "out"
    assert run.main([*SMALL, "--out", str(out)]) == 1
    told, root = capsys.readouterr().err, program_of(out) / "checkpoints"
    assert "compiling" not in told
    last = told.splitlines()[-1]
    assert last.startswith(f"error: {root}/") and "Function not implemented" in last
    assert list(root.iterdir()) == []
    # The folder is as good as before.
    monkeypatch.undo()
    assert run.main(["--resume", "--out", str(out)]) == 0


def test_the_policies_are_written_even_if_the_last_checkpoint_is_not(
    env, tmp_path, monkeypatch, capsys
):
    failing(monkeypatch, lambda state: len(jax.tree.leaves(state)) > 1)
    out = tmp_path / "out"
    arguments = [*SMALL, "--stagger-episodes", "--out", str(out)]
    assert run.main(arguments) == 1
    told = capsys.readouterr().err.splitlines()[-1]
    assert told == (
        f"error: {program_of(out)}/checkpoints can't be written: Function not "
        f"implemented; continue with: python -m gasil_jax.run --resume --out {out}"
    )
    assert (out / "summary.json").exists()
    action = gasil_jax.load_policy(out)(np.zeros(env.observation_size))

    monkeypatch.undo()
    assert run.main(["--resume", "--out", str(out)]) == 0
    same = gasil_jax.load_policy(out)(np.zeros(env.observation_size))
    np.testing.assert_array_equal(action, same)


def killed_while_writing(path):
    """Leave what a process that is killed while it writes a file leaves."""
    path.parent.mkdir(exist_ok=True)
    with output_file.atomic(path) as partial:
        partial.write_text("{")
    path.rename(partial)


def test_a_kill_during_the_first_description_does_not_spoil_the_folder(tmp_path):
    """Which may have any name."""
    out = tmp_path / NAME
    killed_while_writing(out / "config.json")
    assert run.main([*SMALL, "--resume", f"--out={out}"]) == 0
    # A program without a description counts as none.
    description = program_of(out) / "program.json"
    description.unlink()
    killed_while_writing(description)
    assert run.main(["--resume", f"--out={out}"]) == 0
    assert description.exists() and saved.load(out)[2] == [0]


@pytest.mark.parametrize(
    ("name", "replaced"),
    [("", True), ("metrics.csv", False)],
)
def test_what_is_gone_is_told_at_the_next_write(name, replaced, env, tmp_path):
    out, seen = tmp_path / "out", []

    def callback(progress):
        seen.append(program_of(out) / name)
        if len(seen) == 1:
            seen[0].rename(tmp_path / "moved")
            if replaced:
                copy = shutil.copy if name else shutil.copytree
                copy(tmp_path / "moved", seen[0])

    given = {"folder": out, "evaluate_every": 128, "evaluate_episodes": 1}
    with pytest.raises(output_file.WriteError) as told:
        gasil_jax.fit(env, PPO, **given, callback=callback)
    path = seen[0] if name else seen[0] / "metrics.csv"
    assert str(told.value) == f"{path} was deleted or replaced during training"
    assert len(seen) == 1


def test_a_full_disk_is_one_line_that_says_how_to_continue(
    tmp_path, monkeypatch, capsys
):
    out, write = tmp_path / "out", checkpoint.write
    table = lambda: program_of(out) / "metrics.csv"
    _, hard = limits = resource.getrlimit(resource.RLIMIT_FSIZE)

    def full(folder, iteration, *arguments):
        write(folder, iteration, *arguments)
        # No file may grow beyond this: writing fails as on a full disk.
        if iteration > 0:
            size = table().stat().st_size + 1
            resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))

    monkeypatch.setattr(checkpoint, "write", full)
    try:
        assert run.main([*SMALL, "--checkpoint-every", "128", "--out", str(out)]) == 1
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    told = capsys.readouterr().err
    loud = r"^(?:error: |Traceback|\w*Error\b|\w*Warning\b|WARN|ERROR).*$"
    (error,) = re.findall(loud, told, re.MULTILINE)
    assert error == told.splitlines()[-1]
    assert error == (
        f"error: {table()} can't be written: File too large; continue with: "
        f"python -m gasil_jax.run --resume --out {out}"
    )
    newest, errors = checkpoint.latest(program_of(out) / "checkpoints")
    assert newest.iteration == 1 and errors == []

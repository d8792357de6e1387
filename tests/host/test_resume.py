"""A run that is stopped early loses nothing, and continues bit for bit."""

import itertools
import json
import os
import pathlib
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
from typing import NamedTuple

import jax
import numpy as np
import pytest
import test_members
from refusals import refused
from small_training import FLAGS
from test_checkpoints import assert_same

from gasil_jax import run
from gasil_jax.cli import reporting
from gasil_jax.errors import InputError
from gasil_jax.host import checkpoint, folders
from gasil_jax.host.members import Members

ITERATIONS = 160
# Of the states with a buffer PPO+BC's compiles soonest; other agents': below.
SMALL = (
    *(*FLAGS, "--agent", "ppo+bc", "--seeds", "3", "--devices", "2"),
    *("--total-steps", str(ITERATIONS * 128), "--buffer-steps", "300"),
    *("--reward-delay", "7", "--obs-noise", "0.1"),
)
OFTEN = ("--checkpoint-every", str(20 * 128))
# Pictures are drawn, and not written, which takes long.
pytestmark = pytest.mark.usefixtures("figures")


def start(out, *arguments, cache):
    """Start a run with a user's own cache of compiled programs."""
    mine = os.environ | {"XDG_CACHE_HOME": str(cache)}
    for of_tests in ("JAX_COMPILATION_CACHE_DIR", "TF_CPP_MIN_LOG_LEVEL"):
        del mine[of_tests]
    command = [sys.executable, "-m", "gasil_jax.run", "--out", str(out), *arguments]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.Popen(command, env=mine, text=True, **pipes)


def wait_for(condition, *children, seconds=120):
    """Poll until the condition holds; a child must be alive till then."""
    deadline = time.monotonic() + seconds
    while not condition():
        ended = [child.poll() is not None for child in children]
        assert not all(ended), [child.communicate() for child in children]
        assert time.monotonic() < deadline
        time.sleep(0.005)


def finish(child, seconds=200):
    out, err = child.communicate(timeout=seconds)
    return child.returncode, out, err


def program_of(out):
    """Return the folder of the only program of a run; it may not be made yet."""
    return next((out / "programs").glob("*"), out / "programs" / "none")


def checkpoints(out):
    root = program_of(out) / "checkpoints"
    return sorted(path.name for path in root.glob("*[0-9]"))


def rows(out):
    path = program_of(out) / "metrics.csv"
    return path.read_text().count("\n") if path.exists() else 0


def metrics(out):
    return (program_of(out) / "metrics.csv").read_bytes()


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


class Undisturbed(NamedTuple):
    """A run without checkpoints on the way, which two processes began at once."""

    folder: pathlib.Path
    #: Memory in MB of the process that trained, as it went on.
    memory: list[float]
    #: Status and last line of the other process.
    other: tuple[int, str]


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory, cache):
    out, memory = tmp_path_factory.mktemp("whole") / "out", []
    both = [start(out, *SMALL, "--resume", cache=cache) for _ in range(2)]
    for iterations in (40, 80, 120, 150):
        wait_for(lambda: rows(out) > 3 * iterations, *both)  # noqa: B023
        lock = (program_of(out) / ".lock").read_text()
        pid = int(re.match(r"process (\d+)", lock).group(1))
        pages = int(pathlib.Path(f"/proc/{pid}/statm").read_text().split()[1])
        memory.append(pages * resource.getpagesize() / 1e6)
    child, other = sorted(both, key=lambda child: child.pid != pid)
    status, _, err = finish(child)
    assert status == 0, err
    status, _, err = finish(other)
    return Undisturbed(out, memory, (status, err.splitlines()[-1]))


@pytest.fixture(scope="module")
def whole(undisturbed):
    """The folder of the undisturbed run."""
    return undisturbed.folder


def test_iterations_take_no_more_memory(undisturbed):
    first, *later = undisturbed.memory
    assert max(later) - first < 10.0, undisturbed.memory


def test_of_two_processes_that_begin_at_once_one_trains(undisturbed):
    """The other one is told so, or finds everything done."""
    status, last = undisturbed.other
    assert status in (0, 2)
    assert status == 0 or "is writing to: name another folder or wait" in last


def interrupt_at_call(count, number, monkeypatch):
    """Send this process a signal when it trains its chunk number `count`."""
    train, calls = Members.train, itertools.count(1)

    def interrupted(self, *arguments):
        if next(calls) == count:
            os.kill(os.getpid(), number)
        return train(self, *arguments)

    monkeypatch.setattr(Members, "train", interrupted)


def test_killed_again_and_again_it_ends_as_if_undisturbed(
    whole, cache, tmp_path, monkeypatch, capsys
):
    out = tmp_path / "out"
    compiled = {x.name: x.stat().st_mtime_ns for x in cache.rglob("*-cache")}
    assert compiled

    # After a checkpoint, with rows in metrics.csv that it has not seen.
    child = start(out, *SMALL, *OFTEN, cache=cache)
    new = lambda: checkpoints(out)
    wait_for(lambda: new() and rows(out) > 1 + 3 * (int(max(new())) + 5), child)
    child.send_signal(signal.SIGSTOP)
    # While it runs, another process can't train the same program.
    assert run.main(["--resume", "--out", str(out)]) == 2
    assert f"process {child.pid}" in capsys.readouterr().err
    child.kill()
    _, _, err = finish(child)
    with folders.lock(program_of(out)):
        pass
    # It loaded what the undisturbed run had compiled, and XLA told nothing of it.
    again = {x.name: x.stat().st_mtime_ns for x in cache.rglob("*-cache")}
    assert again == compiled and "Loading" not in err

    # From here on in this process: programs and folders are the same. SIGTERM and
    # Ctrl-C save and say how to continue.
    resumed = ["--resume", "--out", str(out), *OFTEN]
    # Version control may have changed how lines end.
    table = program_of(out) / "metrics.csv"
    table.write_text(table.read_text())
    for number in (signal.SIGTERM, signal.SIGINT):
        with monkeypatch.context() as patch:
            interrupt_at_call(2, number, patch)
            assert run.main(resumed) == 128 + number
        err = capsys.readouterr().err
        assert "all that was done is saved" in err
        command = re.search(r"python -m gasil_jax.run --resume --out (\S+)", err)
        assert command.group(1) == str(out)
        done = int(max(checkpoints(out)))
        assert done < ITERATIONS and rows(out) == 1 + 3 * done
    assert run.main(resumed) == 0
    assert metrics(out).splitlines() == metrics(whole).splitlines()
    # The newest two and the best.
    assert len(checkpoints(out)) in (2, 3)
    assert {max(checkpoints(x)) for x in (whole, out)} == {f"{ITERATIONS:08d}"}
    for name in ("results.csv", "policy.npz"):
        assert (out / name).read_bytes() == (whole / name).read_bytes()


@pytest.fixture
def copy(whole, tmp_path):
    """A copy of the undisturbed run's folder."""
    return pathlib.Path(shutil.copytree(whole, tmp_path / "copy"))


def test_ctrl_c_before_training_is_one_line(capsys):
    def work():
        raise KeyboardInterrupt

    assert reporting.reports_errors(work)() == 130
    assert capsys.readouterr().err == "interrupted\n"


def test_a_new_folder_has_a_name_of_its_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    made = [folders.create_new("hopper").name for _ in range(3)]
    assert made == ["hopper", "hopper-2", "hopper-3"]
    # A disk that is not mounted is told.
    (tmp_path / "runs").rename(tmp_path / "other")
    (tmp_path / "runs").symlink_to(tmp_path / "unmounted")
    with pytest.raises(InputError, match="out is runs"):
        folders.create_new("hopper")


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda text: text[: len(text) // 2], "damaged: it lacks iterations"),
        (lambda text: text.replace(b",", b"", 9), "metrics.csv is damaged: row 1 has"),
        (lambda text: text.replace(b",0.", b",z."), "damaged: could not convert"),
    ],
)
def test_a_damaged_table_is_told_in_a_line(edit, message, copy, capsys):
    path = program_of(copy) / "metrics.csv"
    path.write_bytes(edit(path.read_bytes()))
    assert message in refused(capsys, run, "--resume", "--out", copy)
    path.unlink()
    told = refused(capsys, run, "--resume", "--out", copy)
    assert "metrics.csv is damaged: it is missing" in told


def test_rows_that_training_needs_to_continue_are_missed(copy, capsys):
    """It is told before anything is trained; what is left of the table is kept."""
    path = program_of(copy) / "metrics.csv"
    kept = path.read_text().splitlines(keepends=True)[:-1]
    path.write_text("".join(kept))
    more = ("--total-steps", (ITERATIONS + 5) * 128)
    told = refused(capsys, run, "--resume", "--out", copy, *more)
    assert "lacks rows that were in it at the last" in told
    assert path.read_text() == "".join(kept)


def test_a_run_that_was_killed_before_it_said_so_has_no_speed(whole, copy, capsys):
    (program_of(copy) / "training.json").unlink()
    assert run.main(["--resume", "--out", str(copy)]) == 0
    assert "steps/s" not in capsys.readouterr().out
    summaries = [json.loads((x / "summary.json").read_text()) for x in (copy, whole)]
    assert summaries[0]["env_steps_per_second"] is None
    assert summaries[0]["points"] == summaries[1]["points"]


def test_results_without_checkpoints_are_not_replaced(copy, capsys):
    root = program_of(copy) / "checkpoints"
    before = {x: x.read_bytes() for x in copy.rglob("*.csv")}
    arguments = ["--resume", "--out", copy, "--total-steps", (ITERATIONS + 5) * 128]
    for name in checkpoints(copy):
        (root / name / "manifest.json").unlink()
    damaged = checkpoints(copy)
    for _ in range(2):
        assert "no undamaged checkpoint to con" in refused(capsys, run, *arguments)
        assert checkpoints(copy) in (damaged, [])
        shutil.rmtree(root, ignore_errors=True)
    assert all(path.read_bytes() == content for path, content in before.items())


def test_training_without_a_checkpoint_begins_anew(whole, copy, capsys):
    shutil.rmtree(program_of(copy) / "checkpoints")
    (program_of(copy) / "training.json").unlink()
    assert run.main(["--resume", "--out", str(copy)]) == 0
    told = capsys.readouterr().err
    assert "has no checkpoint: training starts from the beginning" in told
    assert metrics(copy) == metrics(whole)


def test_a_run_continues_from_the_checkpoint_before_a_damaged_one(
    whole, tmp_path, capsys
):
    out = tmp_path / "out"
    twice = ("--checkpoint-every", str(ITERATIONS // 2 * 128))
    assert run.main([*SMALL, *twice, "--out", str(out)]) == 0
    *_, last = checkpoints(out)
    assert len(checkpoints(out)) == 2
    root = program_of(out) / "checkpoints"
    (root / last / "manifest.json").write_text("3")
    # As if it had been killed just before the end.
    (program_of(out) / "training.json").unlink()
    assert run.main(["--resume", "--out", str(out)]) == 0
    told = capsys.readouterr().err
    assert f"{last} is damaged" in told and f"starts from {ITERATIONS // 2:08d}" in told
    assert metrics(out) == metrics(whole)
    assert checkpoint.latest(root)[0].folder.name == last
    assert (root / f"{last}.damaged").is_dir()


@pytest.mark.xdist_group("members")
def test_an_agent_continues_bit_for_bit(tmp_path):
    members, first, advance = test_members.compiled()
    states, _ = members.train(advance, members.to_devices(first), 0, 1)
    states, _ = members.train(advance, states, 1, 1)
    record = checkpoint.Record(metrics_rows=0, evaluations_rows=0, score=None)
    checkpoint.write(tmp_path, 2, members.trim(states), record)
    newest, _ = checkpoint.latest(tmp_path)
    restored = newest.restore(jax.eval_shape(lambda: first))
    (after, metrics), (again, same) = (
        members.train(advance, before, 2, 1)
        for before in (states, members.to_devices(restored))
    )
    assert_same(members.trim(again), members.trim(after))
    jax.tree.map(np.testing.assert_array_equal, same, metrics)
    # It has trained all the while, with delay and noise and without a NaN.
    assert metrics["skipped_updates"].sum() == 0
    assert np.isfinite(metrics["policy_loss"]).all()
    assert (metrics["good_steps"] == 100).all()

"""A run that is stopped early loses nothing, and continues bit for bit."""

import errno
import fcntl
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
from unittest import mock

import jax
import numpy as np
import pytest
import test_members
from small_training import FLAGS

from gasil_jax import run
from gasil_jax.errors import InputError
from gasil_jax.host import checkpoint, command_line, devices, run_folder, run_options
from gasil_jax.host.environments import Settings
from gasil_jax.host.members import Members

ITERATIONS = 400
# Of the states with a buffer PPO+BC's compiles soonest; other agents': below.
SMALL = (
    *(*FLAGS, "--agent", "ppo+bc", "--seeds", "3", "--devices", "2"),
    *("--total-steps", str(ITERATIONS * 128), "--buffer-steps", "300"),
    *("--reward-delay", "7", "--obs-noise", "0.1"),
)
OFTEN = ("--checkpoint-every", str(20 * 128))


def start(out, *arguments, cache=None):
    """Start a run, which may have a user's own cache of compiled programs."""
    mine = dict(os.environ)
    if cache is not None:
        for tests_own in ("JAX_COMPILATION_CACHE_DIR", "TF_CPP_MIN_LOG_LEVEL"):
            mine.pop(tests_own)
        mine["XDG_CACHE_HOME"] = str(cache)
    return subprocess.Popen(
        [sys.executable, "-m", "gasil_jax.run", "--out", str(out), *arguments],
        env=mine,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def wait_for(condition, child, seconds=120):
    """Poll until the condition holds; the child must be alive till then."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert child.poll() is None, child.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.005)


def finish(child, seconds=200):
    out, err = child.communicate(timeout=seconds)
    return child.returncode, out, err


def checkpoints(out):
    return sorted(p.name for p in (out / "checkpoints").glob("*[0-9]"))


def rows(out):
    path = out / "metrics.csv"
    return path.read_text().count("\n") if path.exists() else 0


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="module")
def whole_and_memory(tmp_path_factory, cache):
    """An undisturbed run without checkpoints on the way, and its memory in MB.

    The memory is that of the process after 80, 200, 300 and 390 iterations.
    """
    out = tmp_path_factory.mktemp("whole") / "out"
    child = start(out, *SMALL, cache=cache)
    statistics = pathlib.Path(f"/proc/{child.pid}/statm")
    memory = []
    for iterations in (80, 200, 300, 390):
        wait_for(lambda: rows(out) > 3 * iterations, child)  # noqa: B023
        pages = int(statistics.read_text().split()[1])
        memory.append(pages * resource.getpagesize() / 1e6)
    status, _, err = finish(child)
    assert status == 0, err
    return out, memory


@pytest.fixture(scope="module")
def whole(whole_and_memory):
    """The folder of the undisturbed run."""
    return whole_and_memory[0]


def test_iterations_take_no_more_memory(whole_and_memory):
    _, (first, *later) = whole_and_memory
    print("MB:", first, *later)
    assert max(later) - first < 10.0


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
    # While it runs, its folder is locked.
    assert run.main(["--resume", "--out", str(out)]) == 2
    assert f"process {child.pid}" in capsys.readouterr().err
    child.kill()
    _, _, err = finish(child)
    with run_folder.lock(out):
        pass
    # It loaded what the undisturbed run had compiled, and XLA told nothing of it.
    again = {x.name: x.stat().st_mtime_ns for x in cache.rglob("*-cache")}
    assert again == compiled and "Loading" not in err

    # From here on in this process: programs and folders are the same. SIGTERM and
    # Ctrl-C save and say how to continue.
    resumed = ["--resume", "--out", str(out), *OFTEN]
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
    assert (out / "metrics.csv").read_bytes() == (whole / "metrics.csv").read_bytes()
    assert list(out.glob("metrics-cut-*.csv"))  # no row is thrown away
    # The newest two and the best.
    assert len(checkpoints(out)) in (2, 3)
    final = [checkpoint.latest(x / "checkpoints")[0].folder for x in (whole, out)]
    assert {x.name for x in final} == {f"{ITERATIONS:08d}"}
    results = [json.loads((x / "summary.json").read_text()) for x in (whole, out)]
    assert results[0]["final_return"] == results[1]["final_return"]


def copy(whole, tmp_path):
    return pathlib.Path(shutil.copytree(whole, tmp_path / "copy"))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--behavior-cloning-coefficient 0.7", "coefficient was 0.1, is 0.7"),
        ("--obs-noise 0.2 --num-epochs 3", "num_epochs was 1, is 3"),
        ("--seeds 4", "seeds was 3, is 4"),
        ("--total-steps 100", "total_steps was 51200, is 100"),
    ],
)
def test_changed_settings_are_refused(arguments, message, whole, capsys):
    before = {p.name: p.stat().st_mtime_ns for p in whole.iterdir()}
    assert run.main(["--resume", "--out", str(whole), *arguments.split()]) == 2
    error = capsys.readouterr().err
    assert message in error and len(error.splitlines()) == 1
    assert {p.name: p.stat().st_mtime_ns for p in whole.iterdir()} == before


def test_settings_that_changed_before_the_lock_are_refused(whole, tmp_path):
    """Another process may have trained in the folder since they were read."""
    out = copy(whole, tmp_path)
    arguments = ["--resume", "--out", str(out)]
    begun = run_options.resumed_run(arguments)
    options = run_options.parse(run.Options, arguments, "gasil_jax.run", begun)
    path = out / "config.json"
    changed = json.loads(path.read_text())
    changed["algorithm"]["total_steps"] *= 2
    del changed["sha256"]
    path.write_text(json.dumps(changed))
    with pytest.raises(InputError, match="total_steps was 102400, is 51200"):
        with run_options.open_folder(options, "gasil_jax.run"):
            pass


def test_a_file_system_without_locks_is_told(tmp_path, monkeypatch, capsys):
    def flock(file, operation):
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "flock", flock)
    with run_folder.lock(tmp_path):
        assert "can't be locked (No locks available): make" in capsys.readouterr().err
    with run_folder.lock(tmp_path):
        assert capsys.readouterr().err == ""


def test_ctrl_c_before_training_is_one_line(capsys):
    def work():
        raise KeyboardInterrupt

    assert command_line.reports_errors(work)() == 130
    assert capsys.readouterr().err == "interrupted\n"


def test_devices_without_effect_are_told(capsys):
    """JAX has been started by the tests, with two."""
    devices.use_devices(Settings(), 1, 4)
    assert "devices is 1, which has no effect: JAX is" in capsys.readouterr().err
    devices.use_devices(Settings(), None, 1)
    devices.use_devices(Settings(), 2, 4)
    assert capsys.readouterr().err == ""


def test_a_new_folder_has_a_name_of_its_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    made = [run_folder.create_new("hopper").name for _ in range(3)]
    assert made == ["hopper", "hopper-2", "hopper-3"]


def test_a_disk_that_is_not_mounted_is_told(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs").symlink_to(tmp_path / "unmounted")
    with pytest.raises(InputError, match="out is runs"):
        run_folder.create_new("hopper")


def test_resume_needs_a_folder(capsys):
    assert run.main(["--resume"]) == 2
    assert "resume needs --out" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda path: path.unlink(), "lacks rows that were in it at the last"),
        (
            lambda path: path.write_text(path.read_text().replace(",", "", 9)),
            "metrics.csv",
        ),
        (
            lambda path: path.write_text(path.read_text().replace(",0.", ",z.")),
            "metrics.csv",
        ),
        (
            lambda path: path.write_bytes(
                path.read_bytes().replace(b",0.", b",00.", 3)
            ),
            "metrics.csv is damaged: it has changed since the checkpoint",
        ),
    ],
)
def test_a_damaged_table_is_reported_in_a_line(
    damage, message, whole, tmp_path, capsys
):
    out = copy(whole, tmp_path)
    damage(out / "metrics.csv")
    assert run.main(["--resume", "--out", str(out)]) == 2
    assert message in capsys.readouterr().err.splitlines()[-1]


def test_resuming_a_finished_run_changes_nothing(whole, tmp_path, capsys):
    out = copy(whole, tmp_path)
    assert run.main(["--resume", "--out", str(out)]) == 0
    assert "compiling" not in capsys.readouterr().err
    for name in ("summary.json", "metrics.csv"):
        assert (out / name).read_bytes() == (whole / name).read_bytes()
    with np.load(out / "policy.npz") as ours, np.load(whole / "policy.npz") as theirs:
        for name in theirs:
            np.testing.assert_array_equal(ours[name], theirs[name])
    assert checkpoints(out) == checkpoints(whole)


def test_a_run_that_was_killed_before_its_summary_has_no_speed(whole, tmp_path, capsys):
    out = copy(whole, tmp_path)
    (out / "summary.json").unlink()
    assert run.main(["--resume", "--out", str(out)]) == 0
    assert "steps/s" not in capsys.readouterr().out
    summary = json.loads((out / "summary.json").read_text())
    assert summary["env_steps_per_second"] is None


def test_results_without_checkpoints_are_not_replaced(whole, tmp_path, capsys):
    out = copy(whole, tmp_path)
    shutil.rmtree(out / "checkpoints")
    kinds = (".csv", ".npz", ".json")
    before = {x: x.read_bytes() for x in out.iterdir() if x.suffix in kinds}
    more = str((ITERATIONS + 5) * 128)
    arguments = ["--resume", "--out", str(out), "--total-steps", more]
    assert run.main(arguments) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert "has ended and its checkpoints are gone" in error
    assert all(path.read_bytes() == content for path, content in before.items())
    # Nor if there are some, but all are damaged.
    shutil.copytree(whole / "checkpoints", out / "checkpoints")
    for name in checkpoints(out):
        delete_the_manifest(out / "checkpoints" / name)
    damaged = checkpoints(out)
    assert run.main(arguments) == 2
    assert (
        "no undamaged checkpoint to continue from ("
        in capsys.readouterr().err.splitlines()[-1]
    )
    assert all(path.read_bytes() == content for path, content in before.items())
    assert checkpoints(out) == damaged
    # Where it has not ended, its table is kept under another name.
    shutil.rmtree(out / "checkpoints")
    (out / "summary.json").unlink()
    (out / "policy.npz").unlink()
    assert run.main(["--resume", "--out", str(out)]) == 0
    assert (
        "has no checkpoint: training starts from the beginning"
        in capsys.readouterr().err
    )
    assert (out / "metrics.csv").read_bytes() == before[out / "metrics.csv"]
    assert (out / "metrics-cut-1.csv").exists()


def truncate(folder):
    path = max(folder.rglob("*"), key=lambda p: p.stat().st_size * p.is_file())
    os.truncate(path, path.stat().st_size // 2)


def flip_a_bit(folder):
    path = max(folder.rglob("*"), key=lambda p: p.stat().st_size * p.is_file())
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 4
    path.write_bytes(content)


def delete_a_file(folder):
    next(p for p in sorted((folder / "state").rglob("*")) if p.is_file()).unlink()


def delete_the_manifest(folder):
    (folder / "manifest.json").unlink()


def edit_the_manifest(**changes):
    def damage(folder):
        path = folder / "manifest.json"
        manifest = json.loads(path.read_text())
        record = manifest["record"] | changes.pop("record", {})
        path.write_text(json.dumps(manifest | {"record": record} | changes))

    return damage


@pytest.mark.parametrize(
    "damage",
    [
        truncate,
        flip_a_bit,
        delete_a_file,
        delete_the_manifest,
        edit_the_manifest(files=[]),
        edit_the_manifest(files={"state": 3}),
        edit_the_manifest(record={"score": "high"}),
        edit_the_manifest(record={"metrics_size": "12"}),
        edit_the_manifest(record={"metrics_size": -1}),
        lambda folder: (folder / "manifest.json").write_text("[" * 100_000),
        lambda folder: (folder / "manifest.json").write_text("3"),
    ],
)
def test_a_damaged_checkpoint_is_reported_and_the_one_before_is_used(damage, tmp_path):
    root = tmp_path / "checkpoints"
    states = [{"x": np.full(1000, float(i), np.float32)} for i in range(3)]
    for i, state in enumerate(states):
        checkpoint.write(root, i, state, {"score": float(i), "metrics_size": 5})
    damage(root / "00000002")
    assert checkpoint.best(root).iteration == 1
    newest, errors = checkpoint.latest(root)
    assert newest.iteration == 1
    assert len(errors) == 1 and "00000002 is damaged" in errors[0]
    np.testing.assert_array_equal(newest.restore(states[1])["x"], states[1]["x"])
    # Written again, it is whole.
    checkpoint.write(root, 2, states[2], {"score": None})
    assert checkpoint.latest(root)[0].iteration == 2


def test_a_run_continues_from_the_checkpoint_before_a_damaged_one(
    whole, tmp_path, capsys
):
    out = tmp_path / "out"
    twice = ("--checkpoint-every", str(ITERATIONS // 2 * 128))
    assert run.main([*SMALL, *twice, "--out", str(out)]) == 0
    *_, last = checkpoints(out)
    assert len(checkpoints(out)) == 2
    flip_a_bit(out / "checkpoints" / last)
    assert run.main(["--resume", "--out", str(out)]) == 0
    told = capsys.readouterr().err
    assert f"{last} is damaged" in told and "starts from 00000200" in told
    assert (out / "metrics.csv").read_bytes() == (whole / "metrics.csv").read_bytes()
    assert checkpoint.latest(out / "checkpoints")[0].folder.name == last
    assert (out / "checkpoints" / f"{last}.damaged").is_dir()


def test_a_damaged_checkpoint_does_not_count_as_the_newest(tmp_path):
    root = tmp_path / "checkpoints"
    for iteration in (1, 5):
        checkpoint.write(root, iteration, {"x": np.zeros(1000)}, {"score": None})
    flip_a_bit(root / "00000005")
    assert checkpoint.latest(root)[0].iteration == 1
    checkpoint.set_aside(root, newer_than=1)
    checkpoint.write(root, 2, {"x": np.zeros(1000)}, {"score": None})
    checkpoint.prune(root, 1)
    assert checkpoint.latest(root) == (checkpoint.read(root / "00000002"), [])


def test_a_checkpoint_that_cannot_be_read_now_is_not_taken_for_damaged(
    tmp_path, monkeypatch, capsys
):
    out = tmp_path / "out"
    checkpoint.write(out / "checkpoints", 1, {"x": np.zeros(3)}, {"score": None})

    def fail(folder):
        raise OSError(errno.ESTALE, os.strerror(errno.ESTALE))

    with monkeypatch.context() as patched:
        patched.setattr(checkpoint, "_hashes", fail)
        with pytest.raises(OSError, match="Stale"):
            checkpoint.latest(out / "checkpoints")
        with pytest.raises(checkpoint.WriteError, match="Stale"):
            checkpoint.write(out / "checkpoints", 1, {"x": np.ones(3)}, {})
    assert checkpoint.latest(out / "checkpoints")[0].iteration == 1


def test_a_checkpoint_that_cannot_be_deleted_is_left(tmp_path, monkeypatch):
    for i in range(3):
        checkpoint.write(tmp_path, i, {"x": np.zeros(3)}, {"score": None})
    names = lambda: sorted(path.name for path in tmp_path.iterdir())
    rename = pathlib.Path.rename

    def fail(path, other):
        if path.name == "00000001":
            raise PermissionError
        return rename(path, other)

    with monkeypatch.context() as patched:
        patched.setattr(pathlib.Path, "rename", fail)
        checkpoint.prune(tmp_path, 1)
    assert names() == ["00000001", "00000002"]
    with monkeypatch.context() as patched:
        patched.setattr(os, "unlink", mock.Mock(side_effect=PermissionError))
        checkpoint.prune(tmp_path, 1)
    assert names() == ["00000001.partial", "00000002"]
    assert checkpoint.latest(tmp_path)[0].iteration == 2
    checkpoint.delete_partial(tmp_path)
    assert names() == ["00000002"]


def test_the_best_and_the_newest_are_kept(tmp_path):
    root = tmp_path / "checkpoints"
    for i, score in enumerate([None, 3.0, 9.0, 1.0, 2.0, None]):
        checkpoint.write(root, i, {"x": np.zeros(3)}, {"score": score})
        checkpoint.prune(root, 2)
    assert sorted(p.name for p in root.iterdir()) == [
        "00000002",
        "00000004",
        "00000005",
    ]
    assert checkpoint.best(root).iteration == 2


# States with a discriminator and a buffer, and with a replay and a model of rewards;
# what others have is arrays too, and test_disks.py writes those of any kind.
@pytest.mark.parametrize(
    "agent",
    [
        pytest.param(name, marks=pytest.mark.xdist_group(f"members {name}"))
        for name in ("ppo+gasil", "ppo+sil")
    ],
)
def test_an_agent_continues_bit_for_bit(agent, tmp_path):
    members, first, advance = test_members.compiled(agent)
    rest = []
    states, _ = members.train(advance, members.to_devices(first), 0, 1)
    states, _ = members.train(advance, states, 1, 1)
    checkpoint.write(tmp_path, 2, members.trim(states), {})
    newest, _ = checkpoint.latest(tmp_path)
    like = jax.eval_shape(lambda: first)
    for before in (states, members.to_devices(newest.restore(like))):
        after, metrics = members.train(advance, before, 2, 1)
        after, more = members.train(advance, after, 3, 1)
        after = jax.tree.leaves(members.trim(after))
        rest.append(
            [
                metrics,
                more,
                [
                    np.asarray(jax.device_get(x))
                    for x in after
                    if not jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key)
                ],
            ]
        )
    jax.tree.map(np.testing.assert_array_equal, *rest)
    # It has trained all the while, with delay and noise and without a NaN.
    metrics, _, leaves = rest[0]
    assert metrics["skipped_updates"].sum() == 0
    assert np.isfinite(metrics["policy_loss"]).all()
    if "buffer_steps" in members.algorithm.settings:
        assert (metrics["good_steps"] == 100).all()
    assert len(leaves) > 20


def test_of_another_agent_the_agent_is_the_only_difference():
    before = {"agent": "ppo+gasil", "buffer_steps": 1000, "gamma": 0.9}
    now = {"agent": "ppo", "gamma": 0.99}
    assert run_folder.differences(before, now) == ["agent was ppo+gasil, is ppo"]
    assert run_folder.differences(now, now | {"gamma": 1.0}) == [
        "gamma was 0.99, is 1.0"
    ]

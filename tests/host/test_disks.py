"""Folders of any name, disks that lack something, and what happens when one is full."""

import errno
import fcntl
import io
import os
import re
import resource
import shutil
import subprocess
import sys
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint
import pytest
from brax.envs import State
from small_training import FLAGS, SETTINGS
from test_resume import finish, start, wait_for

import gasil_jax
from gasil_jax import merge, run, sweep
from gasil_jax.host import (
    checkpoint,
    command_line,
    metrics_files,
    output_file,
    run_folder,
)
from gasil_jax.sweeps import saved_states

PPO = gasil_jax.algorithm("ppo", **SETTINGS)
SMALL = (*FLAGS, "--agent", "ppo")
#: Characters that mean something to a shell, to patterns, to URLs, or nothing at all.
NAMES = ("sweep[lr=1e-3]", "a*?{b}", "line\nline", "$x%20#", " é ", "--x")
#: A name that no encoding has.
BYTES = os.fsdecode(b"\xff")


class Static:
    """An environment whose state has arrays of every odd kind, as MJX's has."""

    observation_size, action_size, episode_length = 2, 1, 8

    def reset(self, key):
        state = {
            "none": jnp.zeros((0, 3)),
            "key": jax.random.key(3, impl="rbg"),
            "half": jnp.ones(3, jnp.bfloat16),
        }
        zero = jnp.float32(0)
        return State(state, jnp.zeros(2), zero, zero, {}, {})

    def step(self, state, action):
        half = state.pipeline_state["half"] * jnp.bfloat16(1.01)
        return state.replace(
            pipeline_state={**state.pipeline_state, "half": half},
            obs=jnp.concatenate([action, half[:1].astype(jnp.float32)]),
            reward=action[0],
        )


@pytest.fixture(scope="module")
def env():
    return gasil_jax.make_env("point_mass")


def assert_same(states, others):
    """Compare states bit for bit, with their random keys."""
    assert jax.tree.structure(states) == jax.tree.structure(others)
    for x, y in zip(jax.tree.leaves(states), jax.tree.leaves(others), strict=True):
        assert x.dtype == y.dtype
        if jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
            x, y = jax.random.key_data(x), jax.random.key_data(y)
        assert np.asarray(x).tobytes() == np.asarray(y).tobytes()


@pytest.mark.parametrize("name", [*NAMES, pytest.param(BYTES, id="bytes")])
def test_a_checkpoint_is_read_from_a_folder_of_any_name(name, tmp_path):
    state = {"x": np.arange(1000, dtype=np.float32)}
    checkpoint.write(tmp_path / name, 1, state, {"score": 2.0})
    for found in (
        checkpoint.latest(tmp_path / name)[0],
        checkpoint.best(tmp_path / name),
    ):
        assert_same(found.restore(state), state)


def test_runs_sweeps_shards_and_fit_take_folders_of_any_name(env, tmp_path):
    names = iter(NAMES)
    point = lambda: tmp_path / "".join(next(names) for _ in range(2))

    out = point()
    assert run.main([*SMALL, f"--out={out}"]) == 0
    states = saved_states.load(out)[-1]
    assert_same(gasil_jax.fit(env, algorithm_of(out), folder=point()).states, states)

    out = point()
    arguments = [*SMALL, f"--out={out}", "--grid", "gamma=0.9,0.99", "--shard"]
    for shard in ("1/2", "2/2"):
        assert sweep.main([*arguments, shard]) == 0
    assert merge.main([str(out), f"--out={tmp_path / 'united'}"]) == 0
    for folder in (out, tmp_path / "united"):
        state = saved_states.load(folder, point=1)[-1]
        np.testing.assert_array_equal(state.iteration, [PPO.config.num_iterations])


def algorithm_of(out):
    return run_folder.read(out)["algorithm"]


def test_a_name_that_the_terminal_cannot_show_is_printed(monkeypatch):
    written = io.BytesIO()
    strict = io.TextIOWrapper(written, encoding="ascii", write_through=True)
    monkeypatch.setattr(sys, "stdout", strict)
    assert command_line.reports_errors(lambda: print(f"in {BYTES}é") or 0)() == 0
    assert written.getvalue() == b"in \\udcff\\xe9\n"


STATES = {
    "zero size": {"x": np.zeros((3, 0), np.float32), "y": np.zeros((0, 2), bool)},
    "scalars": {"x": np.float32(1.5), "y": np.int8(-3), "z": np.bool_(True)},
    "not NumPy's": {"x": jnp.arange(3, dtype=jnp.bfloat16), "y": jnp.ones(5, "int4")},
    "not a number": {"x": np.array([np.nan, -0.0, np.inf], np.float32)},
    "keys": [jax.random.key(1), jax.random.split(jax.random.key(2, impl="rbg"), 3)],
    "names": {"a/b": {"../x": np.int8(2)}, "": np.int8(3), "file": np.int8(4)},
    "one array": np.arange(5, dtype=np.uint16),
    "transposed": (np.int32([[1, 2], [3, 4]]).T, np.int32([1, 2, 3])[::2]),
    "nothing": {},
}


@pytest.mark.parametrize("kind", STATES)
def test_any_state_is_saved_and_restored(kind, tmp_path):
    state = STATES[kind]
    checkpoint.save(tmp_path / "state", state)
    like = jax.eval_shape(lambda: state)
    assert_same(checkpoint.restore(tmp_path / "state", like), state)


def test_a_type_of_the_same_size_is_not_taken_for_another(tmp_path):
    checkpoint.save(tmp_path / "state", {"x": jnp.ones(3, jnp.bfloat16)})
    with pytest.raises(ValueError, match=r"holds another state: \['x'\] differs"):
        checkpoint.restore(tmp_path / "state", {"x": jnp.ones(3, jnp.float16)})


def test_an_environment_with_arrays_of_every_kind_continues_bit_for_bit(tmp_path):
    env = Static()
    whole = gasil_jax.fit(env, PPO, seeds=2).states
    once = lambda progress: True
    for callback in (once, None):
        states = gasil_jax.fit(
            env,
            PPO,
            seeds=2,
            folder=tmp_path,
            resume=True,
            callback=callback,
        ).states
    assert_same(states, whole)


@pytest.mark.parametrize("name", ["plain", "sweep[lr=1e-3]"])
def test_a_folder_that_was_renamed_since_is_read(name, tmp_path):
    state = {"x": np.arange(6.0, dtype=np.float32), "key": jax.random.key(1)}
    arrays = {
        "['x']": state["x"],
        "['key']": np.array(jax.random.key_data(state["key"])),
    }
    with orbax.checkpoint.StandardCheckpointer() as checkpointer:
        checkpointer.save(tmp_path / "before", arrays)
    (tmp_path / "before").rename(tmp_path / name)
    assert_same(checkpoint.restore(tmp_path / name, state), state)


def test_a_checkpoint_that_reads_otherwise_does_not_count_as_written(
    tmp_path, monkeypatch
):
    checkpointer = orbax.checkpoint.StandardCheckpointer
    save = checkpointer.save
    worse = lambda self, path, arrays: save(self, path, {"['x']": 2 * arrays["['x']"]})
    monkeypatch.setattr(checkpointer, "save", worse)
    with pytest.raises(checkpoint.WriteError, match="is not what was written"):
        checkpoint.write(tmp_path, 1, {"x": np.ones(3)}, {})
    assert checkpoint.latest(tmp_path) == (None, [])


@pytest.mark.parametrize("number", [errno.ENOSYS, errno.EINVAL])
def test_a_disk_without_locks_and_flushes_keeps_everything(
    number, tmp_path, monkeypatch
):
    def fail(*arguments):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(fcntl, "flock", fail)
    monkeypatch.setattr(os, "fsync", fail)
    out = tmp_path / "out"
    assert run.main([*SMALL, "--out", str(out)]) == 0
    newest, _ = checkpoint.latest(out / "checkpoints")
    assert newest.iteration == PPO.config.num_iterations
    for name in ("policy.npz", "summary.json"):
        assert (out / name).exists()


def test_a_disk_that_is_full_during_a_checkpoint_is_one_line(tmp_path):
    """Each of Orbax's and TensorStore's threads has a traceback of its own."""
    program = """
import pathlib, resource, sys
import numpy as np
from gasil_jax.host import checkpoint

# No file may grow beyond this: writing fails as on a full disk.
resource.setrlimit(resource.RLIMIT_FSIZE, (2000, 2000))
state = {str(i): np.random.default_rng(i).normal(size=10_000) for i in range(60)}
try:
    checkpoint.write(pathlib.Path(sys.argv[1]), 1, state, {})
except checkpoint.WriteError as error:
    print(error, file=sys.stderr)
"""
    arguments = [sys.executable, "-c", program, str(tmp_path)]
    ended = subprocess.run(arguments, capture_output=True, text=True)
    assert ended.stderr == f"{tmp_path} can't be written: File too large\n"
    assert list(tmp_path.iterdir()) == []


def test_what_failed_first_is_told_where_cleaning_up_fails_too(tmp_path):
    with pytest.raises(OSError, match="File too large"):
        with checkpoint._orbax(tmp_path / "state"):
            try:
                raise ValueError(f"writing fails: os_error_code='{errno.EFBIG}'")
            finally:  # Cleaning up.
                raise OSError(errno.ENOTEMPTY, "Directory not empty")
    with pytest.raises(OSError, match="Directory not empty"):
        with checkpoint._orbax(tmp_path / "state"):
            raise OSError(errno.ENOTEMPTY, "Directory not empty")


def test_an_error_in_a_thread_that_is_not_orbaxs_is_still_told(tmp_path, monkeypatch):
    told = []
    monkeypatch.setattr(sys, "unraisablehook", told.append)
    (tmp_path / "state").mkdir()
    with pytest.raises(ValueError, match="already exists"):
        checkpoint.save(tmp_path / "state", {"x": np.ones(3)})
    for text in ("Event loop is closed", "mine"):
        sys.unraisablehook(mock.Mock(exc_value=RuntimeError(text)))
    assert [str(unraisable.exc_value) for unraisable in told] == ["mine"]


def test_a_full_disk_has_a_hint(tmp_path):
    with pytest.raises(output_file.WriteError, match="left on device: make room there"):
        with output_file.errors_named(tmp_path):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_rows_that_could_not_be_written_are_not_written_later(tmp_path):
    path = tmp_path / "metrics.csv"
    writer = metrics_files.MetricsWriter(path, {"seed": [0]}, columns=("env_steps",))
    full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    writer._file.flush = mock.Mock(side_effect=full)
    with pytest.raises(output_file.WriteError, match="left on device: make room"):
        writer.write({"env_steps": np.ones((1, 1))})
    # Python would write them once there is room.
    assert writer._file.closed


def test_a_row_that_is_changed_during_training_is_told_when_it_continues(tmp_path):
    path = tmp_path / "metrics.csv"
    start = lambda record=None: metrics_files.MetricsWriter(
        path, {"seed": [0]}, record, columns=("env_steps",)
    )
    write = lambda writer, steps: writer.write({"env_steps": np.full((1, 1), steps)})
    writer = start()
    write(writer, 7.0)
    record = writer.record()
    writer.close()
    # With other line ends, and a row after the checkpoint.
    text = path.read_text()
    path.write_text(text)
    writer = start(record | {"metrics_size": path.stat().st_size})
    write(writer, 8.0)
    assert metrics_files.has_recorded_rows(path, writer.record())
    path.write_bytes(path.read_bytes().replace(b"0,7", b"0,6"))
    write(writer, 9.0)
    with pytest.raises(ValueError, match="it has changed since the checkpoint"):
        metrics_files.has_recorded_rows(path, writer.record())
    writer.close()


def test_a_table_of_other_seeds_is_refused(tmp_path):
    path = tmp_path / "metrics.csv"
    writer = metrics_files.MetricsWriter(path, {"seed": [3, 4]}, columns=("env_steps",))
    writer.write({"env_steps": np.full((2, 1), 7.0)})
    writer.close()
    (first, _) = metrics_files.read_metrics(path, {"seed": [3, 4]})["env_steps"]
    assert first.tolist() == [7.0]
    with pytest.raises(ValueError, match="its rows are not in order"):
        metrics_files.read_metrics(path, {"seed": [4, 3]})


def test_windows_is_refused_in_a_line():
    program = "import sys; sys.platform = 'win32'; import gasil_jax"
    ended = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True
    )
    assert ended.stderr.splitlines()[-1] == (
        "ImportError: gasil_jax runs on Linux and macOS: on Windows, use WSL"
    )


def test_a_flush_that_failed_is_told(tmp_path, monkeypatch):
    def fail(descriptor):
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(checkpoint.WriteError, match=r"written: Input/output error$"):
        checkpoint.write(tmp_path, 1, {"x": np.ones(3)}, {})


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
    told = capsys.readouterr().err
    assert "compiling" not in told
    assert f"error: {out / 'checkpoints'}/" in told.splitlines()[-1]
    assert "Function not implemented" in told.splitlines()[-1]
    assert list((out / "checkpoints").iterdir()) == []
    # The folder is as good as before.
    monkeypatch.undo()
    assert run.main(["--resume", "--out", str(out)]) == 0


def test_the_policies_are_written_even_if_the_last_checkpoint_is_not(
    env, tmp_path, monkeypatch, capsys
):
    failing(monkeypatch, lambda state: len(jax.tree.leaves(state)) > 1)
    out = tmp_path / "out"
    assert run.main([*SMALL, "--out", str(out)]) == 1
    told = capsys.readouterr().err.splitlines()[-1]
    assert (
        told == f"error: {out}/checkpoints can't be written: Function not implemented"
    )
    assert (out / "summary.json").exists()
    action = gasil_jax.load_policy(out)(np.zeros(env.observation_size))

    with pytest.raises(checkpoint.WriteError, match="Function not implemented"):
        gasil_jax.fit(env, algorithm_of(out), folder=tmp_path / "fit")
    same = gasil_jax.load_policy(tmp_path / "fit")(np.zeros(env.observation_size))
    np.testing.assert_array_equal(action, same)

    # A program of a sweep has its policies in its checkpoint alone.
    out = tmp_path / "sweep"
    arguments = [*SMALL, "--out", str(out), "--grid", "gamma=0.9"]
    assert sweep.main(arguments) == 1
    told = capsys.readouterr().err.splitlines()[-1]
    assert told.endswith(f"python -m gasil_jax.sweep --resume --out {out}")
    monkeypatch.undo()
    assert sweep.main(["--resume", "--out", str(out)]) == 0
    assert saved_states.load(out, point=0)


def killed_while_writing(path):
    """Let a process be killed while it writes a file; return what it leaves."""
    program = f"""
import os, pathlib
from gasil_jax.host import output_file

with output_file.atomic(pathlib.Path({str(path)!r})) as partial:
    partial.write_text("{{")
    os._exit(9)
"""
    assert subprocess.run([sys.executable, "-c", program]).returncode == 9
    (left,) = path.parent.glob(f".{path.stem}.*{path.suffix}")
    return left


def test_a_kill_during_the_first_description_does_not_spoil_the_folder(env, tmp_path):
    film = tmp_path / f".film.{32 * '0'}.gif"
    film.touch()  # Someone may be drawing it now.
    left = killed_while_writing(tmp_path / "config.json")
    assert run.main([*SMALL, "--resume", "--out", str(tmp_path)]) == 0
    assert not left.exists() and film.exists()

    folder = tmp_path / "fit"
    folder.mkdir()
    left = killed_while_writing(folder / "fit.json")
    assert gasil_jax.fit(env, PPO, folder=folder, resume=True).metrics
    assert not left.exists()

    # The tables of shards, too.
    out = tmp_path / "sweep"
    arguments = [*SMALL, "--out", str(out), "--grid", "gamma=0.9", "--shard", "1/1"]
    assert sweep.main(arguments) == 0
    left = killed_while_writing(out / "config.json")
    assert merge.main([str(out)]) == 0
    assert not left.exists()


@pytest.mark.parametrize("name", ["", "metrics.csv", "evaluations.csv"])
@pytest.mark.parametrize("replaced", [False, True])
def test_what_is_gone_is_told_at_the_next_write(name, replaced, env, tmp_path):
    out, seen = tmp_path / "out", []

    def callback(progress):
        seen.append(progress.iteration)
        if len(seen) == 1:
            (out / name).rename(tmp_path / "moved")
            if replaced:
                copy = shutil.copy if name else shutil.copytree
                copy(tmp_path / "moved", out / name)

    with pytest.raises(output_file.WriteError) as told:
        gasil_jax.fit(
            env,
            PPO,
            folder=out,
            evaluate_every=128,
            evaluate_episodes=1,
            callback=callback,
        )
    path = out / (name or "metrics.csv")
    assert str(told.value) == f"{path} was deleted or replaced during training"
    assert len(seen) == 1
    if not name and not replaced:
        assert not out.exists()


def test_a_full_disk_is_one_line_that_says_how_to_continue(tmp_path):
    out = tmp_path / "out"
    flags = ("--total-steps", str(10**6), "--checkpoint-every", str(500 * 128))
    child = start(out, *SMALL, *flags)
    table = out / "metrics.csv"
    wait_for(lambda: (out / "checkpoints" / "00000500").exists(), child)
    # No file may grow beyond this: writing fails as on a full disk.
    largest = table.stat().st_size + 20_000
    resource.prlimit(child.pid, resource.RLIMIT_FSIZE, (largest, largest))
    status, _, told = finish(child)
    assert status == 1
    loud = r"^(?:error: |Traceback|\w*Error\b|\w*Warning\b|WARN|ERROR).*$"
    (error,) = re.findall(loud, told, re.MULTILINE)
    assert error == told.splitlines()[-1]
    assert error == (
        f"error: {table} can't be written: File too large; continue with: "
        f"python -m gasil_jax.run --resume --out {out}"
    )
    newest, errors = checkpoint.latest(out / "checkpoints")
    assert newest.iteration == 500 and errors == []

"""Any state is saved whole, damage is seen, and the newest and the best are kept."""

import errno
import os
import resource
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint
import pytest

from gasil_jax.host import checkpoint


def write(root, iteration, score=None, state=None):
    record = checkpoint.Record(metrics_rows=5, evaluations_rows=0, score=score)
    checkpoint.write(root, iteration, state or {"x": np.zeros(1000)}, record)


def names(root):
    return sorted(path.name for path in root.iterdir())


def assert_same(states, others):
    """Compare states bit for bit, with their random keys."""
    assert jax.tree.structure(states) == jax.tree.structure(others)
    for x, y in zip(jax.tree.leaves(states), jax.tree.leaves(others), strict=True):
        assert x.dtype == y.dtype
        if jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
            x, y = jax.random.key_data(x), jax.random.key_data(y)
        assert np.asarray(x).tobytes() == np.asarray(y).tobytes()


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


@pytest.mark.parametrize(
    "like", [{"x": jnp.ones(3, jnp.float16)}, {"x": jnp.ones(2, jnp.bfloat16)}, {}]
)
def test_another_state_is_not_taken_for_what_is_stored(like, tmp_path):
    checkpoint.save(tmp_path / "state", {"x": jnp.ones(3, jnp.bfloat16)})
    with pytest.raises(ValueError, match=r"holds another state: \['x'\] "):
        checkpoint.restore(tmp_path / "state", like)


def test_what_reads_otherwise_does_not_count_as_written(tmp_path, monkeypatch):
    checkpointer = orbax.checkpoint.StandardCheckpointer
    save = checkpointer.save
    worse = lambda self, path, arrays: save(self, path, {"['x']": 2 * arrays["['x']"]})
    monkeypatch.setattr(checkpointer, "save", worse)
    with pytest.raises(checkpoint.WriteError, match="is not what was written"):
        write(tmp_path, 1, state={"x": np.ones(3)})
    assert checkpoint.latest(tmp_path) == (None, [])


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


@pytest.mark.parametrize(
    "damage",
    [
        truncate,
        flip_a_bit,
        delete_a_file,
        lambda folder: (folder / "manifest.json").unlink(),
        lambda folder: (folder / "manifest.json").write_text("[" * 100_000),
    ],
)
def test_a_damaged_checkpoint_is_told_and_the_one_before_is_used(damage, tmp_path):
    states = [{"x": np.full(1000, float(i), np.float32)} for i in range(3)]
    for i, state in enumerate(states):
        write(tmp_path, i, float(i), state)
    damage(tmp_path / "00000002")
    newest, errors = checkpoint.latest(tmp_path)
    assert newest.iteration == 1
    assert len(errors) == 1 and "00000002 is damaged" in errors[0]
    np.testing.assert_array_equal(newest.restore(states[1])["x"], states[1]["x"])
    # The best may be the damaged one: another is never taken for it.
    with pytest.raises(ValueError, match="00000002 is damaged"):
        checkpoint.best(tmp_path)
    assert checkpoint.best_score(tmp_path) >= 1.0
    # Written again, it is whole.
    write(tmp_path, 2, None, states[2])
    assert checkpoint.latest(tmp_path)[0].iteration == 2
    assert checkpoint.best(tmp_path).iteration == 1
    # Set aside, it counts no more.
    checkpoint.set_aside(tmp_path, newer_than=1)
    assert names(tmp_path) == ["00000000", "00000001", "00000002.damaged"]
    assert checkpoint.latest(tmp_path)[0].iteration == 1


def test_the_best_and_the_newest_are_kept(tmp_path):
    for i, score in enumerate([None, 3.0, 9.0, 1.0, 2.0, None]):
        write(tmp_path, i, score)
        checkpoint.prune(tmp_path, 2)
    assert names(tmp_path) == ["00000002", "00000004", "00000005"]
    assert checkpoint.best(tmp_path).iteration == 2


def test_what_cannot_be_read_now_is_not_taken_for_damaged(tmp_path, monkeypatch):
    write(tmp_path, 1)
    stale = mock.Mock(side_effect=OSError(errno.ESTALE, os.strerror(errno.ESTALE)))
    with monkeypatch.context() as patched:
        patched.setattr(checkpoint, "_hashes", stale)
        with pytest.raises(OSError, match="Stale"):
            checkpoint.latest(tmp_path)
        with pytest.raises(checkpoint.WriteError, match="Stale"):
            write(tmp_path, 1)
    assert checkpoint.latest(tmp_path)[0].iteration == 1


def test_a_checkpoint_that_cannot_be_deleted_is_left(tmp_path, monkeypatch):
    for i in range(3):
        write(tmp_path, i)
    with monkeypatch.context() as patched:
        patched.setattr(os, "unlink", mock.Mock(side_effect=PermissionError))
        checkpoint.prune(tmp_path, 1)
    left = ["00000000.partial", "00000001.partial", "00000002"]
    assert names(tmp_path) == left
    assert checkpoint.latest(tmp_path)[0].iteration == 2
    checkpoint.delete_partial(tmp_path)
    assert names(tmp_path) == ["00000002"]


def test_a_disk_that_is_full_during_a_checkpoint_is_told_once(tmp_path, capfd, caplog):
    """Orbax's and TensorStore's threads would print tracebacks of their own."""
    state = {str(i): np.random.default_rng(i).normal(size=10_000) for i in range(60)}
    _, hard = limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    # No file may grow beyond this: writing fails as on a full disk.
    resource.setrlimit(resource.RLIMIT_FSIZE, (2000, hard))
    try:
        with pytest.raises(checkpoint.WriteError) as told:
            write(tmp_path, 1, state=state)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert str(told.value) == f"{tmp_path} can't be written: File too large"
    assert names(tmp_path) == []
    assert capfd.readouterr().err == caplog.text == ""


def test_a_flush_that_failed_is_told(tmp_path, monkeypatch):
    broken = mock.Mock(side_effect=OSError(errno.EIO, os.strerror(errno.EIO)))
    monkeypatch.setattr(os, "fsync", broken)
    with pytest.raises(checkpoint.WriteError, match=r"written: Input/output error$"):
        write(tmp_path, 1)

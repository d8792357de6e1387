"""Files of arrays that are altered or damaged are read whole or refused in a line."""

import json
import warnings

import numpy as np
import pytest
from altered_archives import altered

from gasil_jax import numpy_policy, policy
from gasil_jax.agents import expert

POLICY = {
    "seeds": np.arange(2),
    "final_return": np.array([1.0, np.nan]),
    "mean": np.zeros((2, 3), np.float32),
    "scale": np.ones((2, 3), np.float32),
    "log_std": np.zeros((2, 1), np.float32),
    "low": np.full(1, -1, np.float32),
    "high": np.ones(1, np.float32),
    "kernel_0": np.ones((2, 3, 4), np.float32),
    "bias_0": np.zeros((2, 4), np.float32),
    "kernel_1": np.ones((2, 4, 1), np.float32),
    "bias_1": np.zeros((2, 1), np.float32),
}
EXPERT = {"observation": np.ones((5, 3)), "action": np.zeros((5, 1))}


def act(path):
    weights = numpy_policy.read(path)
    observation = np.zeros_like(weights["mean"])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        action = numpy_policy.make(weights)(observation)
    assert action.shape == (1,) and np.isfinite(action).all()
    assert {x.dtype for x in weights.values()} == {np.dtype(np.float32)}


def load(path):
    for array in expert.load(str(path)):
        assert array.ndim == 2 and np.isfinite(array).all()


@pytest.mark.parametrize(
    ("arrays", "use"), [(POLICY, act), (EXPERT, load)], ids=["policy", "expert"]
)
def test_an_altered_archive_is_read_or_refused(arrays, use, tmp_path):
    refused = 0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for number, content in enumerate(altered(arrays, 350)):
            path = tmp_path / f"{number}.npz"
            path.write_bytes(content)
            try:
                use(path)
            except ValueError as error:
                refused += 1
                assert str(path) in str(error) and "\n" not in str(error)
    assert 150 < refused < 330


@pytest.mark.parametrize(
    ("name", "value", "why"),
    [
        ("kernel_1", np.zeros((2, 3, 1)), r"must be \(2, 4, 1\)"),
        ("kernel_0", np.full((2, 3, 4), np.nan), "numbers that aren't finite"),
        ("scale", np.zeros((2, 3)), "scale has numbers that aren't positive"),
        ("low", np.full(1, np.nan), "low isn't below high"),
        ("high", np.full(1, -2.0), "low isn't below high"),
    ],
)
def test_a_policy_that_cannot_act_is_refused(name, value, why, tmp_path):
    np.savez(tmp_path / "policy.npz", **{**POLICY, name: value})
    with pytest.raises(ValueError, match=f"is not a saved policy .*{why}"):
        numpy_policy.load(tmp_path)


def test_a_name_of_thousands_of_bytes_is_cut(tmp_path):
    path = tmp_path / "policy.npz"
    np.savez(path, **POLICY)
    content = bytearray(path.read_bytes())
    content[26:28] = b"\xff\x0f"  # the length of the first array's name
    path.write_bytes(content)
    with pytest.raises(ValueError, match="File name in directory") as told:
        numpy_policy.load(path)
    assert len(str(told.value)) < len(str(path)) + 400


def test_a_policy_of_another_byte_order_and_with_a_further_array_acts(tmp_path):
    swapped = {name: x.astype(x.dtype.newbyteorder()) for name, x in POLICY.items()}
    np.savez(tmp_path / "policy.npz", **swapped, bias_9=np.ones(()))
    np.savez(tmp_path / "plain.npz", **POLICY)
    observation = np.ones(3, np.float32)
    expected = policy.load_policy(tmp_path / "plain.npz")(observation)
    assert policy.load_policy(tmp_path)(observation) == expected
    assert numpy_policy.load(tmp_path)(observation) == expected


@pytest.mark.parametrize("about", [None, "{", "[]1", "[1]"])
def test_a_damaged_policy_of_the_zoo_is_told(about, tmp_path, monkeypatch):
    monkeypatch.setattr(numpy_policy, "ZOO", tmp_path)
    entry = {} if about is None else {"about": np.array(about)}
    np.savez(tmp_path / "mine.npz", **POLICY, **entry)
    with pytest.raises(ValueError, match=r"mine\.npz is damaged: about can't be read"):
        numpy_policy.about("zoo:mine")
    np.savez(tmp_path / "mine.npz", about=np.array(json.dumps({"env": "hopper"})))
    assert numpy_policy.about("zoo:mine")["env"] == "hopper"

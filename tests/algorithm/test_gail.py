"""GAIL's expert is data, and files without expert data are refused.

That it learns from one: test_discrete.py.
"""

import sys
from unittest import mock

import gymnasium
import jax
import minari
import numpy as np
import pytest
from minari.data_collector import EpisodeBuffer
from refusals import refused
from small_training import FLAGS

import gasil_jax
from gasil_jax import run
from gasil_jax.agents import expert as expert_module
from gasil_jax.cli import options
from gasil_jax.context import Sizes
from gasil_jax.errors import InputError
from gasil_jax.host import training
from gasil_jax.host.members import make_members


def write_expert(path, steps):
    rng = np.random.default_rng(0)
    arrays = {"observation": rng.normal(size=(steps, 11))}
    np.savez(path, action=rng.normal(size=(steps, 2)), **arrays)
    return gasil_jax.algorithm("gail", expert=str(path), num_envs=4, batch_steps=64)


def test_an_expert_is_data_of_which_each_device_has_one_copy(tmp_path):
    """Not a constant of the program, a part of its states, or a copy for each seed."""
    env, sizes = gasil_jax.make_env("point_mass"), {}
    for steps in (10, 10_000):
        algorithm = write_expert(tmp_path / "expert.npz", steps)
        members = make_members(env, algorithm, range(3), devices=jax.devices()[:2])
        states = jax.eval_shape(members.init)
        lowered = members.advance.lower(states, np.int32(0), members.data)
        state = sum(x.size for x in jax.tree.leaves(states))
        sizes[steps] = state, len(lowered.as_text())
        shapes = [[y.data.shape for y in x.addressable_shards] for x in members.data]
        assert shapes == [[(steps, 11)] * 2, [(steps, 2)] * 2]
    assert sizes[10][0] == sizes[10_000][0]
    assert abs(sizes[10][1] - sizes[10_000][1]) < 1000


def test_an_expert_is_an_argument_of_a_training_function(tmp_path):
    env = gasil_jax.make_env("point_mass")
    algorithm = write_expert(tmp_path / "expert.npz", 9999).replace(total_steps=64)
    train, data = gasil_jax.make_train(env, algorithm), algorithm.agent.data()
    program = jax.make_jaxpr(train)(jax.random.key(0), None, data)
    assert [x.shape for x in program.in_avals[1:]] == [(9999, 11), (9999, 2)]
    assert all(np.size(x) < 9999 for x in program.consts)


@pytest.fixture
def data_set(tmp_path, monkeypatch):
    """A function that writes a Minari data set of episodes of some lengths."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    rng = np.random.default_rng(0)
    space = lambda n: gymnasium.spaces.Box(-9.0, 9.0, (n,))

    def write(*lengths):
        episodes = [
            EpisodeBuffer(
                id=index,
                observations=rng.normal(size=(length + 1, 4)).astype(np.float32),
                actions=rng.normal(size=(length, 2)).astype(np.float32),
                rewards=[0.0] * length,
                terminations=[False] * length,
                truncations=[False] * (length - 1) + [True],
            )
            for index, length in enumerate(lengths)
        ]
        spaces = {"observation_space": space(4), "action_space": space(2)}
        minari.create_dataset_from_buffers("test/expert-v0", episodes, **spaces)
        return episodes

    return write


@pytest.mark.filterwarnings("ignore::UserWarning")  # on who made the data set
def test_a_minari_data_set_is_an_expert(data_set, tmp_path, monkeypatch):
    lengths = (5, 3)
    episodes = data_set(*lengths)
    observation, action = expert_module.load("minari:test/expert-v0")
    for got, name in ((observation, "observations"), (action, "actions")):
        expected = [getattr(e, name)[:n] for e, n in zip(episodes, lengths)]
        np.testing.assert_array_equal(got, np.concatenate(expected))
    with pytest.raises(ValueError, match=r"of size 2: .* of size 4 and 3"):
        expert_module.check("minari:test/expert-v0", Sizes(1, 4, 3))
    # Another data set under the same name is read, not the one before.
    minari.delete_dataset("test/expert-v0")
    (episode,) = data_set(7)
    observation, _ = expert_module.load("minari:test/expert-v0")
    np.testing.assert_array_equal(observation, episode.observations[:7])
    # What is there may need a package that is not.
    (described,) = tmp_path.rglob("metadata.json")
    described.write_text(described.read_text().replace('"hdf5"', '"arrow"'))
    for package, message in (
        ("pyarrow", r"'minari:test/expert-v0'.*pyarrow"),
        ("minari", r"read with gasil_jax\[minari\] \(.*minari"),
    ):
        monkeypatch.setitem(sys.modules, package, None)
        with pytest.raises(ValueError, match=message) as refusal:
            expert_module.load("minari:test/expert-v0")
        assert "\n" not in str(refusal.value)


def test_a_run_does_not_continue_with_another_expert(tmp_path, capsys, monkeypatch):
    path, out = tmp_path / "own.npz", tmp_path / "out"
    write_expert(path, 20)
    own = dict(np.load(path))
    out.mkdir()
    words = [*FLAGS, "--agent", "gail", "--expert", str(path)]
    options.read(options.Options, words, "x")[1].write(out)
    continued = ["--resume", "--out", str(out), "--env", "point_mass"]
    monkeypatch.setattr(training, "prepare", mock.Mock(side_effect=InputError("here")))
    for sign, told in ((-1, "the trajectories of the expert were others"), (1, "here")):
        np.savez(path, **{name: sign * x for name, x in own.items()})
        assert told in refused(capsys, run, *continued)

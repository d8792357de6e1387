"""Good trajectories as a Minari data set, and back."""

import shutil
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_training import FLAGS

from gasil_jax import buffer as good_trajectories
from gasil_jax import export_minari, run
from gasil_jax.agents import expert
from gasil_jax.host import checkpoint
from gasil_jax.sweeps import saved_states

minari = pytest.importorskip("minari")

# Episodes of the point mass have at most 50 steps.
LENGTHS, RETURNS = (50, 50, 50, 40, 10), (9.0, 4.5, 3.0, 2.0, -1.0)


def buffer(lengths, returns, capacity, observation_size, action_size):
    """One that holds episodes of these lengths and returns, of random steps."""
    rng, size = np.random.default_rng(0), sum(lengths)
    filled = lambda values: np.append(values, [0] * (capacity - size))
    return good_trajectories.GoodTrajectories(
        observation=jnp.float32(rng.normal(size=(capacity, observation_size))),
        action=jnp.float32(rng.normal(size=(capacity, action_size))),
        return_=jnp.float32(filled(np.repeat(returns, lengths))),
        time=jnp.int32(filled(np.concatenate([np.arange(n) for n in lengths]))),
        size=jnp.int32(size),
    )


@pytest.fixture
def filled(untrained_point_mass, tmp_path, monkeypatch):
    """A run whose buffer is full, its last episode cut, and the steps in it."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    out = shutil.copytree(untrained_point_mass, tmp_path / "run")
    env, algorithm, _, states = saved_states.load(out)
    sizes = (env.observation_size, env.action_size)
    kept = buffer(LENGTHS, RETURNS, algorithm.agent.buffer_steps, *sizes)
    with_seeds = jax.tree.map(lambda x: x[None], kept)
    agent = states.agent.replace(buffer=with_seeds)
    states = states.replace(agent=agent)
    checkpoint.write(out / "checkpoints", 1, states, {"score": 1.0})
    return out, kept


def test_whole_episodes_come_back(filled, capsys):
    out, kept = filled
    assert export_minari.main([str(out), "--name", "mass/good-v0"]) == 0
    assert "4 episodes, 190 steps in mass/good-v0" in capsys.readouterr().out
    observation, action = expert.load("minari:mass/good-v0")
    np.testing.assert_array_equal(observation, kept.observation[:190])
    np.testing.assert_array_equal(action, kept.action[:190])

    dataset = minari.load_dataset("mass/good-v0")
    episodes = [*dataset.iterate_episodes()]
    assert len(episodes) == 4
    for episode, length, return_ in zip(episodes, LENGTHS, RETURNS):
        assert episode.observations.shape == (length + 1, 11)
        assert episode.actions.shape == (length, 2)
        np.testing.assert_array_equal(episode.rewards[:-1], 0.0)
        assert episode.rewards[-1] == return_
        assert not episode.terminations.any()
        assert np.flatnonzero(episode.truncations).tolist() == [length - 1]
        np.testing.assert_array_equal(*episode.observations[-2:])
    env = dataset.recover_environment().unwrapped
    assert (
        env.reset(seed=0)[0].shape == (11,) and env.spec.id == "gasil_envs/point_mass"
    )
    metadata = dataset.storage.metadata
    assert metadata["algorithm_name"] == "ppo+gasil"
    assert "its return, discounted by 0.99 a step, and" in metadata["description"]


def test_the_discount_is_that_of_the_states(filled, monkeypatch):
    out, _ = filled
    metadata = {}
    load = saved_states.load

    def of_a_swept_point(folder, which, point, seed):
        env, algorithm, seeds, states = load(folder)
        numbers = states.hyperparameters
        numbers = {**numbers, "gamma": 0.9 * jnp.ones_like(numbers["gamma"])}
        return env, algorithm, seeds, states.replace(hyperparameters=numbers)

    monkeypatch.setattr(saved_states, "load", of_a_swept_point)
    monkeypatch.setattr(
        export_minari, "write", lambda *_, **settings: metadata.update(settings)
    )
    assert export_minari.main([str(out), "--name", "mass/swept-v0"]) == 0
    assert "discounted by 0.9 a step" in metadata["description"]

    def without_discount(*arguments, **others):
        env, algorithm, seeds, states = load(*arguments, **others)
        return env, algorithm.replace(buffer_discounts=False), seeds, states

    monkeypatch.setattr(saved_states, "load", without_discount)
    assert export_minari.main([str(out), "--name", "mass/swept-v0"]) == 0
    assert "its return, not discounted, and" in metadata["description"]


def test_the_last_episode_of_a_buffer_is_kept_if_it_is_whole():
    lengths = lambda kept, limit: [
        len(episode.action) for episode in export_minari.episodes(kept, limit)
    ]
    full = buffer((30, 20, 50), (3.0, 2.0, 1.0), 100, 4, 2)
    assert lengths(full, 1000) == [30, 20]
    assert lengths(full, 50) == [30, 20, 50]
    partly = buffer((30, 20), (3.0, 2.0), 100, 4, 2)
    assert lengths(partly, 1000) == [30, 20]
    assert lengths(good_trajectories.init_buffer(100, 4, 2), 1000) == []


def test_bad_input_is_one_line_and_status_2(filled, untrained_point_mass, capsys):
    out, _ = filled
    assert export_minari.main([str(out), "--name", "there-v0"]) == 0
    capsys.readouterr()
    for arguments, message in (
        ([str(out), "--name", "there-v0"], "'there-v0', which exists"),
        ([str(out), "--name", "../there-v0"], "must be like hopper/good-v0"),
        ([str(out), "--name", "there"], "must be like hopper/good-v0"),
        ([str(out), "--name", "a/there-v0"], "two characters before a slash"),
        ([str(out), "--name", "new-v0", "--seed", "7"], "seed is 7: the run has 0"),
        ([str(untrained_point_mass), "--name", "new-v0"], "no whole episode"),
        ([str(out.parent), "--name", "new-v0"], "must be the folder of a run"),
    ):
        assert export_minari.main(arguments) == 2
        error = capsys.readouterr().err
        assert message in error and len(error.splitlines()) == 1
    assert [*minari.list_local_datasets()] == ["there-v0"]


def test_a_run_of_an_agent_without_a_buffer_is_refused(tmp_path, capsys):
    out = str(tmp_path / "run")
    # As many seeds as in other tests, whose program it shares.
    small = (*FLAGS, "--agent", "ppo", "--seeds", "2")
    assert run.main([*small, "--out", out]) == 0
    capsys.readouterr()
    assert export_minari.main([out, "--name", "new-v0"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.endswith("of agent 'ppo': it has no buffer of good trajectories")


def test_a_failure_leaves_nothing(filled, monkeypatch, capsys):
    from minari.dataset.minari_storage import MinariStorage

    def full(*_):
        raise OSError("no space left on device")

    out, _ = filled
    with monkeypatch.context() as patched:
        patched.setattr(MinariStorage, "update_metadata", full)
        assert export_minari.main([str(out), "--name", "new-v0"]) == 1
    assert "no space left" in capsys.readouterr().err
    assert "new-v0" not in minari.list_local_datasets()


def test_a_missing_package_is_named(untrained_point_mass, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "minari.dataset.minari_dataset", None)
    assert export_minari.main([str(untrained_point_mass), "--name", "new-v0"]) == 2
    assert 'pip install "gasil_jax[minari]"' in capsys.readouterr().err

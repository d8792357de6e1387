"""A run stands once, under what decides its numbers; files are whole and the same."""

import dataclasses
import json
import subprocess
import threading

import numpy as np
import pytest

import gasil_jax
from experiments.store import (
    NEWER,
    RESULTS,
    Record,
    Store,
    from_stored,
    read,
    to_stored,
    write,
)
from gasil_jax import npz
from gasil_jax.errors import InputError
from gasil_jax.host.environments import Settings
from gasil_jax.host.runs import Run


def run(seed=0, env="hopper", **changes):
    return Run(env, gasil_jax.algorithm(**changes), seed)


def record(value=1.0, rows=3, **more):
    nan = np.full(rows, np.nan)
    steps = np.arange(1, rows + 1) * 2048
    return Record(steps, np.full(rows, value), nan, more)


def test_what_decides_numbers_decides_the_key_and_nothing_else_does():
    one = run()
    others = [
        run(seed=1),
        run(env="ant"),
        run(alpha=0.2),
        run(stagger_episodes=False),
        run(total_steps=5),
        run(decompose_rewards=True),
        run(alpha_schedule=((1e3, 0.0), (2e3, 1.0))),
        *(
            dataclasses.replace(one, **change)
            for change in (
                {"settings": Settings(reward_delay=20)},
                {"settings": Settings(obs_noise=0.1)},
                {"settings": Settings(integrator="euler")},
                {"settings": Settings(max_episode_steps=50)},
                {"settings": Settings(reward_delay=20, observe_phase=True)},
                {"algorithm_version": 99},
            )
        ),
    ]
    assert len({x.key for x in [one, *others]}) == 1 + len(others)
    assert run().key == one.key == run(alpha=0.1).key
    same = dataclasses.replace(one, settings=Settings(physics="mujoco"))
    assert same == one and same.key == one.key
    # A whole number and the same as a float are one number.
    assert run(gamma=1).key == run(gamma=1.0).key and run(gamma=1) == run(gamma=1.0)


#: Settings that runs of the point mass, and of no other task, are stored without.
_ADDED_TO_THE_KEY = {"activation", "layer_norm", "admission", "ties"}


@pytest.mark.parametrize("path", sorted((RESULTS / "runs").glob("*.npz")), ids=str)
def test_stored_runs_keep_their_keys(path):
    for stored in json.loads(str(npz.read(path)["index"]))["experiments"]:
        now = to_stored(from_stored(stored).experiment)
        for name in now["algorithm"].keys() - stored["algorithm"].keys():
            assert path.stem == "point_mass" and name in _ADDED_TO_THE_KEY
            del now["algorithm"][name]
        assert now == stored


def test_a_newer_setting_is_stored_unless_it_is_what_stored_runs_had():
    one = run(decompose_rewards=True)
    every = {**one.algorithm.settings, **dataclasses.asdict(one.settings)}
    stored = to_stored(one.experiment)
    for name, value in NEWER.items():
        # A stored run that lacks the setting is read with the default.
        assert every.get(name, []) == value
        assert name not in {*stored, *stored["algorithm"]}
    limited = dataclasses.replace(run(), settings=Settings(max_episode_steps=50))
    assert to_stored(limited.experiment)["max_episode_steps"] == 50


def test_what_is_written_is_read_again_in_whatever_order_it_came(tmp_path):
    records = {
        run(seed, alpha_schedule=((1e3, 0.0), (2e3, 1.0))): record(
            100.0 / 3 + seed, rows=3 + seed, physics="mjx"
        )
        for seed in range(3)
    } | {
        run(alpha=0.3): record(np.nan, physics="mujoco", commit=None),
        run(alpha=0.4): dataclasses.replace(
            record(),
            evaluation_steps=np.array([4096, 6144]),
            evaluation_return=np.array([10.0 / 3, 7.0]),
        ),
    }
    one, other = tmp_path / "one.npz", tmp_path / "other.npz"
    write(one, records)
    write(other, dict(reversed(records.items())))
    assert one.read_bytes() == other.read_bytes()
    back = read(one)
    assert set(back) == set(records)
    for each, before in records.items():
        now = back[each]
        assert now.provenance == before.provenance
        np.testing.assert_array_equal(now.env_steps, before.env_steps)
        np.testing.assert_allclose(now.episode_return, before.episode_return, 5e-6)
        assert now.evaluation_steps.tolist() == before.evaluation_steps.tolist()
        np.testing.assert_allclose(
            now.evaluation_return, before.evaluation_return, 5e-6
        )
    # What was read is written as it was.
    write(other, back)
    assert one.read_bytes() == other.read_bytes()


def test_a_field_that_a_file_has_not_is_the_default(tmp_path, monkeypatch):
    path = tmp_path / "hopper.npz"
    older = run().experiment.replace('"num_epochs": 10, ', "")
    assert older != run().experiment
    monkeypatch.setattr(Run, "experiment", older)
    write(path, {run(): record()})
    monkeypatch.undo()
    assert list(read(path)) == [run()]


@pytest.mark.parametrize("content", [b"", b"no zip"])
def test_a_damaged_file_is_told(tmp_path, content):
    path = tmp_path / "hopper.npz"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"hopper\.npz is not a file of runs"):
        _ = run() in Store(tmp_path)


def test_a_run_that_is_there_stays(tmp_path):
    store = Store(tmp_path)
    assert store.add({run(): record(1.0), run(env="ant"): record(2.0)}) == 2
    assert sorted(path.name for path in tmp_path.glob("*.npz")) == [
        "ant.npz",
        "hopper.npz",
    ]
    assert store.add({run(): record(9.0), run(1): record(3.0)}) == 1
    for fresh in (store, Store(tmp_path)):
        assert fresh[run()].episode_return.tolist() == [1.0] * 3
        assert fresh.missing([run(), run(2), run(1), run(2)]) == [run(2)]


def test_runs_are_added_side_by_side(tmp_path):
    add = lambda seed: Store(tmp_path).add({run(seed): record(float(seed))})
    threads = [threading.Thread(target=add, args=(seed,)) for seed in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    store = Store(tmp_path)
    assert [store[run(i)].part(0, 1) for i in range(6)] == list(range(6))


def test_a_part_of_training_is_the_rows_whose_middle_is_in_it():
    ends = np.array([11, 20, 31, 40, 51, 60, 71, 80, 91, 100])
    nan = np.full(10, np.nan)
    kept = Record(ends, np.arange(10.0), nan, {})
    assert kept.part(0.9, 1.0) == 9.0  # Though the ninth row ends after 90.
    assert kept.part(0.0, 0.2) == 0.5
    assert kept.part(0.0, 0.01) == 0.0
    assert kept.part(0.99, 1.0) == 9.0
    assert np.isnan(dataclasses.replace(kept, episode_return=nan).part(0, 1))
    # Where no episode ends in the last tenth, of the last part in which one did.
    assert kept.final == 9.0
    returns = np.where(np.arange(10) < 7, np.arange(10.0), np.nan)
    assert dataclasses.replace(kept, episode_return=returns).final == 6.0
    assert np.isnan(dataclasses.replace(kept, episode_return=nan).final)


def test_what_is_checked_in_is_small_and_of_few_files():
    files = [x for x in RESULTS.rglob("[!.]*") if x.is_file()]
    assert len(files) <= 90 and sum(x.stat().st_size for x in files) < 8e6
    # A pattern of .gitignore would leave them out.
    git = ("git", "-C", str(RESULTS), "check-ignore", "-q", *map(str, files))
    assert subprocess.run(git).returncode != 0


@pytest.mark.parametrize("path", sorted((RESULTS / "runs").glob("*.npz")), ids=str)
def test_what_is_checked_in_says_what_it_was_trained_with(path):
    for each, kept in read(path).items():
        assert path.stem == each.env.replace(":", "-")
        assert {"physics", "versions", "commit", "clean"} <= set(kept.provenance)
        assert (np.diff(kept.env_steps) > 0).all()
        assert kept.env_steps[-1] == 2048 * each.algorithm.config.num_iterations

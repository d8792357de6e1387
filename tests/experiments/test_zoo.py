"""The trained policies that the package comes with."""

import json
import shutil

import numpy as np
import pytest

import gasil_jax
from experiments import zoo
from gasil_jax import evaluate, numpy_policy, policy
from gasil_jax.host import policy_file, saved

NAMES = numpy_policy.zoo()


def test_they_are_small_and_their_table_is_true():
    assert sum(path.stat().st_size for path in numpy_policy.ZOO.glob("*")) < 2e6
    assert zoo.table() in zoo.TABLE.read_text()
    assert len(NAMES) > 0


@pytest.mark.parametrize("name", NAMES)
def test_one_acts_in_numpy_and_in_jax(name):
    about = numpy_policy.about(f"zoo:{name}")
    env = gasil_jax.make_env(about["env"])
    observation = np.linspace(-1.0, 1.0, env.observation_size, dtype=np.float32)
    action = numpy_policy.load(f"zoo:{name}")(observation)
    assert action.shape == (env.action_size,)
    in_jax = gasil_jax.load_policy(f"zoo:{name}")(observation)
    np.testing.assert_allclose(in_jax, action, atol=1e-4)


def test_one_is_as_good_as_its_score_says(capsys):
    about = numpy_policy.about("zoo:swimmer-delayed")
    run = ["zoo:swimmer-delayed", "--gymnasium", "--episodes", "3", "--key", "1000"]
    assert evaluate.main(run) == 0
    *_, last = capsys.readouterr().out.splitlines()
    mean = float(last.removeprefix("return ").removesuffix(" (1 seed)"))
    error = about["deviation"] * np.sqrt(1 / 3 + 1 / about["episodes"])
    assert abs(mean - about["mean"]) < 5 * error + 1.0


def test_a_better_policy_replaces_another(untrained_hopper, tmp_path):
    run, kept = tmp_path / "run", tmp_path / "zoo"
    shutil.copytree(untrained_hopper, run)
    env, _, seeds, states = saved.load(run)
    policy_file.save(run / "policy.npz", states, env, seeds, np.array([3.0]))
    assert "hopper: " in zoo.add(run, 2, kept)
    assert "stays" in zoo.add(run, 2, kept)
    path = kept / "hopper.npz"
    stored = dict(np.load(path))
    about = json.loads(str(stored["about"]))
    assert about["env"] == "hopper" and about["seed"] == 0 and about["episodes"] == 2
    np.testing.assert_array_equal(
        stored["kernel_0"], np.asarray(policy.weights(states, env)["kernel_0"])
    )
    before = about["mean"]
    stored["about"] = np.array(json.dumps({**about, "mean": before - 1.0}))
    np.savez(path, **stored)
    assert f"before {before - 1.0}" in zoo.add(run, 2, kept)
    assert json.loads(str(np.load(path)["about"]))["mean"] == before

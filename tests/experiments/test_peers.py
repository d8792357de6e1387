"""The benchmark of PPO beside other packages."""

import importlib.util

import jax
import pytest

from experiments import __main__ as experiments
from experiments import peers


@pytest.mark.parametrize("missing", ["rejax", "ppo_continuous_action"])
def test_a_peer_that_is_not_installed_is_told_in_a_line(missing, monkeypatch, capsys):
    find_spec = lambda name: None if name == missing else importlib.machinery.PathFinder
    monkeypatch.setattr(importlib.util, "find_spec", find_spec)
    assert experiments.main(["benchmark", "--tables", "peers"]) == 2
    told = capsys.readouterr().err.strip()
    name = "rejax" if missing == "rejax" else "purejaxrl"
    assert told.startswith(f"error: {name} is not installed: ") and "\n" not in told
    assert "install" in told.partition("installed: ")[2]


# Brax's hopper takes a quarter of a minute to trace.
def test_ours_has_the_sizes_of_the_others():
    pytest.importorskip("gymnax")
    train, _ = peers._ours(peers.ENVS[0], 3 * 32 * 64)
    state, metrics = jax.eval_shape(train, jax.random.key(0))
    assert metrics["env_steps"].shape == (3,)
    assert state.environments.episode_length.shape == (32,)
    layers = jax.tree.leaves(state.actor_critic.policy.params)
    assert sum(x.shape == (64, 64) for x in layers) == 1


def test_the_last_tenth_counts_and_steps_without_an_end_do_not():
    nan = float("nan")
    returns = [[[9.0]] * 18 + [[nan, 2.0], [4.0, nan]]]
    padded = [[x if len(x) == 2 else [*x, nan] for x in seed] for seed in returns]
    assert peers._of_last_tenth(padded).tolist() == [3.0]

"""Every agent with discrete actions, and what a run of one leaves behind."""

import pathlib

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from corridor import LENGTH
from gymnasium.utils.env_checker import check_env

import gasil_jax
from gasil_envs.gymnasium_adapter import GymnasiumEnv, GymnasiumVectorEnv
from gasil_envs.gymnax_adapter import GymnaxEnv
from gasil_jax import (
    evaluate,
    evaluation,
    normalization,
    render,
    run,
)
from gasil_jax.host import saved
from gasil_jax.networks import Discriminator

SETTINGS = {"total_steps": 20 * 256, "num_envs": 8, "batch_steps": 256, "gamma": 0.9}
SETTINGS |= {"minibatch_size": 64, "num_epochs": 4, "hidden_sizes": (16,)}
SETTINGS |= {"learning_rate": 1e-2, "entropy_coefficient": 0.01}
DISCRIMINATOR = {"discriminator_updates": 20, "discriminator_learning_rate": 1e-2}
DISCRIMINATOR |= {"discriminator_hidden_sizes": (16,)}


@pytest.fixture(scope="module")
def expert(tmp_path_factory):
    """Pairs of a policy that always moves right, with numbers as actions."""
    path = tmp_path_factory.mktemp("expert") / "expert.npz"
    position = np.minimum(np.arange(20), LENGTH - 1)
    np.savez(path, observation=np.eye(LENGTH)[position], action=2 + 0 * position)
    return str(path)


# The others use nothing of an action that one of these does not. GAIL's discriminator
# is that of PPO+GASIL, which is trained below.
@pytest.mark.parametrize("agent", ["ppo+sil", "gail"])
def test_agents_learn(agent, expert):
    env = gasil_jax.make_env("corridor:Corridor")
    more = {**DISCRIMINATOR, "expert": expert} if agent == "gail" else {}
    algorithm = gasil_jax.algorithm(agent, **SETTINGS, **more)
    fitted = gasil_jax.fit(env, algorithm, seeds=2)
    states, metrics = fitted.states, fitted.metrics
    returns = np.nan_to_num(metrics["episode_return"], nan=-1.0)
    assert (returns[:, -3:].mean(axis=1) > returns[:, :2].mean(axis=1) + 3.0).all()
    # Evaluations take the most probable action.
    score = jax.vmap(
        lambda state: evaluation.evaluate(
            env, algorithm, state, key=jax.random.key(5), num_episodes=8
        )
    )(states)
    assert (score["episode_return"] > 17.0).all()
    assert (metrics["entropy"] <= np.log(3) + 1e-5).all()
    assert (metrics["entropy"][:, -1] < metrics["entropy"][:, 0]).all()


FLAGS = (
    *("--env", "corridor:Corridor", "--agent", "ppo+gasil", "--num-envs", "8"),
    *("--batch-steps", "256", "--minibatch-size", "64", "--hidden-sizes", "16"),
    *("--num-epochs", "2", "--buffer-steps", "200", "--reward-delay", "5"),
    *("--obs-noise", "0.1", "--discriminator-hidden-sizes", "16"),
)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A run with delayed rewards and noise."""
    out = str(tmp_path_factory.mktemp("discrete") / "run")
    more = ("--seeds", "2", "--initial-std", "0.5")
    assert run.main([*FLAGS, *more, "--total-steps", "1024", "--out", out]) == 0
    return out


def test_a_run_from_end_to_end(finished, tmp_path, capsys):
    # Finished, it is not trained again.
    assert run.main(["--resume", "--out", finished]) == 0
    said = capsys.readouterr()
    assert "gasil_jax.render" in said.out
    assert evaluate.main([finished, "--episodes", "4", "--stochastic"]) == 0
    film = tmp_path / "film.png"
    assert render.main([finished, "--out", str(film), "--width", "80"]) == 0
    assert film.stat().st_size


def test_the_discriminators_reward_is_that_of_its_formula(finished):
    reward = gasil_jax.load_reward(finished, 1)
    _, algorithm, seeds, states = saved.load(pathlib.Path(finished))
    state = gasil_jax.member(states, seeds.index(1))
    observation = np.tile(np.eye(LENGTH, dtype=np.float32), (3, 1))
    action = np.repeat(np.arange(3), LENGTH)
    network = Discriminator(algorithm.agent.discriminator_hidden_sizes)
    logit = jax.jit(
        lambda state: network.apply(
            state.agent.discriminator.params,
            normalization.normalize(state.normalizer, observation),
            np.eye(3, dtype=np.float32)[action],
        )
    )(state)
    expected = -np.log(1 / (1 + np.exp(-np.asarray(logit, np.float64))))
    np.testing.assert_allclose(reward(observation, action), expected, rtol=1e-4)
    one = jax.jit(jax.vmap(reward))(observation, action)
    np.testing.assert_allclose(one, expected, rtol=1e-4)
    with pytest.raises(ValueError, match=r"observation has shape \(3,\): it must be"):
        reward(np.zeros(3), 1)
    with pytest.raises(ValueError, match="seed is 7: the run has 0, 1"):
        gasil_jax.load_reward(finished, 7)


def test_other_libraries_see_a_discrete_space():
    gym = GymnasiumEnv("corridor:Corridor")
    assert gym.action_space == gymnasium.spaces.Discrete(3)
    check_env(gym, skip_render_check=True)
    gym.reset(seed=0)
    assert gym.step(2)[1] == gym.step(np.int64(1))[1] > 0
    for action in (3, 0.5, -1):
        with pytest.raises(ValueError, match=r"it must be in Discrete\(3\)"):
            gym.step(action)
    batch = GymnasiumVectorEnv("corridor:Corridor", 4)
    batch.reset(seed=0)
    assert batch.action_space == gymnasium.spaces.MultiDiscrete([3] * 4)
    assert (batch.step(np.array([2, 2, 2, 2]))[1] > 0).all()
    gymnax = GymnaxEnv("corridor:Corridor")
    assert gymnax.num_actions == 3
    _, state = gymnax.reset(jax.random.key(0), gymnax.default_params)
    _, _, reward, *_ = gymnax.step(jax.random.key(1), state, jnp.int32(2))
    assert reward > 0

"""Presets are valid, hold the search's results, and are overridden by flags."""

import pathlib

import gymnasium
import mujoco
import numpy as np
import pytest

import gasil_envs
import gasil_jax
from gasil_envs import locomotion
from gasil_jax import algorithms, presets
from gasil_jax.cli import options

ONE = "ppo+gasil+novelty"
TASKS = ("hopper", "walker2d", "halfcheetah", "swimmer", "ant", "humanoid")


def parse(*arguments):
    return options.read(options.Options, ["--env", *arguments], "x")[1].algorithm


@pytest.mark.parametrize("name", presets.names())
@pytest.mark.parametrize("reward_delay", [1, 20])
def test_every_row_is_valid_and_of_something_that_exists(name, reward_delay):
    rows = presets.PRESETS[name][reward_delay > 1]
    for (env, agent), overrides in rows.items():
        assert env in gasil_envs.names() and agent in gasil_jax.agents.AGENTS
        algorithm = gasil_jax.preset(env, agent, name, reward_delay=reward_delay)
        algorithms.check(algorithm)
        assert overrides and algorithm != gasil_jax.algorithm(agent)


@pytest.mark.parametrize("env", TASKS)
def test_scaled_rows_follow_the_number_of_actions(env):
    # An environment would take seconds to build.
    assets = pathlib.Path(gymnasium.__file__).parent / "envs/mujoco/assets"
    actions = mujoco.MjModel.from_xml_path(str(assets / locomotion.TASKS[env].xml)).nu
    # Straight lines from two dimensions to eight; more have the values of eight.
    ends = {"learning_rate": (7.5e-4, 1e-4), "initial_std": (0.7, 0.25)}
    ends |= {"gae_lambda": (0.975, 0.9)}
    for delay in (1, 20):
        row = gasil_jax.preset(env, "ppo", "scaled", reward_delay=delay)
        for name, values in ends.items():
            expected = np.interp(actions, (2, 8), values)
            assert row.settings[name] == pytest.approx(expected)
        assert row.settings["decompose_rewards"] == (delay > 1)
        sized = gasil_jax.preset(
            "brax:reacher", "ppo", "scaled", reward_delay=delay, action_size=actions
        )
        assert sized == row


@pytest.mark.parametrize(
    ("agent", "name"), [(x, "scaled") for x in presets.RULED] + [(ONE, "tuned")]
)
def test_an_environment_of_ones_own_is_scaled_by_its_actions(agent, name):
    row = gasil_jax.preset("my:env", agent, name, action_size=2)
    # It has two, and fewer have the values of two, as discrete actions do.
    words = ("--agent", agent, "--preset", name)
    assert parse("point_mass", *words) == row
    assert parse("sparse:key_grid", *words) == row
    assert gasil_jax.preset("my:env", agent, name, action_size=1) == row
    expected = {**presets.scaled(2, decompose_rewards=False)}
    if agent == ONE:
        expected["entropy_coefficient"] = 0.01
    assert row == gasil_jax.algorithm(agent, **expected)
    with pytest.raises(ValueError, match="needs the dimension of my:env's actions"):
        gasil_jax.preset("my:env", agent, name)


def test_the_command_line_starts_from_the_preset():
    assert parse("point_mass", "--agent", "gasil") == gasil_jax.preset(
        "point_mass", "gasil"
    )
    without_row = parse("point_mass", "--agent", "ppo+novelty")
    assert without_row == gasil_jax.algorithm("ppo+novelty")
    delayed = parse("walker2d", "--reward-delay", "20")
    assert delayed == gasil_jax.preset("walker2d", "ppo+gasil", reward_delay=20)
    assert delayed != parse("walker2d")
    assert delayed == parse("walker2d", "--reward_delay=20")


def test_the_papers_batch_is_of_one_environment():
    config = parse("walker2d", "--preset", "paper").config
    assert (config.num_envs, config.num_steps) == (1, 2048)
    assert not config.stagger_episodes
    more = parse("walker2d", "--preset", "paper", "--num-envs", "8")
    assert more.config.num_envs == 8

"""Presets: valid, used by default, and overridden by flags."""

import pytest

import gasil_envs
import gasil_jax
from gasil_jax import presets, run
from gasil_jax.config import Config, validate


def parse(*arguments):
    return run.parse(run.Options, ["--env", *arguments], "x").config


@pytest.mark.parametrize("name", presets.names())
def test_every_row_is_valid_and_of_something_that_exists(name):
    for (env, agent), overrides in presets.PRESETS[name].items():
        assert env in gasil_envs.names() and agent in gasil_jax.agents()
        config = gasil_jax.preset(env, agent, name)
        validate(config, gasil_jax.agents())
        assert overrides and config != Config(agent=agent)


def test_the_command_line_starts_from_the_preset():
    assert parse("point_mass", "--agent", "gasil") == gasil_jax.preset(
        "point_mass", "gasil"
    )
    assert parse("walker2d", "--agent", "ppo") == Config(agent="ppo")


def test_flags_override_the_preset():
    config = parse("point_mass", "--agent", "gasil", "--alpha", "0.3")
    assert config.hyperparameters.alpha == 0.3
    assert config.discriminator_updates == 20


def test_the_papers_rule_for_humanoid():
    config = parse("humanoid", "--agent", "ppo+gasil", "--preset", "paper")
    assert config.hyperparameters.alpha == 0.02
    assert config.alpha_schedule == ((2e6, 0.0), (3e6, 1.0))


def test_an_unknown_preset_is_refused(capsys):
    assert run.main(["--env", "hopper", "--preset", "papre"]) == 2
    assert "did you mean 'paper'" in capsys.readouterr().err

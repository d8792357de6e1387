"""Agents of one's own, given as MODULE:NAME, and the numbers that they declare."""

import json
import re

import numpy as np
import pytest
from small_training import FLAGS

import gasil_jax
from gasil_jax import evaluate, merge, render, run, sweep
from gasil_jax.config import Hyperparameters, validate

MODULE = '''
import sys

import jax.numpy as jnp

import gasil_jax
from gasil_jax.config import number
from gasil_jax.imitation.interface import Imitation, leave_policy
from gasil_jax.imitation.none import no_state


class Own(gasil_jax.Hyperparameters):
    my_weight: float = number(0.5, 0.0, 1.0)
    """Share of the reward."""


class Taken(gasil_jax.Hyperparameters):
    alpha: float = number(0.5, 0.0, 1.0)


class Column(gasil_jax.Hyperparameters):
    diverged: float = number(0.5, 0.0, 1.0)


class AnOption(gasil_jax.Hyperparameters):
    seeds: float = number(0.5, 0.0, 1.0)


class Bare(gasil_jax.Hyperparameters):
    bare: float = 0.5


def reward(state, context, key):
    return state, context.hyperparameters.my_weight * context.rollout.reward, {
        "my_weight": context.hyperparameters.my_weight
    }


def rewards(state, context, key):
    return state, context.rollout.reward, {"my_rewards": context.rollout.reward}


def unfinished(state, context, key):
    return state, context.nothing, {}


def start(key, config, observation_size, action_size):
    return {"count": jnp.float32(0)}


def grows(state, context, key):
    return {"count": jnp.zeros(3)}, context.rollout.reward, {}


def exits(state, context, key):
    sys.exit()


def interrupts(state, context, key):
    raise KeyboardInterrupt


def refuses(config, observation_size, action_size):
    sys.exit(7)


def is_wrong(config, observation_size, action_size):
    return config.alhpa


def shrinks(state, context, key):
    return {"count": state["count"].sum()}, context.rollout.reward, {}


def forgets(state, policy, context, key):
    return state, (), {}


OWN = Imitation(no_state, reward, leave_policy, fields=(), hyperparameters=Own)
TAKEN = OWN._replace(hyperparameters=Taken)
COLUMN = OWN._replace(hyperparameters=Column)
AN_OPTION = OWN._replace(hyperparameters=AnOption)
BARE = OWN._replace(hyperparameters=Bare)
MISSPELT = OWN._replace(fields=("alhpa",))
MANY = OWN._replace(update_and_reward=rewards)
UNFINISHED = OWN._replace(update_and_reward=unfinished)
GROWS = OWN._replace(init=start, update_and_reward=grows)
SHRINKS = OWN._replace(
    init=lambda *_: {"count": jnp.zeros(3)}, update_and_reward=shrinks
)
EXITS = OWN._replace(update_and_reward=exits)
INTERRUPTS = OWN._replace(update_and_reward=interrupts)
REFUSES = OWN._replace(check=refuses)
IS_WRONG = OWN._replace(check=is_wrong)
TURNS = OWN._replace(
    init=lambda *_: {"count": jnp.int32(0)},
    update_and_reward=lambda state, context, key: (
        {"count": state["count"] + 0.5}, context.rollout.reward, {}
    ),
)
FORGETS = OWN._replace(update_policy=forgets)
SILENT = OWN._replace(update_policy=lambda state, policy, *_: (state, policy, None))
NO_CLASS = OWN._replace(hyperparameters={"my_weight": 0.5})
TWO = OWN._replace(update_and_reward=lambda state, context, key: (state, {}))
FOUR = OWN._replace(update_policy=lambda state, policy, *_: (state, policy, {}, {}))
ONE = OWN._replace(mix=lambda state, advantages, context: advantages[..., 0])
SUMMED = OWN._replace(
    update_and_reward=lambda state, context, key: (
        state, context.rollout.reward.sum(axis=0), {}
    )
)
UNMIXED = OWN._replace(mix=lambda state, advantages, context: (advantages, {}))
STREAMS = OWN._replace(num_streams=2)
NAMED = OWN._replace(
    mix=lambda state, advantages, context: (
        advantages[..., 0], {"explained_variance": 0.5}
    )
)
'''
SMALL = (*FLAGS, "--agent", "my_agents:OWN", "--devices", "1")


@pytest.fixture(autouse=True)
def my_agents(tmp_path, monkeypatch):
    (tmp_path / "my_agents.py").write_text(MODULE)
    (tmp_path / "leaves.py").write_text("raise SystemExit(3)")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)


def column(path, name):
    header, *rows = [line.split(",") for line in path.read_text().splitlines()]
    return {float(row[header.index(name)]) for row in rows}


def test_every_command_takes_it(tmp_path, capsys):
    out = tmp_path / "run"
    assert run.main([*SMALL, "--my-weight", "0.25", "--out", str(out)]) == 0
    assert column(out / "metrics.csv", "my_weight") == {0.25}
    config = json.loads((out / "config.json").read_text())["config"]
    assert config["hyperparameters"]["my_weight"] == 0.25
    again = ["--env", "point_mass", "--out", str(out), "--resume"]
    assert run.main([*again, "--total-steps", "384"]) == 0
    assert column(out / "metrics.csv", "my_weight") == {0.25}
    assert run.main([*again, "--my-weight", "0.3"]) == 2
    assert "my_weight was 0.25, is 0.3" in capsys.readouterr().err
    assert evaluate.main([str(out), "--episodes", "1"]) == 0
    picture = str(tmp_path / "x.png")
    assert render.main([str(out), "--out", picture, "--steps", "5"]) == 0

    grid = [*SMALL, "--grid", "my_weight=0.1,0.3"]
    for part in ("1/2", "2/2"):
        assert sweep.main([*grid, "--shard", part, "--out", "parts"]) == 0
    assert merge.main(["parts"]) == 0
    assert column(tmp_path / "parts" / "results.csv", "my_weight") == {0.1, 0.3}
    (tmp_path / "points.json").write_text('[{"my_weight": 0.2}, {"gamma": 0.9}]')
    options = sweep.run_options.parse(
        sweep.Options, [*SMALL, "--points-file", "points.json"], "gasil_jax.sweep"
    )
    _, (program,) = sweep.plan(options)
    assert [x.my_weight for x in program.hyperparameters] == [0.2, 0.5]


@pytest.mark.parametrize(
    ("agent", "why"),
    [
        ("nowhere:OWN", "'nowhere:OWN' can't be imported: No module named 'nowhere'"),
        ("my_agents:NO", "can't be imported: module 'my_agents' has no attribute 'NO'"),
        ("my_agents:reward", "is of type function: it must be an Imitation"),
        ("my_agents:TAKEN", "'alpha', a name that is taken"),
        ("my_agents:AN_OPTION", "'seeds', a name that is taken by an option"),
        ("my_agents:COLUMN", "'diverged', a name that is taken"),
        ("my_agents:BARE", "'bare' without a range: .* gasil_jax.config.number"),
        ("my_agents:MISSPELT", "says that it uses 'alhpa': it must be the name"),
        ("my_agents:NO_CLASS", "{'my_weight': 0.5}: they must be a class"),
        ("my_agents:MANY", "'my_rewards' .* has shape .*: it must be one number"),
        ("my_agents:TWO", "reward .* returns 2 values: .* 3, state, rewards, metrics"),
        ("my_agents:FOUR", "update_policy .* returns 4 values: .* 3, state, actor_"),
        ("my_agents:ONE", "mix of agent .* returns 1 value: .* 2, advantage, metrics"),
        ("my_agents:SUMMED", r"returns rewards of shape \(4,\): it must be \(32, 4\)"),
        ("my_agents:UNMIXED", r"mix .* advantage of shape \(32, 4, 1\): .* \(32, 4\)"),
        ("my_agents:STREAMS", "has 2 reward streams: it must have a function mix that"),
        ("my_agents:NAMED", "names that other metrics have: explained_variance"),
        (
            "my_agents:UNFINISHED",
            r"can't be traced: AttributeError: .*my_agents.py, li",
        ),
        (
            "my_agents:GROWS",
            r"update_and_reward .*\['count'\] is float32\[3\]: .* float32\[\], as",
        ),
        ("my_agents:SHRINKS", r"state\['count'\] is float32\[\]: .* float32\[3\], as"),
        ("my_agents:TURNS", r"state\['count'\] is float32\[\]: .* int32\[\], as"),
        ("my_agents:FORGETS", r"update_policy of .* returned actor_critic.* missing:"),
        ("my_agents:SILENT", "update_policy .* returns metrics None: .* be a dict"),
        ("my_agents:EXITS", r"EXITS' can't be traced: SystemExit \(.*my_agents"),
        ("my_agents:INTERRUPTS", r"be traced: KeyboardInterrupt \(.*my_agents"),
        ("my_agents:REFUSES", "check of agent .* fails: SystemExit: 7"),
        ("my_agents:IS_WRONG", "check of agent .* fails: AttributeError: .*alhpa"),
        ("leaves:OWN", "'leaves:OWN' can't be imported: SystemExit: 3"),
        ("my_agents", "'my_agents' is unknown: it must be .*, gail, MODULE:NAME$"),
    ],
)
def test_what_is_no_agent_is_refused_in_a_line(tmp_path, capsys, agent, why):
    # JAX has been started by other tests, so that --devices would be told of.
    assert run.main([*SMALL[:-2], "--agent", agent, "--out", "run"]) == 2
    # On a slow machine a line says first that the program is traced.
    *others, error = capsys.readouterr().err.splitlines()
    assert error.startswith("error: ") and re.search(why, error), error
    assert all(line.startswith("point_mass: ") for line in others), others
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("program", "arguments", "why"),
    [
        (run, "--my-weight 2", "my_weight is 2.0: it must be 0 or more and at most 1"),
        (run, "--my-weight much", "my_weight is 'much': it must be a number"),
        (run, "--my-wieght 0.2", "--my-weight"),
        (run, "--agent ppo --my-weight 0.2", "option --my-weight is unknown"),
        (sweep, "--grid my_weight=0.1,2", "my_weight is 2.0: it must be 0 or more"),
        (sweep, "--grid my_wieght=0.1", "did you mean 'my_weight'?"),
        (sweep, "--agent ppo --grid my_weight=0.1", "'my_weight' can't vary"),
        (sweep, "--grid alpha=0.1", "agent 'my_agents:OWN' does not use it"),
    ],
)
def test_its_numbers_are_checked(tmp_path, capsys, program, arguments, why):
    assert program.main([*SMALL, *arguments.split(), "--out", "run"]) == 2
    captured = capsys.readouterr()
    assert why in captured.err and captured.err.count("\n") == 1, captured.err
    assert not (tmp_path / "run").exists()


def test_a_run_without_its_module_says_so(tmp_path, capsys, monkeypatch):
    from gasil_jax.host import run_folder

    config = gasil_jax.Config(agent="my_agents:OWN")
    described = {"env": "point_mass", "seeds": 1, "first_seed": 0, "settings": {}}
    text = json.dumps(described | {"config": {"agent": "gone:OWN"}})
    (tmp_path / "config.json").write_text(text)
    assert evaluate.main([str(tmp_path)]) == 2
    message = "error: agent 'gone:OWN' can't be imported: No module named 'gone'\n"
    assert capsys.readouterr().err == message
    run_folder.write_description(tmp_path, described | {"config": config})
    assert run_folder.read(tmp_path)["config"] == config


def test_a_config_has_the_numbers_of_its_agent():
    config = gasil_jax.Config(agent="my_agents:OWN")
    assert config.hyperparameters.my_weight == 0.5
    changed = config.replace(my_weight=0.1, gamma=0.9)
    assert changed.hyperparameters.my_weight == 0.1
    assert {config, changed, config.replace(my_weight=0.1, gamma=0.9)} == {
        config,
        changed,
    }
    validate(changed)
    assert gasil_jax.preset("hopper", "my_agents:OWN").hyperparameters.my_weight == 0.5
    # Those of another agent are dropped, the others kept.
    other = changed.replace(agent="ppo").hyperparameters
    assert type(other) is Hyperparameters and other.gamma == 0.9
    back = gasil_jax.Config(agent="my_agents:OWN", hyperparameters=other)
    assert back.hyperparameters.my_weight == 0.5
    with pytest.raises(ValueError, match=r"'my_wieght'.*did you mean 'my_weight'"):
        config.replace(my_wieght=0.1)
    with pytest.raises(ValueError, match="my_weight is -1"):
        validate(config.replace(my_weight=-1))
    with pytest.raises(ValueError, match="can't be imported"):
        validate(gasil_jax.Config(agent="my_agents:NO"))
    with pytest.raises(ValueError, match="can't be imported"):
        gasil_jax.Config(agent="my_agents:NO").replace(my_weight=0.1)


def test_numbers_that_are_not_given_have_their_defaults():
    import jax

    config = gasil_jax.Config(
        agent="my_agents:OWN", batch_steps=64, num_envs=4, hidden_sizes=(4,)
    )
    env, key = gasil_jax.make_env("point_mass"), jax.random.key(0)
    state = gasil_jax.init(env, config, key, Hyperparameters(gamma=0.9))
    np.testing.assert_allclose(state.hyperparameters.my_weight, 0.5)
    np.testing.assert_allclose(state.hyperparameters.gamma, 0.9)

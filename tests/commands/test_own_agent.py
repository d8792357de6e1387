"""Agents of one's own, given as MODULE:CLASS, and the numbers that they declare."""

import dataclasses
import importlib
import json
import re

import pytest
from refusals import refused, rows
from small_training import FLAGS

import gasil_jax
from gasil_jax import algorithms, evaluate, render, run, sweep
from gasil_jax.cli import options
from gasil_jax.host.sweep import Sweep
from gasil_jax.host.sweep import read as read_sweep

MODULE = """
import sys

import jax.numpy as jnp

import gasil_jax
from gasil_jax.config import number, schedule


class Own(gasil_jax.Agent):
    \"\"\"PPO on a share of the reward.

    Attributes:
      my_weight: share of the reward.
    \"\"\"

    my_weight: float = number(0.5, 0.0, 1.0)

    def update_and_reward(self, state, context, key):
        reward = self.my_weight * context.rollout.reward
        return state, reward, {"my_weight": self.my_weight}


class Derived(gasil_jax.PPOBC):
    my_bonus: float = number(0.5, 0.0)

    def update_and_reward(self, state, context, key):
        state, reward, metrics = super().update_and_reward(state, context, key)
        return state, reward + self.my_bonus, metrics


class Counts(Own):
    def init(self, key, sizes):
        return {"count": jnp.int32(0)}


INSTANCE = Own()
"""
#: What stands for parts of the definitions below.
SHORT = {
    "REWARD": "def update_and_reward(self, state, context, key): return",
    "POLICY": "def update_policy(self, state, actor_critic, context, key): return",
    "MIX": "def mix(self, state, advantages, context): return",
    "ONE": "float = number(0.5, 0.0, 1.0)",
    "PAID": "context.rollout.reward",
    "UPDATE": "def update(self, state, context, key): return",
    "Agent": "gasil_jax.Agent",
}


def in_full(lines):
    return re.sub("|".join(SHORT), lambda found: SHORT[found.group()], lines)


#: What agents are derived from, what they define, and why they are refused.
WRONG = rows(
    r"""
Own | name = "mine" | calls itself 'mine': name the module
Agent | gamma: ONE | 'gamma', a name that is taken
Agent | seeds: ONE | 'seeds', a name that is taken by an option
Agent | bare: float = 0.5 | 'bare' has no range: .*config.number
Agent | my_weight: float = number(2.0, 0.0, 1.0) | my_weight is 2.0: it must be 0 or m
Own | def __post_init__(self): raise RuntimeError('not') | RuntimeError: not \(.*my_
Own | REWARD state, PAID, {'my': PAID} | 'my' .* has shape .*: it must be one number
Own | REWARD (state, {}) | reward .* returns 2 values: .* 3, state, rewards, metrics
Own | POLICY state, actor_critic, {}, {} | update_policy .* returns 4 values: .* 3, sta
Own | REWARD state, PAID.sum(axis=0), {} | rewards is float32\[4\]: .*32\[32, 4\]
Own | num_streams = 2 | has 2 reward streams: it must have a function mix that
Own | MIX (advantages[..., 0], {'value_loss': 0.5}) | 'value_loss' .* of another metric
Counts | REWARD {'count': jnp.zeros(3, int)}, PAID, {} | 'count'\] is int32\[3\]: .*int
Counts | def remember(self, state, context): pass | state\['count'\] is missing: .*int
Own | REWARD sys.exit() | can't be traced: SystemExit \(.*my_agents
Own | def check(self, sizes): sys.exit(7) | check of agent .* fails: SystemExit: 7
"""
)
for number, (base, definition, _) in enumerate(WRONG):
    MODULE += in_full(f"\n\nclass Wrong{number}({base}):\n    {definition}\n")
#: Other names of agents, and why they are refused.
NAMES = """
nowhere:Own | 'nowhere:Own' can't be imported: No module named 'nowhere'
my_agents:No | can't be imported: module 'my_agents' has no attribute 'No'
my_agents:INSTANCE | is of type Own: it must be a class that is derived
leaves:Own | 'leaves:Own' can't be imported: SystemExit: 3
my_agents | 'my_agents' is unknown: it must be .*, gail, MODULE:CLASS$
"""
SMALL = (*FLAGS, "--agent", "my_agents:Own")
# Pictures are drawn, and not written, which takes long.
pytestmark = pytest.mark.usefixtures("figures")


@pytest.fixture(autouse=True)
def my_agents(tmp_path, monkeypatch):
    (tmp_path / "my_agents.py").write_text(MODULE)
    (tmp_path / "leaves.py").write_text("raise SystemExit(3)")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    return importlib.import_module("my_agents")


def column(path, name):
    header, *rows = [line.split(",") for line in path.read_text().splitlines()]
    return {float(row[header.index(name)]) for row in rows}


def metrics(folder):
    (path,) = folder.glob("programs/*/metrics.csv")
    return path


def test_every_command_takes_it(tmp_path, capsys):
    """Also one that is derived from another agent, with the numbers of both."""
    out = tmp_path / "run"
    derived = (*FLAGS, "--agent", "my_agents:Derived", "--no-stagger-episodes")
    own = ("--my-bonus", "0.25", "--buffer-episodes", "3", "--buffer-steps", "70")
    assert run.main([*derived, *own, "--out", str(out)]) == 0
    described = json.loads((out / "config.json").read_text())["algorithm"]
    expected = {"agent": "my_agents:Derived", "my_bonus": 0.25, "buffer_episodes": 3}
    assert described == described | expected | {"buffer_steps": 70}
    assert column(metrics(out), "good_steps") == {0, 70}
    again = ["--out", out, "--resume"]
    told = refused(capsys, run, *again, "--my-bonus", "0.3")
    assert "my_bonus was 0.25, is 0.3" in told
    assert evaluate.main([str(out), "--episodes", "1"]) == 0
    picture = str(tmp_path / "x.png")
    assert render.main([str(out), "--out", picture, "--steps", "5"]) == 0

    grid = [*SMALL, "--grid", "my_weight=0.1,0.3"]
    for part in ("1/2", "2/2"):
        assert sweep.main([*grid, "--shard", part, "--out", "parts"]) == 0
    results = tmp_path / "parts" / "results.csv"
    table = next((tmp_path / "parts").glob("programs/*/metrics.csv"))
    assert column(results, "my_weight") == {0.1, 0.3} > column(table, "my_weight")
    (tmp_path / "points.json").write_text('[{"my_weight": 0.2}, {"gamma": 0.9}]')
    words = [*SMALL, "--points-file", "points.json"]
    _, requested = options.read(options.SweepOptions, words, "x")
    (program,) = requested.unfinished(tmp_path)
    assert [x["my_weight"] for x in program.hyperparameters] == [0.2, 0.5]


def test_the_help_explains_its_settings(capsys):
    with pytest.raises(SystemExit):
        run.main(["--help", "--agent", "my_agents:Own"])
    assert re.search(
        r"--my-weight NUMBER\W+share of the reward", capsys.readouterr().out
    )


@pytest.mark.parametrize(
    ("agent", "why"),
    [
        *((f"my_agents:Wrong{i}", why) for i, (*_, why) in enumerate(WRONG)),
        *rows(NAMES),
    ],
)
def test_what_is_no_agent_is_refused_in_a_line(tmp_path, capsys, agent, why):
    told = refused(capsys, run, *SMALL, "--agent", agent, "--out", "run")
    assert re.search(why, told), told
    assert not (tmp_path / "run").exists()


#: Words of `run`, or of `sweep` with a grid.
NUMBERS = """
--my-weight 2 | my_weight is 2.0: it must be 0 or more and at most 1
--grid my_weight=0.1,2 | my_weight is 2.0: it must be 0 or more
--grid my_wieght=0.1 | did you mean 'my_weight'?
--agent ppo --grid my_weight=0.1 | 'my_weight' can't vary
--grid alpha=0.1 | alpha is a setting of gasil, ppo+gasil, ppo+gasil+novelty
"""


@pytest.mark.parametrize(("words", "why"), rows(NUMBERS))
def test_its_numbers_are_checked(tmp_path, capsys, words, why):
    program = sweep if "--grid" in words else run
    assert why in refused(capsys, program, *SMALL, *words.split(), "--out", "run")
    assert not (tmp_path / "run").exists()


def test_a_run_without_its_module_says_so(my_agents, tmp_path, capsys):
    algorithm = gasil_jax.Algorithm(my_agents.Own(my_weight=0.25))
    Sweep("point_mass", algorithm, (0,)).write(tmp_path)
    assert read_sweep(tmp_path).algorithm == algorithm
    path = tmp_path / "config.json"
    path.write_text(path.read_text().replace("my_agents:Own", "gone:Own"))
    assert evaluate.main([str(tmp_path)]) == 2
    told, error = capsys.readouterr().err.splitlines()
    assert told.startswith("note: ") and told.endswith(" imported now: gone")
    assert error == "error: agent 'gone:Own' can't be imported: No module named 'gone'"


def test_an_algorithm_has_the_numbers_of_its_agent(my_agents):
    algorithm = gasil_jax.Algorithm(my_agents.Own())
    assert algorithm.agent.my_weight == algorithm.hyperparameters["my_weight"] == 0.5
    changed = algorithm.replace(my_weight=0.1, gamma=0.9)
    assert changed.agent.my_weight == 0.1 and changed.config.gamma == 0.9
    assert {changed, algorithm.replace(my_weight=0.1, gamma=0.9)} == {changed}
    assert gasil_jax.preset("hopper", my_agents.Own).agent.my_weight == 0.5
    # With another agent it has the others.
    other = dataclasses.replace(changed, agent=gasil_jax.PPO())
    assert "my_weight" not in other.settings and other.settings["gamma"] == 0.9
    with pytest.raises(ValueError, match="my_weight is -1"):
        algorithms.check(algorithm.replace(my_weight=-1))


MODEL = """
import gasil_jax
from gasil_jax.config import number


class Signs(gasil_jax.RewardModel):
    factor: float = number(1.0, 0.0)

    def update(self, state, context, key):
        reward = self.factor * context.rollout.reward
        context = context.replace(rollout=context.rollout.replace(reward=reward))
        return state, context, True, {"my_factor": self.factor}
"""
#: What models of rewards define, and why they are refused.
WRONG_MODELS = rows(
    r"""
UPDATE state, context, {} | update .* 3 values: .*state, context, learned
UPDATE state, context.rollout, True, {} | returned context.rollout.* missing
UPDATE state, context, True, {'entropy': 0} | 'entropy' of a model of rew
def update(self, state, context): pass | traced: .*update\(\) takes 3 posi
seeds: ONE | 'seeds', a name that is taken by an option
"""
)
for number, (definition, _) in enumerate(WRONG_MODELS):
    MODEL += in_full(f"\n\nclass Wrong{number}(Signs):\n    {definition}\n")


@pytest.fixture
def my_models(my_agents, tmp_path, monkeypatch):
    (tmp_path / "my_models.py").write_text(MODEL)
    return importlib.import_module("my_models")


def test_a_model_of_rewards_is_taken_by_every_command(my_models, tmp_path, capsys):
    small = [*FLAGS, "--agent", "ppo", "--rewards", "my_models:Signs", "--devices", "1"]
    assert sweep.main([*small, "--grid", "factor=0.5,2", "--out", "out"]) == 0
    assert column(metrics(tmp_path / "out"), "my_factor") == {0.5, 2.0}
    stored = read_sweep(tmp_path / "out").algorithm
    assert stored.rewards == (my_models.Signs(), gasil_jax.Normalize())
    # Among others, the package's models have their own places.
    both = stored.replace(decompose_rewards=True)
    kinds = (my_models.Signs, gasil_jax.Decompose, gasil_jax.Normalize)
    assert tuple(map(type, both.rewards)) == kinds
    assert evaluate.main(["out", "--episodes", "1"]) == 0
    assert render.main(["out", "--out", "x.png", "--steps", "5"]) == 0
    again = ["--resume", "--out", "out", "--rewards", "my_models:Wrong0"]
    told = refused(capsys, run, *again)
    assert "rewards was ('my_models:Signs',), is ('my_mod" in told


@pytest.mark.parametrize(
    ("model", "why"),
    [
        *((f"my_models:Wrong{i}", why) for i, (_, why) in enumerate(WRONG_MODELS)),
        ("my_models", "rewards is 'my_models': it must be MODULE:CLASS"),
        ("gasil_jax:Agent", "derived from gasil_jax.RewardModel"),
        ("gasil_jax.rewards.normalization:Normalize", "use normalize_rewards instead"),
    ],
)
def test_what_is_no_model_is_refused_in_a_line(my_models, capsys, model, why):
    words = ("--agent", "ppo", "--rewards", model, "--out", "x")
    told = refused(capsys, run, *FLAGS, *words)
    assert re.search(why, told), told

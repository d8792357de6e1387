"""The examples of the documentation run, made small."""

import functools
import json
import pathlib
import re
import runpy
import sys

import matplotlib.pyplot as plt
import numpy as np
import pytest

import gasil_jax
from gasil_jax.host import policy_file
from gasil_jax.sweeps import saved_states

SMALL = {"num_epochs": 1, "hidden_sizes": (8,)}
EXAMPLES = pathlib.Path(__file__).parent.parent / "docs" / "examples"


@pytest.fixture
def run_script(monkeypatch, capsys):
    """Run a script with arguments; return what it prints."""
    plt.switch_backend("Agg")

    def run(name, *arguments):
        monkeypatch.setattr(sys, "argv", [name, *map(str, arguments)])
        runpy.run_path(str(EXAMPLES / name), run_name="__main__")
        return capsys.readouterr().out

    yield run
    plt.close("all")


@pytest.fixture
def small(monkeypatch):
    """Let examples train with less."""

    def smaller(original):
        def make(*names, **settings):
            return original(*names, **settings).replace(**SMALL)

        return make

    for name in ("preset", "algorithm"):
        monkeypatch.setattr(gasil_jax, name, smaller(getattr(gasil_jax, name)))
    config = functools.partial(gasil_jax.Config, **SMALL)
    monkeypatch.setattr(gasil_jax, "Config", config)


def numbers(text):
    return [float(number) for number in re.findall(r"-?\d+\.\d+", text)]


def test_all_are_listed():
    text = (EXAMPLES / "index.md").read_text()
    for path in EXAMPLES.iterdir():
        if path.suffix == ".py":
            assert f'--8<-- "docs/examples/{path.name}"' in text, path
        if path.suffix in (".py", ".ipynb"):
            assert f"]({path.name})" in text, path


def test_alpha_is_swept_and_plotted(run_script, small, tmp_path):
    out = tmp_path / "alpha.png"
    options = ("--steps", 2048, "--seeds", 2, "--out", out)
    printed = run_script("sweep_alpha.py", *options)
    assert re.findall(r"alpha (\S+):", printed) == ["0", "0.1", "0.3", "1"]
    assert np.isfinite(numbers(printed)).all()
    assert plt.imread(out).std() > 0.01


def test_an_environment_of_ones_own_trains(run_script, small, monkeypatch):
    printed = run_script("own_environment.py", "--steps", 4096)
    assert re.findall(r"^(\S+): return", printed, re.MULTILINE) == ["ppo", "ppo+gasil"]
    # A step's reward is between 0 and 1, and nearly 0 while the pendulum hangs.
    assert all(0 < number < 200 for number in numbers(printed))
    monkeypatch.syspath_prepend(EXAMPLES)
    assert gasil_jax.make_env("own_environment:Pendulum").observation_size == 3


def test_an_agent_of_ones_own_trains(run_script, small, monkeypatch):
    monkeypatch.syspath_prepend(EXAMPLES)  # as a script's own folder is
    printed = run_script("own_agent.py", "--steps", 4096)
    agents = re.findall(r"^(\S+): return", printed, re.MULTILINE)
    assert agents == ["PPO", "Nearest"]
    without, with_bonus = numbers(printed)
    assert np.isfinite(without) and with_bonus != without


def test_a_policy_plays_in_gymnasium(run_script, untrained_hopper, tmp_path):
    env, _, _, states = saved_states.load(untrained_hopper)
    policy_file.save(tmp_path / "policy.npz", states, env, [0], np.zeros(1))
    arguments = (tmp_path, "Hopper-v5", "--episodes", "2")
    lines = run_script("gymnasium_rollout.py", *arguments).splitlines()
    assert [line.split(":")[0] for line in lines] == ["episode 0", "episode 1"]


def test_the_notebook_tells_its_story(monkeypatch, capsys):
    monkeypatch.setenv("EXAMPLE_SIZE", "0.01")
    preset = gasil_jax.preset
    monkeypatch.setattr(
        gasil_jax, "preset", lambda *names: preset(*names).replace(**SMALL)
    )
    plt.switch_backend("Agg")
    notebook = json.loads((EXAMPLES / "point_mass.ipynb").read_text())
    assert (notebook["nbformat"], notebook["nbformat_minor"]) == (4, 5)
    ids = [cell["id"] for cell in notebook["cells"]]
    assert len(set(ids)) == len(ids)
    names = {}
    for cell in notebook["cells"]:
        source = "".join(cell["source"])
        assert cell["metadata"] == {} and source
        if cell["cell_type"] == "code":
            exec(compile(source, cell["id"], "exec"), names)
    printed = capsys.readouterr().out
    assert re.findall(r"(\S+): final returns", printed) == ["ppo", "ppo+gasil"]
    # The layout, the returns, the policies and their good episodes.
    panels = [len(plt.figure(number).axes) for number in plt.get_fignums()]
    plt.close("all")
    assert panels == [1, 1, 8]
    for _, returns in names["trained"].values():
        assert returns.shape == (2, 2) and np.isfinite(returns).all()
    states, _ = names["trained"]["ppo+gasil"]
    assert (states[-1].agent.buffer.size > 0).all()

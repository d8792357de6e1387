"""The examples of the documentation run, made small."""

import functools
import json
import pathlib
import re
import runpy
import shutil
import sys

import matplotlib.pyplot as plt
import numpy as np
import pytest

import gasil_jax
from gasil_jax.agents import expert
from gasil_jax.host import checkpoint, policy_file, saved

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
    env, _, _, states = saved.load(untrained_hopper)
    policy_file.save(tmp_path / "policy.npz", states, env, [0], np.zeros(1))
    arguments = (tmp_path, "Hopper-v5", "--episodes", "2")
    lines = run_script("gymnasium_rollout.py", *arguments).splitlines()
    assert [line.split(":")[0] for line in lines] == ["episode 0", "episode 1"]


@pytest.mark.filterwarnings("ignore::UserWarning")  # on who made the data set
def test_good_trajectories_become_a_data_set(
    run_script, untrained_point_mass, tmp_path, monkeypatch
):
    minari = pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    out = shutil.copytree(untrained_point_mass, tmp_path / "run")
    *_, states = saved.load(out)
    # Four whole episodes and a fifth that may be cut fill the buffer.
    lengths, returns = (50, 50, 50, 40, 10), (9.0, 4.5, 3.0, 2.0, -1.0)
    buffer = states.agent.buffer
    assert sum(lengths) == buffer.return_.shape[1]
    rng = np.random.default_rng(0)
    filled = buffer.replace(
        observation=rng.normal(size=buffer.observation.shape).astype(np.float32),
        action=rng.normal(size=buffer.action.shape).astype(np.float32),
        return_=np.float32(np.repeat(returns, lengths))[None],
        time=np.concatenate([np.arange(x, dtype=np.int32) for x in lengths])[None],
        size=np.full_like(buffer.size, sum(lengths)),
    )
    states = states.replace(agent=states.agent.replace(buffer=filled))
    (root,) = out.glob("programs/*/checkpoints")
    record = checkpoint.Record(metrics_rows=0, evaluations_rows=0, score=1.0)
    checkpoint.write(root, 1, states, record)

    printed = run_script("export_minari.py", out, "mass/good-v0")
    assert printed == "4 episodes in mass/good-v0\n"
    episodes = [*minari.load_dataset("mass/good-v0").iterate_episodes()]
    assert [len(episode.actions) for episode in episodes] == [50, 50, 50, 40]
    seen = np.concatenate([episode.observations[:-1] for episode in episodes])
    np.testing.assert_array_equal(seen, filled.observation[0, :190])
    for episode, total in zip(episodes, returns):
        assert episode.rewards[-1] == total and not episode.rewards[:-1].any()
        assert episode.truncations[-1] and not episode.terminations.any()
    # An agent that imitates an expert can read it.
    observation, action = expert.load("minari:mass/good-v0")
    np.testing.assert_array_equal(observation, filled.observation[0, :190])
    np.testing.assert_array_equal(action, filled.action[0, :190])


def test_the_notebook_tells_its_story(monkeypatch, capsys):
    monkeypatch.setenv("EXAMPLE_SIZE", "0.01")
    preset = gasil_jax.preset
    monkeypatch.setattr(
        gasil_jax, "preset", lambda *names: preset(*names).replace(**SMALL)
    )
    plt.switch_backend("Agg")
    notebook = json.loads((EXAMPLES / "point_mass.ipynb").read_text())
    names = {}
    for cell in notebook["cells"]:
        if cell["cell_type"] == "code":
            exec(compile("".join(cell["source"]), cell["id"], "exec"), names)
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

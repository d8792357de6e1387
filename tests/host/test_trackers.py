"""Metrics in TensorBoard and Weights & Biases."""

import sys
import types

import numpy as np
import pytest
from PIL import Image
from refusals import refused
from small_training import FLAGS

from gasil_envs import pictures
from gasil_jax import run, sweep
from gasil_jax.errors import InputError
from gasil_jax.host import trackers

SMALL = (*FLAGS, "--agent", "ppo", "--seeds", "2", "--first-seed", "3")

METRICS = {
    "env_steps": np.array([[10, 20], [10, 20]]),
    "episode_return": np.array([[1.0, 2.0], [3.0, np.nan]]),
    "entropy": np.array([[np.nan, 1.0], [np.nan, 2.0]]),
}
MEMBERS = {"0-5": {"alpha": 0.1, "seed": 5}, "1-5": {"alpha": 0.2, "seed": 5}}


class Taken(list):
    """What a library was called with, by its own functions' names."""

    def __getattr__(self, name):
        return lambda *given, **named: self.append((name, *given, *named.items()))


def test_the_means_and_the_members_are_given_to_tensorboard(tmp_path, monkeypatch):
    tensorboard, taken = pytest.importorskip("tensorboardX"), Taken()
    monkeypatch.setattr(tensorboard, "SummaryWriter", lambda folder: taken)
    (tracker,) = trackers.make(
        ["tensorboard"], tmp_path, run_name="alpha", config={}, members=MEMBERS
    )
    trackers.log([tracker], METRICS)
    assert taken[1:] == [
        ("add_scalar", "mean/episode_return", 2.0, 10),
        ("add_scalar", "episode_return/0-5", 1.0, 10),
        ("add_scalar", "episode_return/1-5", 3.0, 10),
        ("add_scalar", "mean/episode_return", 2.0, 20),
        ("add_scalar", "episode_return/0-5", 2.0, 20),
        ("add_scalar", "mean/entropy", 1.5, 20),
    ]


def test_each_member_is_a_run_in_wandb(tmp_path, monkeypatch):
    """With its own numbers and metrics, in one group."""
    runs, wandb = {}, types.ModuleType("wandb")
    wandb.init = lambda **given: runs.setdefault(given["name"], (given, Taken()))[1]
    monkeypatch.setitem(sys.modules, "wandb", wandb)
    (tracker,) = trackers.make(
        ["wandb"], tmp_path, run_name="alpha", config={"alpha": 1.0}, members=MEMBERS
    )
    trackers.log([tracker], METRICS)
    wandb.Video = lambda path, format: (path, format)
    tracker.log_video(20, tmp_path / "00000020.gif")
    (first, logged), (second, _) = runs["alpha-0-5"], runs["alpha-1-5"]
    assert first["group"] == second["group"] == "alpha" and first["id"] != second["id"]
    assert second["config"] == {"alpha": 0.2, "seed": 5}
    assert logged == [
        ("log", {"episode_return": 1.0}, ("step", 10)),
        ("log", {"episode_return": 2.0, "entropy": 1.0}, ("step", 20)),
        ("log", {"video": (str(tmp_path / "00000020.gif"), "gif")}, ("step", 20)),
    ]


def test_a_run_in_tensorboard_with_films(tmp_path, monkeypatch, capsys, figures):
    pytest.importorskip("tensorboardX")
    out, plain = tmp_path / "out", tmp_path / "plain"
    small = (*SMALL, "--video-every", "100", "--max-episode-steps", "20")
    small += ("--no-stagger-episodes",)
    more = ("--log", "tensorboard", "--out", str(out))
    scored = ("--evaluate-every", "128", "--evaluate-episodes", "2")
    assert run.main([*small, *scored, *more]) == 0
    films = [*out.glob("programs/*/videos/*")]
    assert sorted(x.name for x in films) == ["00000128.gif", "00000256.gif"]
    assert all(Image.open(x).size == (320, 240) for x in films)

    # Without OpenGL training goes on, and films do not change its numbers.
    def painter(env, size):
        raise pictures.NoOpenGL("no OpenGL here")

    monkeypatch.setattr(pictures, "painter", painter)
    capsys.readouterr()
    assert run.main([*small, "--out", str(plain)]) == 0
    assert capsys.readouterr().err.count("warning: no videos are made: no OpenGL") == 1
    one, other = (next(x.glob("programs/*/metrics.csv")) for x in (out, plain))
    assert one.read_bytes() == other.read_bytes()
    (path,) = out.glob("programs/*/tensorboard/*")
    content = path.read_bytes()
    # Before training, and after each of the iterations.
    assert content.count(b"mean/evaluation") == 3
    # Episodes of 20 steps end in both iterations.
    assert content.count(b"episode_return/0-4") == 2
    assert content.count(b"GIF89a") == content.count(b"video/0-3") == 2


def test_a_program_of_a_sweep_is_told_with_its_own_values(
    tmp_path, monkeypatch, capsys
):
    """And with the name of the sweep's folder."""
    pytest.importorskip("tensorboardX")
    monkeypatch.chdir(tmp_path)
    told = []

    def make(names, folder, *, run_name, config, members):
        told.append((run_name, config["num_epochs"]))
        raise InputError("enough")

    monkeypatch.setattr(trackers, "make", make)
    grid = ("--grid", "num_epochs=2,3", "--out", "programs/7")
    refused(capsys, sweep, *SMALL, "--log", "tensorboard", *grid)
    assert told == [("7", 2)]


def test_wandb_without_a_login_is_one_line(tmp_path, monkeypatch, capsys):
    wandb = pytest.importorskip("wandb")

    def refuse(**settings):
        raise wandb.errors.UsageError("No API key\nconfigured.")

    monkeypatch.setattr(wandb, "init", refuse)
    told = refused(capsys, run, *SMALL, "--log", "wandb", "--out", tmp_path / "out")
    assert "error: log is 'wandb', which can't start: No API key configured." in told


def test_a_missing_package_is_named(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "wandb", None)
    told = refused(capsys, run, *SMALL, "--log", "wandb")
    assert 'pip install "gasil_jax[wandb]"' in told

"""Films of a run's policy."""

import itertools
import subprocess
import sys

import jax
import numpy as np
import pytest
from PIL import Image

from gasil_jax.cli import render
from gasil_jax.host import saved, video

pytestmark = pytest.mark.xdist_group("commands")


def check_strip(image, width, height):
    """Two rows of four pictures, each above the time that it shows."""
    columns, rows = image.size
    assert 4 * width < columns < 4.3 * width
    assert 2 * height < rows < 2.6 * height
    pixels = np.asarray(image.convert("L"), int)
    below = rows // 2 - height
    times = [
        pixels[top : top + below, left : left + width]
        for top in (height, rows // 2 + height)
        for left in range(0, columns, (columns - width) // 3)
    ]
    assert len(times) == 8
    for time in times:
        # Black letters in a white margin.
        assert time.min() < 50
        assert (time[[0, -1]] > 250).all() and (time[:, [0, -1]] > 250).all()
    for first, second in itertools.combinations(times, 2):
        assert (first != second).any()


@pytest.mark.parametrize("suffix", [".gif", ".png", ".mp4"])
def test_the_point_mass_is_drawn(trained, suffix, tmp_path, capsys):
    path = tmp_path / f"film{suffix}"
    size = ("--width", "161", "--height", "120")
    assert render.main([str(trained.folder), "--out", str(path), *size]) == 0
    count = "8 frames" if suffix == ".png" else "51 frames"
    assert count in capsys.readouterr().out
    if suffix == ".mp4":
        assert b"ftyp" in path.read_bytes()[:12]
        return
    image = Image.open(path)
    if suffix == ".png":
        check_strip(image, 162, 120)
    else:
        assert image.size == (162, 120)
        first = np.asarray(image.convert("RGB"), int)
        image.seek(image.n_frames - 1)
        assert np.abs(np.asarray(image.convert("RGB"), int) - first).max() > 50


def test_locomotion_is_drawn(untrained_hopper, tmp_path):
    strip = tmp_path / "strip.png"
    # In a process of its own: MuJoCo chooses its OpenGL when it is imported.
    command = [sys.executable, "-m", "gasil_jax.render", str(untrained_hopper)]
    command += ["--steps", "20", "--out", str(strip)]
    result = subprocess.run(command, capture_output=True, text=True)
    if result.returncode == 1:
        assert "no OpenGL for MuJoCo" in result.stderr
        pytest.skip("no OpenGL here")
    assert result.returncode == 0, result.stderr
    picture = Image.open(strip)
    check_strip(picture, 480, 360)
    # Not one colour, as where nothing is drawn.
    sky_and_floor = np.asarray(picture.convert("RGB").crop((0, 0, 480, 360)))
    assert sky_and_floor.std() > 10


def test_a_film_is_whole_or_not_there(trained, tmp_path, monkeypatch, capsys):
    def half(frames, fps, path):
        path.write_bytes(b"x")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(video, "write_film", half)
    path = tmp_path / "film.gif"
    assert render.main([str(trained.folder), "--out", str(path), "--steps", "2"]) == 1
    assert "No space left on device" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_an_episode_ends_before_the_physics_fails(trained):
    policies = saved.load_policies(trained.folder)
    env = policies.env

    class Failing(type(env)):
        def __getattr__(self, name):
            return getattr(env, name)

        def __init__(self):
            pass

        reset = staticmethod(env.reset)

        @staticmethod
        def step(state, action):
            stepped = env.step(state, action)
            fails = stepped.info["steps"] == 4
            blow_up = lambda x: jax.numpy.where(fails, jax.numpy.nan, x)
            return stepped.replace(obs=blow_up(stepped.obs), reward=blow_up(1.0))

    run = video.make_episode(Failing(), num_steps=20)
    states, total = run(policies.weights[0], jax.random.key(0))
    assert len(states) == 4 and total == 3.0

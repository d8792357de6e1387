"""Films of a run's policy."""

import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

from gasil_jax import render, run

SMALL = (
    *("--seeds", "2", "--total-steps", "256", "--batch-steps", "128"),
    *("--num-envs", "4", "--num-epochs", "1", "--minibatch-size", "32"),
    *("--hidden-sizes", "8", "--discriminator-hidden-sizes", "8"),
)


@pytest.fixture(scope="module")
def point_mass(tmp_path_factory):
    out = tmp_path_factory.mktemp("render") / "run"
    assert run.main(["--env", "point_mass", *SMALL, "--out", str(out)]) == 0
    return out


@pytest.mark.parametrize("suffix", [".gif", ".png", ".mp4"])
def test_the_point_mass_is_drawn(point_mass, suffix, tmp_path, capsys):
    path = tmp_path / f"film{suffix}"
    size = ("--width", "161", "--height", "120")
    assert render.main([str(point_mass), "--out", str(path), *size]) == 0
    assert "51 frames" in capsys.readouterr().out
    if suffix == ".mp4":
        assert b"ftyp" in path.read_bytes()[:12]
        return
    image = Image.open(path)
    assert image.size == ((162, 120) if suffix == ".gif" else (8 * 162, 120))
    if suffix == ".gif":
        first = np.asarray(image.convert("RGB"), int)
        image.seek(image.n_frames - 1)
        assert np.abs(np.asarray(image.convert("RGB"), int) - first).max() > 50


def test_locomotion_is_drawn(tmp_path):
    out = tmp_path / "run"
    arguments = ("--env", "hopper", "--physics", "mujoco", *SMALL, "--out", str(out))
    assert run.main(arguments) == 0
    path = tmp_path / "film.gif"
    # In a process of its own: MuJoCo chooses its OpenGL when it is imported.
    command = [sys.executable, "-m", "gasil_jax.render", str(out), "--steps", "40"]
    result = subprocess.run(
        [*command, "--out", str(path)], capture_output=True, text=True
    )
    if result.returncode == 1:
        assert "no OpenGL for MuJoCo" in result.stderr
        pytest.skip("no OpenGL here")
    assert result.returncode == 0, result.stderr
    image = Image.open(path)
    assert image.size == (480, 360)
    # Not one colour, as where nothing is drawn.
    assert np.asarray(image.convert("RGB")).std() > 10


def test_bad_input_is_one_line_and_status_2(point_mass, tmp_path, capsys):
    (tmp_path / "there.gif").touch()
    for arguments, message in (
        (["--out", "film.avi"], "must end in .mp4, .gif, .png"),
        (["--out", str(tmp_path / "there.gif")], "which exists"),
        (["--seed", "9"], "seed is 9: the run has 0 to 1"),
        (["--steps", "0"], "steps is 0"),
    ):
        assert render.main([str(point_mass), *arguments]) == 2
        error = capsys.readouterr().err
        assert message in error and len(error.splitlines()) == 1


def test_a_missing_package_is_named(point_mass, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    path = tmp_path / "film.mp4"
    assert render.main([str(point_mass), "--out", str(path)]) == 1
    assert "needs the package imageio-ffmpeg" in capsys.readouterr().err

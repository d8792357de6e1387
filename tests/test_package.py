"""The package as it is installed: its wheel, its commands and its version."""

import importlib.metadata
import importlib.util
import os
import pathlib
import runpy
import shutil
import subprocess
import sys
import zipfile

import pytest
from refusals import rows
from small_training import FLAGS

import gasil_jax
from gasil_jax import __main__ as package

ROOT = pathlib.Path(__file__).parent.parent
#: What only an extra installs, by the names of the modules.
EXTRAS = (
    "gymnax imageio_ffmpeg latex2mathml minari mkdocs optuna ray stable_baselines3 "
    "tensorboardX wandb warp pytest hypothesis"
).split()
_RUN = """
import sys
sys.modules.update(dict.fromkeys({extras}))
import gasil_jax.run
assert gasil_jax.__file__.startswith({site!r}), gasil_jax.__file__
sys.exit(gasil_jax.run.main({arguments}))
"""


def test_the_commands_are_listed(capsys):
    runpy.run_path(package.__file__, run_name="__main__")
    printed = capsys.readouterr().out
    for command in package.COMMANDS:
        assert importlib.util.find_spec(f"gasil_jax.{command}")
        (line,) = [x for x in printed.splitlines() if f"gasil_jax.{command} " in x]
        assert len(line.split()) > 4, line


@pytest.mark.parametrize("command", package.COMMANDS)
def test_every_command_tells_its_version_and_its_options(command, capsys):
    module = importlib.import_module(f"gasil_jax.{command}")
    for flag, start in (
        ("--version", f"{gasil_jax.__version__}\n"),
        ("--help", f"usage: python -m gasil_jax.{command} "),
    ):
        with pytest.raises(SystemExit) as exit_:
            module.main([flag])
        assert exit_.value.code == 0
        assert capsys.readouterr().out.startswith(start)


#: What is changed before the import, and what that says.
CANNOT_RUN = """
sys.platform = 'win32' | runs on Linux and macOS: on Windows, use WSL
importlib.metadata.version = lambda name: '0.10.2' | jaxlib 0.10.2 gives wrong numbers
"""


@pytest.mark.parametrize(("change", "message"), rows(CANNOT_RUN))
def test_where_it_cannot_run_the_import_says_so(change, message):
    code = f"import importlib.metadata, sys; {change}; import gasil_jax"
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    last = ended.stderr.splitlines()[-1]
    assert last.startswith("ImportError: ") and message in last


def test_the_wheel_alone_trains(tmp_path):
    major = int(importlib.metadata.version("setuptools").partition(".")[0])
    if major < 77:
        pytest.skip(f"setuptools is {major}: the wheel is built with 77 or later")
    source, site = tmp_path / "source", tmp_path / "site"
    source.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    for name in ("gasil_jax", "envs"):
        ignored = shutil.ignore_patterns("__pycache__", "*.egg-info")
        shutil.copytree(ROOT / name, source / name, ignore=ignored)
    build = "from setuptools import build_meta; build_meta.build_wheel('.')"
    subprocess.run(
        [sys.executable, "-c", build], cwd=source, check=True, capture_output=True
    )
    (wheel,) = source.glob("*.whl")
    assert gasil_jax.__version__ in wheel.name
    zipfile.ZipFile(wheel).extractall(site)

    # Other tests compile the same.
    arguments = [*FLAGS, "--agent", "ppo", "--out", "run"]
    program = _RUN.format(extras=EXTRAS, site=str(site), arguments=arguments)
    environment = os.environ | {
        "PYTHONPATH": str(site),
        "JAX_DISABLE_MOST_OPTIMIZATIONS": "1",
        # Another test may be writing an entry of the cache that they share.
        "PYTHONWARNINGS": "ignore:Error reading persistent compilation cache",
    }
    command = [sys.executable, "-c", program]
    place = {"cwd": tmp_path, "env": environment, "timeout": 200}
    result = subprocess.run(command, capture_output=True, text=True, **place)
    assert result.returncode == 0, result.stderr
    # Nothing that is imported prints.
    line, following = result.stdout.splitlines()
    assert line.startswith("final return") and following.startswith("next: ")
    assert all(
        x.startswith(("point_mass", "note")) for x in result.stderr.splitlines()
    ), result.stderr
    assert (tmp_path / "run" / "policy.npz").is_file()

"""A run and a sweep that are trained once, for all tests that look at them."""

import contextlib
import io
import pathlib
from typing import NamedTuple

import pytest
from small_training import GRID, SMALL

from gasil_jax import run, sweep


class Done(NamedTuple):
    """What a command has left."""

    folder: pathlib.Path
    told: str
    printed: str


def _done(folder, program, *arguments):
    told, printed = io.StringIO(), io.StringIO()
    with contextlib.chdir(folder):
        with contextlib.redirect_stderr(told), contextlib.redirect_stdout(printed):
            status = program.main([*arguments, "--out", "out"])
    assert status == 0, told.getvalue()
    return Done(folder / "out", told.getvalue(), printed.getvalue())


@pytest.fixture(scope="session")
def trained(tmp_path_factory):
    """A run of three seeds, which is evaluated three times."""
    more = ("--seeds", "3", "--evaluate-every", "512")
    return _done(tmp_path_factory.mktemp("trained"), run, *SMALL, *more)


@pytest.fixture(scope="session")
def swept(tmp_path_factory):
    """A sweep of two points with two of the run's seeds; point 0 is the run's."""
    folder = tmp_path_factory.mktemp("swept")
    more = ("--seeds", "2", "--evaluate-every", "512")
    return _done(folder, sweep, *SMALL, *more, *GRID)

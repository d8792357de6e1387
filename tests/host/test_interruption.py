"""Ctrl-C has an answer at once, whatever the program is doing."""

import os
import signal
import subprocess
import sys
import threading

import jax
import pytest
from small_training import FLAGS
from test_progress import wait_for_text

from gasil_jax import run
from gasil_jax.host import checkpoint, folders, interruption


@pytest.fixture(autouse=True)
def as_in_a_terminal():
    """Let Ctrl-C have its effect, which a program in the background does not have."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_ctrl_c_during_imports_is_one_line(tmp_path):
    # What a command imports, here with Ctrl-C in it; some code passes that by.
    numpy = """
try:
    import os, signal
    os.kill(os.getpid(), signal.SIGINT)
except BaseException:
    pass
raise ImportError
"""
    (tmp_path / "numpy.py").write_text(numpy)
    path = os.pathsep.join([str(tmp_path), *sys.path])
    ended = subprocess.run(
        [sys.executable, "-m", "gasil_jax.run"],
        env=os.environ | {"PYTHONPATH": path},
        capture_output=True,
        text=True,
    )
    assert (ended.returncode, ended.stderr) == (130, "interrupted\n")


@pytest.mark.parametrize("twice", [False, True])
def test_ctrl_c_while_compiling_is_answered_at_once(
    twice, tmp_path, monkeypatch, capsys, equal_members_share_a_program
):
    equal_members_share_a_program.clear()
    ready, ended = jax.block_until_ready, threading.Event()

    def slow(states):
        # XLA would not let a signal through to its own thread.
        assert threading.current_thread() is not threading.main_thread()
        os.kill(os.getpid(), signal.SIGINT)
        told = ""
        while interruption.ANSWER not in told:
            more = wait_for_text(capsys)
            assert more
            told += more
        if twice:
            os.kill(os.getpid(), signal.SIGINT)
            assert ended.wait(60)
        return ready(states)

    monkeypatch.setattr(jax, "block_until_ready", slow)
    arguments = [*FLAGS, "--agent", "ppo", "--out", str(tmp_path)]
    assert run.main(arguments) == 130
    ended.set()
    last = capsys.readouterr().err.splitlines()
    (program,) = (tmp_path / "programs").iterdir()
    with folders.lock(program):
        newest, _ = checkpoint.latest(program / "checkpoints")
    if twice:
        assert last == ["interrupted"] and newest is None
    else:
        assert last[-1].startswith("continue with: ") and newest.iteration == 0

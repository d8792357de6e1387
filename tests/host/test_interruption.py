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
from gasil_jax.host import checkpoint, driver, folders, interruption


@pytest.fixture(autouse=True)
def as_in_a_terminal():
    """Let Ctrl-C have its effect, which a program in the background does not have."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize("module", ["gasil_jax.run", "experiments"])
def test_ctrl_c_during_imports_is_one_line(module, tmp_path):
    # What the commands import first, here with Ctrl-C in it; some code passes that by.
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
        [sys.executable, "-m", module],
        env=os.environ | {"PYTHONPATH": path},
        capture_output=True,
        text=True,
    )
    assert (ended.returncode, ended.stderr) == (130, "interrupted\n")


def test_only_commands_of_the_package_take_ctrl_c_for_themselves(monkeypatch):
    cases = {
        ("-m", "-m theirs"): False,
        ("theirs.py", "theirs.py"): False,
        ("/gasil_jax/run.py", "-m gasil_jax.run"): False,
        ("-m", "-m gasil_jax.run"): True,
    }
    for (first, given), ours in cases.items():
        monkeypatch.setattr(sys, "argv", [first])
        monkeypatch.setattr(sys, "orig_argv", ["python", *given.split()])
        assert interruption.runs_as_program("gasil_jax") is ours


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
        while driver._AFTER_COMPILATION not in told:
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

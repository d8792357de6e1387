"""Progress messages."""

import io
import sys
import threading
import time

import numpy as np
import pytest

from gasil_jax.host import progress


def wait_for_text(capsys, seconds=20.0):
    text, deadline = "", time.monotonic() + seconds
    while not text and time.monotonic() < deadline:
        time.sleep(0.005)
        text = capsys.readouterr().err
    return text


def test_a_slow_phase_is_announced_in_one_line(monkeypatch, capsys):
    monkeypatch.setattr(progress, "_SECONDS_BEFORE_ANNOUNCEMENT", 0.01)
    with progress.announced("hopper", "building"):
        assert wait_for_text(capsys) == "hopper: building\n"
    with pytest.raises(OSError, match="full"), progress.announced("hopper", "saving"):
        assert wait_for_text(capsys) == "hopper: saving\n"
        raise OSError("full")


def test_a_long_phase_says_for_how_long_it_has(monkeypatch, capsys):
    monkeypatch.setattr(progress, "_SECONDS_BETWEEN_ANNOUNCEMENTS", 0.01)
    with progress.Progress("hopper", 100).aside("compiling", at_once=True):
        deadline, text = time.monotonic() + 20.0, ""
        while text.count("\n") < 2 and time.monotonic() < deadline:
            text += wait_for_text(capsys)
    assert text.startswith("hopper: compiling\nhopper: compiling (0 s)\n")


def test_a_quick_phase_is_not_announced(monkeypatch, capsys):
    monkeypatch.setattr(progress, "_SECONDS_BEFORE_ANNOUNCEMENT", 600.0)
    before = threading.active_count()
    with progress.announced("hopper", "building"):
        assert threading.active_count() == before + 1
    assert threading.active_count() == before
    assert capsys.readouterr().err == ""


def test_the_speed_excludes_time_spent_aside(monkeypatch, capsys):
    clock = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    shown = progress.Progress("hopper ppo", 2000)
    shown.phase("training")
    clock[0] += 10.0
    with shown.aside("saving a checkpoint"):
        clock[0] += 90.0
    clock[0] += 10.0
    shown.update(2000, np.array([[3.0, np.nan]]))
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "hopper ppo: training"
    assert lines[1] == (
        "hopper ppo: 2,000/2,000 steps, return 3.0, 100 steps/s, 0:00:00 left"
    )


def test_a_terminal_has_one_line_that_is_rewritten_until_the_end(monkeypatch):
    terminal = io.StringIO()
    terminal.isatty = lambda: True
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("COLUMNS", "40")
    shown = progress.Progress("hopper ppo", 2000)
    shown.phase("training")
    for steps in (500, 1000, 2000):
        shown.update(steps, np.ones((1, 1)))
    before = f"\r{' ' * 39}\r"
    _, whole, first, second, last = terminal.getvalue().split(before)
    assert whole == "hopper ppo: training\n" and last.endswith(" 0:00:00 left\n")
    # Only the end of a longer line has room, and the next takes its row.
    assert [len(x) for x in (first, second)] == [39, 39]
    assert first.endswith(" left") and second.endswith(" left")
    shown.close()
    assert terminal.getvalue().endswith(last)
    shown.update(500, np.ones((1, 1)))
    shown.close()
    assert terminal.getvalue().endswith(" left\n")

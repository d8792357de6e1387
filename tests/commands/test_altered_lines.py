"""Command lines in which something is altered, drawn from a seed, end in one line."""

import re

import numpy as np

from gasil_jax import evaluate, export_minari, merge, plot, render, run, sweep

#: Each program with lines of which none can run: their folders can't be made or found.
LINES = [
    (run, "--env point_mass --total-steps 256 --num-envs 4 --seeds 2 --out no/run"),
    (run, "--env hopper --agent gail --expert no.npz --alpha 0.5 --out no"),
    (run, "--env ant --agent ppo+sil --reward-delay 20 --hidden-sizes 8 8 --out no"),
    (run, "--env ant --alpha-schedule 2e6 0 3e6 1 --preset paper --devices 1 --out no"),
    (run, "--env ant --agent ppo --preset scaled --no-stagger-episodes --out no"),
    (run, "--resume --out no --total-steps 1e6 --checkpoint-every 5"),
    (sweep, "--env point_mass --grid alpha=0.1,0.2 buffer_steps=10,20 --out no"),
    (sweep, "--env point_mass --random 4 --shard 1/2 --out no"),
    (sweep, "--env point_mass --points-file no.json --out no"),
    (evaluate, "no/run --episodes 3 --checkpoint best --point 0"),
    (render, "no/run --out no.gif --steps 10 --seed 0"),
    (plot, "no/run no/other --out no.png"),
    (merge, "no/run"),
    (export_minari, "no/run --name a/b-v0 --seed 1"),
]
WORDS = [
    *("", "-", "--", "---", "=", "--=", "-1", "1e999", "nan", "é", "\udcff", "\x00"),
    *("a\nb", "x" * 500, "9" * 5000, "0x10", "1_000", "1/0", "0/1", "[", "{}", "None"),
    *("--help=", "--out", "--env", "--seeds=", "--grid", "alpha=", "=1", "alpha=a"),
    *("../..", "minari:", "zoo:", "zoo:x", "brax:", ":", "a:", "a:b", "@file", "%s"),
    *("--no-seeds", "--first-seed", "--version=3", "*", "-h1", "True"),
]


def altered(line, draw):
    """Return a line's words with one or two changes."""
    words = line.split()
    for _ in range(draw.integers(1, 3)):
        kind, at = draw.integers(7), int(draw.integers(len(words))) if words else 0
        word = words[at] if words else ""
        place = int(draw.integers(len(word))) if word else 0
        if not word or kind == 0:
            words.insert(at, WORDS[draw.integers(len(WORDS))])
        elif kind == 1:
            del words[at]
        elif kind == 2:
            words[at] = WORDS[draw.integers(len(WORDS))]
        elif kind == 3:
            words.insert(at, word)
        elif kind == 4:
            words.append(words.pop(at))
        elif kind == 5:
            words[at] = word[:place] + word[place + 1 :]
        else:
            other = chr(draw.integers(48, 127))  # no slash, so no other folder
            words[at] = word[:place] + other + word[place + 1 :]
    return words


def test_an_altered_command_line_ends_in_one_line(capsys, monkeypatch):
    monkeypatch.chdir("/proc")  # where nothing can be written
    draw = np.random.default_rng(0)
    for number in range(20 * len(LINES)):
        program, line = LINES[number % len(LINES)]
        words = altered(line, draw)
        if {"-h", "--help", "--version"} & set(words):
            continue
        assert program.main(words) == 2, words
        printed = capsys.readouterr()
        told = [x for x in printed.err.splitlines() if not x.startswith("note: ")]
        told = [x for x in told if not x.endswith(("environment", "devices"))]
        assert all(len(line) < 2000 for line in told), words
        assert len(told) == 1 and told[0].startswith("error: "), (words, printed.err)
        assert printed.out == "", words


def test_the_middle_of_a_long_word_is_left_out_of_the_message(capsys):
    word = 5000 * "x"
    for words in (["--alpha", word], [word], [f"--{word}"], ["--seeds", word]):
        assert run.main(["--env", "ant", *words, "--out", "/proc/no"]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert re.search(f"^error: .*{30 * 'x'}[.]{{3}}{15 * 'x'}", line), line
        assert len(line) < 200

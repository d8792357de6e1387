"""An altered file of a run or a sweep is refused, or it changes nothing."""

import json
import math
import re
import shutil

import numpy as np
import pytest
from matplotlib.figure import Figure
from small_training import FLAGS

from gasil_jax import merge, plot, run, sweep

SMALL = [
    *(*FLAGS, "--agent", "ppo", "--seeds", "2", "--max-episode-steps", "10"),
    *("--evaluate-every", "128", "--evaluate-episodes", "1"),
]
VALUES = [None, True, -1, 0.5, 10**30, math.nan, "", "a", "x" * 300, [], [1], {"a": 1}]
CELLS = ["1.5", "inf", "1e999", "a", '"', "é", "0x1"]


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    parent = tmp_path_factory.mktemp("whole")
    # Two points of one seed are as many members as the run has, and share its program.
    grid = ["--seeds", "1", "--grid", "gamma=0.9,0.99"]
    assert run.main([*SMALL, "--out", str(parent / "run")]) == 0
    assert sweep.main([*SMALL, *grid, "--out", str(parent / "sweep")]) == 0
    return parent


def altered(content, draw):
    """Return the content of a JSON file with another value, or without one."""
    if not content or not isinstance(content, dict | list) or draw.random() < 0.1:
        return VALUES[draw.integers(len(VALUES))]
    copy, keys = content.copy(), [*(content if isinstance(content, dict) else [])]
    key = keys[draw.integers(len(keys))] if keys else draw.integers(len(content))
    kind = draw.integers(4)
    if keys and kind == 0:
        del copy[key]
    elif keys and kind == 1:
        copy["other"] = copy.pop(key)
    else:
        copy[key] = altered(content[key], draw)
    return copy


def alter(path, draw):
    """Alter one thing in a JSON file or a table."""
    if path.suffix == ".json":
        path.write_text(json.dumps(altered(json.loads(path.read_text()), draw)))
        return
    lines = path.read_text().split("\n")[:-1]
    # Without a row of its last iteration a table is one that is being written.
    row, kind = draw.integers(len(lines) // 2), draw.integers(4)
    cells = lines[row].split(",")
    if kind == 0:
        del lines[row]
    elif kind == 1:
        lines.insert(row, lines[row])
    else:
        cells[draw.integers(len(cells))] = CELLS[draw.integers(len(CELLS))]
        lines[row] = ",".join(cells[kind - 2 :])
    path.write_text("\n".join([*lines, ""]))


def test_an_altered_file_is_refused_or_changes_nothing(
    folders, tmp_path, capsys, monkeypatch
):
    # To render pictures takes most of a command's time.
    monkeypatch.setattr(Figure, "savefig", lambda _, path, **__: path.touch())
    draw, work, figures = np.random.default_rng(0), tmp_path / "work", iter(range(9999))

    def ended(name, arguments, path=None):
        shutil.rmtree(work, ignore_errors=True)
        shutil.copytree(folders / name, work)
        if path is not None:
            alter(work / path, draw)
        capsys.readouterr()
        figure = ["--out", str(tmp_path / f"{next(figures)}.png")]
        program, *words = arguments
        status = program.main([*words, *figure] if program is plot else words)
        told = capsys.readouterr()
        assert status in (0, 2), told.err
        assert sum(x.startswith("error: ") for x in told.err.splitlines()) == status / 2
        # Neither the number of the figure nor the speed is a result.
        out = re.sub(r"[0-9,]+ steps/s |in .*\.png", "", told.out)
        return status, out

    commands = {
        "run": [(plot, str(work)), (run, "--resume", "--out", str(work))],
        "sweep": [(plot, str(work)), (merge, str(work))],
    }
    refused = 0
    for name, every in commands.items():
        whole = folders / name
        files = [
            x.relative_to(whole)
            for ending in (
                "config.json",
                "program.json",
                "manifest.json",
                "summary.json",
            )
            for x in sorted(whole.rglob(ending))
        ]
        files += [x.relative_to(whole) for x in sorted(whole.rglob("metrics.csv"))]
        for arguments in every:
            status, expected = ended(name, arguments)
            assert status == 0
            for path in files * 2:
                status, out = ended(name, arguments, path)
                refused += status == 2
                assert status == 2 or out == expected, (arguments, path)
    assert 10 < refused < 36


def edited(path):
    """Change the last digit of a cell."""
    header, row, rest = path.read_bytes().split(b"\r\n", 2)
    other = b"1" if row.endswith(b"2") else b"2"
    path.write_bytes(b"\r\n".join([header, row[:-1] + other, rest]))


@pytest.mark.parametrize("name", ["metrics.csv", "evaluations.csv"])
@pytest.mark.parametrize("kind", ["run", "sweep"])
def test_a_digit_that_was_changed_is_refused(kind, name, folders, tmp_path, capsys):
    work = shutil.copytree(folders / kind, tmp_path / "work")
    (path,) = work.rglob(name)
    edited(path)
    commands = [(plot, str(work), "--out", str(tmp_path / "x.png"))]
    commands.append((run, "--resume", "--out", str(work)))
    if kind == "sweep":
        commands[1] = (merge, str(work))
    for command, *words in commands:
        capsys.readouterr()
        assert command.main(words) == 2
        told = capsys.readouterr().err
        assert f"{path} is damaged: it has changed since the checkpoint" in told

    # A folder of an older version has no hash of its tables.
    for manifest in path.parent.rglob("manifest.json"):
        content = json.loads(manifest.read_text())
        for field in ("rows", "sha256"):
            del content["record"][f"{path.stem}_{field}"]
        del content["sha256"]
        manifest.write_text(json.dumps(content))
    for command, *words in commands:
        assert command.main(words) == 0


@pytest.mark.parametrize("name", ["metrics.csv", "evaluations.csv"])
def test_a_table_that_was_cut_is_told_where_it_is_drawn(
    name, folders, tmp_path, capsys
):
    work = shutil.copytree(folders / "run", tmp_path / "work")
    # Version control may have changed how lines end.
    rows = (work / name).read_text().splitlines(keepends=True)
    for kept, told in (
        (rows, ""),
        (rows[:-1], f"note: {work / name} lacks rows that its training has written\n"),
    ):
        (work / name).write_text("".join(kept))
        figure = tmp_path / f"{len(kept)}.png"
        assert plot.main([str(work), "--out", str(figure)]) == 0
        assert capsys.readouterr().err == told

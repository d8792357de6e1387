"""An altered file of a run or a sweep is refused, or it changes nothing."""

import json
import math
import re
import shutil

import numpy as np
import pytest
from small_training import FLAGS

from gasil_jax import merge, plot, run, sweep

SMALL = [*FLAGS, "--agent", "ppo", "--seeds", "2", "--max-episode-steps", "10"]
VALUES = [None, True, -1, 0.5, 10**30, math.nan, "", "a", "x" * 300, [], [1], {"a": 1}]
CELLS = ["inf", "1e999", "a", '"', "é", "0x1"]


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    parent = tmp_path_factory.mktemp("whole")
    grid = ["--grid", "gamma=0.9,0.99"]
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


def test_an_altered_file_is_refused_or_changes_nothing(folders, tmp_path, capsys):
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

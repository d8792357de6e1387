"""Runs are drawn and compared."""

import csv
import shutil

import numpy as np
import pytest
from matplotlib.figure import Figure
from small_training import FLAGS

from gasil_jax import plot, run
from gasil_jax.errors import InputError


def test_runs_are_drawn(tmp_path, capsys):
    small = (*FLAGS, "--seeds", "3", "--no-stagger-episodes")
    small += ("--total-steps", "2048", "--batch-steps", "256")
    folders = []
    for name, first_seed in (("ppo", "0"), ("others", "3")):
        folders.append(str(tmp_path / name))
        more = ("--agent", "ppo", "--first-seed", first_seed, "--out", folders[-1])
        assert run.main([*small, *more]) == 0
    capsys.readouterr()
    out = tmp_path / "figure.png"
    assert plot.main([*folders, "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "point_mass, ppo" in printed and "95% interval" in printed
    assert out.read_bytes().startswith(b"\x89PNG")
    assert plot.main([*folders, "--out", "/proc/nowhere/figure.png"]) == 2
    assert "error: out is /proc/nowhere/figure.png" in capsys.readouterr().err
    assert plot.main([*folders, "--out", str(tmp_path / "new" / "er" / "x.svg")]) == 0
    capsys.readouterr()
    # A label is no formula.
    label = ("--labels", r"$\frac$", "others")
    assert plot.main([*folders, "--out", str(tmp_path / "label.svg"), *label]) == 0
    assert r"$\frac$" in capsys.readouterr().out
    curves = plot.read(tmp_path / "ppo")
    assert curves.returns.shape == (3, 8) and curves.env_steps[-1] == 2048

    # Training may be writing a row, or an iteration, when the table is read.
    path = tmp_path / "ppo" / "metrics.csv"
    whole = path.read_bytes()
    for cut in (10, len(whole.splitlines()[-1]) + 10):
        path.write_bytes(whole[:-cut])
        assert plot.read(tmp_path / "ppo").returns.shape == (3, 7)
    for lines in (0, 1, 2):
        path.write_bytes(b"".join(whole.splitlines(keepends=True)[:lines]) + b"0,")
        with pytest.raises(InputError, match="has no curves to draw yet"):
            plot.read(tmp_path / "ppo")
    path.write_bytes(whole)
    assert "metrics.csv lacks rows that its training has" in capsys.readouterr().err

    # A checkpoint knows what was in the table.
    shutil.rmtree(tmp_path / "ppo" / "checkpoints")
    # Where none ended in the last tenth, the last that did count, as in the summary.
    with path.open() as file:
        rows = list(csv.DictReader(file))
    with path.open("w") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        for row in rows:
            late = {"episode_return": "nan"} if float(row["env_steps"]) == 2048 else {}
            writer.writerow(row | late)
    final = [float(x["episode_return"]) for x in rows if float(x["env_steps"]) == 1792]
    np.testing.assert_allclose(plot.read(tmp_path / "ppo").final, final)

    for arguments, message in (
        ([*folders, "--out", str(out)], "which exists"),
        ([str(tmp_path)], "must be the folder of a run"),
        ([folders[0], "--out", "x.txt"], "must end in .png"),
        (
            [*folders, "--labels", "a"],
            "labels has 1 names: it must have one for each of the 2 runs",
        ),
    ):
        assert plot.main(arguments) == 2
        error = capsys.readouterr().err
        assert message in error and len(error.splitlines()) == 1


def test_a_label_with_an_underscore_is_in_the_legends():
    finals = np.arange(3.0)
    curves = [
        plot.Curves("hopper", label, np.arange(4.0), np.ones((3, 4)), finals, None)
        for label in ("_first", "second")
    ]
    panels = Figure().subplots(1, 3)
    plot._draw_row(panels, curves)
    for panel in (panels[0], panels[2]):
        texts = [text.get_text() for text in panel.get_legend().get_texts()]
        assert [text.strip() for text in texts] == ["_first", "second"]

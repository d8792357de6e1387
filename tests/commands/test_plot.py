"""Runs are drawn and compared."""

import csv
import shutil

import numpy as np
import pytest
from refusals import refused

from gasil_jax.cli import plot
from gasil_jax.errors import InputError
from gasil_jax.statistics import interquartile_mean

pytestmark = pytest.mark.xdist_group("commands")


def texts(legend):
    return [text.get_text().strip() for text in legend.get_texts()]


def test_runs_and_points_of_sweeps_are_drawn(trained, swept, tmp_path, capsys):
    out = tmp_path / "new" / "figure.png"
    assert plot.main([str(trained.folder), "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert out.read_bytes().startswith(b"\x89PNG") and f"in {out}" in printed
    assert "95% interval" in printed and "point_mass, ppo+gasil   " in printed
    curves = plot.read(trained.folder)
    assert curves.returns.shape == (3, 4) and curves.env_steps[-1] == 1024
    assert curves.evaluations["mean"].shape == (3, 3)
    for point, folder in ((0, swept.folder), (None, swept.folder)):
        assert plot.read(folder, point=point).returns.shape == (2, 4)
    # The sweep's own rule chose one, and says so.
    assert "the best by mean (learning_rate=0.0003" in capsys.readouterr().err


def test_two_runs_of_one_agent_are_told_apart_by_their_folders(
    trained, swept, tmp_path, capsys, figures
):
    folders = [str(trained.folder), str(swept.folder)]
    arguments = [*folders, "--point", "0", "--out"]
    assert plot.main([*arguments, str(tmp_path / "1.png")]) == 0
    _, *rows, _ = capsys.readouterr().out.splitlines()
    for row, folder in zip(rows, folders, strict=True):
        assert row.startswith(f"point_mass, ppo+gasil ({folder}) ")
    (figure,) = figures
    legends = [panel.get_legend() for panel in (figure.axes[0], figure.axes[2])]
    names = [f"ppo+gasil ({folder})" for folder in folders]
    assert [x for x in texts(legends[0]) if "evaluations" not in x] == names
    assert texts(legends[1]) == names
    # A label of one's own is no formula, and stays as it is.
    labels = ["--labels", r"$\frac$", "_other"]
    assert plot.main([*arguments, str(tmp_path / "2.png"), *labels]) == 0
    printed = capsys.readouterr().out
    assert r"$\frac$  " in printed and "_other  " in printed
    assert texts(figures[-1].axes[2].get_legend()) == [r"\$\frac\$", "_other"]


def test_a_table_that_is_being_written_is_read_up_to_its_last_whole_row(
    trained, tmp_path
):
    out = shutil.copytree(trained.folder, tmp_path / "out")
    (path,) = out.glob("programs/*/metrics.csv")
    (path.parent / "training.json").unlink()
    whole = path.read_bytes()
    for cut in (10, len(whole.splitlines()[-1]) + 10):
        path.write_bytes(whole[:-cut])
        assert plot.read(out).returns.shape == (3, 3)
    for lines in (0, 1, 2):
        path.write_bytes(b"".join(whole.splitlines(keepends=True)[:lines]) + b"0,")
        with pytest.raises(InputError, match="has no curves to draw yet"):
            plot.read(out)
    # Where none ended in the last tenth, the last that did count, as in the summary.
    rows = list(csv.DictReader(whole.decode().splitlines()))
    with path.open("w") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        for row in rows:
            late = {"episode_return": ""} if row["env_steps"] == "1024" else {}
            writer.writerow(row | late)
    final = [float(x["episode_return"]) for x in rows if x["env_steps"] == "768"]
    np.testing.assert_allclose(plot.read(out).final, final)


def test_other_metrics_and_x_axes_are_drawn(trained, figures, tmp_path):
    drawn = ["--metric", "entropy", "--x", "iteration", "--smooth", "4"]
    out = ["--out", str(tmp_path / "x.png")]
    assert plot.main([str(trained.folder), *drawn, *out]) == 0
    axes, read = figures[-1].axes[0], plot.read(trained.folder, metric="entropy")
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("iteration", "entropy")
    line = axes.get_lines()[0]
    np.testing.assert_array_equal(line.get_xdata(), [1, 2, 3, 4])
    last = interquartile_mean(read.returns.mean(axis=1))
    np.testing.assert_allclose(line.get_ydata()[-1], last)
    assert plot.read(trained.folder, x="episodes").env_steps[-1] > 0


def test_files_of_other_libraries_are_curves(trained, figures, tmp_path, capsys):
    """Stable-Baselines3's monitor, with a comment, and CleanRL's with empty cells."""
    monitors = tmp_path / "monitors"
    monitors.mkdir()
    for seed in range(2):
        rows = "".join(f"{seed + i},10,{i}.5\n" for i in range(20))
        (monitors / f"{seed}.csv").write_text(f"#{{}}\nr,l,t\n{rows}")
    read = plot.read_csv(monitors, None, ("sum:l", "r"))
    assert read.returns.shape == (2, 20) and read.env_steps[-1] == 200
    np.testing.assert_allclose(read.final, [18.5, 19.5])
    clean = tmp_path / "clean.csv"
    clean.write_text("global_step,charts/episodic_return\n100,\n200,3.0\n300,4.0\n")
    columns = ["--columns", "global_step", "charts/episodic_return"]
    out = ["--out", str(tmp_path / "x.png")]
    assert plot.main([str(trained.folder), str(clean), *columns, *out]) == 0
    # It stands beside the run.
    assert len(figures[-1].axes) == 3
    assert "clean" in texts(figures[-1].axes[0].get_legend())
    for name, rows, message in (
        ("none", None, "No such file"),
        ("damaged", "1,x", "could not convert string to float: 'x'"),
        ("empty", "", "global_step must have numbers"),
        ("falls", "2,1\n1,2", "global_step must have numbers that do not fall"),
    ):
        path = tmp_path / f"{name}.csv"
        if rows is not None:
            path.write_text(f"global_step,charts/episodic_return\n{rows}\n")
        told = refused(capsys, plot, path, *columns, "--out", tmp_path / "y.png")
        assert f"{path} can't be drawn: " in told and message in told
    (monitors / "1.csv").write_text("r,l\n1,900\n")
    told = refused(capsys, plot, monitors, "--columns", "sum:l", "r")
    assert f"{monitors} can't be drawn: no sum:l is in all its files" in told
    assert "columns has 0 names: " in refused(capsys, plot, clean)
    told = refused(capsys, plot, clean, "--columns", "global_step", "return")
    assert "column 'return' is unknown: did you mean" in told

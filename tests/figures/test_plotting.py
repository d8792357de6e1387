"""The parts that curves are drawn of, and what the figures say and show."""

from unittest import mock

import matplotlib.figure
import numpy as np

from gasil_jax import statistics
from gasil_jax.cli import plot
from gasil_jax.host import plotting, results


def test_parts_are_means_where_every_seed_has_ended_an_episode():
    steps = np.arange(1, 101) * 10
    returns = np.stack([np.arange(100.0), np.ones(100)])
    returns[0, :3], returns[1, 4] = np.nan, np.nan
    ends, means = plotting.binned_returns(steps, returns)
    # Fifty parts of two iterations each, the first without the first seed.
    np.testing.assert_array_equal(ends, np.arange(40, 1001, 20))
    np.testing.assert_array_equal(means[0], [3.0, *np.arange(4.5, 100, 2)])
    np.testing.assert_array_equal(means[1], 1.0)
    ends, means = plotting.binned_returns(steps, np.full((2, 100), np.nan))
    assert ends.shape == (0,) and means.shape == (2, 0)


def test_a_moving_mean_is_of_the_points_before():
    smoothed = plotting.smoothed(np.array([[1.0, 3.0, 5.0, 7.0]]), 2)
    np.testing.assert_allclose(smoothed, [[1.0, 2.0, 4.0, 6.0]])


def made_up(env, label, num_seeds, scale):
    draw = np.random.default_rng(num_seeds).normal
    steps = np.linspace(2e4, 1e6, 50)
    returns = scale * (steps / 1e6 + draw(scale=0.1, size=(num_seeds, 50)))
    return plot.Curves(env, f"{env}, {label}", steps, returns, returns[:, -1], None)


def test_each_environment_has_titled_panels(figures, tmp_path):
    runs = [made_up("hopper", x, 5, 3000.0) for x in ("ppo", "ppo+gasil")]
    plot.draw([*runs, made_up("swimmer", "ppo", 4, 90.0)], tmp_path / "x.png")
    (figure,) = figures
    assert "interquartile mean over 4 or 5 seeds, shaded its 95% interval" in (
        figure.get_supxlabel()
    )
    hopper, swimmer = figure.axes[:3], figure.axes[3:]
    titles = [axes[0].get_title() for axes in (hopper, swimmer)]
    assert titles == ["hopper", "swimmer, ppo"]
    assert hopper[0].get_lines()[0].get_xdata().max() == 1.0
    for axes in (hopper[0], hopper[2]):
        labels = [text.get_text() for text in axes.get_legend().get_texts()]
        assert labels == ["ppo", "ppo+gasil"]
    # A single run needs no legend.
    assert all(axes.get_legend() is None for axes in swimmer)
    for axes, drawn in ((hopper[1], runs), (swimmer[1], [])):
        low, high = axes.get_xlim()
        assert all(low < x.final.min() and x.final.max() < high for x in drawn)


def test_the_learning_curve_is_the_same_statistic(figures, tmp_path):
    run = made_up("hopper", "ppo", 5, 3000.0)
    plotting.learning_curve(
        tmp_path / "x.png", run.env_steps, run.returns, title="hopper"
    )
    (figure,) = figures
    *seeds, middle = figure.axes[0].get_lines()
    assert len(seeds) == 5
    expected = statistics.interquartile_mean(run.returns, axis=0)
    np.testing.assert_allclose(middle.get_ydata(), expected)
    assert "over 5 seeds, shaded its 95% interval" in figure.get_supxlabel()
    assert len(figure.axes[0].collections) == 1
    # Four seeds are too few for an interval.
    plotting.learning_curve(
        tmp_path / "x.png", run.env_steps, run.returns[:4], title="hopper"
    )
    assert "over 4 seeds; grey" in figures[1].get_supxlabel()
    assert not figures[1].axes[0].collections
    # Nothing to draw is no error.
    nothing = np.full((2, 50), np.nan)
    plotting.learning_curve(tmp_path / "x.png", run.env_steps, nothing, title="hopper")


def test_a_sweep_has_a_panel_for_each_hyperparameter(figures, tmp_path):
    alphas, rules = (0.02, 0.1, 1.0), ("gap", "both", "fixed")
    points = [(x, y) for x in alphas for y in rules]
    values = dict(zip(("alpha", "imitation_rule"), zip(*points)))
    values["gamma"] = tuple(np.linspace(0.9, 0.99, 9))
    returns = np.arange(9.0)
    plotting.marginals(
        tmp_path / "x.png", values, returns, title="t", best=8, left_out=2
    )
    (figure,) = figures
    alpha, rule, gamma = figure.axes
    assert alpha.get_xlabel() == "alpha" and alpha.get_xscale() == "log"
    assert [x.get_text() for x in rule.get_xticklabels()] == ["gap", "both", "fixed"]
    means, _, star = alpha.get_lines()
    np.testing.assert_allclose(means.get_ydata(), [1.0, 4.0, 7.0])
    assert (star.get_xdata(), star.get_ydata()) == (1.0, 8.0)
    np.testing.assert_allclose(rule.get_lines()[0].get_ydata(), [3.0, 4.0, 5.0])
    np.testing.assert_allclose(gamma.get_lines()[0].get_ydata(), returns)
    caption = figure.get_supxlabel().replace("\n", " ")
    assert "2 of 11 points are left out, because a seed has no return" in caption


def labels_of(points):
    return results._labels(mock.Mock(sweep=mock.Mock(points=points)))


def of_points(returns):
    """Made-up curves that end with returns (points, seeds)."""
    curves = np.repeat(returns[:, :, None], 4, axis=2)
    steps = np.tile([1e3, 2e3, 3e3, 4e3], (len(returns), 1))
    return {"title": "hopper, ppo", "env_steps": steps, "curves": curves}


def test_a_sweep_is_sorted_and_the_best_points_have_curves(figures, tmp_path):
    points = [{"alpha": x, "gamma": 0.9} for x in (0.1, 1.0, 2.0)]
    returns = np.array([[1.0, 2.0], [3.0, 4.0], [np.nan, 9.0]])
    plotting.final_returns(
        tmp_path / "x.png", labels_of(points), returns, **of_points(returns)
    )
    (figure,) = figures
    rows, curves = figure.axes
    labels = rows.get_yticklabels()
    names = ["1: alpha=1", "0: alpha=0.1", "2: alpha=2"]
    assert [label.get_text() for label in labels] == names
    assert [label.get_weight() for label in labels] == ["bold", "normal", "normal"]
    assert [x.get_ydata()[-1] for x in curves.get_lines()] == [3.5, 1.5]
    assert [x.get_label() for x in curves.get_lines()] == ["1", "0"]
    assert curves.get_xlabel() == "steps" and figure.get_suptitle() == "hopper, ppo"


def test_a_picture_of_many_points_is_not_too_large(monkeypatch, tmp_path):
    kept = []
    pixels = lambda self, *_, dpi: kept.append(dpi * self.get_size_inches().max())
    monkeypatch.setattr(matplotlib.figure.Figure, "savefig", pixels)
    names = [f"alpha={i}" for i in range(1300)]
    returns = np.zeros((1300, 1))
    plotting.final_returns(tmp_path / "x.png", names, returns, **of_points(returns))
    assert kept[0] < 2**16

"""The plan of all agents and tasks: alike for every agent, and its holes are told."""

import collections

import numpy as np
import pytest

from experiments import __main__, matrix
from experiments.figures import FIGURES
from experiments.matrix import AGENTS, SPACES, Cell, Single
from experiments.report import Page
from experiments.store import Record, Store


def fill(store, cell, stage, scores):
    """As if each point's seeds all had ended with its score."""
    steps, nan = np.arange(1, 11) * 100, np.full(10, np.nan)
    store.add(
        {
            run: Record(steps, np.full(10, float(score)), nan, {"physics": "mjx"})
            for runs, score in zip(cell.runs(stage), scores, strict=True)
            for run in runs
        }
    )


@pytest.mark.parametrize("agent", AGENTS)
def test_every_agent_is_searched_alike(agent):
    points = matrix.draw(agent)
    assert len(points) == len(matrix.draw("ppo")) == len(set(map(str, points)))
    for name, values in SPACES[agent].items():
        assert list(values) == sorted(values)
        counts = collections.Counter(point[name] for point in points)
        assert set(counts) == set(values)
        assert max(counts.values()) - min(counts.values()) <= 1


def test_a_value_at_an_end_is_tried_one_step_further():
    point = dict(zip(SPACES["ppo"], (1e-4, 0.98, 0.995, 0.4), strict=True))
    further = list(matrix.beyond("ppo", point))
    assert further == [{**point, "learning_rate": 3e-5}, {**point, "gamma": 0.998}]


def test_the_best_of_all_points_is_chosen(tmp_path):
    store, cell = Store(tmp_path), Cell("swimmer", "ppo", 20)
    (first,) = cell.stages(store)
    scores = np.arange(len(first.points))
    assert cell.best(store) is None
    fill(store, cell, first, scores)
    first, second = cell.stages(store)
    assert cell.chosen(store) is None  # until those beyond have been tried
    fill(store, cell, second, [0.0] * (len(second.points) - 1) + [99.0])
    point, best = cell.best(store)
    assert point == second.points[-1] and best.tolist() == [99.0, 99.0]
    for run in cell.runs(second)[-1]:
        assert run.config.normalize_rewards and run.config.num_envs == 32
        assert not run.config.decompose_rewards and run.reward_delay == 20
    adaptive = Cell("swimmer", "ppo+gasil-adaptive", 20).config({})
    assert adaptive.decompose_rewards


def test_one_point_for_all_tasks_has_the_best_mean_rank(tmp_path):
    store, single = Store(tmp_path), Single("hopper", "ppo", 20)
    points = matrix.draw("ppo")
    for number, (env, delay) in enumerate(matrix.CELLS):
        assert single.chosen(store) is None
        cell = Cell(env, "ppo", delay)
        # The first point is by far the best on one task; the second is so everywhere.
        scores = np.arange(len(points), 0.0, -1.0)
        scores[0] = 1e6 if number == 0 else -1.0
        fill(store, cell, cell.stages(store)[0], scores)
    assert single.chosen(store) == points[1]


def test_what_matters_is_told(tmp_path):
    store, points = Store(tmp_path), matrix.draw("ppo")
    assert matrix.importance("ppo", store) == {}
    for env, delay in matrix.CELLS:
        cell = Cell(env, "ppo", delay)
        fill(store, cell, cell.stages(store)[0], [1e4 * x["gamma"] for x in points])
    shares = matrix.importance("ppo", store)
    assert shares["gamma"] == pytest.approx(1.0)
    assert max(shares["gae_lambda"], shares["initial_deviation"]) < 0.3
    row = next(
        x for x in Page("matrix", store).importance().splitlines() if "| ppo |" in x
    )
    assert "| 100% |" in row


def test_holes_of_the_plan_are_told(tmp_path, monkeypatch, capsys):
    store, cell = Store(tmp_path / "runs"), Cell("hopper", "ppo", 20)
    (first,) = cell.stages(store)
    fill(store, cell, first, range(len(first.points)))
    curves = [curve for *_, curve in FIGURES["matrix"].curves()]
    rows = {x.cell: x for x in matrix.coverage(store, curves)}
    # Where rewards are delayed, there is PPO with decomposed rewards too.
    assert len(rows) == len(matrix.CELLS) * len(AGENTS) + len(matrix.TASKS)
    mine, other = rows[cell], rows[Cell("hopper", "ppo", 1)]
    assert mine.searched == 2 * len(first.points) < mine.to_search
    assert (mine.trained, mine.to_train) == (0, 20) and not mine.complete
    assert (other.searched, other.to_train) == (0, 10)
    monkeypatch.setattr(__main__, "RESULTS", tmp_path)
    assert __main__.main(["coverage"]) == 1
    printed = capsys.readouterr().out
    line = next(x for x in printed.splitlines() if x.startswith("hopper-delayed"))
    words = f"hopper-delayed ppo {mine.searched} of {mine.to_search} 0 of 20"
    assert line.split() == words.split()

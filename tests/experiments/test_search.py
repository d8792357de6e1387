"""The points that a search tries, and the one that it chooses."""

import collections
import dataclasses
import itertools

import numpy as np
import pytest

from experiments import search as searches
from experiments.figures import Figure
from experiments.report import Page
from experiments.search import AGENTS, DELAY, PAIR, SPACES, TASKS, Search
from experiments.store import RESULTS, Record, Store


def fill(store, search, stage, scores):
    """As if each point's seeds all had ended with its score."""
    records = {}
    for runs, score in zip(search.runs(stage), scores, strict=True):
        for run in runs:
            values = np.array([0.0] * 8 + [score] * 2)
            nan = np.full(10, np.nan)
            steps = np.arange(1, 11) * 100
            records[run] = Record(steps, values, nan, {"physics": "mjx"})
    store.add(records)


@pytest.fixture
def five(monkeypatch):
    """PPO's search has five points with two seeds."""
    rates = (5e-4, 4e-4, 3e-4, 2e-4, 1e-4)
    monkeypatch.setitem(SPACES, "ppo", {"learning_rate": rates})
    monkeypatch.setattr(searches, "_RUNS", 10)
    return Search("hopper", "ppo")


def test_the_best_points_are_compared_again(tmp_path, five):
    """What looks best with few seeds is not taken if more seeds say otherwise."""
    store = Store(tmp_path)
    (first,) = five.stages(store)
    assert five.best(store) is None
    fill(store, five, first, (1.0, 9.0, 3.0, 8.0, 7.0))
    # The second stage may choose another: no figure has the first's best.
    assert five.chosen(store) is None
    first, second = five.stages(store)
    kept = [point["learning_rate"] for point in second.points]
    assert kept == [4e-4, 2e-4, 1e-4, 3e-4]
    assert not set(first.seeds) & set(second.seeds)
    # 2 seeds with 9 and 4 with 2; 8 and 7: 8 x 2 + 7 x 4 is more.
    fill(store, five, second, (2.0, 7.0, 6.0, 3.0))
    point, scores = five.best(store)
    assert point == {"learning_rate": 2e-4}
    assert scores.tolist() == [8.0] * 2 + [7.0] * 4
    table = Page(
        "x", store, figure=Figure("", "", searches={"hopper ppo": five})
    ).searches()
    assert (
        "| hopper ppo | 5 x 2 | 4 x 4 | learning_rate 0.0002 | 7 | 6 | 7 | 1 |" in table
    )


def test_points_that_ended_no_episode_are_last(tmp_path, five):
    store = Store(tmp_path)
    fill(store, five, five.first(store), (np.nan, -9.0, 1.0, -2.0, -1.0))
    second = five.stages(store)[1]
    assert {"learning_rate": 5e-4} not in second.points


def test_a_search_with_seeds_enough_has_one_stage(tmp_path):
    store, search = Store(tmp_path), Search("hopper", "ppo", DELAY)
    (first,) = search.stages(store)
    assert len(first.seeds) == 8
    fill(store, search, first, (1.0, 3.0, 2.0, 0.0))
    assert search.stages(store) == [first]
    assert search.chosen(store) == first.points[1]


def test_a_wider_search_covers_what_the_first_leaves_open(tmp_path):
    store, before = Store(tmp_path), Search("hopper", "ppo+gasil", DELAY)
    free = ("discriminator_updates", "discriminator_learning_rate", "buffer_steps")
    wider = dataclasses.replace(before, after=before, free=free)
    assert wider.stages(store) == []
    first = before.first(store)
    scores = [100 * x["alpha"] - 1e6 * x["learning_rate"] for x in first.points]
    fill(store, before, first, scores)
    (stage,) = wider.stages(store)
    assert len({tuple(point.items()) for point in stage.points}) == 32
    assert {(x["alpha"], x["learning_rate"]) for x in stage.points} == {(1.0, 1e-4)}


def test_the_effect_of_a_hyperparameter_is_the_mean_of_its_points(tmp_path):
    store, search = Store(tmp_path), Search("hopper", "ppo+gasil", DELAY)
    stage = search.first(store)
    others = {"sil": Search("hopper", "ppo+sil", DELAY)}
    figure = Figure("", "", searches=others | {"hopper": search})
    effects = Page("x", store, figure=figure).effects
    assert len(effects().splitlines()) == 2
    fill(store, search, stage, range(16))
    head, _, row = effects().splitlines()
    cells = dict(zip(head.split(" | "), row.split(" | "), strict=True))
    for name, values in SPACES["ppo+gasil"].items():
        (cell,) = (x for label, x in cells.items() if label.strip("| ") == name)
        for value in values:
            has = [i for i, x in enumerate(stage.points) if x[name] == value]
            assert len(has) in (4, 8)
            assert f"{value:g}: {np.mean(has):.0f}" in cell


def test_every_pair_of_values_is_drawn_equally_often():
    space = SPACES["ppo+gasil"]
    points = searches.draw(space)
    assert len({tuple(point.items()) for point in points}) == 16
    for one, other in itertools.combinations(space, 2):
        counts = collections.Counter((point[one], point[other]) for point in points)
        pairs = list(itertools.product(space[one], space[other]))
        assert counts == dict.fromkeys(pairs, 16 // len(pairs))
    with pytest.raises(ValueError, match="at most five hyperparameters"):
        searches.draw({"alpha": tuple(range(17))})


def test_every_agent_has_as_many_runs(tmp_path):
    store = Store(tmp_path)
    for env, agent in itertools.product(TASKS, AGENTS):
        search = Search(env, agent, DELAY)
        runs = search.runs(search.first(store))
        total = 16 if env in ("ant", "humanoid") else 32
        assert sum(map(len, runs)) == total


def test_the_searches_that_are_checked_in_are_complete():
    store = Store(RESULTS / "runs")
    for env, agent in itertools.product(TASKS, AGENTS):
        assert Search(env, agent).chosen(store) and Search(env, agent, DELAY).chosen(
            store
        )
    for agent in PAIR:
        assert Search("point_mass", agent).chosen(store)

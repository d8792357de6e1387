"""The plan of all agents and tasks: alike for every agent, and its holes are told."""

import collections

import numpy as np
import pytest

from experiments import search
from experiments.search import (
    AGENTS,
    SPACES,
    TASKS,
    Search,
    SingleSetting,
)
from experiments.store import RESULTS, Record, Store


def fill(store, one, points, scores, seeds=(1000, 1001)):
    """As if each point's seeds all had ended with its score."""
    steps, nan = np.arange(1, 11) * 100, np.full(10, np.nan)
    store.add(
        {
            run: Record(steps, np.full(10, float(score)), nan, {"physics": "mjx"})
            for runs, score in zip(one.runs(points, seeds), scores, strict=True)
            for run in runs
        }
    )


@pytest.mark.parametrize("agent", AGENTS)
def test_every_agent_is_searched_alike(agent):
    points = search.draw(agent)
    assert len(points) == len(search.draw("ppo")) == len(set(map(str, points)))
    for name, values in SPACES[agent].items():
        assert list(values) == sorted(values)
        counts = collections.Counter(point[name] for point in points)
        assert set(counts) == set(values)
        assert max(counts.values()) - min(counts.values()) <= 1


def test_a_value_at_an_end_is_tried_one_step_further():
    point = dict(zip(SPACES["ppo"], (1e-4, 0.98, 0.995, 0.4), strict=True))
    further = list(search.beyond("ppo", point))
    assert further == [{**point, "learning_rate": 3e-5}, {**point, "gamma": 0.998}]


def test_the_best_of_all_points_is_chosen(tmp_path):
    store, one = Store(tmp_path), Search("swimmer", "ppo", 20)
    drawn = one.points(store)
    assert one.best(store) is None
    fill(store, one, drawn, np.arange(len(drawn)))
    assert one.chosen(store) is None  # until those beyond have been tried
    further = one.points(store)[len(drawn) :]
    fill(store, one, further, [0.0] * (len(further) - 1) + [99.0])
    assert one.best(store) is None  # until the best have been trained with more seeds
    finalists = one.finalists(store)
    assert finalists == (further[-1], drawn[-1], drawn[-2])
    requested = one.requested(store)
    assert len(requested) == 2 * len(drawn + further) + 4 * len(finalists)
    fill(store, one, finalists, [0.0, 50.0, 60.0], range(1002, 1006))
    assert not store.missing(requested)
    point, best = one.best(store)  # (99 + 99) / 6 and (10 + 10 + 4 * 60) / 6
    assert point == drawn[-2]
    assert best.tolist() == [10.0, 10.0, *[60.0] * 4]
    for run in one.runs(further)[-1]:
        settings = run.algorithm.settings
        assert settings["normalize_rewards"] and settings["num_envs"] == 32
        assert not settings["decompose_rewards"] and run.settings.reward_delay == 20


def test_a_point_that_ended_no_episode_is_not_chosen(tmp_path):
    store, one = Store(tmp_path), Search("swimmer", "ppo", 20)
    drawn = one.points(store)
    fill(store, one, drawn, [np.nan, 2.0, *[1.0] * (len(drawn) - 2)])
    assert one.points(store)[len(drawn) :] == tuple(search.beyond("ppo", drawn[1]))


def test_one_point_for_all_delayed_tasks_has_the_best_mean_rank(tmp_path):
    store, single = Store(tmp_path), SingleSetting("hopper", "ppo", 20)
    points = search.draw("ppo")
    for number, env in enumerate(TASKS):
        assert single.chosen(store) is None
        one = Search(env, "ppo", 20)
        # The first point is by far the best on one task; the second is so everywhere.
        scores = np.arange(len(points), 0.0, -1.0)
        scores[0] = 1e6 if number == 0 else -1.0
        fill(store, one, points, scores)
    assert single.chosen(store) == points[1]


def test_an_agent_with_ppos_values_keeps_what_ppo_does_not_have(tmp_path):
    store, mixed = Store(tmp_path), Search("hopper", "ppo+bc", chooser="ppo")
    chosen = {}
    for agent in ("ppo", "ppo+bc"):
        assert mixed.chosen(store) is None
        one = Search("hopper", agent)
        fill(store, one, search.draw(agent), np.arange(len(search.draw(agent))))
        fill(store, one, one.points(store), np.arange(len(one.points(store))))
        fill(store, one, one.finalists(store), [1.0, 0.0, 0.0], range(1002, 1006))
        chosen[agent] = one.chosen(store)
    assert mixed.chosen(store) == {**chosen["ppo+bc"], **chosen["ppo"]}
    assert mixed.chosen(store) != chosen["ppo+bc"]
    assert "behavior_cloning_coefficient" not in chosen["ppo"]


def test_the_papers_protocol_has_the_appendix_s_values():
    numbers = {"ppo": 4, "ppo+bc": 16, "ppo+sil": 16, "ppo+bonus": 16, "ppo+gasil": 32}
    for agent, count in numbers.items():
        points = search.paper_points(agent)
        assert len(points) == len(set(map(str, points))) == count
        for name, values in search.PAPER_SPACES[agent].items():
            counts = collections.Counter(point[name] for point in points)
            assert set(counts) == set(values) and len(set(counts.values())) == 1
    one = search.PaperSearch("hopper", "ppo+gasil", 20)
    for runs in one.runs(one.points(Store(RESULTS / "runs"))):
        assert [run.seed for run in runs] == [1000, 1001]
        algorithm, config = runs[0].algorithm, runs[0].algorithm.config
        assert (config.num_envs, config.num_steps) == (1, 2048)
        assert algorithm.settings["normalize_rewards"] and not config.stagger_episodes
        assert (config.num_epochs, config.minibatch_size) == (10, 64)
        assert (config.gamma, config.gae_lambda) == (0.99, 0.95)
        assert config.initial_std == 1.0 and config.entropy_coefficient == 0.0


def test_the_best_of_two_seeds_is_chosen_under_the_papers_protocol(tmp_path):
    store, one = Store(tmp_path), search.PaperSearch("hopper", "ppo", 20)
    raw = search.PaperSearch("hopper", "ppo", 20, normalize_rewards=False)
    assert one.best(store) is None
    fill(store, one, one.points(store), [1.0, 3.0, 2.0, 0.0])
    assert one.chosen(store) == {"learning_rate": 5e-5}
    assert not store.missing(one.requested(store)) and raw.chosen(store) is None

"""Shares of seeds that solve a task: against SciPy, and what a page says of them."""

import dataclasses
import sys

import numpy as np
import pytest
import scipy.stats

from experiments import comparisons, report, shares, tables
from experiments.figure_results import Results
from experiments.figures import FIGURES
from experiments.search import (
    SPARSE,
    SPARSE_GRIDS,
    SPARSE_ROBOTS,
    SPARSE_SEARCHED,
    SPARSE_SPACES,
    SparseSearch,
    solved_from,
)
from experiments.store import Record, Store

PROVENANCE = {"physics": "mjx", "versions": {}, "commit": "", "device": "none"}


def record(*returns):
    steps = 1000 * np.arange(1, len(returns) + 1)
    values = np.array(returns, float)
    return Record(steps, values, values, PROVENANCE)


@pytest.mark.parametrize("counts", [(0, 0), (3, 9), (20, 0), (7, 6), (20, 20)])
def test_the_exact_test_is_scipys(counts):
    table = [[x, n - x] for x, n in zip(counts, (20, 20))]
    expected = scipy.stats.fisher_exact(table).pvalue
    assert shares.fisher_p(counts[0], 20, counts[1], 20) == pytest.approx(expected)


def test_a_seed_solves_a_task_with_half_of_a_successs_return():
    until = lambda *returns: shares.steps_until_solved(record(*returns), 1.0)
    assert until(0, 0.6, 0, 1) == 2000 and until(0, 0.5) == 2000
    assert until(0, 0.4) == until(1, 0.49) == until(0, np.nan) == np.inf


def alone_in_its_family(effect):
    return comparisons.judged({"": effect})[""]


def test_differences_are_corrected_and_the_mean_is_over_panels():
    some = lambda count: np.arange(20) < count
    solved = {(p, "a"): some(18) for p in "xyz"} | {(p, "b"): some(4) for p in "xyz"}
    solved |= {("z", "b"): some(17)}
    result = shares.verdicts(solved, [(p, "a", "b") for p in "xyz"])
    assert [*result.values()] == ["better", "better", "not clear"]
    # Of one task this would be 0.03, and of three it is more than 0.05.
    one = solved | {("x", "a"): some(11)}
    assert [
        shares.verdicts(one, [(p, "a", "b") for p in ps])["x", "a", "b"]
        for ps in ("x", "xyz")
    ] == ["better", "not clear"]
    lead = alone_in_its_family(shares.overall(solved, "xyz", ("a", "b")))
    assert lead.middle == pytest.approx((14 + 14 + 1) / 60)
    assert lead.low < lead.middle < lead.high
    assert lead.p < 0.001 and lead.verdict_in_words() == "better"
    assert shares.overall(solved, "xyz", ("a", "a")).p == 1.0


def test_who_is_sooner_is_the_rank_sum_test():
    """Steps infinite for seeds that never solve tie with each other, and come last."""
    rng = np.random.default_rng(0)
    steps = {}
    for panel in "xy":
        for curve, later in (("a", 0.0), ("b", 3.0)):
            until = rng.integers(0, 10, 15) + later
            steps[panel, curve] = np.where(until > 9, np.inf, until)
    expected = []
    for panel in "xy":
        ours, other = steps[panel, "a"], steps[panel, "b"]
        wins = scipy.stats.mannwhitneyu(other, ours).statistic
        expected.append(wins / 15**2 - 0.5)
    lead = alone_in_its_family(shares.sooner(steps, "xy", ("a", "b")))
    assert lead.middle == pytest.approx(np.mean(expected)) and lead.middle > 0.1
    assert lead.low < lead.middle < lead.high and lead.p < 0.01
    # One task alone has SciPy's p-value, which is that of a normal distribution.
    exact = scipy.stats.mannwhitneyu(steps["x", "a"], steps["x", "b"]).pvalue
    alone = shares.sooner(steps, "x", ("a", "b"))
    assert alone.p == pytest.approx(exact, abs=0.02)
    back = shares.sooner(steps, "xy", ("b", "a"))
    assert back.middle == pytest.approx(-lead.middle) and back.p < 0.01
    same = shares.sooner(steps, "xy", ("a", "a"))
    assert same.middle == pytest.approx(0.0) and same.p == 1.0


def test_a_change_of_leads_has_the_spread_of_four_shares():
    some = lambda count: np.arange(20) < count
    solved = {("x", "a"): some(15), ("x", "b"): some(5)}
    solved |= {("noisy", "a"): some(8), ("noisy", "b"): some(10)}
    effect = shares.change(solved, "x", ["noisy"], pair=("a", "b"))
    change = alone_in_its_family(effect)
    assert change.middle == pytest.approx(-0.1 - 0.5)
    deviation = np.sqrt(sum(x.mean() * (1 - x.mean()) / 20 for x in solved.values()))
    half = (change.high - change.low) / 2
    assert half == pytest.approx(1.96 * deviation, rel=0.06)
    normal_p = 2 * scipy.stats.norm.sf(0.6 / deviation)
    assert change.p == pytest.approx(normal_p, abs=5e-3)
    none = shares.change(solved, "x", "x", pair=("a", "b"))
    assert none.p > 0.5
    # Of a single comparison, 1.96 + 0.84 deviations would be found.
    deviation = np.sqrt(2 * (0.75 * 0.25 + 0.25 * 0.75) / 20)
    words = f"not clear (visible from {2.80 * deviation:.2f} on)"
    alone = alone_in_its_family(none)
    assert alone.verdict_in_words(".2f") == words
    pair = comparisons.judged({"changed": effect, "none": none})
    assert pair["changed"].p == pytest.approx(2 * change.p)
    assert alone.visible < pair["none"].visible


def test_one_point_is_chosen_for_all_tasks(tmp_path):
    store = Store(tmp_path)
    search = SparseSearch(SPARSE_SEARCHED[0], "ppo")
    good = search.points(store)[3]
    for env in SPARSE_SEARCHED:
        assert search.best(store) is None
        own = dataclasses.replace(search, env=env)
        store.add(
            {
                run: record(
                    *[solved_from(env) * (run.algorithm == own.algorithm(good))] * 10
                )
                for run in own.requested(store)
            }
        )
    point, progress = search.best(store)
    assert point == good and (progress == 1.0).all()
    # Other tasks, with noise for example, get the same point.
    noisy = SparseSearch("sparse:u_maze_noisy", "ppo")
    assert noisy.chosen(store) == good
    assert {len(SparseSearch("", x).points(store)) for x in SPARSE_SPACES} == {6}


def test_a_page_tells_shares_and_verdicts(tmp_path):
    store, figure = Store(tmp_path), FIGURES["sparse_causes"]
    for curves in figure.panels.values():
        for name, curve in curves.items():
            best = solved_from(curve.env) if name == "novelty" else 0.0
            store.add({run: record(*[best] * 10) for run in curve.runs(store)})
    results = Results(figure, store)
    table = tables.shares(results)
    assert "| mean | 0.00 |" in table and "1.00 (1)" in table
    words = "novelty against ppo: mean share +1.00 [+1.00, +1.00], better; better on 3"
    assert f"{words} of 3 tasks" in tables.lead(results, "novelty", "", "ppo")
    assert tables.means(results, "", "ppo", "novelty") == "PPO 0.00, NOVELTY 1.00"
    words = (
        "- novelty sooner than ppo: with probability 1.00 [1.00, 1.00], better, on 3"
    )
    assert tables.sooner(results, "novelty", "", "ppo") == f"{words} tasks."
    assert "How to read this" in report.page("x", results, "")


def test_a_page_tells_what_noise_changes(tmp_path, monkeypatch):
    monkeypatch.setattr(SparseSearch, "chosen", lambda *_: {})
    store, figure = Store(tmp_path), FIGURES["sparse"]
    results = lambda: Results(figure, store)
    for panel, curves in figure.panels.items():
        if panel.removesuffix("_noisy") != "sparse:u_maze":
            continue
        for agent in ("ppo", "ppo+sil"):
            solves = (agent == "ppo") == panel.endswith("_noisy")
            returns = [solved_from(curves[agent].env) * solves] * 10
            store.add(dict.fromkeys(curves[agent].runs(store), record(*returns)))
    words = (
        "ppo+sil's lead over ppo: -2.00 [-2.00, -2.00] with noise, worse, on 1 tasks"
    )
    assert tables.noise(results(), "ppo", "ppo+sil", "ppo+bc") == f"- {words}."


def test_longer_tasks_are_told_apart_and_without_their_package(tmp_path, monkeypatch):
    """The mean of the others must not wait for them, nor mix with them."""
    monkeypatch.setitem(sys.modules, "navix", None)
    monkeypatch.delitem(sys.modules, "gasil_envs.of_navix", raising=False)
    monkeypatch.setattr(SparseSearch, "chosen", lambda *_: {})
    store, figure = Store(tmp_path), FIGURES["sparse"]
    results = lambda: Results(figure, store)
    for env in SPARSE:
        (run, *_) = runs = figure.panels[env]["ppo"].runs(store)
        assert run.algorithm.config.total_steps == 500_000
        store.add(dict.fromkeys(runs, record(*[solved_from(env)] * 10)))
    assert tables.mean_shares(results())["ppo"] == 1.0
    assert (
        tables.mean_shares(results(), "robots")
        == tables.mean_shares(results(), "navix")
        == {}
    )
    for env in (*SPARSE_ROBOTS, *SPARSE_GRIDS):
        (run, *_) = runs = figure.panels[env]["ppo"].runs(store)
        assert run.algorithm.config.total_steps == 1_000_000
        best = solved_from(env) * (env in SPARSE_GRIDS)
        store.add(dict.fromkeys(runs, record(*[best] * 10)))
    for kind, share in (("", 1.0), ("robots", 0.0), ("navix", 1.0)):
        assert tables.mean_shares(results(), kind)["ppo"] == share
    for panel, noise in ((SPARSE_GRIDS[0], 0.0), (f"{SPARSE_GRIDS[0]}_noisy", 0.1)):
        runs = figure.panels[panel]["ppo+bc"].runs(store)
        assert {run.settings.action_noise for run in runs} == {noise}
    table = tables.shares(results(), "robots")
    assert "| halfcheetah | 0.00 |" in table and "maze" not in table
    assert tables.shares(results(), "robots noisy") == ""  # Nothing of it is stored.

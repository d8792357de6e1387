"""The runs that the figures request."""

import dataclasses

import numpy as np
import pytest

from experiments import search
from experiments.curves import Curve
from experiments.figures import FIGURES
from experiments.search import Search
from experiments.store import RESULTS, Record, Store
from gasil_jax.algorithms import check

STORE = Store(RESULTS / "runs")


@pytest.mark.parametrize("name", FIGURES)
def test_every_run_of_a_figure_is_valid(name):
    runs = FIGURES[name].requested(STORE)
    for algorithm in {run.algorithm for run in runs}:
        check(algorithm)


@pytest.mark.parametrize("name", FIGURES)
def test_a_figure_names_what_it_has(name):
    figure = FIGURES[name]
    names = {
        (panel, curve) for panel, curves in figure.panels.items() for curve in curves
    }
    if figure.early is not None:
        names |= {(panel, f"{curve} early") for panel, curve in names}
    for terms in figure.compared().values():
        assert {(panel, curve) for _, panel, curve in terms} <= names
        assert sum(weight for weight, _, _ in terms) == 0


def test_a_curve_has_no_runs_before_its_search_has_chosen(tmp_path):
    store, curves = Store(tmp_path), FIGURES["matrix"].panels["hopper-delayed"]
    for curve in curves.values():
        assert curve.runs(store) == ()
        while missing := store.missing(curve.search.requested(store)):
            assert curve.runs(store) == ()
            record = Record(*[np.ones(10)] * 3, {"physics": "mjx"})
            store.add(dict.fromkeys(missing, record))
        (first,) = curve.search.runs(search.draw(curve.agent)[:1])
        runs = curve.runs(store)
        assert [run.seed for run in runs] == list(range(20))
        assert runs[0].algorithm == first[0].algorithm


def test_a_curve_changes_what_was_chosen(tmp_path, monkeypatch):
    monkeypatch.setattr(Search, "chosen", lambda *_: {"alpha": 0.2, "gamma": 0.99})
    curves = FIGURES["humanoid"].panels["humanoid"]
    scheduled, fixed = (
        curves[name].runs(STORE)[0].algorithm
        for name in ("ppo+gasil-from-2M", "ppo+gasil")
    )
    assert scheduled.agent.alpha_schedule == ((2e6, 0.0), (3e6, 1.0))
    assert (fixed.agent.alpha, fixed.config.total_steps) == (0.2, 3_000_000)
    assert scheduled.replace(alpha=0.2, alpha_schedule=()) == fixed
    bare = dataclasses.replace(curves["ppo"], base="tuned", changes={})
    assert isinstance(bare, Curve) and bare.point(STORE) == {}

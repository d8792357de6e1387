"""Pages and pictures are what the stored runs say."""

import csv
import dataclasses
import functools
import re

import numpy as np
import pytest

from experiments import (
    claims,
    comparisons,
    doing_nothing,
    figure_results,
    plots,
    report,
    search,
    tables,
)
from experiments.curves import Arm, Curve, Figure, grid
from experiments.figure_results import Results
from experiments.figures import FIGURES
from experiments.search import SparseSearch, solved_from
from experiments.store import RESULTS, Record, Store
from gasil_jax import presets
from gasil_jax.errors import InputError

FIGURE = Figure(
    "Title",
    "Claim.",
    {
        panel: {
            name: Curve(env, "ppo", seeds=6, changes={"gamma": gamma})
            for name, gamma in (("ours", 0.5), ("other", 0.6))
        }
        for panel, env in (("one", "hopper"), ("two", "swimmer"))
    },
    favourite="ours",
)
BY = {"physics": "mjx", "device": None, "versions": None, "commit": "c"}


def constant(value, steps=(), returns=()):
    """A record that always returned the same, and its evaluations."""
    nan, values = np.full(10, np.nan), np.full(10, value)
    by = {**BY, "clean": False}
    every = (np.arange(1, 11), values, nan, by, np.array(steps), np.array(returns))
    return Record(*every)


@pytest.fixture
def results(tmp_path):
    store = Store(tmp_path / "runs")
    for panel, means in (("one", (200.0, 100.0)), ("two", (5.0, 5.0))):
        for curve, mean in zip(FIGURE.panels[panel].values(), means, strict=True):
            runs = enumerate(curve.runs(store))
            store.add({run: constant(mean + i) for i, run in runs})
    return Results("x", FIGURE, store)


@pytest.fixture(scope="module")
def published():
    """The results of all figures."""
    return report.all_results(Store(RESULTS / "runs"))


@pytest.mark.parametrize("name", report.NAMES)
def test_a_page_is_what_the_stored_runs_say(name, published):
    text = report.note(name)
    assert (report.PAGES / f"{name}.md").read_text() == report.page(published, text)
    for picture in report.pictures(published, text):
        assert (report.PAGES / picture).exists()


def test_the_readme_tables_and_presets_are_what_the_stored_runs_say(published):
    value = functools.partial(report.value, published)
    for path in report.DOCUMENTS:
        text = path.read_text()
        assert report.fill_blocks(text, value) == text
        assert text.count("<!-- begin ") == text.count("<!-- end -->") > 0
    assert presets.TUNED.read_text() == report.tuned(published)
    for name, rows in (
        ("curves", report.curves_table(published)),
        ("comparisons", report.comparisons_table(published)),
    ):
        with (report.PAGES / f"{name}.csv").open(newline="") as file:
            assert [*csv.reader(file)] == [*rows]


def test_a_forest_has_a_row_for_each_pair(results):
    (row,) = results.forest()
    assert row.name == "ours − other"
    # All pairs of seeds on one task, and half of the others.
    assert row.compared.middle == 0.25
    assert row.verdicts == {"one": "better", "two": "not clear"}
    numbers = tables.numbers(results)
    assert "| ours | 202 | 7.5 |" in numbers and "| ours − other | 0.75 [" in numbers
    assert results.forest("dense") == results.forest() and not results.forest("raw")
    _, panels, squares = None, *plots.forest(results).axes
    assert len(squares.patches) == 2
    colors = [x.get_facecolor() for x in squares.patches]
    assert colors[0] != colors[1]
    # The interval, the estimate and the smallest visible effects.
    assert len(panels.get_lines()) == 2 + 1 + 2


def test_slots(results):
    value = functools.partial(report.value, {"x": results})
    filled = report.fill("so {{x count better '' ours other}} tasks", value)
    assert filled == "so 1 of 2 tasks"
    assert value("x", "final", "one", "ours") == "202"
    assert value("x", "apart", "two", "ours", "other").endswith(", not clear")
    assert value("x", "share", "", "none") == "not measured"
    assert tables.passing(results, "150", "one").splitlines()[2:] == [
        "| ours | 100% of 6 |",
        "| other | 0% of 6 |",
    ]
    assert value("x", "foretold", "one", "ours", "other", "better") == "yes"
    wrong = ("one", "ours", "other", "worse")
    assert tables.foretold(results, *wrong, *wrong[:3], "better") == "1 of 2"
    with pytest.raises(InputError, match="foretold has one, ours, ours"):
        tables.foretold(results, "one", "ours", "ours", "better")
    with pytest.raises(InputError, match="slot is x nonsense"):
        value("x", "nonsense")
    with pytest.raises(InputError, match="curve"):
        value("x", "final", "one", "mine")


def test_every_number_is_in_the_tables(results):
    head, *rows = report.curves_table({"x": results})
    row = dict(zip(head, rows[0], strict=True))
    assert row["final_return"] == "202.5" and row["seeds"] == "6"
    assert float(row["low"]) < 202.5 < float(row["high"])
    assert row["trained_with"] == "mjx, commit c, changed"
    assert "gamma 0.5" in row["settings"]
    head, *rows = report.comparisons_table({"x": results})
    assert [row[-1] for row in rows] == ["better", "not clear"]


def test_what_lacks_seeds_is_not_compared(results):
    curve = dataclasses.replace(FIGURE.panels["one"]["ours"], seeds=7)
    panels = {**FIGURE.panels, "one": {**FIGURE.panels["one"], "ours": curve}}
    figure = dataclasses.replace(FIGURE, panels=panels)
    lacking = Results("x", figure, results.searched)
    assert ("one", "ours", "other") not in lacking.comparisons
    assert "Not trained yet: 1 of 25 runs." in tables.numbers(lacking)


def test_a_page_is_written_with_its_pictures(results, tmp_path):
    text = "# Title\n\n{{x claim}}\n\n{{x curves}}\n\n{{x forest dense}}\n"
    report.write({"x": results}, "page", tmp_path, text)
    for picture in ("x.png", "x_forest_dense.png"):
        assert (tmp_path / picture).read_bytes().startswith(b"\x89PNG")
    page = (tmp_path / "page.md").read_text()
    assert "# Title\n\n**The paper's claim.** Claim.\n\n![" in page
    assert "](x_forest_dense.png)\n\n<details" in page


def test_a_page_tells_shares_and_who_is_sooner(tmp_path):
    store, figure = Store(tmp_path), FIGURES["sparse_causes"]
    for curves in figure.panels.values():
        for name, curve in curves.items():
            best = solved_from(curve.env) if name == "novelty" else 0.0
            store.add(dict.fromkeys(curve.runs(store), constant(best)))
    results = Results("x", figure, store)
    rows = {row.name: row for row in results.forest()}
    assert rows["novelty − ppo"].compared.middle == 1.0
    assert [*rows["novelty − ppo"].verdicts.values()] == ["better"] * 3
    sooner = {row.name: row.compared for row in results.forest(sooner=True)}
    assert sooner["novelty − ppo"].middle == 0.5
    assert sooner["cloning − ppo"].verdict == "not clear"
    numbers = tables.numbers(results)
    assert "| novelty | 1.00 (0) | 1.00 (0) | 1.00 (0) |" in numbers
    assert "| novelty − ppo | 1.00 [1.00, 1.00] |" in numbers
    assert tables.share(results, "", "novelty") == "100%"
    assert len(plots.forest(results).axes) == 3


def test_of_two_curves_below_doing_nothing_neither_is_better(tmp_path, monkeypatch):
    panels = grid(("ant", "hopper"), ["ppo", "ppo+gasil"], base=None, seeds=5)
    figure = Figure("Ants", "", panels, floor=True)
    store = Store(tmp_path)
    for curves in panels.values():
        for i, curve in enumerate(curves.values()):
            runs = enumerate(curve.runs(store))
            store.add({run: constant(900.0 * i + j) for j, run in runs})
    for floor, verdict in ((2000.0, comparisons.BELOW), (500.0, "better")):
        floors = {
            x: doing_nothing.Return(*[y] * 3)
            for x, y in (("ant", floor), ("hopper", 0))
        }
        monkeypatch.setattr(doing_nothing, "stored", lambda floors=floors: floors)
        results = Results("x", figure, store)
        (row,) = results.forest()
        assert row.verdicts == {"ant": verdict, "hopper": "better"}
        assert tables.below(results) == "ant" * (verdict == comparisons.BELOW)
        assert f"| doing nothing | {floor:,.0f} | 0.0 |" in tables.numbers(results)


@pytest.mark.parametrize(
    ("verdicts", "words"),
    [
        ([], "not measured"),
        (["better", "better"], "**holds**: 2 of 2 (0, 1); 1 not measured"),
        (["not clear"] * 2, "**does not hold**: 0 of 2; 1 not measured"),
        (
            ["worse", "better", "worse"],
            "**holds in part**: 1 of 3 (1); the opposite in 2 of 3 comparisons",
        ),
    ],
)
def test_a_claim_is_only_judged_when_its_cases_decide(verdicts, words):
    keys = [("panel", "ppo+gasil", f"other {i}") for i in range(3)]
    of = {"better": (1.0, 0.0), "worse": (-1.0, 0.0), "not clear": (1.0, 1.0)}
    compared = {
        key: comparisons.Comparison(*of[verdict], low=0.0, high=0.0, visible=0.0)
        for key, verdict in zip(keys, verdicts, strict=False)
    }
    pages = {"x": type("Compared", (), {"comparisons": compared})}
    cases = {f"{i}": [(key, "better")] for i, key in enumerate(keys)}
    assert claims.verdict(pages, claims.Test("x", cases, needed=2)) == words
    assert claims.verdict(pages, None) == ""


@pytest.fixture
def rising(tmp_path):
    """The results of three agents that begin with no return on three tasks."""
    units = {"hopper": 1000.0, "swimmer": 50.0, "ant": 10.0}
    arms = ["ppo", "ppo+bc", Arm("more", "ppo+gasil")]
    panels = grid([*units], arms, base=None, seeds=6)
    store = Store(tmp_path / "runs")
    for panel, curves in panels.items():
        for i, curve in enumerate(curves.values()):
            record = constant(units[panel] * (1 + i))
            record.episode_return[0] = 0.0
            store.add(dict.fromkeys(curve.runs(store), record))
    return Results("x", Figure("", "", panels, favourite="more"), store)


def test_the_mean_over_tasks_stands_beside_them(rising):
    """A score is 0 at the start and 1 at the end of the best."""
    whole = rising.whole()
    assert [x[0] for x in whole.values()] == pytest.approx([1 / 3, 2 / 3, 1.0])
    *drawn, last = [x for x in plots.curves(rising).axes if x.get_visible()]
    assert [x.get_title() for x in drawn] == [*rising.figure.panels]
    assert [x.get_text() for x in last.texts] == [*whole]
    # Panels that share a task have no mean.
    panels = dict.fromkeys(["one", "other"], rising.figure.panels["ant"])
    figure = dataclasses.replace(rising.figure, panels=panels)
    shared = Results("x", figure, rising.searched)
    assert len(shared.scores) == 6 and not shared.whole()


def test_families_of_tasks_stand_in_one_picture(rising):
    assert [*figure_results.families([rising])] == ["dense"]
    scores, ahead = [
        x.get_lines() for x in plots.families([rising]).axes if x.get_visible()
    ]
    # An interval and its middle for each agent.
    middles = [line.get_xdata() for line in scores[1::2]]
    assert np.ravel(middles) == pytest.approx([1 / 3, 2 / 3, 1.0])
    # The null, and an interval, its middle and no visible effect for each of two.
    rows = [line.get_ydata()[0] for line in ahead[1:]]
    assert sorted(set(rows)) == [0, 1]
    text = report.value({"x": rising}, "families", "x")
    assert "![" in text and "](x_families.png)" in text
    assert "| ppo+bc | 0.67 [0.67, 0.67] |" in text
    assert "| ppo | 1.00 [1.00, 1.00], better |" in text
    assert [*report.pictures({"x": rising}, "{{families x}}")] == ["x_families.png"]


def test_what_was_asked_stands_beside_what_came_out(rising):
    value = functools.partial(report.value, {"x": rising}, "x")
    assert value("likely", "more", "ppo", "dense", "0.9").endswith("better, reached")
    assert value("likely", "more", "ppo", "dense", "1.1").endswith("**not reached**")
    on = value("tasks", "not clear", "dense", "more", "ppo")
    assert on == "hopper, swimmer, ant"
    assert value("tasks", "worse", "", "more", "ppo") == "none"
    assert value("tasks", "worse", "raw", "more", "ppo") == "not measured"
    _, _, tasks, own = value("rule", "more", "dense").splitlines()
    assert tasks == "| hopper, swimmer, ant |  |" and "alpha 0.1" in own


def test_one_point_is_chosen_for_all_sparse_tasks(tmp_path):
    store = Store(tmp_path)
    one = SparseSearch(search.SPARSE_SEARCHED[0], "ppo")
    good = one.points(store)[3]
    for env in search.SPARSE_SEARCHED:
        assert one.best(store) is None
        own = dataclasses.replace(one, env=env)
        best = {
            x: solved_from(env) * (x.algorithm == own.algorithm(good))
            for x in own.requested(store)
        }
        store.add({run: constant(value) for run, value in best.items()})
    point, progress = one.best(store)
    assert point == good and (progress == 1.0).all()
    # Other tasks, with noise for example, get the same point.
    assert SparseSearch("sparse:u_maze_noisy", "ppo").chosen(store) == good
    sizes = {len(SparseSearch("", x).points(store)) for x in search.SPARSE_SPACES}
    assert sizes == {6}


#: What may stand in a note in digits: settings, and names.
_SETTINGS = (
    *(
        "walker2d",
        "deep_sea_[12]0",
        "[568]x[568]",
        "`[^`]*`",
        "[Ff]igures? [2-8](?: (?:and|to) [2-8])?",
        r"\dM steps",
    ),
    *("table 1", r"to 0\.02 at 3M", "is 0 until", '"from-2M"', r"\b20 steps", "95%"),
    *("delay 10*", "delay of 1000", "delay 20", r"alpha 0\.02", "32\\s+environments"),
    *("30,000 steps", "128 drawn", "1,000 steps", "buffer of 500"),
)
_NOTES = {x.stem: x.read_text() for x in sorted(report.NOTES.glob("*.md"))}


@pytest.mark.parametrize("name", _NOTES)
def test_no_number_of_a_note_is_typed_by_hand(name):
    """Every digit is of a slot, or of a setting."""
    rest = re.sub(r"{{.+?}}|\]\(.+?\)", "", _NOTES[name])
    for setting in _SETTINGS:
        rest = re.sub(setting, "", rest)
    assert not re.findall(r".*\d.*", rest)


def test_no_verdict_of_a_note_is_typed_by_hand():
    words = r"\b(better than|worse than|clearly|outperforms|ahead of)\b"
    for name, note in _NOTES.items():
        text = " ".join(re.sub(r"{{.+?}}", "", note).split())
        assert not re.findall(words, text), name

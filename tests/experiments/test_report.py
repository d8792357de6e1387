"""Pages are what the stored runs say; verdicts are corrected for their number."""

import dataclasses
import functools
import itertools
import re

import numpy as np
import pytest
from test_figures import DELAYS

from experiments import (
    comparisons,
    doing_nothing,
    figure_results,
    plots,
    report,
    search,
    summary,
    tables,
)
from experiments.comparisons import compare
from experiments.curves import Arm, Curve, Figure, difference, grid
from experiments.figure_results import Results
from experiments.figures import FIGURES
from experiments.store import RESULTS, Record, Store
from gasil_jax import presets
from gasil_jax.errors import InputError
from gasil_jax.host import plotting
from gasil_jax.statistics import interquartile_mean

STORE = Store(RESULTS / "runs")


def scores(**means):
    rng = np.random.default_rng(0)
    return {("a", name): mean + rng.normal(0, 1, 10) for name, mean in means.items()}


def family(*pairs):
    return {("a", *pair): difference("a", *pair) for pair in pairs}


def test_a_clear_difference_is_told_and_none_is_not():
    result = compare(
        scores(high=9.0, low=0.0, same=0.0), family(("high", "low"), ("low", "same"))
    )
    assert result["a", "high", "low"].verdict == "better"
    assert result["a", "low", "same"].verdict == "not clear"
    (other,) = compare(scores(high=9.0, low=0.0), family(("low", "high"))).values()
    assert other.verdict == "worse"
    assert other.low < other.middle < other.high < 0


def test_the_correction_is_holm_s():
    """Against a plain loop over sorted p-values."""
    means = {f"x{i}": 0.4 * i for i in range(6)} | {"zero": 0.0}
    pairs = [(name, "zero") for name in means if name != "zero"]
    data = scores(**means)
    alone = {key: compare(data, {key: x})[key].p for key, x in family(*pairs).items()}
    result = compare(data, family(*pairs))
    order = sorted(alone, key=alone.get)
    rejected = True
    for i, key in enumerate(order):
        rejected = rejected and alone[key] <= comparisons.LEVEL / (len(order) - i)
        assert (result[key].verdict != "not clear") == rejected
    # The correction decides something here.
    assert any(alone[key] <= comparisons.LEVEL < result[key].p for key in order)


def test_the_permutation_test_is_right_with_few_seeds():
    """Against all ways to deal the seeds, and for seeds without a difference."""
    apart = lambda a, b: abs(interquartile_mean(a) - interquartile_mean(b))
    five = {name: x[:5] for name, x in scores(high=9.0, low=0.0).items()}
    close = np.array([5.0, 3.0, 9.0]), np.array([1.0, 4.0, 2.0])
    for ours, other in (close, tuple(five.values())):
        pooled, distance = np.array([*ours, *other]), apart(ours, other)
        ways = [
            apart(pooled[list(x)], np.delete(pooled, x)) >= distance - 1e-9
            for x in itertools.combinations(range(len(pooled)), len(ours))
        ]
        p = comparisons.permutation_p(ours, other)
        assert p == pytest.approx(np.mean(ways), abs=0.01)
        assert p == comparisons.permutation_p(other, ours)
    # The bootstrap's alone would be a hundredth of it.
    (result,) = compare(five, family(("high", "low"))).values()
    assert result.p == p > 0.01
    rng = np.random.default_rng(1)
    ps = [comparisons.permutation_p(*rng.normal(size=(2, 5))) for _ in range(200)]
    assert np.mean(np.array(ps) <= 0.1) < 0.16


def test_a_contrast_is_a_weighted_sum():
    data = scores(ours=5.0, other=1.0, calm=2.0)
    terms = (*difference("a", "ours", "other"), *difference("a", "other", "calm"))
    (result,) = compare(data, {("x",): terms}).values()
    (same,) = compare(data, {("x",): difference("a", "ours", "calm")}).values()
    assert (result.middle, result.low, result.high) == pytest.approx(
        (same.middle, same.low, same.high)
    )


def test_few_seeds_make_nothing_clear():
    few = {name: x[:3] for name, x in scores(high=9.0, low=0.0).items()}
    (result,) = compare(few, family(("high", "low"))).values()
    assert result.verdict == "not clear"
    assert comparisons.interval(np.array([1.0, 2.0, 3.0])) == "2.0"
    # Nor does a seed that ended no episode.
    none = scores(high=9.0, low=0.0)
    none["a", "low"][0] = np.nan
    (result,) = compare(none, family(("high", "low"))).values()
    assert result.verdict == "not clear"
    assert comparisons.interval(np.arange(5.0)).startswith("2.0 [")


def test_the_probability_of_improvement_is_of_pairs_of_seeds():
    data = {
        ("a", "x"): np.array([3.0, 1.0]),
        ("a", "y"): np.array([2.0, 1.0]),
        ("b", "x"): np.array([9.0, 9.0]),
        ("b", "y"): np.array([-1.0, 8.0]),
    }
    # 2 of 4 pairs and half of another on one task, and all 4 on the other.
    assert comparisons.improvement(data, "ab", "x", other="y").startswith("0.81 [")
    assert comparisons.improvement(data, "ab", "y", other="x").startswith("0.19 [")
    assert comparisons.improvement(data, "b", "x", other="y") == "1.00 [1.00, 1.00]"
    # A seed that ended no episode has less than any other, on either side.
    none = {**data, ("b", "y"): np.array([np.nan, np.nan])}
    assert comparisons.improvement(none, "b", "x", other="y") == "1.00 [1.00, 1.00]"
    assert comparisons.improvement(none, "b", "y", other="x") == "0.00 [0.00, 0.00]"


def test_every_task_counts_alike_in_the_aggregate(tmp_path):
    """Tasks have other units and numbers of seeds; one with more seeds weighs alike."""
    arms = ("ppo", "ppo+gasil")
    panels = {
        **grid(("hopper",), arms, (1,), base=None, seeds=8),
        **grid(("hopper",), arms, (20,), base=None, seeds=16),
        **grid(("swimmer",), arms, (1, 20), base=None, seeds=8),
    }
    unit, ratio = {"hopper": 1000.0, "swimmer": 50.0}, {"hopper": 2.0, "swimmer": 4.0}
    store, records = Store(tmp_path / "runs"), {}
    for curve in (x for curves in panels.values() for x in curves.values()):
        delayed = curve.agent == "ppo+gasil" and curve.reward_delay > 1
        value = unit[curve.env] * (ratio[curve.env] if delayed else 1.0)
        for run in curve.runs(store):
            values = np.full(10, value)
            records[run] = Record(np.arange(1, 11), values, values, {"physics": "mjx"})
    store.add(records)
    results = Results(Figure("", "", panels), store)
    _, _, *rows = tables.aggregate(results).splitlines()
    assert rows[0] == "| dense | ppo | 2 | 1.00 [1.00, 1.00] |"
    assert rows[3] == "| delayed | ppo+gasil | 2 | 3.00 [3.00, 3.00] |"


def test_others_returns_stand_beside_ours(tmp_path):
    panels = grid(("hopper", "ant"), ("ppo",), (1, 20), base=None, seeds=8)
    store = Store(tmp_path / "runs")
    for run in panels["ant-delayed"]["ppo"].runs(store):
        store.add({run: Record(*[np.full(10, 700.0)] * 3, {"physics": "mjx"})})
    results = Results(Figure("", "", panels), store)
    printed = tables.published(results, "delayed", "ppo", "gasil")
    head, _, ours, *others = printed.splitlines()
    assert head.split(" | ")[3:] == [*search.TASKS[:-1], f"{search.TASKS[-1]} |"]
    empty = "|  " * 4
    assert ours == f"| ours, ppo | v5 | 8 {empty}| 700 [700, 700] |  |"
    assert len(others) == 2 and all("nnabla-rl" in row for row in others)
    assert "| 2370 | 3494 |" in tables.published(results, "dense", "ppo")


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
    return Results(FIGURE, store)


def test_a_table_and_a_tally(results):
    table = tables.table(results)
    assert "| one | other | 6 | 102 [101, 104] |  | 100 [" in table
    assert report.value(results, "evaluated") == "Nothing is complete yet."
    assert table.count(" better |") == 1 == table.count(" not clear |")
    (line,) = tables.tally(results).splitlines()
    words = "- ours against other: better on 1, not clear on 1 of 2; probability of"
    assert line.startswith(f"{words} improvement 0.75 [")
    assert tables.tally(results, "dense") == line and not tables.tally(results, "raw")
    filled = report.fill("so {{tally dense}}", functools.partial(report.value, results))
    assert filled == f"so {line}"
    assert "- one, ours - other: 100 [" in tables.differences(results)
    assert "commit c, changed" in tables.settings(results)
    with pytest.raises(InputError, match="slot is nonsense"):
        report.value(results, "nonsense")


def test_where_a_curve_is_better_is_half_a_sentence(results):
    words = "better than OTHER on 1 of 2 tasks"
    assert tables.better(results, "", "ours", "other") == words
    words = "better than OTHER and OTHER on 1 of 2 tasks each"
    assert tables.better(results, "", "ours", "other", "other") == words
    one = results.comparisons["one", "ours", "other"]
    behind = dataclasses.replace(one, middle=-one.middle)
    results.comparisons["two", "ours", "other"] = behind
    words = "better than OTHER on 1 (worse on 1) of 2 tasks"
    assert tables.better(results, "", "ours", "other") == words
    del results.comparisons["two", "ours", "other"]
    words = "better than OTHER on 1 of 1 measured tasks"
    assert tables.better(results, "", "ours", "other") == words


def test_the_last_policies_evaluations_are_compared_on_their_own(tmp_path):
    store = Store(tmp_path / "runs")
    # While they learn, ours has more; evaluated, other has. One seed of it was not.
    for name, trained, evaluated in (("ours", 200.0, 5.0), ("other", 100.0, 50.0)):
        for i, run in enumerate(FIGURE.panels["one"][name].runs(store)):
            scored = [(1, 2), (1000.0, evaluated + i)]
            more = [] if (name, i) == ("other", 5) else scored
            store.add({run: constant(trained + i, *more)})
    results = Results(FIGURE, store)
    assert tables.tally(results).startswith("- ours against other: better on 1 of 1, ")
    words = "- ours against other: worse on 1 of 1, 1 without enough evaluations; "
    assert tables.evaluated(results).startswith(words)
    table = tables.table(results)
    assert "| one | ours | 6 | 202 [201, 204] | 7.5 |" in table
    assert "| one | other | 6 | 102 [101, 104] | 52.0 (5) | 100 [" in table


def test_returns_of_curves_beside_each_other(results):
    head, _, ours, other = tables.returns(results, "two", "one").splitlines()
    assert head == "| agent | two | one |"
    assert (ours, other) == ("| ours | 7.5 | 202 |", "| other | 7.5 | 102 |")
    del results.scores["two", "other"]
    assert "| other |  | 102 |" in tables.returns(results, "two", "one")


def test_what_lacks_seeds_is_not_compared(results):
    curve = dataclasses.replace(FIGURE.panels["one"]["ours"], seeds=7)
    panels = {**FIGURE.panels, "one": {**FIGURE.panels["one"], "ours": curve}}
    lacking = Results(dataclasses.replace(FIGURE, panels=panels), results.searched)
    assert "| one | ours | 6 of 7 |" in tables.table(lacking)
    assert ("one", "ours", "other") not in lacking.comparisons
    assert "Not trained yet: 1 of 25 runs." in report.page("x", lacking, "")


def test_a_page_is_written_with_its_plot(results, tmp_path):
    report.write("x", results, tmp_path, "{{table}}")
    assert (tmp_path / "x.png").read_bytes().startswith(b"\x89PNG")
    page = (tmp_path / "x.md").read_text()
    assert page == report.page("x", results, "{{table}}")
    assert "# Title\n\n**The paper's claim.** Claim.\n\n![x](x.png)" in page


def drawn(results):
    records = {key: [*x.records.values()] for key, x in results.curves.items()}
    return plots.draw(results.figure, records, results.scores)


def test_a_figure_over_delays_is_drawn_and_compared(tmp_path):
    store, records = Store(tmp_path / "runs"), {}
    for i, (_, _, curve) in enumerate(DELAYS.curves()):
        for run in curve.runs(store):
            value = 100.0 + i % 2 * run.settings.reward_delay + run.seed
            records[run] = constant(value)
    store.add(records)
    results = Results(DELAYS, store)
    table = tables.table(results)
    assert "| hopper | ppo-1000 | 10 | 104 [102, 107] |  | 1000 [" in table
    tally = tables.tally(results).splitlines()
    assert len(tally) == 4
    assert tally[0].startswith("- ppo+gasil-1 against ppo-1: not clear on 2 of 2;")
    assert tally[3].startswith("- ppo+gasil-1000 against ppo-1000: better on 2 of 2;")
    # An agent has the color that it has where learning curves are drawn.
    styles = plots._lines(FIGURES["matrix"])
    lines = {x.get_label(): x for x in drawn(results).axes[0].containers}
    for agent in ("ppo", "ppo+gasil"):
        assert lines[agent].lines[0].get_color() == styles[agent]["color"]


def test_where_colors_are_too_few_an_agents_curves_share_its_color():
    lines = plots._lines(FIGURES["sparse"])
    looks = {tuple(x[key] for key in ("color", "linestyle")) for x in lines.values()}
    assert len(looks) == len(lines) > len(plotting.COLORS)
    own, shared = lines["ppo+sil"], lines["ppo+sil (PPO's values)"]
    assert own["color"] == shared["color"] != lines["ppo"]["color"]
    assert own["linestyle"] != shared["linestyle"]


@pytest.mark.parametrize("count", [3, 9])
def test_every_arm_has_a_color_and_a_name(results, count):
    arms = [Arm(f"arm {i}", "ppo", {"gamma": 0.5}) for i in range(count)]
    panels = grid(("hopper",), ("ppo", *arms), seeds=6, changes={"gamma": 0.6})
    figure = Figure("Arms", "", panels, favourite="ppo")
    (axes,) = drawn(Results(figure, results.searched)).axes
    colors = [str(line.get_color()) for line in axes.get_lines()]
    assert len(set(colors)) == len(colors) == count + 1
    # At most five have a band; the subject is thick, and names are at the ends.
    assert len(axes.collections) == min(count + 1, 5)
    thick = max(axes.get_lines(), key=lambda line: line.get_linewidth())
    assert thick.get_label() == "ppo" and axes.get_legend() is None
    assert len(axes.texts) == count + 1


@pytest.fixture(scope="module")
def published():
    """The results of all figures."""
    return summary.all_results(STORE)


@pytest.fixture(scope="module")
def nothing_measured(tmp_path_factory):
    return summary.all_results(Store(tmp_path_factory.mktemp("empty")))


@pytest.mark.parametrize("name", FIGURES)
def test_a_published_page_is_what_the_stored_runs_say(name, published):
    page = report.page(name, published[name], report.note(name))
    assert (RESULTS / f"{name}.md").read_text() == page


def test_the_summary_and_the_readme_are_what_the_stored_runs_say(published):
    for page in summary.SUMMARIES:
        text = summary.text(published, page)
        assert (RESULTS / f"{page}.md").read_text() == text
    text = summary.README.read_text()
    value = functools.partial(summary.value, published)
    assert report.fill_blocks(text, value) == text
    assert text.count("<!-- begin ") == text.count("<!-- end -->") > 0
    assert presets.TUNED.read_text() == summary.tuned(published)


def test_seeds_in_words():
    assert figure_results._ranges([0, 1, 2, 4, 6, 7]) == "0 to 2, 4, 6 to 7"
    assert figure_results._ranges([3]) == "3"


def test_a_block_is_made_anew(nothing_measured):
    value = functools.partial(summary.value, nothing_measured)
    text = "before\n<!-- begin claims -->\nold\n<!-- end -->\nafter"
    filled = report.fill_blocks(text, value)
    made = summary.claims(nothing_measured)
    assert filled == text.replace("old\n", f"\n{made}\n\n")
    assert report.fill_blocks(filled, value) == filled
    with pytest.raises(InputError, match="slot is nonsense: it must be one of claims"):
        report.fill_blocks(text.replace("claims", "nonsense"), value)


@pytest.mark.parametrize(
    ("verdicts", "words"),
    [
        ([], "not measured yet"),
        (
            ["worse"],
            "open so far: in 0 of 1 cases; the opposite in 1 of 1 comparisons; "
            "2 not measured yet",
        ),
        (["better", "better"], "holds: in 2 of 2 cases (0; 1); 1 not measured yet"),
        (["not clear"] * 2, "does not hold: in 0 of 2 cases; 1 not measured yet"),
        (
            ["worse", "better", "worse"],
            "holds in part: in 1 of 3 cases (1); the opposite in 2 of 3 comparisons",
        ),
    ],
)
def test_a_claim_is_only_judged_when_its_cases_decide(
    verdicts, words, nothing_measured, monkeypatch
):
    keys = [("panel", "ppo+gasil", f"other {i}") for i in range(3)]
    of = {"better": (1.0, 0.0), "worse": (-1.0, 0.0), "not clear": (1.0, 1.0)}
    results = {
        key: comparisons.Comparison(*of[verdict], low=0.0, high=0.0, visible=0.0)
        for key, verdict in zip(keys, verdicts, strict=False)
    }
    monkeypatch.setattr(nothing_measured["matrix"], "comparisons", results)
    cases = {f"{i}": [(key, "better")] for i, key in enumerate(keys)}
    test = summary.Test("matrix", cases, needed=2)
    assert summary.verdict(nothing_measured, test) == words
    assert summary.verdict(nothing_measured, None) == ""


#: Settings, and names: what may stand in a note in digits.
_SETTINGS = (
    *("walker2d", "`[^`]*`", "[Ff]igures? [2-8](?: and [2-8])?", r"\dM steps"),
    *("is 0 until", r"to 0\.02 at 3M", '"from-2M"'),
    *("30,000 steps", "of 128 drawn", "1,000 steps", r"buffer\s+of 500"),
)
_NOTES = {
    x.stem: x.read_text()
    for x in sorted(report.NOTES.glob("*.md"))
    if not x.stem.startswith("how_to_read")  # They explain the statistics.
}


@pytest.mark.parametrize("name", _NOTES)
def test_no_number_of_a_note_is_typed_by_hand(name):
    """Every digit is of a slot, or of a setting."""
    rest = re.sub(r"{{.+?}}", "", _NOTES[name])
    for setting in _SETTINGS:
        rest = re.sub(setting, "", rest)
    assert not re.findall(r".*\d.*", rest)


@pytest.mark.parametrize("setting", _SETTINGS)
def test_every_number_that_a_note_may_have_is_in_one(setting):
    assert any(re.search(setting, note) for note in _NOTES.values())


def test_no_verdict_of_a_note_is_typed_by_hand():
    words = r"\b(better than|worse than|clearly|not clear|outperforms|ahead of)\b"
    allowed = ("PPO+GASIL was most clearly ahead, on new seeds",)
    for name, note in _NOTES.items():
        text = " ".join(re.sub(r"{{.+?}}", "", note).split())
        for sentence in allowed:
            text = text.replace(sentence, "")
        assert not re.findall(words, text), name


def test_of_two_curves_below_doing_nothing_neither_is_better(tmp_path, monkeypatch):
    panels = grid(("ant",), ["ppo", "ppo+gasil"], base=None, seeds=5)
    figure = Figure("Ants", "", panels, floor=True)
    store = Store(tmp_path)
    for i, curve in enumerate(panels["ant"].values()):
        rows = np.arange(1.0, 11.0)
        records = [
            Record(rows, np.full(10, 900.0 * i + j), rows, {"physics": "jax"})
            for j in range(5)
        ]
        store.add(dict(zip(curve.runs(store), records, strict=True)))
    for floor, verdict in ((2000.0, comparisons.BELOW), (500.0, "better")):
        returned = {"ant": doing_nothing.Return(floor, floor, floor)}
        monkeypatch.setattr(doing_nothing, "stored", lambda returned=returned: returned)
        results = figure_results.Results(figure, store)
        (compared,) = results.comparisons.values()
        assert compared.verdict == verdict
        assert tables.tally(results) == (
            f"- ppo+gasil against ppo: {verdict} on 1 of 1; probability of improvement "
            "1.00 [1.00, 1.00]."
        )
        assert f"| ant | doing nothing |  | {floor:.0f} [" in tables.table(results)


def test_predictions_are_compared_with_verdicts(published):
    results = published["paper_controls"]
    first = ("walker2d-delayed", "ppo+bonus", "ppo")
    verdict = results.comparisons[first].verdict
    assert tables.foretold(results, *first, verdict) == "yes"
    assert tables.foretold(results, *first, verdict, *first, "none") == "1 of 2"
    missing = ("ant-delayed", "ppo+gasil", "ppo+bonus")
    assert tables.foretold(results, *missing, "better") == "not measured"
    with pytest.raises(InputError, match="foretold"):
        tables.foretold(results, "ant-delayed", "ppo", "ppo+bonus", "better")

"""Pages are what the stored runs say; verdicts are corrected for their number."""

import dataclasses
import functools
import itertools
import re

import numpy as np
import pytest
from test_figures import DELAYS

from experiments import comparisons, doing_nothing, plots, report, search, summary
from experiments.comparisons import compare
from experiments.curves import Arm, Curve, Figure, difference, grid
from experiments.figures import FIGURES
from experiments.report import Page
from experiments.store import RESULTS, Record, Store
from gasil_jax import presets
from gasil_jax.errors import InputError
from gasil_jax.figures import plotting
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
    page = Page("x", store, figure=Figure("", "", panels))
    _, _, *rows = page.aggregate().splitlines()
    assert rows[0] == "| dense | ppo | 2 | 1.00 [1.00, 1.00] |"
    assert rows[3] == "| delayed | ppo+gasil | 2 | 3.00 [3.00, 3.00] |"


def test_others_returns_stand_beside_ours(tmp_path):
    panels = grid(("hopper", "ant"), ("ppo",), (1, 20), base=None, seeds=8)
    store = Store(tmp_path / "runs")
    for run in panels["ant-delayed"]["ppo"].runs(store):
        store.add({run: Record(*[np.full(10, 700.0)] * 3, {"physics": "mjx"})})
    page = Page("x", store, figure=Figure("", "", panels))
    head, _, ours, *others = page.published("delayed", "ppo", "gasil").splitlines()
    assert head.split(" | ")[3:] == [*search.TASKS[:-1], f"{search.TASKS[-1]} |"]
    empty = "|  " * 4
    assert ours == f"| ours, ppo | v5 | 8 {empty}| 700 [700, 700] |  |"
    assert len(others) == 2 and all("nnabla-rl" in row for row in others)
    assert "| 2370 | 3494 |" in page.published("dense", "ppo")


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


@pytest.fixture
def page(tmp_path):
    store = Store(tmp_path / "runs")
    nan = np.full(10, np.nan)
    by = {
        "physics": "mjx",
        "device": None,
        "versions": None,
        "commit": "c",
        "clean": False,
    }
    for panel, means in (("one", (200.0, 100.0)), ("two", (5.0, 5.0))):
        for curve, mean in zip(FIGURE.panels[panel].values(), means, strict=True):
            for i, run in enumerate(curve.runs(store)):
                values = np.full(10, mean + i)
                store.add({run: Record(np.arange(1, 11), values, nan, by)})
    return Page("matrix", store, figure=FIGURE)


def test_a_table_and_a_tally(page):
    assert "| one | other | 6 | 102 [101, 104] |  | 100 [" in page.table()
    assert page.value("evaluated") == "Nothing is complete yet."
    assert page.table().count(" better |") == 1 == page.table().count(" not clear |")
    (line,) = page.tally().splitlines()
    two = page.tally("two")
    words = "- ours against other: better on 1, not clear on 1 of 2; probability of"
    assert line.startswith(f"{words} improvement 0.75 [")
    assert two.startswith("- ours against other: not clear on 1 of 1; ")
    assert report.fill("so {{tally two}}", page.value) == f"so {two}"
    words = "better than OTHER on 1 of 2 tasks"
    assert page.value("better", "", "ours", "other") == words
    words = "better than OTHER and OTHER on 1 of 2 tasks each"
    assert page.better("", "ours", "other", "other") == words
    one = page.comparisons["one", "ours", "other"]
    behind = dataclasses.replace(one, middle=-one.middle)
    page.comparisons["two", "ours", "other"] = behind
    words = "better than OTHER on 1 (worse on 1) of 2 tasks"
    assert page.better("", "ours", "other") == words
    del page.comparisons["two", "ours", "other"]
    words = "better than OTHER on 1 of 1 measured tasks"
    assert page.better("", "ours", "other") == words
    assert "- one, ours - other: 100 [" in page.value("differences")
    assert "commit c, changed" in page.settings()


def test_the_last_policies_evaluations_are_compared_on_their_own(tmp_path):
    store, nan = Store(tmp_path / "runs"), np.full(10, np.nan)
    # While they learn, ours has more; evaluated, other has. One seed of it was not.
    for name, trained, evaluated in (("ours", 200.0, 5.0), ("other", 100.0, 50.0)):
        for i, run in enumerate(FIGURE.panels["one"][name].runs(store)):
            values = np.full(10, trained + i)
            returns = np.array([1000.0, evaluated + i])
            if (name, i) == ("other", 5):
                returns = np.empty(0)
            steps = np.arange(len(returns)) + 1
            by = {"physics": "mjx"}
            record = Record(np.arange(1, 11), values, nan, by, steps, returns)
            store.add({run: record})
    page = Page("matrix", store, figure=FIGURE)
    assert page.value("tally").startswith("- ours against other: better on 1 of 1, ")
    words = "- ours against other: worse on 1 of 1, 1 without enough evaluations; "
    assert page.value("evaluated").startswith(words)
    assert "| one | ours | 6 | 202 [201, 204] | 7.5 |" in page.table()
    assert "| one | other | 6 | 102 [101, 104] | 52.0 (5) | 100 [" in page.table()


def test_returns_of_curves_beside_each_other(page):
    head, _, ours, other = page.value("returns", "two", "one").splitlines()
    assert head == "| agent | two | one |"
    assert (ours, other) == ("| ours | 7.5 | 202 |", "| other | 7.5 | 102 |")
    del page.scores["two", "other"]
    assert "| other |  | 102 |" in page.returns("two", "one")
    for panels in ((), ("three",)):
        with pytest.raises(InputError, match="slot is returns"):
            page.value("returns", *panels)


def test_what_lacks_seeds_is_not_compared(page, tmp_path):
    curve = dataclasses.replace(FIGURE.panels["one"]["ours"], seeds=7)
    panels = {**FIGURE.panels, "one": {**FIGURE.panels["one"], "ours": curve}}
    lacking = dataclasses.replace(FIGURE, panels=panels)
    page = Page("matrix", page.searched, figure=lacking)
    assert "| one | ours | 6 of 7 |" in page.table()
    assert ("one", "ours", "other") not in page.comparisons
    assert "Not trained yet: 1 of 25 runs." in page.text()
    with pytest.raises(InputError, match="tally three in matrix"):
        page.value("tally", "three")
    with pytest.raises(InputError, match="slot is nonsense"):
        page.value("nonsense")


def test_a_page_is_written_with_its_plot(page, tmp_path):
    page.write(tmp_path)
    assert (tmp_path / "matrix.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "matrix.md").read_text() == page.text()


def test_a_figure_over_delays_is_drawn_and_compared(tmp_path):
    store, nan = Store(tmp_path / "runs"), np.full(10, np.nan)
    by = {"physics": "mjx", "device": None, "versions": None, "commit": "c"}
    records = {}
    for i, (_, _, curve) in enumerate(DELAYS.curves()):
        for run in curve.runs(store):
            values = np.full(10, 100.0 + i % 2 * run.settings.reward_delay + run.seed)
            records[run] = Record(np.arange(1, 11), values, nan, by | {"clean": True})
    store.add(records)
    page = Page("delays", store, figure=DELAYS)
    assert "| hopper | ppo-1000 | 10 | 104 [102, 107] |  | 1000 [" in page.table()
    tally = page.tally().splitlines()
    assert len(tally) == 4
    assert tally[0].startswith("- ppo+gasil-1 against ppo-1: not clear on 2 of 2;")
    assert tally[3].startswith("- ppo+gasil-1000 against ppo-1000: better on 2 of 2;")
    page.write(tmp_path)
    assert (tmp_path / "delays.png").stat().st_size > 3000
    # An agent has the color that it has where learning curves are drawn.
    drawn = plots._lines(FIGURES["matrix"])
    lines = {x.get_label(): x for x in page.picture().axes[0].containers}
    for agent in ("ppo", "ppo+gasil"):
        assert lines[agent].lines[0].get_color() == drawn[agent]["color"]


def test_where_colors_are_too_few_an_agents_curves_share_its_color():
    lines = plots._lines(FIGURES["sparse"])
    looks = {tuple(x[key] for key in ("color", "linestyle")) for x in lines.values()}
    assert len(looks) == len(lines) > len(plotting.COLORS)
    own, shared = lines["ppo+sil"], lines["ppo+sil (PPO's values)"]
    assert own["color"] == shared["color"] != lines["ppo"]["color"]
    assert own["linestyle"] != shared["linestyle"]


@pytest.mark.parametrize("count", [3, 9])
def test_every_arm_has_a_color_and_a_name(page, tmp_path, count):
    arms = [Arm(f"arm {i}", "ppo", {"gamma": 0.5}) for i in range(count)]
    panels = grid(("hopper",), ("ppo", *arms), seeds=6, changes={"gamma": 0.6})
    figure = Figure("Arms", "", panels, favourite="ppo")
    drawn = Page("matrix", page.searched, figure=figure).picture()
    (axes,) = drawn.axes
    colors = [str(line.get_color()) for line in axes.get_lines()]
    assert len(set(colors)) == len(colors) == count + 1
    # At most five have a band; the subject is thick, and names are at the ends.
    assert len(axes.collections) == min(count + 1, 5)
    thick = max(axes.get_lines(), key=lambda line: line.get_linewidth())
    assert thick.get_label() == "ppo" and axes.get_legend() is None
    assert len(axes.texts) == count + 1


@pytest.fixture(scope="module")
def published():
    """The summary of the stored runs, whose pages compare them once."""
    choose = search.Search.chosen
    kept = functools.cache(choose)
    # Each of many curves asks for it, of runs that do not change here.
    ask = lambda self, store: (kept if store is STORE else choose)(self, store)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(search.Search, "chosen", ask)
        yield summary.Summary(STORE)


@pytest.fixture(scope="module")
def nothing_measured(tmp_path_factory):
    return summary.Summary(Store(tmp_path_factory.mktemp("empty")))


@pytest.mark.parametrize("name", FIGURES)
def test_a_published_page_is_what_the_stored_runs_say(name, published):
    assert (RESULTS / f"{name}.md").read_text() == published.pages[name].text()


def test_the_summary_and_the_readme_are_what_the_stored_runs_say(published):
    for page in summary.SUMMARIES:
        assert (RESULTS / f"{page}.md").read_text() == published.text(page)
    text = summary.README.read_text()
    assert report.fill_blocks(text, published.value) == text
    assert text.count("<!-- begin ") == text.count("<!-- end -->") > 0
    assert presets.TUNED.read_text() == published.tuned()


def test_seeds_in_words():
    assert report._ranges([0, 1, 2, 4, 6, 7]) == "0 to 2, 4, 6 to 7"
    assert report._ranges([3]) == "3"


def test_a_block_is_made_anew(nothing_measured):
    made = nothing_measured
    text = "before\n<!-- begin claims -->\nold\n<!-- end -->\nafter"
    filled = report.fill_blocks(text, made.value)
    assert filled == text.replace("old\n", f"\n{made.claims()}\n\n")
    assert report.fill_blocks(filled, made.value) == filled
    with pytest.raises(InputError, match="slot is nonsense: it must be one of claims"):
        report.fill_blocks(text.replace("claims", "nonsense"), made.value)


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
    made = nothing_measured
    keys = [("panel", "ppo+gasil", f"other {i}") for i in range(3)]
    of = {"better": (1.0, 0.0), "worse": (-1.0, 0.0), "not clear": (1.0, 1.0)}
    results = {
        key: comparisons.Comparison(*of[verdict], low=0.0, high=0.0, visible=0.0)
        for key, verdict in zip(keys, verdicts, strict=False)
    }
    monkeypatch.setattr(made.pages["matrix"], "comparisons", results)
    cases = {f"{i}": [(key, "better")] for i, key in enumerate(keys)}
    assert made.verdict(summary.Test("matrix", cases, needed=2)) == words
    assert made.verdict(None) == ""


#: Settings, and names: what may stand in a note in digits.
_SETTINGS = (
    *("walker2d", "`[^`]*`", "[Ff]igures? [2-8](?: and [2-8])?", r"\dM steps"),
    *("is 0 until", r"to 0\.02 at 3M", '"from-2M"'),
    *("30,000 steps", "of 128 drawn", "1,000 steps", r"buffer\s+of 500"),
)
_NOTES = {x.stem: x.read_text() for x in sorted(report.NOTES.glob("*.md"))}


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
    for path in report.NOTES.glob("*.md"):
        text = " ".join(re.sub(r"{{.+?}}", "", path.read_text()).split())
        for sentence in allowed:
            text = text.replace(sentence, "")
        assert not re.findall(words, text), path.name


def test_of_two_curves_below_doing_nothing_neither_is_better(tmp_path, monkeypatch):
    panels = grid(("ant",), ["ppo", "ppo+gasil"], base=None, seeds=5)
    figure = Figure("Ants", "", panels, floor=True)
    store = Store(tmp_path)
    for i, curve in enumerate(panels["ant"].values()):
        rows = np.arange(1.0, 11.0)
        records = [
            Record(rows, np.full(10, 900.0 * i + j), rows, {"physics": "mjx"})
            for j in range(5)
        ]
        store.add(dict(zip(curve.runs(store), records, strict=True)))
    for floor, verdict in ((2000.0, comparisons.BELOW), (500.0, "better")):
        returned = {"ant": doing_nothing.Return(floor, floor, floor)}
        monkeypatch.setattr(doing_nothing, "stored", lambda returned=returned: returned)
        page = report.Page("matrix", store, figure=figure)
        (compared,) = page.comparisons.values()
        assert compared.verdict == verdict
        assert page.tally() == (
            f"- ppo+gasil against ppo: {verdict} on 1 of 1; probability of improvement "
            "1.00 [1.00, 1.00]."
        )
        assert f"| ant | doing nothing |  | {floor:.0f} [" in page.table()


def test_predictions_are_compared_with_verdicts(published):
    page = published.pages["paper_controls"]
    first = ("walker2d-delayed", "ppo+bonus", "ppo")
    verdict = page.comparisons[first].verdict
    assert page.foretold(*first, verdict) == "yes"
    assert page.foretold(*first, verdict, *first, "none") == "1 of 2"
    missing = ("ant-delayed", "ppo+gasil", "ppo+bonus")
    assert page.foretold(*missing, "better") == "not measured"
    with pytest.raises(InputError, match="foretold"):
        page.foretold("ant-delayed", "ppo", "ppo+bonus", "better")

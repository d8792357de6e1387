"""Verdicts are right, and corrected for their number; shares against SciPy."""

import itertools

import numpy as np
import pytest
import scipy.stats

from experiments import comparisons
from experiments.comparisons import compare
from experiments.curves import difference
from gasil_jax.statistics import interquartile_mean


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
        assert p == pytest.approx(np.mean(ways))
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
    # Nor does a seed that ended no episode.
    none = scores(high=9.0, low=0.0)
    none["a", "low"][0] = np.nan
    (result,) = compare(none, family(("high", "low"))).values()
    assert result.verdict == "not clear"


def sides(scores, panels, pair):
    return [tuple(scores[panel, curve] for curve in pair) for panel in panels]


def alone(effect):
    """The comparison of an effect that is alone in its family."""
    return comparisons.judged({"": effect})[""]


def test_the_probability_of_improvement_is_of_pairs_of_seeds():
    data = {("a", "x"): [3.0, 1.0], ("a", "y"): [2.0, 1.0]}
    data |= {("b", "x"): [9.0, 9.0], ("b", "y"): [-1.0, 8.0]}
    data = {key: np.array(scores) for key, scores in data.items()}
    improvement = lambda *of: comparisons.improvement("", sides(data, *of)).middle + 0.5
    # 2 of 4 pairs and half of another on one task, and all 4 on the other.
    assert improvement("ab", ("x", "y")) == 0.8125
    assert improvement("ab", ("y", "x")) == pytest.approx(0.1875)
    # A seed that ended no episode has less than any other, on either side.
    data["b", "y"] = np.array([np.nan, np.nan])
    assert improvement("b", ("x", "y")) == 1.0 and improvement("b", ("y", "x")) == 0.0


def test_who_is_sooner_is_the_rank_sum_test():
    """Seeds that never solve tie with each other, and come last."""
    rng = np.random.default_rng(0)
    sooner = {}
    for panel in "xy":
        for curve, later in (("a", 0.0), ("b", 3.0)):
            until = rng.integers(0, 10, 15) + later
            sooner[panel, curve] = np.where(until > 9, -np.inf, -until)
    every = [sooner[x] for x in (("x", "a"), ("x", "b"), ("y", "a"), ("y", "b"))]
    exact = [scipy.stats.mannwhitneyu(*every[i : i + 2]) for i in (0, 2)]
    lead = alone(comparisons.improvement("", sides(sooner, "xy", ("a", "b"))))
    expected = np.mean([x.statistic / 15**2 for x in exact]) - 0.5
    assert lead.middle == pytest.approx(expected) and lead.middle > 0.1
    assert lead.low < lead.middle < lead.high and lead.p < 0.01
    # One task alone has SciPy's p-value, which is that of a normal distribution.
    one = comparisons.improvement("", sides(sooner, "x", ("a", "b")))
    assert one.p == pytest.approx(exact[0].pvalue, abs=0.02)
    same = comparisons.improvement("", sides(sooner, "xy", ("a", "a")))
    assert same.middle == pytest.approx(0.0) and same.p == 1.0


@pytest.mark.parametrize("counts", [(0, 0), (3, 9), (20, 0), (7, 6), (20, 20)])
def test_the_exact_test_is_scipys(counts):
    table = [[x, n - x] for x, n in zip(counts, (20, 20))]
    expected = scipy.stats.fisher_exact(table).pvalue
    assert comparisons.fisher_p(counts[0], 20, counts[1], 20) == pytest.approx(expected)


def test_shares_are_compared_on_one_task_and_on_several():
    some = lambda count: np.arange(20) < count
    solved = {(p, "a"): some(18) for p in "xyz"} | {(p, "b"): some(4) for p in "xyz"}
    solved |= {("z", "b"): some(17)}
    lead = alone(comparisons.lead("", sides(solved, "xyz", ("a", "b"))))
    assert lead.middle == pytest.approx((14 + 14 + 1) / 60)
    assert lead.low < lead.middle < lead.high
    assert lead.p < 0.001 and lead.verdict == "better"
    assert comparisons.lead("", sides(solved, "xyz", ("a", "a"))).p == 1.0
    one = comparisons.lead("", sides(solved, "z", ("a", "b")))
    assert one.p == comparisons.fisher_p(18, 20, 17, 20)
    # 1.96 + 0.84 deviations would be found.
    deviation = np.sqrt((0.9 * 0.1 + 0.85 * 0.15) / 20)
    assert alone(one).visible == pytest.approx(2.8 * deviation, rel=0.05)
    pair = comparisons.judged({"one": one, "other": one})
    assert pair["one"].visible > alone(one).visible

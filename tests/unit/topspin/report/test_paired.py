"""Differences between experiments, seed by seed, against Student's t by hand."""

import math
from dataclasses import replace

import pytest

from tests.unit.evaluation.played import OUT, RETURNED
from tests.unit.topspin.report.runs import make_result, make_run
from topspin.report.config import ReportConfig
from topspin.report.paired import comparisons, difference
from topspin.report.results import GroupResult, Results
from topspin.report.tables import differences


def test_a_hand_worked_difference():
    """Differences 1, 2, 6: mean 3, deviation sqrt(7), t = 3/(sqrt(7)/sqrt(3)) = 1.964; t(2, 0.975) = 4.3027."""
    found = difference([10.0, 20.0, 30.0], [11.0, 22.0, 36.0])
    half = 4.30265 * math.sqrt(7.0 / 3.0)
    t = 3.0 / math.sqrt(7.0 / 3.0)

    assert found.mean == pytest.approx(3.0)
    assert (found.low, found.high) == pytest.approx((3.0 - half, 3.0 + half), rel=1e-5)
    assert found.p == pytest.approx(1.0 - t / math.sqrt(2.0 + t * t))  # Student's distribution with 2 degrees
    assert found.pairs == 3


def test_what_all_seeds_share_is_no_noise():
    """The seeds differ by 10 and more, the experiments by 1 in each: pairs show it, groups would not."""
    found = difference([0.0, 10.0, 50.0], [1.0, 11.1, 50.9])

    assert found.p < 0.01
    assert found.low > 0.0


@pytest.mark.parametrize("b", [[0.9, 0.8], [0.91, 0.81]])
def test_equal_differences_have_neither_interval_nor_p_value(b):
    found = difference([0.9, 0.8], b)

    assert found.mean == pytest.approx(b[0] - 0.9)
    assert (found.low, found.high, found.p, found.pairs) == (None, None, None, 2)


@pytest.mark.parametrize(("a", "b"), [([1.0], [2.0]), ([1.0, 2.0], [1.0])])
def test_one_pair_or_unequal_numbers_are_refused(a, b):
    with pytest.raises(ValueError, match="allowed: two or more pairs"):
        difference(a, b)


def make_group(label, returned_by_seed):
    results = [
        make_result(make_run(), [RETURNED] * returned + [OUT] * (10 - returned), seed=seed)
        for seed, returned in returned_by_seed.items()
    ]
    return GroupResult(label, "", tuple(results), None, {}, {}, {}, {})


def test_experiments_are_compared_by_the_seeds_that_both_have():
    groups = [
        make_group("a", {0: 5, 1: 6, 2: 9}),
        make_group("b", {1: 8, 2: 10, 3: 1}),
        make_group("c", {7: 5}),
    ]
    found = {one.measure: one for one in comparisons(groups)}

    assert {(one.first, one.second) for one in found.values()} == {("a", "b")}
    assert found["return_rate"].difference.mean == pytest.approx((0.2 + 0.1) / 2)
    assert found["return_rate"].difference.pairs == 2


def test_of_several_runs_of_one_seed_the_mean_counts():
    one, other = make_group("a", {0: 5, 1: 6}), make_group("b", {0: 7, 1: 7})
    again = replace(other, runs=(*other.runs, *make_group("b", {0: 9}).runs))
    (found,) = [each for each in comparisons([one, again]) if each.measure == "return_rate"]

    assert found.difference.mean == pytest.approx(((0.8 - 0.5) + (0.7 - 0.6)) / 2)


def test_the_table_says_points_metres_and_p():
    groups = (make_group("stage 3 only", {0: 5, 1: 6, 2: 7}), make_group("stages 1+2+3", {0: 7, 1: 7, 2: 8}))
    table = differences(Results(groups, ReportConfig(), {}, {}, ()))

    # differences 20, 10, 10 points: mean 13.3, deviation 5.77, t = 4, p = 1 - 4/sqrt(18)
    assert table is not None
    assert table.rows[0] == (
        "stages 1+2+3 minus stage 3 only", "returned", "+13.3 points", "-1.0 to +27.7", "0.057", "3",
    )  # fmt: skip
    assert table.rows[-1][1:3] == ("target error", "+0.000 m")


def test_without_common_seeds_there_is_no_table():
    groups = (make_group("a", {0: 5}), make_group("b", {1: 7}))

    assert differences(Results(groups, ReportConfig(), {}, {}, ())) is None

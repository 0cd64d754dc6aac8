"""Recorded outcomes: the policies of the box play as they did before the code moved, on any processor."""

import numpy as np
import pytest

from benchmarks.golden import CASES, FIELDS, differences, load_golden, play
from common.evaluation.measures import MatchResult

RALLIES = 40  # the first ones, because their robots start at home
# On the machine that made the file all bits are the same. Another processor rounds differently, and then a ball that
# touches an edge may have another outcome
SAME_SHARE, LANDING_TOLERANCE = 0.95, 1e-3  # [-], [m]


def rows_of(result: MatchResult, seeds: np.ndarray) -> np.ndarray:
    """Return the rows of ``seeds`` that hold the result's rallies, in the result's order."""
    order = np.argsort(seeds)
    rows = order[np.searchsorted(seeds, result.seeds, sorter=order)]
    np.testing.assert_array_equal(seeds[rows], result.seeds)
    return rows


@pytest.mark.parametrize("name", ["default_paper", "paper_off"])
def test_the_first_rallies_end_as_they_did_when_they_were_recorded(name):
    golden = load_golden()
    result = play(CASES[name], RALLIES)
    rows = rows_of(result, golden[f"{name}/seeds"])

    assert len(result.seeds) == RALLIES
    same = result.outcomes == golden[f"{name}/outcomes"][rows]
    assert same.mean() >= SAME_SHARE
    np.testing.assert_allclose(
        result.landings[same], golden[f"{name}/landings"][rows][same], rtol=0.0, atol=LANDING_TOLERANCE
    )
    assert np.isfinite(result.landings[same]).all(axis=1).sum() > RALLIES // 2


def test_the_file_holds_every_field_of_every_case():
    golden = load_golden()

    assert golden.keys() == {f"{name}/{field}" for name in CASES for field in FIELDS}
    assert all(len(golden[f"{name}/seeds"]) == case.rallies for name, case in CASES.items())


def test_every_rally_with_a_difference_is_counted_once():
    golden = load_golden()
    parts = {field: golden[f"paper_off/{field}"].copy() for field in FIELDS}
    none = np.zeros((300, 0))
    result = MatchResult(**parts, launches=none, targets=none, bounces=none, arrivals=none)

    assert differences("paper_off", result, golden) == 0
    result.outcomes[3] += 1
    result.landings[3] += 1.0
    result.returns[7] += 0.01
    assert differences("paper_off", result, golden) == 2

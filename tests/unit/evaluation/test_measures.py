import json

import numpy as np
import pytest

from common.evaluation.measures import measures, wilson
from common.task.states import Outcome
from tests.unit.evaluation.played import make_played


@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    [
        (81, 263, 0.2553, 0.3662),  # Newcombe 1998, table I, method 3
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0000, 0.1611),
        (1, 29, 0.0061, 0.1718),
        (29, 29, 0.8830, 1.0000),
        (0, 0, 0.0, 1.0),
    ],
)
def test_wilsons_intervals_are_the_published_ones(successes, trials, low, high):
    np.testing.assert_allclose(wilson(successes, trials), (low, high), atol=5e-5)


def test_rates_are_those_of_a_count_by_hand():
    nan = float("nan")
    found = measures(
        make_played(
            [
                (Outcome.RETURNED, True, True, 0.1),
                (Outcome.RETURNED, True, True, 0.25),
                (Outcome.RETURNED, True, True, 0.7),
                (Outcome.OUT, True, True, nan),
                (Outcome.NET, True, False, nan),
                *[(Outcome.MISS, False, False, nan)] * 5,
            ]
        )
    )

    assert found["rallies"] == 10
    assert (found["catch_rate"], found["over_rate"], found["return_rate"]) == (0.5, 0.4, 0.3)
    assert found["return_after_catch"] == 0.6
    assert found["return_after_catch_ci"] == [round(bound, 4) for bound in wilson(3, 5)]
    assert found["target_error_mean"] == 0.35
    assert found["target_error_median"] == 0.25
    # 0.35 +- 1.96 * 0.3122 / sqrt(3)
    np.testing.assert_allclose(found["target_error_mean_ci"], (-0.0033, 0.7033), atol=1e-4)
    assert (found["within_0.2_m"], found["within_0.3_m"]) == (0.3333, 0.6667)
    assert found["outcomes"] == {"returned": 3, "out": 1, "net": 1, "miss": 5}


def test_rates_without_trials_are_none_and_the_line_is_still_json():
    found = measures(make_played([(Outcome.MISS, False, False, float("nan"))]))

    assert found["catch_rate"] == 0.0
    assert found["return_after_catch"] is None
    assert found["target_error_mean"] is None
    assert json.loads(json.dumps(found, allow_nan=False)) == found

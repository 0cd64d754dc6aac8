"""When the goal is reached."""

import pytest

from benchmarks.time_to_quality import is_reached


@pytest.mark.parametrize(
    ("returned", "error", "reached"),
    [("0.81", "0.31", True), ("0.80", "0.20", False), ("0.95", "0.32", False), ("0.0", "", False)],
)
def test_the_goal_is_reached_if_both_figures_are(returned, error, reached):
    row = {"return_rate": returned, "target_error_mean": error}

    assert is_reached(row, 0.81, 0.31) is reached

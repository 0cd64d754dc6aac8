"""When the goal counts as met, and reading a curve that is still being written."""

import pytest

from benchmarks.time_to_quality import is_reached, read_curve


@pytest.mark.parametrize(
    ("returned", "error", "reached"),
    [("0.81", "0.31", True), ("0.80", "0.20", False), ("0.95", "0.32", False), ("0.0", "", False)],
)
def test_the_goal_is_both_figures_at_once(returned, error, reached):
    row = {"return_rate": returned, "target_error_mean": error}

    assert is_reached(row, 0.81, 0.31) is reached


def test_half_a_line_is_left_for_later(tmp_path):
    path = tmp_path / "evaluations.csv"
    assert read_curve(path) == []
    path.write_text("frames,return_rate\n100,0.5\n200,0.")

    assert [row["frames"] for row in read_curve(path)] == ["100"]

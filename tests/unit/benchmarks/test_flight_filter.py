"""The benchmark compares with the right truth: without noise the errors are small."""

import numpy as np
import pytest

from benchmarks.flight_filter import FEWEST, compare, figures


def test_without_noise_the_errors_of_ball_and_interception_are_millimetres_after_the_bounce():
    """The errors after the bounce come from sidespin that is hidden because lift saturates."""
    by_moment = {row["since_bounce_ms"]: row for row in figures(compare(150, "paper", "off", seed=0))}

    assert by_moment[-40]["present_mm"] < 2.0
    assert by_moment[120]["present_mm"] < 3.0
    assert by_moment[120]["meeting_mm"] < 3.0
    assert by_moment[120]["sample_mm"] == pytest.approx(0.0, abs=1e-9)  # no latency and no noise


def test_figures_are_medians_and_root_mean_squares():
    rows = np.zeros((FEWEST, 21))
    rows[:, 0], rows[:, 12], rows[0, 3] = 0.003, 2.0, 100.0
    (row,) = figures({0: rows, 40: rows[:3]})

    assert row["balls"] == FEWEST
    assert row["present_mm"] == 3.0
    assert row["present_velocity_m_s"] == 0.0
    assert row["spin_rad_s"] == [2.0, 0.0, 0.0]

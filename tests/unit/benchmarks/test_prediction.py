"""The benchmark compares with the right truth: without noise, little is left between the two."""

import numpy as np
import pytest

from benchmarks.prediction import FEWEST, figures, watch


def test_without_noise_ball_and_meeting_are_known_to_millimetres_behind_the_bounce():
    """What is left behind the bounce is sidespin beyond lift's saturation."""
    by_moment = {row["since_bounce_ms"]: row for row in figures(watch(150, "paper", "off", seed=0))}

    assert by_moment[-40]["present_mm"] < 2.0
    assert by_moment[120]["present_mm"] < 3.0
    assert by_moment[120]["meeting_mm"] < 3.0
    assert by_moment[120]["sample_mm"] == pytest.approx(0.0, abs=1e-9)  # nothing late, nothing noisy


def test_figures_are_medians_and_root_mean_squares():
    rows = np.zeros((FEWEST, 21))
    rows[:, 0], rows[:, 12], rows[0, 3] = 0.003, 2.0, 100.0
    (row,) = figures({0: rows, 40: rows[:3]})

    assert row["balls"] == FEWEST
    assert row["present_mm"] == 3.0
    assert row["present_velocity_m_s"] == 0.0
    assert row["spin_rad_s"] == [2.0, 0.0, 0.0]

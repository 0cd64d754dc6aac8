"""The baselines that the camera filter is compared with, and the benchmark's figures."""

import numpy as np
import pytest

from benchmarks.camera_filter import (
    CameraFilterConfig,
    Comparison,
    Errors,
    differentiated,
    quadratic_fit,
    summary,
)
from common.errors import ConfigError
from common.service.config import load

TIMES = np.array([[np.nan, 0.0, 0.1, 0.2], [np.nan, np.nan, np.nan, 0.2], [0.0, 0.05, 0.1, 0.2]])
NOW = np.array([0.3, 0.3, 0.3])


def straight(times: np.ndarray) -> np.ndarray:
    return np.stack([1.0 - 5.0 * times, 0.5 * times, 0.0 * times], axis=-1)


def test_differentiation_is_exact_on_a_straight_line_and_nan_for_a_single_detection():
    found = differentiated(TIMES, straight(TIMES), NOW)

    np.testing.assert_allclose(found[[0, 2]], [[-0.5, 0.15, 0.0, -5.0, 0.5, 0.0]] * 2, atol=1e-12)
    assert np.isnan(found[1]).all()


def test_the_quadratic_is_exact_on_a_parabola_and_nan_for_three_detections():
    positions = straight(TIMES)
    positions[:, :, 2] += 0.3 - 4.9 * TIMES**2
    found = quadratic_fit(TIMES, positions, NOW)

    assert np.isnan(found[:2]).all()
    np.testing.assert_allclose(found[2], [-0.5, 0.15, 0.3 - 4.9 * 0.09, -5.0, 0.5, -9.8 * 0.3], atol=1e-9)


def test_the_published_ratio_is_the_smaller_one():
    def off(position: float, velocity: float) -> Errors:
        return Errors(np.full(6, position), np.full(6, velocity))

    state = np.array([0, 0, 1, 2, 2, 3])
    figures = summary(
        Comparison(off(0.002, 0.1), off(0.01, 0.3), off(0.004, 0.2), state, np.minimum(state, 2))
    )

    assert figures["ratio_to_differentiation_position"] == 5.0
    assert figures["ratio_to_differentiation"] == figures["ratio_to_differentiation_velocity"] == 3.0
    assert figures["position_error_mm_median"] == 2.0
    assert figures["state_accuracy"] == pytest.approx(5 / 6, abs=1e-4)
    assert [figures[f"estimates_{p}"] for p in ("before_bounce", "after_bounce", "after_hit")] == [2, 1, 3]


@pytest.mark.parametrize(
    "flags", [["--window", "3"], ["--rallies", "0"], ["--seconds", "0"], ["--seed", "-1"]]
)
def test_settings_out_of_range_are_refused(flags):
    with pytest.raises(ConfigError, match=rf"^bench.{flags[0][2:]} = .*allowed: "):
        load(CameraFilterConfig, flags, prog="camera_filter", section="bench", environ={})

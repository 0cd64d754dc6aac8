"""The simulated camera: its detections, its losses, and that all of them are functions of the rally's seed."""

import numpy as np
import pytest

from common.perception.camera import DETECTIONS, MAX_RATE_HZ, detection_position, detection_time
from common.physics.constants import GRID_STEP
from common.physics.flight import FULL, Air
from common.physics.fly import NO_ROBOT, fly_step
from common.physics.table_bounce import table_bounce
from common.physics.touch import NONE
from common.task.launch import draw_rallies
from common.task.randomization import (
    MAX_LATENCY_STEPS,
    PROFILES,
    RALLY_PARAMETERS,
    RallyParameter,
    draw_parameters,
)
from tests.unit.perception.camera_rallies import CONTROL_STEPS, camera_rallies

STANDARD = PROFILES["standard"]
SHARP = STANDARD._replace(camera_noise=0.0, outlier_share=0.0, loss=0.0, burst_share=0.0)
LONGEST_CONTROL_STEP = 0.040  # s


def moments(seed: int, count: int = 200) -> np.ndarray:
    return np.array([detection_time(np.uint64(seed), k, STANDARD) for k in range(count)])


def detections_of(played, row: int) -> np.ndarray:
    return played.detections[row][np.isfinite(played.detections[row, :, 0])]


def true_position(record: np.ndarray, parameters: np.ndarray, moment: float) -> tuple[float, ...]:
    """Return the ball's position after flight in steps of half a millisecond, with a shorter last step."""
    pos, vel, spin = (tuple(record[k : k + 3].tolist()) for k in (0, 3, 6))
    air = Air(record[9], record[10], FULL)
    left = moment
    while left > 1e-12:
        pos, vel, flown, what, normal = fly_step(pos, vel, spin, min(left, 5e-4), air, NO_ROBOT, 0.0)
        left -= flown
        if what != NONE:
            vel, spin = table_bounce(vel, spin, normal, parameters[2], parameters[3])
    return pos


@pytest.mark.parametrize("profile", PROFILES)
def test_the_buffer_holds_every_detection_that_has_not_arrived(profile):
    rate = PROFILES[profile].camera_rate_hz

    assert rate <= MAX_RATE_HZ
    assert (MAX_LATENCY_STEPS * GRID_STEP + LONGEST_CONTROL_STEP) * MAX_RATE_HZ + 2 < DETECTIONS


def test_a_detection_shows_the_ball_at_its_own_moment_also_in_a_grid_step_with_a_touch():
    played = camera_rallies(20, profile=SHARP, has_hit=False)
    block = draw_rallies(20, seed=0)
    parameters = np.empty(RALLY_PARAMETERS)
    checked = 0
    for row in range(20):
        draw_parameters(
            block.seeds[row], block.launches[row, 9], block.launches[row, 10], 0.0, SHARP, parameters
        )
        for detection in detections_of(played, row)[::3]:
            true = true_position(block.launches[row], parameters, detection[0])

            # two integrations of the same flight, with steps of 5 and 0.5 ms, differ by less than 1 um
            np.testing.assert_allclose(detection[1:4], true, atol=2e-6)
            checked += 1
    assert checked > 200


def test_detections_have_the_cameras_rate_and_jitter_and_keep_their_order():
    period = 1.0 / STANDARD.camera_rate_hz
    taken = np.array([moments(seed) for seed in range(50)])
    jitter = taken - period * np.arange(taken.shape[1])

    assert np.all(np.diff(taken, axis=1) > 0.0)
    assert jitter.std() == pytest.approx(STANDARD.camera_jitter, rel=0.03)  # 10,000 draws: 1 % is 1.4 sigma
    assert np.abs(jitter).max() < 0.46 * period


def test_detections_are_a_function_of_seed_and_index():
    pos = (1.0, 0.2, 0.3)
    once, again = ([detection_position(np.uint64(7), k, pos, STANDARD) for k in range(50)] for _ in range(2))
    other = [detection_position(np.uint64(8), k, pos, STANDARD) for k in range(50)]

    assert once == again
    assert not set(once) & set(other)


def test_detections_have_the_profiles_noise_and_share_of_gross_errors():
    off = np.array([detection_position(np.uint64(3), k, (0.0, 0.0, 0.0), STANDARD) for k in range(20_000)])
    gross = np.abs(off).max(axis=1) > 0.012  # six sigmas

    # of errors up to 0.3 m in three axes all but 1 in 15,000 are larger; 20,000 detections have 100 +- 10 gross errors
    assert gross.mean() == pytest.approx(STANDARD.outlier_share, rel=0.35)
    np.testing.assert_allclose(off[~gross].std(axis=0), STANDARD.camera_noise, rtol=0.02)
    assert np.abs(off).max() < STANDARD.outlier_size + 0.012


def test_three_percent_of_detections_are_lost_and_none_of_the_launch():
    profile = STANDARD._replace(burst_share=0.0)
    played = camera_rallies(400, profile=profile, has_hit=False)
    steps = np.isfinite(played.truth[:, :, 0]).sum(axis=1)
    long = steps >= 25
    until = 72.5 / profile.camera_rate_hz  # 0.4 s: the launch's detection and 72 that may be lost
    kept = np.array([(played.detections[row, :, 0] < until).sum() - 1 for row in np.flatnonzero(long)])

    assert np.all(played.detections[:, 0, 0] == 0.0)
    assert 1.0 - kept.mean() / 72 == pytest.approx(profile.loss, abs=0.004)


def test_in_a_burst_all_detections_are_lost():
    profile = STANDARD._replace(burst_share=1.0)
    block, played = draw_rallies(50, seed=0), camera_rallies(50, profile=profile)
    parameters = np.empty(RALLY_PARAMETERS)
    for row in range(50):
        draw_parameters(block.seeds[row], 1.0, 1.0, 0.0, profile, parameters)
        stamps = detections_of(played, row)[1:, 0]
        start, end = parameters[RallyParameter.BURST_START], parameters[RallyParameter.BURST_END]

        assert not np.any((stamps >= start) & (stamps < end))


def test_without_noise_the_camera_is_perfect():
    played = camera_rallies(30, profile=PROFILES["off"], latency=0.0)
    stamps = detections_of(played, 0)[:, 0]

    np.testing.assert_allclose(np.diff(stamps), 1.0 / PROFILES["off"].camera_rate_hz, atol=1e-12)
    assert played.truth.shape[1] == CONTROL_STEPS

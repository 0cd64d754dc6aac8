"""The camera filter: exact on nominal balls, as accurate as stated on others, and finite for all detections."""

import numpy as np
import pytest

from common.perception.camera_filter import (
    COVARIANCE,
    ESTIMATE,
    EXTRA,
    EXTRA_DRIFT,
    POS,
    REJECTED_COUNT,
    STATE_BEFORE_TOUCH,
    TOUCH,
    VEL,
    add_detection,
    begin_filter,
    estimate_at,
    track,
)
from common.perception.flight_track import COMING
from common.physics.flight import LINEAR, Air, flight_step
from common.physics.table_bounce import table_bounce
from common.task.randomization import PROFILES
from tests.unit.perception.camera_rallies import camera_rallies, errors_of

RATE_HZ = 180.0
SIGMA = 0.002  # m
NO_SPIN = (0.0, 0.0, 0.0)


def fly(pos, vel, moments, spin=NO_SPIN, step=5e-4) -> np.ndarray:
    """Return (n, 6) position and velocity at ``moments``, through nominal bounces on an infinite table."""
    now, rows = 0.0, []
    for moment in moments:
        while now < moment - 1e-12:
            h = min(step, moment - now)
            pos, vel = flight_step(pos, vel, spin, h, Air(1.0, 1.0, LINEAR))
            now += h
            if pos[2] < 0.02 and vel[2] < 0.0:
                vel, spin = table_bounce(vel, spin, (0.0, 0.0, 1.0), 0.98, 0.25)
        rows.append((*pos, *vel))
    return np.array(rows)


def stamps(count: int, jitter: float = 0.0007, seed: int = 0) -> np.ndarray:
    moments = np.arange(count) / RATE_HZ
    moments[1:] += np.clip(np.random.default_rng(seed).normal(0.0, jitter, count - 1), -0.002, 0.002)
    return moments


def followed(moments: np.ndarray, positions: np.ndarray, sigma: float = SIGMA) -> np.ndarray:
    """Return the row after all detections."""
    row = np.zeros(ESTIMATE)
    begin_filter(row, moments[0], tuple(positions[0]), sigma, COMING)
    for moment, pos in zip(moments[1:], positions[1:], strict=True):
        add_detection(row, moment, tuple(pos), sigma)
    return row


def at(row: np.ndarray, moment: float) -> np.ndarray:
    pos, vel, _ = estimate_at(row, moment)
    return np.array([*pos, *vel])


def test_a_flight_without_noise_is_followed_exactly():
    moments = stamps(40)
    truth = fly((1.0, 0.2, 0.3), (-5.0, 1.0, 1.0), np.append(moments, moments[-1] + 0.025))

    row = followed(moments, truth[:-1, :3])

    # 25 ms ahead; the prior of the first detection leaves an error of less than a tenth of a millimetre
    np.testing.assert_allclose(at(row, moments[-1] + 0.025), truth[-1], atol=2e-3)
    np.testing.assert_allclose(at(row, moments[-1] + 0.025)[:3], truth[-1, :3], atol=1e-4)


def test_a_parabola_without_air_is_followed_too_although_the_model_has_air():
    moments = stamps(45)
    start, vel, gravity = np.array([1.0, 0.0, 0.5]), np.array([-5.0, 0.5, 0.5]), np.array([0, 0, -9.81])
    t = moments[:, None]

    row = followed(moments, start + t * vel + 0.5 * t**2 * gravity, sigma=0.0)

    # all of the drag, 4 m/s^2, is in the extra acceleration, which lags by its drift
    np.testing.assert_allclose(
        row[POS : POS + 3], start + t[-1] * vel + 0.5 * t[-1] ** 2 * gravity, atol=5e-4
    )
    np.testing.assert_allclose(row[VEL : VEL + 3], vel + t[-1] * gravity, atol=0.02)


def test_a_detection_corrects_as_in_the_textbook():
    """The slow obvious reference: full (9, 9) matrices, products and inverses."""
    rng = np.random.default_rng(0)
    moments = stamps(20)
    # slow: the part of the extra acceleration due to spin does not turn with the velocity
    truth = fly((0.0, 0.0, 1.0), (-0.4, 0.2, 0.3), moments)
    row = followed(moments[:-1], truth[:-1, :3] + rng.normal(0.0, SIGMA, (19, 3)))
    h, detection = moments[-1] - moments[-2], truth[-1, :3] + 0.003
    eye, zero = np.eye(3), np.zeros((3, 3))
    transition = np.block([[eye, h * eye, 0.5 * h * h * eye], [zero, eye, h * eye], [zero, zero, eye]])
    before = np.zeros((9, 9))
    for axis in range(3):
        pp, pv, pe, vv, ve, ee = row[COVARIANCE + 6 * axis : COVARIANCE + 6 * axis + 6]
        before[axis::3, axis::3] = [[pp, pv, pe], [pv, vv, ve], [pe, ve, ee]]
    ahead = transition @ before @ transition.T
    ahead[6:, 6:] += EXTRA_DRIFT**2 * h * eye
    look = np.hstack([eye, zero, zero])
    gain = ahead @ look.T @ np.linalg.inv(look @ ahead @ look.T + SIGMA**2 * eye)
    predicted = np.concatenate([at(row, moments[-1]), row[EXTRA : EXTRA + 3]])
    after = (np.eye(9) - gain @ look) @ ahead

    accepted = add_detection(row, moments[-1], tuple(detection), SIGMA)

    assert accepted
    np.testing.assert_allclose(
        row[POS : POS + 9], predicted + gain @ (detection - predicted[:3]), rtol=1e-9, atol=1e-12
    )
    for axis in range(3):
        found = row[COVARIANCE + 6 * axis : COVARIANCE + 6 * axis + 6]
        part = after[axis::3, axis::3]
        np.testing.assert_allclose(
            found,
            [part[0, 0], part[0, 1], part[0, 2], part[1, 1], part[1, 2], part[2, 2]],
            rtol=1e-7,
            atol=1e-15,
        )


def test_a_bounce_is_predicted_and_followed():
    moments = stamps(60)
    truth = fly((0.3, 0.0, 0.25), (-4.0, 0.3, -0.5), moments)
    estimate = track(moments, truth[:, :3])
    bounce = int(np.argmax(np.diff(truth[:, 5]) > 1.0)) + 1
    ahead = track(moments[:bounce], truth[:bounce, :3], latency=0.03)[-1]

    np.testing.assert_array_equal(estimate[:, 6], np.arange(60) >= bounce)
    assert ahead[6] == 1
    assert ahead[5] > 1.0  # on its way up
    # the nominal table is this table
    np.testing.assert_allclose(estimate[bounce + 1 :, :3], truth[bounce + 1 :, :3], atol=1e-3)
    np.testing.assert_allclose(estimate[bounce + 1 :, 3:6], truth[bounce + 1 :, 3:], atol=0.12)


def hit_ball(seed: int = 0) -> tuple[np.ndarray, np.ndarray, float]:
    """Return stamps (80,) and the truth (80, 6) of a ball that bounces and is hit, and the moment of the hit."""
    moments = stamps(80, seed=seed)
    first = fly((0.0, 0.0, 0.25), (-4.0, 0.3, -0.5), moments[:50])
    hit = moments[49] + 0.002
    pos, _ = flight_step(tuple(first[-1, :3]), tuple(first[-1, 3:]), NO_SPIN, 0.002, Air(1.0, 1.0, LINEAR))
    second = fly(pos, (6.0, -0.5, 1.5), moments[50:] - hit)
    truth = np.concatenate([first, second])
    return moments, truth, hit


@pytest.mark.parametrize("seed", range(20))
def test_a_hit_is_found_two_or_three_detections_after_it(seed):
    moments, truth, hit = hit_ball(seed)
    positions = truth[:, :3] + np.random.default_rng(seed).normal(0.0, SIGMA, (80, 3))

    estimate = track(moments, positions)
    row = followed(moments, positions)

    assert list(estimate[53:, 6]) == [2] * 27
    assert np.all(estimate[:50, 6] < 2)
    assert row[TOUCH] == pytest.approx(hit, abs=0.005)
    assert row[STATE_BEFORE_TOUCH] == 1
    assert np.median(np.linalg.norm(estimate[60:, 3:6] - truth[60:, 3:], axis=1)) < 0.3


def test_before_a_touch_the_estimate_is_the_path_before_it():
    moments, truth, hit = hit_ball()
    row = followed(moments[:53], truth[:53, :3])

    pos, vel, state = estimate_at(row, hit - 0.01)

    assert state == 1
    np.testing.assert_allclose([*pos, *vel][3:], truth[48, 3:], atol=0.15)


def test_a_gross_error_is_rejected_and_changes_nothing():
    moments = stamps(40)
    truth = fly((1.0, 0.0, 0.4), (-5.0, 0.0, 1.0), moments)
    positions = truth[:, :3] + np.random.default_rng(0).normal(0.0, SIGMA, (40, 3))
    spoilt = positions.copy()
    spoilt[30] += [0.2, -0.1, 0.05]

    clean, rough = track(moments, positions), track(moments, spoilt)

    # the only difference is one missing detection of thirty
    np.testing.assert_allclose(rough[30:, :3], clean[30:, :3], atol=0.002)
    np.testing.assert_allclose(rough[30:, 3:6], clean[30:, 3:6], atol=0.1)


def test_the_estimate_flies_on_through_a_burst_of_fifteen_lost_detections():
    moments = stamps(45)
    truth = fly((1.0, 0.0, 0.4), (-5.0, 0.3, 1.5), moments)
    positions = truth[:, :3] + np.random.default_rng(1).normal(0.0, SIGMA, (45, 3))
    row = followed(moments[:30], positions[:30])

    # 83 ms ahead, with noise of 2 mm and an uncertainty of 0.5 m/s^2 in the effect of the air
    np.testing.assert_allclose(at(row, moments[44])[:3], truth[44, :3], atol=0.02)
    assert add_detection(row, moments[44], tuple(positions[44]), SIGMA)


def test_a_first_detection_that_is_a_gross_error_is_dropped():
    moments = stamps(20)
    truth = fly((1.0, 0.0, 0.4), (-5.0, 0.3, 1.5), moments)
    positions = truth[:, :3].copy()
    positions[0] += [0.3, 0.3, 0.3]

    estimate = track(moments, positions)

    np.testing.assert_allclose(estimate[-1, :3], truth[-1, :3], atol=0.003)
    assert np.all(estimate[:, 6] == 0)


@pytest.mark.parametrize("seed", range(20))
def test_the_estimate_is_finite_for_any_detections(seed):
    rng = np.random.default_rng(seed)
    moments = np.cumsum(rng.exponential(1 / RATE_HZ, 500))
    positions = rng.uniform(-3.0, 3.0, (500, 3))
    positions[100:200] = np.cumsum(rng.normal(0.0, 0.05, (100, 3)), axis=0)
    positions[300:320] = np.nan

    estimate = track(moments, positions, latency=0.1)

    assert np.isfinite(estimate).all()
    assert np.abs(estimate[:, 3:6]).max() < 150.0  # 35 m/s, and a second of the largest extra acceleration


def test_detections_out_of_order_are_ignored():
    row = np.zeros(ESTIMATE)
    begin_filter(row, 0.1, (0.0, 0.0, 0.3), SIGMA, COMING)
    before = row.copy()

    assert not add_detection(row, 0.1, (0.0, 0.0, 0.3), SIGMA)
    np.testing.assert_array_equal(row, before)
    assert row[REJECTED_COUNT] == 0


@pytest.mark.parametrize(
    ("times", "positions"),
    [
        ([0.0, 0.1], [[0, 0, 0]]),
        ([0.1, 0.0], np.zeros((2, 3))),
        ([0.0], [[np.nan, 0, 0]]),
        ([], np.zeros((0, 3))),
    ],
)
def test_invalid_tracks_are_refused(times, positions):
    with pytest.raises(
        ValueError, match=r"allowed: \(n,\) and \(n, 3\)|allowed: finite and increasing times"
    ):
        track(np.array(times, dtype=float), np.array(positions, dtype=float))


# Measured on 3,000 rallies each; the limits are a fifth larger. [mm, m/s, share of correct states]
@pytest.mark.parametrize(
    ("randomization", "launch", "position_mm", "velocity", "states"),
    [
        ("off", "paper", 0.5, 0.02, 0.95),
        ("standard", "paper", 4.2, 0.10, 0.95),
        ("hard", "paper", 7.0, 0.14, 0.94),
        ("standard", "match", 4.4, 0.10, 0.95),
    ],
)
def test_the_error_25_ms_ahead_of_the_camera_is_as_stated(
    randomization, launch, position_mm, velocity, states
):
    position_error, velocity_error, state, estimated = errors_of(
        camera_rallies(600, profile=PROFILES[randomization], launch=launch)
    )

    assert 1e3 * np.median(position_error) < position_mm
    assert np.median(velocity_error) < velocity
    assert np.mean(state == estimated) > states


def test_a_rally_has_the_same_bits_in_batches_of_any_size():
    many, fewer = camera_rallies(40), camera_rallies(20)

    for name in ("truth", "estimate", "detections"):
        np.testing.assert_array_equal(getattr(many, name)[:20], getattr(fewer, name))

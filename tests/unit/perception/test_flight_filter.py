"""The flight filter: its fit is a slow least squares, and its bounce a Monte Carlo estimate."""

import numpy as np
import pytest

from common.perception.bounce_prediction import BOUNCE_SPIN_SIGMA, BOUNCE_VELOCITY_SIGMA, expected_bounce
from common.perception.flight_filter import (
    INTERCEPTION_AFTER,
    add_measurement,
    begin_track,
    predict_interception,
)
from common.perception.flight_track import (
    BOUNCE_AS_PREDICTED,
    BOUNCED,
    COMING,
    DV,
    DW,
    INTERCEPTION,
    MOMENT,
    NOMINAL_DRAG,
    NORMAL_MATRIX,
    PRESENT,
    RIGHT_SIDE,
    SOLUTION,
    SPIN,
    SPIN_RATIO_SIGMA,
    SPIN_SIGMA,
    new_tracks,
)
from common.physics.flight import LINEAR, Air, flight_step
from common.physics.fly import NO_ROBOT, fly_to_touch
from common.physics.table_bounce import table_bounce

GRAVITY = 9.81  # m/s^2
AIR_FACTOR = 1.204 * np.pi * 0.020**2 / (2 * 0.0027)  # 1/m
START, FLYING = (1.0, 0.2, 0.3), (-6.0, 1.0, 1.0)
SPIN_RATIO_PRIOR = (1.2, 0.2)  # [-] mean and sigma of spin / visible spin of mild balls
NOISE = (0.003, 0.08)  # [m], [m/s] of the profile `standard`
UP = (0.0, 0.0, 1.0)
PRESENT_POS, PRESENT_VEL = slice(PRESENT, PRESENT + 3), slice(PRESENT + 3, PRESENT + 6)
INTERCEPTION_POS = slice(INTERCEPTION + 1, INTERCEPTION + 4)
INTERCEPTION_VEL = slice(INTERCEPTION + 4, INTERCEPTION + 7)
SPIN_AFTER = slice(SPIN, SPIN + 3)
FLIGHT_SPIN = slice(SOLUTION + DW, SOLUTION + DW + 3)


def flown(spin, moment, pos=START, vel=FLYING, drag=1.0, step=0.001):
    """Return a ball's position and velocity after ``moment`` seconds of flight."""
    for _ in range(round(moment / step)):
        pos, vel = flight_step(pos, vel, spin, step, Air(drag, 1.0, LINEAR))
    return pos, vel


def samples(spin, moments, drag=1.0, noise=(0.0, 0.0), seed=0, vel=FLYING) -> np.ndarray:
    """Return measurements (n, 6) of a ball at ``moments``, all before its bounce."""
    rng = np.random.default_rng(seed)
    measured = np.array([np.concatenate(flown(spin, moment, vel=vel, drag=drag)) for moment in moments])
    return measured + rng.standard_normal(measured.shape) * np.repeat(noise, 3)


def tracked(measured, moments, noise=(0.0, 0.0)) -> np.ndarray:
    """Return the track after measurements (n, 6) from before the bounce."""
    track = new_tracks(1)[0]
    begin_track(track, np.append(measured[0], COMING), moments[0], *noise)
    for sample, moment in zip(measured[1:], moments[1:], strict=True):
        add_measurement(track, sample, moment, False, *noise)
    return track


def spin_found(measured, moments, noise=(0.0, 0.0)) -> np.ndarray:
    return SPIN_SIGMA * tracked(measured, moments, noise)[FLIGHT_SPIN]


def least_squares(measured, moments, noise) -> np.ndarray:
    """Return the spin by NumPy's least squares. Its sums along the nominal flight have steps of 0.1 ms."""
    h, lift, drag = 1e-4, AIR_FACTOR * 0.78 * 0.020, AIR_FACTOR * 0.52
    position, velocity = max(noise[0], 0.001), max(noise[1], 0.02)
    p, v = measured[0, :3].copy(), measured[0, 3:].copy()
    displacement, displacement_sum, slowed, slowed_path = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
    left, left_path = 1.0, 0.0
    rows, rest, k = [], [], 0
    for sample, moment in zip(measured[1:], moments[1:], strict=True):
        while k < round(moment / h):
            rate = drag * np.linalg.norm(v)
            displacement_sum += h * displacement
            displacement += h * (v - rate * displacement)
            slowed_path += h * slowed
            slowed += h * (-rate * v - 2.0 * rate * slowed)
            left_path += h * left
            left -= h * rate * left
            brake = -rate * v
            p = p + h * v + 0.5 * h * h * (brake - [0, 0, GRAVITY])
            v = v + h * (brake - [0, 0, GRAVITY])
            k += 1
        for i in range(3):
            turned = [np.cross(axis, displacement_sum)[i] * lift for axis in np.eye(3)]
            bent = [np.cross(axis, displacement)[i] * lift for axis in np.eye(3)]
            rows.append(np.r_[np.eye(3)[i], left_path * np.eye(3)[i], turned, slowed_path[i]] / position)
            rest.append((sample[i] - p[i]) / position)
            rows.append(np.r_[np.zeros(3), left * np.eye(3)[i], bent, slowed[i]] / velocity)
            rest.append((sample[3 + i] - v[i]) / velocity)
    prior = 1.0 / np.array([position] * 3 + [velocity] * 3 + [50.0] * 3 + [0.09])
    found, *_ = np.linalg.lstsq(np.vstack([rows, np.diag(prior)]), np.r_[rest, np.zeros(10)])
    return found[6:9]


@pytest.mark.parametrize("noise", [(0.0, 0.0), NOISE])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_fit_is_the_least_squares_solution(noise, seed):
    moments = np.arange(0, 0.32, 0.02)
    spin = tuple(np.random.default_rng(seed).uniform(-60, 60, 3))
    measured = samples(spin, moments, noise=noise, seed=seed)

    # The filter takes one step of its sums per sample, the reference 200
    np.testing.assert_allclose(
        spin_found(measured, moments, noise), least_squares(measured, moments, noise), atol=0.5, rtol=0.01
    )


ACROSS = {
    "topspin": np.cross(FLYING, UP) / np.hypot(FLYING[0], FLYING[1]),
    "sidespin": np.array([0, 0, 1.0]),
}


@pytest.mark.parametrize("drag", [0.9, 1.0, 1.1])
@pytest.mark.parametrize("rate", [-50.0, 20.0, 50.0])
@pytest.mark.parametrize("axis", ACROSS)
def test_spin_across_the_flight_is_found_to_6_percent_without_noise(axis, rate, drag):
    """The model includes the effect of drag on a deviation; the priors reduce the estimate by 2 %."""
    moments = np.arange(0, 0.32, 0.02)
    spin = rate * ACROSS[axis]

    assert np.dot(spin_found(samples(tuple(spin), moments, drag), moments), spin) == pytest.approx(
        rate**2, rel=0.06
    )


def test_spin_along_the_flight_is_almost_hidden():
    """It shows only because gravity turns the flight, and noise hides that too."""
    moments = np.arange(0, 0.22, 0.02)
    middle = samples((0.0, 0.0, 0.0), [0.1])[0, 3:]
    along = 60.0 * middle / np.linalg.norm(middle)
    measured = samples(tuple(along), moments)

    assert np.linalg.norm(spin_found(measured, moments)) < 0.6 * 60.0
    assert np.linalg.norm(spin_found(measured, moments, NOISE)) < 0.2 * 60.0


def test_lost_samples_do_not_corrupt_the_estimate():
    moments = np.arange(0, 0.32, 0.02)
    measured = samples((20.0, -40.0, 30.0), moments)
    kept = np.array([0, 1, 4, 5, 6, 9, 15])

    np.testing.assert_allclose(
        spin_found(measured[kept], moments[kept]), spin_found(measured, moments), atol=4.0
    )


def test_a_sample_that_is_held_changes_nothing():
    moments = np.arange(0, 0.22, 0.02)
    measured = samples((20.0, -40.0, 30.0), moments)
    held = np.repeat(np.arange(len(measured)), 3)

    np.testing.assert_array_equal(tracked(measured, moments), tracked(measured[held], moments[held]))


def test_before_the_second_sample_the_spin_is_0():
    np.testing.assert_array_equal(spin_found(samples((90.0, 0.0, 0.0), [0.0]), [0.0]), 0.0)


def bounce_of(spin, vel=FLYING):
    """Return moment, position and velocity of the ball of ``samples`` at its bounce."""
    pos, vel, moment, what, _ = fly_to_touch(START, vel, spin, 2.0, Air(1.0, 1.0, LINEAR), NO_ROBOT)
    assert what != 0
    return moment, pos, vel


@pytest.mark.parametrize("spin", [(5.0, -40.0, 20.0), (-50.0, 60.0, 0.0)])
def test_the_prior_after_the_bounce_equals_a_monte_carlo_estimate(spin):
    """Ten points represent the uncertainty of spin and table: the mean of 20,000 draws to a tenth of a sigma.

    Their covariance is right to a quarter, because the table's law has a kink between rolling and sliding.
    """
    moments = np.arange(0, 0.3, 0.02)
    track = tracked(samples(spin, moments, noise=NOISE), moments, NOISE)
    normal = track[NORMAL_MATRIX:RIGHT_SIDE].reshape(10, 10)
    normal = np.tril(normal) + np.tril(normal, -1).T
    variance = np.linalg.inv(normal)
    visible = SPIN_SIGMA * track[FLIGHT_SPIN]
    _, _, vel = bounce_of(spin)
    rng = np.random.default_rng(0)
    spins = rng.multivariate_normal(visible, SPIN_SIGMA**2 * variance[6:9, 6:9], 20_000)
    spins *= rng.normal(*SPIN_RATIO_PRIOR, (20_000, 1))
    after = np.array(
        [
            np.concatenate(table_bounce(vel, tuple(turned), UP, restitution, friction))
            for turned, restitution, friction in zip(
                spins,
                rng.normal(0.975, 0.0144, 20_000),
                rng.normal(0.25, 0.029, 20_000),
                strict=True,
            )
        ]
    )
    covariance = np.empty((6, 6))
    expected = np.concatenate(expected_bounce(vel, tuple(visible), *SPIN_RATIO_PRIOR, variance, covariance))
    covariance -= np.diag([BOUNCE_VELOCITY_SIGMA**2] * 3 + [BOUNCE_SPIN_SIGMA**2] * 3)
    sigma = after.std(axis=0)

    assert (np.abs(expected - after.mean(axis=0)) < 0.1 * sigma).all()
    np.testing.assert_allclose(covariance / np.outer(sigma, sigma), np.corrcoef(after.T), atol=0.25)


def bounced(spin, vel=FLYING, ratio_sigma=None, noise=(0.0, 0.0)):
    """Return the track 0.09 s after the bounce, and the ball's spin there."""
    rng = np.random.default_rng(3)
    moment, place, falling = bounce_of(spin, vel)
    rising, turned = table_bounce(falling, spin, UP, 0.975, 0.25)
    moments = np.arange(0.0, moment, 0.02)
    track = tracked(samples(spin, moments, vel=vel, noise=noise), moments, noise)
    track[SPIN_RATIO_SIGMA] = track[SPIN_RATIO_SIGMA] if ratio_sigma is None else ratio_sigma
    for later in np.arange(0.01, 0.1, 0.02):
        measured = np.concatenate(flown(turned, later, place, rising)) + rng.normal(size=6) * np.repeat(
            noise, 3
        )
        add_measurement(track, measured, moment + later, True, *noise)
    return track, turned


@pytest.mark.parametrize("along", [-50.0, 50.0])
def test_after_a_rolling_bounce_the_spin_in_the_tables_plane_is_known_also_the_hidden_part(along):
    """A ball that leaves without slip rolls: its velocity shows the spin along x that the flight hid."""
    vel = (-3.0, 0.3, 1.0)
    spin = (along, -20.0, 10.0)
    moments = np.arange(0, 0.3, 0.02)
    hidden = spin_found(samples(spin, moments, vel=vel), moments)
    track, turned = bounced(spin, vel)
    predict_interception(track, track[MOMENT])

    assert abs(hidden[0] - along) > 10.0
    assert np.abs(track[SPIN_AFTER] - turned)[:2].max() < 5.0


def test_the_predicted_interception_is_where_the_ball_goes():
    """Without noise on an average table: to 2 cm before the bounce, and to 3 mm after it."""
    spin = (10.0, -45.0, 20.0)
    moment, place, vel = bounce_of(spin)
    vel, turned = table_bounce(vel, spin, UP, 0.975, 0.25)
    there, velocity = flown(turned, INTERCEPTION_AFTER, place, vel)
    moments = np.arange(0, moment, 0.02)
    before = tracked(samples(spin, moments), moments)
    predict_interception(before, moments[-1] + 0.03)
    after, _ = bounced(spin)
    predict_interception(after, moment + 0.08)

    assert np.linalg.norm(before[INTERCEPTION_POS] - there) < 0.02
    assert before[INTERCEPTION] == pytest.approx(moment + INTERCEPTION_AFTER - moments[-1] - 0.03, abs=1e-3)
    assert np.linalg.norm(after[INTERCEPTION_POS] - there) < 0.003
    assert np.linalg.norm(after[INTERCEPTION_VEL] - velocity) < 0.05
    assert after[INTERCEPTION] == pytest.approx(INTERCEPTION_AFTER - 0.08, abs=1e-3)


def test_the_present_compensates_latency_also_through_the_bounce():
    spin = (10.0, -45.0, 20.0)
    moment, place, vel = bounce_of(spin)
    vel, turned = table_bounce(vel, spin, UP, 0.975, 0.25)
    moments = np.arange(0, moment, 0.02)
    track = tracked(samples(spin, moments), moments)
    for now in (moments[-1] + 0.005, moment + 0.02):
        pos, velocity = flown(spin, now) if now < moment else flown(turned, now - moment, place, vel)
        predict_interception(track, now)

        np.testing.assert_allclose(track[PRESENT_POS], pos, atol=0.01)
        np.testing.assert_allclose(track[PRESENT_VEL], velocity, atol=0.3)


def test_the_fit_restarts_at_a_bounce_that_was_not_predicted():
    """For example after a net cord: the ball is suddenly elsewhere. The fit starts from the measurement."""
    moments = np.arange(0, 0.1, 0.02)
    track = tracked(samples((0.0, 0.0, 0.0), moments), moments)
    add_measurement(track, np.array([-0.3, 0.5, 0.05, -2.0, 0.5, 2.0]), 0.12, True, *NOISE)
    predict_interception(track, 0.12)

    np.testing.assert_allclose(track[PRESENT_POS], [-0.3, 0.5, 0.05], atol=0.01)
    np.testing.assert_allclose(track[PRESENT_VEL], [-2.0, 0.5, 2.0], atol=1e-6)
    assert track[BOUNCED] == 1.0


def test_the_bounce_changes_no_information_on_drag():
    moments = np.arange(0, 0.3, 0.02)
    measured = samples((5.0, -40.0, 20.0), moments, drag=1.1, noise=NOISE)
    track = tracked(measured, moments, NOISE)
    normal = track[NORMAL_MATRIX:RIGHT_SIDE].reshape(10, 10)
    known = 1.0 / np.linalg.inv(np.tril(normal) + np.tril(normal, -1).T)[9, 9]
    moment, place, falling = bounce_of((5.0, -40.0, 20.0))
    rising, _ = table_bounce(falling, (5.0, -40.0, 20.0), UP, 0.975, 0.25)
    add_measurement(track, np.array([*place, *rising]), moment + 1e-3, True, *NOISE)

    assert track[RIGHT_SIDE - 1] == pytest.approx(known, rel=0.01)


def test_the_interception_of_a_lob_is_at_the_horizon_and_its_present_is_predicted():
    """It stays in the air longer than the longest prediction."""
    lob = (-0.5, 0.1, 6.0)
    moments = np.arange(0, 0.1, 0.02)
    track = tracked(samples((0.0, 0.0, 0.0), moments, vel=lob), moments)
    predict_interception(track, 0.12)
    here, velocity = flown((0.0, 0.0, 0.0), 0.12, vel=lob)

    np.testing.assert_allclose(track[PRESENT_POS], here, atol=0.005)
    np.testing.assert_allclose(track[PRESENT_VEL], velocity, atol=0.03)
    there, _ = flown((0.0, 0.0, 0.0), 1.08, vel=lob)
    assert track[INTERCEPTION] == pytest.approx(0.96)
    np.testing.assert_allclose(track[INTERCEPTION_POS], there, atol=0.02)


@pytest.mark.parametrize("vertical", [-3.0, 0.0, 2.0])
@pytest.mark.parametrize("height", [-0.1, 0.0, 0.3, 3.0])
def test_predictions_stay_bounded_after_a_wild_sample(height, vertical):
    track = new_tracks(1)[0]
    begin_track(track, np.array([0.8, 0.3, height, -6.0, 0.0, vertical, COMING]), 0.0, *NOISE)
    add_measurement(track, np.array([-5.0, 2.0, -1.0, 30.0, -20.0, 40.0]), 0.02, False, *NOISE)
    predict_interception(track, 0.045)

    assert np.isfinite(track).all()
    assert np.abs(track[PRESENT:BOUNCE_AS_PREDICTED]).max() < 1500.0
    add_measurement(track, np.array([0.5, 0.3, 0.1, -5.0, 0.0, 2.0]), 0.06, True, *NOISE)
    predict_interception(track, 0.08)

    assert np.isfinite(track).all()
    assert 0.5 <= track[NOMINAL_DRAG] <= 1.5
    assert np.abs(track[PRESENT:BOUNCE_AS_PREDICTED]).max() < 1500.0


def test_the_prior_of_the_second_fit_is_no_evidence_of_the_bounce():
    """Also a narrow prior: its information is subtracted, so only measurements show the change of velocity."""
    tight, wide = (bounced((60.0, -45.0, 20.0), ratio_sigma=sigma, noise=NOISE)[0] for sigma in (0.05, 3.0))

    assert (
        np.abs(tight[SOLUTION + DV : SOLUTION + DV + 2] - wide[SOLUTION + DV : SOLUTION + DV + 2]).max()
        > 0.02
    )  # the fits differ
    np.testing.assert_allclose(tight[SPIN_AFTER], wide[SPIN_AFTER], atol=2.0)

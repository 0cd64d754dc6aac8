"""What differs from rally to rally, and what the robot sees of the ball."""

import numpy as np
import pytest

from common.physics.constants import INVERTED
from common.physics.fly import GRID_STEP
from common.rally.noise import (
    CAMERA_RATE_HZ,
    CONDITIONS,
    MAX_LATENCY_STEPS,
    PROFILES,
    Condition,
    NoiseProfile,
    draw_conditions,
)
from tests.unit.rally.scripted import CONTROL_PERIOD, Played, play_ball

every_profile = pytest.mark.parametrize("profile", PROFILES)
OFF = PROFILES["off"]


def draw(seeds: int, noise: NoiseProfile) -> np.ndarray:
    rows = np.empty((seeds, CONDITIONS))
    for seed in range(seeds):
        draw_conditions(np.uint64(seed), 1.1, 0.9, noise, rows[seed])
    return rows


def watch(noise: NoiseProfile, seed: int = 1, steps: int = 20) -> Played:
    """Play a long high ball past a robot that keeps away."""
    return play_ball((1, 0, 0.3), (-2, 0, 3), noise=noise, seed=seed, steps=steps)


@every_profile
def test_conditions_are_a_function_of_the_seed(profile):
    np.testing.assert_array_equal(draw(50, PROFILES[profile]), draw(50, PROFILES[profile]))


@every_profile
def test_drag_and_lift_stay_as_the_rally_brings_them(profile):
    np.testing.assert_array_equal(
        draw(5, PROFILES[profile])[:, [Condition.DRAG, Condition.LIFT]], [[1.1, 0.9]] * 5
    )


@every_profile
def test_drag_and_lift_factors_stay_below_the_2_that_flight_bounds_its_search_by(profile):
    noise = PROFILES[profile]

    assert max(*noise.drag_factor, *noise.lift_factor) < 2.0


@every_profile
def test_the_camera_remembers_as_far_back_as_it_may_be_late(profile):
    assert PROFILES[profile].observation_latency[1] <= MAX_LATENCY_STEPS * GRID_STEP


@pytest.mark.parametrize(
    ("condition", "name"),
    [
        (Condition.TABLE_RESTITUTION0, "table_restitution0"),
        (Condition.TABLE_FRICTION, "table_friction"),
        (Condition.RACKET_RESTITUTION0, "racket_restitution0"),
        (Condition.RACKET_SLOPE, "racket_restitution_slope"),
        (Condition.RACKET_ALPHA, "racket_alpha"),
        (Condition.RACKET_SPIN_LOSS, "racket_spin_loss"),
        (Condition.ACTION_LATENCY, "action_latency"),
    ],
)
@every_profile
def test_a_condition_fills_its_range(profile, condition, name):
    low, high = getattr(PROFILES[profile], name)
    drawn = draw(1000, PROFILES[profile])[:, condition]

    assert np.all((drawn >= low) & (drawn <= high))
    # the extremes of 1,000 uniform draws miss the ends by more than 1 % once in 20,000 profiles
    assert np.ptp(drawn) >= 0.98 * (high - low)


def test_targets_cover_the_opponents_court_inside_its_lines():
    x, y = draw(4000, PROFILES["standard"])[:, [Condition.TARGET_X, Condition.TARGET_Y]].T

    assert x.min() >= 0.1
    assert x.max() <= 1.35
    assert np.abs(y).max() <= 0.7425
    # 4,000 draws: three standard errors of the means are 0.017 and 0.020, of the correlation 0.047
    np.testing.assert_allclose([x.mean(), y.mean()], [0.725, 0.0], atol=0.025)
    assert np.corrcoef(x, y)[0, 1] == pytest.approx(0.0, abs=0.05)


def test_the_target_of_a_rally_is_the_same_under_every_profile():
    targets = [draw(20, noise)[:, [Condition.TARGET_X, Condition.TARGET_Y]] for noise in PROFILES.values()]

    np.testing.assert_array_equal(targets[0], targets[1])
    np.testing.assert_array_equal(targets[0], targets[2])


def test_off_is_the_nominal_rubber_and_table():
    row = draw(1, OFF)[0]

    assert row[Condition.TABLE_RESTITUTION0] == 0.98
    assert row[Condition.TABLE_FRICTION] == 0.25
    np.testing.assert_array_equal(row[Condition.RACKET_RESTITUTION0 : Condition.TARGET_X], INVERTED[:4])


def test_a_burst_lasts_5_to_15_camera_samples_in_5_percent_of_rallies():
    drawn = draw(4000, PROFILES["standard"])
    length = drawn[:, Condition.BURST_END] - drawn[:, Condition.BURST_START]
    bursts = length > 0.0

    assert bursts.mean() == pytest.approx(0.05, abs=0.011)  # three standard errors
    assert np.all((length[bursts] >= 5 / CAMERA_RATE_HZ) & (length[bursts] <= 15 / CAMERA_RATE_HZ))


def test_without_noise_the_robot_sees_the_truth():
    played = watch(OFF)

    np.testing.assert_array_equal(played.seen[:, :6], played.balls[:, :6])


def test_a_latency_of_a_control_step_shows_the_ball_of_a_control_step_ago():
    played = watch(OFF._replace(observation_latency=(CONTROL_PERIOD, CONTROL_PERIOD)))

    np.testing.assert_array_equal(played.seen[1:, :6], played.balls[:-1, :6])


def test_the_trajectory_state_is_seen_as_late_as_the_ball():
    late = OFF._replace(observation_latency=(CONTROL_PERIOD, CONTROL_PERIOD))
    sharp, delayed = (
        play_ball((-0.3, 0, 0.3), (-1, 0, 0), noise=noise, steps=20).seen[:, 6] for noise in (OFF, late)
    )

    assert {0.0, 1.0} == set(sharp)
    np.testing.assert_array_equal(delayed[1:], sharp[:-1])


def test_when_every_sample_is_lost_the_first_is_held():
    played = watch(OFF._replace(loss=1.0))

    np.testing.assert_array_equal(played.seen[:, :3], np.tile([1, 0, 0.3], (20, 1)))


def test_a_lost_sample_holds_the_one_before():
    played = watch(OFF._replace(loss=0.5), steps=30)
    is_new = (played.seen[:, :6] == played.balls[:, :6]).all(axis=1)
    held = (played.seen[1:] == played.seen[:-1]).all(axis=1)

    assert 5 < is_new.sum() < 25
    np.testing.assert_array_equal(is_new[1:], ~held)


def test_in_a_burst_the_last_sample_before_it_is_held():
    noise = OFF._replace(burst_share=1.0, burst_samples=(15.0, 15.0))
    row = np.empty(CONDITIONS)
    draw_conditions(np.uint64(1), 0.0, 0.0, noise, row)
    played = watch(noise)
    moment = CONTROL_PERIOD * (1 + np.arange(len(played.seen)))
    lost = (moment >= row[Condition.BURST_START]) & (moment < row[Condition.BURST_END])
    last = np.flatnonzero(lost)[0] - 1

    assert lost.sum() >= 4
    assert np.all(played.seen[lost] == played.seen[last])
    np.testing.assert_array_equal(played.seen[~lost, :6], played.balls[~lost, :6])


def test_camera_noise_has_the_profiles_spread():
    noise = OFF._replace(position_noise=0.003, velocity_noise=0.08)
    errors = np.concatenate(
        [watch(noise, seed).seen[:, :6] - watch(noise, seed).balls[:, :6] for seed in range(60)]
    )

    # 3,600 numbers each: three standard errors are 3.5 %
    assert errors[:, :3].std() == pytest.approx(0.003, rel=0.04)
    assert errors[:, 3:].std() == pytest.approx(0.08, rel=0.04)
    assert np.abs(np.corrcoef(errors.T) - np.eye(6)).max() < 0.1

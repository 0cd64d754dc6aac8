"""What differs from rally to rally, and what the robot measures of the ball."""

import numpy as np
import pytest

from common.task.randomization import (
    MAX_LATENCY_STEPS,
    PROFILES,
    RALLY_PARAMETERS,
    RallyParameter,
    RandomizationProfile,
    draw_parameters,
)
from tests.unit.rally.scripted import CONTROL_PERIOD, Played, play_ball

every_profile = pytest.mark.parametrize("profile", PROFILES)
OFF = PROFILES["off"]


def draw(seeds: int, profile: RandomizationProfile) -> np.ndarray:
    rows = np.empty((seeds, RALLY_PARAMETERS))
    for seed in range(seeds):
        draw_parameters(np.uint64(seed), 1.1, 0.9, 3.0, profile, rows[seed])
    return rows


def play_high_ball(profile: RandomizationProfile, seed: int = 1, steps: int = 20) -> Played:
    """Play a long high ball with the robot far away from it."""
    return play_ball((1, 0, 0.3), (-2, 0, 3), profile=profile, seed=seed, steps=steps)


@every_profile
def test_parameters_are_a_function_of_the_seed(profile):
    np.testing.assert_array_equal(draw(50, PROFILES[profile]), draw(50, PROFILES[profile]))


@every_profile
def test_drag_lift_and_kind_are_those_of_the_launch(profile):
    columns = [RallyParameter.DRAG, RallyParameter.LIFT, RallyParameter.KIND]

    np.testing.assert_array_equal(draw(5, PROFILES[profile])[:, columns], [[1.1, 0.9, 3.0]] * 5)


@every_profile
def test_drag_and_lift_factors_stay_below_2_as_the_search_for_touches_assumes(profile):
    ranges = PROFILES[profile]

    assert max(ranges.drag_factor[1], ranges.lift_factor[1] + ranges.backspin_lift) < 2.0


@every_profile
def test_the_ring_of_true_samples_is_as_long_as_the_longest_latency(profile):
    assert PROFILES[profile].observation_latency[1] <= MAX_LATENCY_STEPS * 0.005


@pytest.mark.parametrize(
    ("parameter", "name"),
    [
        (RallyParameter.TABLE_RESTITUTION0, "table_restitution0"),
        (RallyParameter.TABLE_FRICTION, "table_friction"),
        (RallyParameter.RACKET_RESTITUTION0, "racket_restitution0"),
        (RallyParameter.RACKET_SLOPE, "racket_restitution_slope"),
        (RallyParameter.RACKET_ALPHA, "racket_alpha"),
        (RallyParameter.RACKET_SPIN_LOSS, "racket_spin_loss"),
        (RallyParameter.ACTION_LATENCY, "action_latency"),
    ],
)
@every_profile
def test_a_parameter_fills_its_range(profile, parameter, name):
    low, high = getattr(PROFILES[profile], name)
    drawn = draw(1000, PROFILES[profile])[:, parameter]

    assert np.all((drawn >= low) & (drawn <= high))
    # the extremes of 1,000 uniform numbers are more than 1 % from an end once in 20,000 profiles
    assert np.ptp(drawn) >= 0.98 * (high - low)


def test_targets_cover_the_opponents_court_inside_its_lines():
    x, y = draw(4000, PROFILES["standard"])[:, [RallyParameter.TARGET_X, RallyParameter.TARGET_Y]].T

    # the extremes of 4,000 uniform numbers are within 0.3 % of the ends
    assert 0.1 <= x.min() < 0.104
    assert 1.346 < x.max() <= 1.35
    assert -0.7425 <= y.min() < -0.738
    assert 0.738 < y.max() <= 0.7425
    # 4,000 draws: three standard errors of the means are 0.017 and 0.020, of the correlation 0.047
    np.testing.assert_allclose([x.mean(), y.mean()], [0.725, 0.0], atol=0.025)
    assert np.corrcoef(x, y)[0, 1] == pytest.approx(0.0, abs=0.05)


def test_the_target_of_a_rally_is_the_same_under_every_profile():
    targets = [
        draw(20, profile)[:, [RallyParameter.TARGET_X, RallyParameter.TARGET_Y]]
        for profile in PROFILES.values()
    ]

    np.testing.assert_array_equal(targets[0], targets[1])
    np.testing.assert_array_equal(targets[0], targets[2])


def test_profile_off_has_the_nominal_rubber_and_table():
    row = draw(1, OFF)[0]

    assert row[RallyParameter.TABLE_RESTITUTION0] == 0.98
    assert row[RallyParameter.TABLE_FRICTION] == 0.25
    np.testing.assert_array_equal(
        row[RallyParameter.RACKET_RESTITUTION0 : RallyParameter.TARGET_X], [0.878, 0.020, 0.70, 0.2]
    )


def test_a_burst_lasts_5_to_15_camera_samples_in_5_percent_of_rallies():
    drawn = draw(4000, PROFILES["standard"])
    length = drawn[:, RallyParameter.BURST_END] - drawn[:, RallyParameter.BURST_START]
    has_burst = length > 0.0

    assert has_burst.mean() == pytest.approx(0.05, abs=0.011)  # three standard errors
    assert np.all((length[has_burst] >= 5 / 180) & (length[has_burst] <= 15 / 180))


def test_a_burst_begins_in_the_first_0_6_s_and_its_length_is_uniform():
    """All of 4,000 rallies with a burst: the mean start is 0.3 s, the mean length 10 samples of 1/180 s."""
    profile = PROFILES["standard"]._replace(burst_share=1.0)
    drawn = draw(4000, profile)
    start = drawn[:, RallyParameter.BURST_START]
    length = drawn[:, RallyParameter.BURST_END] - start

    # three standard errors: 8 ms and 0.8 ms
    assert start.mean() == pytest.approx(0.3, abs=0.008)
    assert 0.59 < start.max() < 0.6
    assert length.mean() == pytest.approx(10 / 180, abs=0.8e-3)


def test_rallies_with_a_burst_have_bursts_of_all_lengths():
    """Whether there is a burst says nothing about its length."""
    drawn = draw(8000, PROFILES["standard"])
    length = (drawn[:, RallyParameter.BURST_END] - drawn[:, RallyParameter.BURST_START]) * 180
    length = length[length > 0.0]

    assert length.min() < 6.0
    assert length.max() > 14.0


def test_a_latency_is_rounded_to_the_nearest_grid_step():
    """10 to 40 ms in steps of 5 ms: 2 to 8, with half as many draws at both ends."""
    steps = draw(4000, PROFILES["standard"])[:, RallyParameter.LATENCY]
    share = np.bincount(steps.astype(int), minlength=9) / 4000

    # three standard errors of 1/6 are 0.018
    np.testing.assert_allclose(share, [0, 0, 1 / 12, 1 / 6, 1 / 6, 1 / 6, 1 / 6, 1 / 6, 1 / 12], atol=0.018)


def test_without_randomization_the_robot_measures_the_true_state():
    played = play_high_ball(OFF)

    np.testing.assert_array_equal(played.measurement[:, :6], played.balls[:, :6])


def test_with_a_latency_of_one_control_step_the_robot_measures_the_ball_one_control_step_ago():
    played = play_high_ball(OFF._replace(observation_latency=(CONTROL_PERIOD, CONTROL_PERIOD)))

    np.testing.assert_array_equal(played.measurement[1:, :6], played.balls[:-1, :6])


def test_the_trajectory_state_is_measured_as_late_as_the_ball():
    late = OFF._replace(observation_latency=(CONTROL_PERIOD, CONTROL_PERIOD))
    prompt, delayed = (
        play_ball((-0.3, 0, 0.3), (-1, 0, 0), profile=profile, steps=20).measurement[:, 6]
        for profile in (OFF, late)
    )

    assert {0.0, 1.0} == set(prompt)
    np.testing.assert_array_equal(delayed[1:], prompt[:-1])


def test_when_every_later_sample_is_lost_the_first_is_held():
    played = play_high_ball(OFF._replace(loss=1.0))

    np.testing.assert_array_equal(played.measurement[:, :3], np.tile([1, 0, 0.3], (20, 1)))


def test_a_lost_sample_repeats_the_last_one():
    played = play_high_ball(OFF._replace(loss=0.5), steps=30)
    is_new = (played.measurement[:, :6] == played.balls[:, :6]).all(axis=1)
    held = (played.measurement[1:] == played.measurement[:-1]).all(axis=1)

    assert 5 < is_new.sum() < 25
    np.testing.assert_array_equal(is_new[1:], ~held)


def test_in_a_burst_the_last_sample_before_it_is_held():
    profile = OFF._replace(burst_share=1.0, burst_samples=(15.0, 15.0))
    row = np.empty(RALLY_PARAMETERS)
    draw_parameters(np.uint64(1), 0.0, 0.0, 0.0, profile, row)
    played = play_high_ball(profile)
    moment = CONTROL_PERIOD * (1 + np.arange(len(played.measurement)))
    lost = (moment >= row[RallyParameter.BURST_START]) & (moment < row[RallyParameter.BURST_END])
    last = np.flatnonzero(lost)[0] - 1

    assert lost.sum() >= 4
    assert np.all(played.measurement[lost] == played.measurement[last])
    np.testing.assert_array_equal(played.measurement[~lost, :6], played.balls[~lost, :6])


def test_measurement_noise_has_the_standard_deviation_of_the_profile():
    profile = OFF._replace(position_noise=0.003, velocity_noise=0.08)
    rallies = [play_high_ball(profile, seed) for seed in range(60)]
    errors = np.concatenate([played.measurement[:, :6] - played.balls[:, :6] for played in rallies])

    # 3,600 numbers each: three standard errors are 3.5 %
    assert errors[:, :3].std() == pytest.approx(0.003, rel=0.04)
    assert errors[:, 3:].std() == pytest.approx(0.08, rel=0.04)
    assert np.abs(np.corrcoef(errors.T) - np.eye(6)).max() < 0.1

"""Prediction at sample times: against the environment's flight, and against a root finder."""

import numpy as np
import pytest
from scipy.optimize import brentq

from common.physics.constants import BALL_RADIUS, GRID_STEP
from common.physics.flight import FULL, SIMPLE, Air, flight_step
from common.physics.fly import NO_ROBOT, fly_to_touch
from common.physics.table_bounce import table_bounce
from common.physics.touch import ROBOT_COURT
from tests.unit.topspin.real2sim.flights import TABLE, launch_of
from topspin.real2sim.fit.predict import predict, touch_down, whitened


def predicted(launch, times, table=TABLE, model=SIMPLE):
    positions, velocities = np.empty((len(times), 3)), np.empty((len(times), 3))
    predict(launch, table, model, np.asarray(times, float), positions, velocities)
    return positions, velocities


def as_vectors(launch):
    return tuple(map(float, launch[:3])), tuple(map(float, launch[3:6])), tuple(map(float, launch[6:9]))


@pytest.mark.parametrize("model", [SIMPLE, FULL])
def test_a_ball_lands_where_the_environments_does(model):
    launch = launch_of(spin=(20.0, -90.0, 30.0), drag=0.9, lift=1.2)
    pos, vel, flown, what, _ = fly_to_touch(*as_vectors(launch), 2.0, Air(0.9, 1.2, model), NO_ROBOT)
    moment, place, falling = touch_down(launch, model, 2.0)

    assert what == ROBOT_COURT
    assert moment == pytest.approx(flown, abs=1e-9)
    np.testing.assert_allclose(place, pos, atol=1e-9)
    np.testing.assert_allclose(falling, vel, atol=1e-8)


def test_a_bounce_between_samples_is_found_where_a_root_finder_finds_it():
    launch = launch_of()
    pos, vel, spin = as_vectors(launch)
    fall = brentq(lambda t: predicted(launch, [t], np.empty(0))[0][0, 2] - BALL_RADIUS, 0.3, 0.6, xtol=1e-13)
    here, there = predicted(launch, [fall], np.empty(0))
    vel, spin = table_bounce(tuple(map(float, there[0])), spin, (0.0, 0.0, 1.0), *TABLE)
    pos = (float(here[0, 0]), float(here[0, 1]), BALL_RADIUS)
    for _ in range(20):
        pos, vel = flight_step(pos, vel, spin, GRID_STEP, Air(1.0, 1.0, SIMPLE))

    np.testing.assert_allclose(predicted(launch, [fall + 20 * GRID_STEP])[0][0], pos, atol=1e-7)


def test_the_sample_times_do_not_change_the_flight():
    launch = launch_of()
    often, _ = predicted(launch, np.linspace(0.0, 0.7, 400))
    once, _ = predicted(launch, [0.7])

    np.testing.assert_allclose(often[-1], once[0], atol=1e-8)


def test_without_a_table_the_ball_flies_on_through_it():
    there, _ = predicted(launch_of(), [0.6], np.empty(0))

    assert there[0, 2] < -0.2


def test_beside_the_table_nothing_bounces():
    there, _ = predicted(launch_of(pos=(1.3, 1.0, 0.33)), [0.6])

    assert there[0, 2] < -0.2


def test_a_ball_that_does_not_descend_has_no_landing():
    moment, _, _ = touch_down(launch_of(vel=(-5.0, 0.0, 9.0)), SIMPLE, 0.5)

    assert np.isnan(moment)


def test_residuals_are_whitened_by_the_root_of_the_covariance():
    rng = np.random.default_rng(1)
    predicted_at, velocities, measured = rng.standard_normal((3, 5, 3))
    residuals = np.empty((5, 3))
    whitened(predicted_at, velocities, measured, 0.3, 0.7, residuals)

    for k in range(5):
        covariance = 0.3**2 * np.eye(3) + 0.7**2 * np.outer(velocities[k], velocities[k])
        difference = predicted_at[k] - measured[k]
        np.testing.assert_allclose(
            residuals[k] @ residuals[k], difference @ np.linalg.solve(covariance, difference), rtol=1e-10
        )

"""Fits: the launch of a simulated flight is found again, within the fit's sigma."""

import numpy as np
import pytest

from common.physics.flight import FULL, SIMPLE
from common.task.launch import DRAG_FACTOR, LIFT_FACTOR, POSITION, SPIN, VELOCITY
from tests.unit.topspin.real2sim.flights import launch_of, seen
from topspin.real2sim.fit.fit_problem import Air, FitOptions
from topspin.real2sim.fit.identify import fit
from topspin.real2sim.formats.tracks import RecordingError, Track

NOISE = {"noise": 1e-3, "jitter": 0.35e-3}
# Topspin, backspin, sidespin, next to none; all short of the lift's saturation at 5 m/s
SPINS = [(5.0, -40.0, 12.0), (-4.0, 45.0, 3.0), (0.0, -10.0, -45.0), (1.0, -2.0, 1.0)]


@pytest.mark.parametrize("flight", [SIMPLE, FULL])
@pytest.mark.parametrize("spin", SPINS)
def test_without_noise_the_fit_finds_the_launch(spin, flight):
    launch = launch_of(spin=spin)
    found = fit(seen(launch, flight=flight), FitOptions(flight=flight))

    # the priors have some effect, mostly on the spin along the flight and on the lift factor
    assert found.rms < 0.5e-3
    np.testing.assert_allclose(found.position, launch[POSITION], atol=1e-3)
    np.testing.assert_allclose(found.velocity, launch[VELOCITY], atol=0.02)
    np.testing.assert_allclose(found.spin, spin, atol=4.0)
    assert found.bounced


@pytest.mark.parametrize("through_bounce", [True, False])
def test_a_launch_lies_within_the_claimed_sigmas(through_bounce):
    rng = np.random.default_rng(7)
    scores = []
    for seed in range(24):
        drag, lift = 1.0 + 0.1 * rng.standard_normal(), 1.0 + 0.1 * rng.standard_normal()
        launch = launch_of(spin=tuple(18.0 * rng.standard_normal(3)), drag=drag, lift=lift)
        found = fit(seen(launch, seed=seed, **NOISE), FitOptions(through_bounce=through_bounce))
        scores.append((found.launch - launch) / found.sigmas[: len(launch)])
    scores = np.array(scores)

    # of 24 draws of a normal distribution the rms lies in 0.6..1.45 in all but 0.1 %; priors wider than what is drawn
    # make it smaller, so only the upper end is checked. The stamps count from the first one: it moves x by 1.75 mm
    rms = np.sqrt(np.mean(scores**2, axis=0))
    assert np.all(rms[1:3] < 1.5)
    assert np.all(rms[VELOCITY] < 1.5)
    assert np.all(rms[SPIN] < 1.5)
    assert rms[DRAG_FACTOR] < 1.5
    assert rms[LIFT_FACTOR] < 1.5


def test_spin_above_saturation_is_unknown_before_the_bounce_and_known_after_it():
    launch = launch_of(vel=(-5.0, 0.0, 1.8), spin=(0.0, -180.0, 0.0))
    track = seen(launch, flight=SIMPLE, **NOISE)
    before = fit(track, FitOptions(flight=SIMPLE, through_bounce=False))
    through = fit(track, FitOptions(flight=SIMPLE))

    # in the simple model lift saturates at 62 rad/s for 5 m/s
    assert before.spin_interval[0, 1] < -180.0 < before.spin_interval[1, 1] < -45.0
    assert before.sigmas[7] > 60.0
    assert through.spin[1] == pytest.approx(-180.0, abs=4.0 * through.sigmas[7])
    assert through.sigmas[7] < 25.0


def test_the_spin_along_the_flight_is_hardly_known():
    flat = launch_of(pos=(1.3, 0.0, 0.5), vel=(-7.0, 0.0, 0.0), spin=(60.0, 0.0, 0.0))
    found = fit(seen(flat, duration=0.2, **NOISE))

    assert found.spin_interval[0, 0] < -30.0
    assert found.spin_interval[1, 0] > 60.0
    assert found.sigmas[6] > 4.0 * found.sigmas[7]


@pytest.mark.parametrize(("air", "free"), [(Air.ALL, 13), (Air.DRAG, 9), (Air.NONE, 8)])
def test_only_the_forces_of_the_model_are_fitted(air, free):
    found = fit(seen(launch_of(), **NOISE), FitOptions(air=air))

    assert np.count_nonzero(found.sigmas) == free
    if air is not Air.ALL:
        np.testing.assert_array_equal(found.spin, 0.0)


def test_a_model_with_fewer_forces_explains_less():
    track = seen(launch_of(spin=(0.0, -60.0, 0.0)), **NOISE)
    rms = {air: fit(track, FitOptions(air=air, through_bounce=False)).rms for air in Air}

    assert rms[Air.ALL] < 3e-3 < 3.0 * rms[Air.ALL] < rms[Air.DRAG] < rms[Air.NONE]


def test_outliers_do_not_move_the_launch():
    track = seen(launch_of(), **NOISE)
    positions = track.positions.copy()
    positions[::15] += 0.04
    dirty, clean = fit(Track("dirty", track.times, positions)), fit(track)

    np.testing.assert_allclose(dirty.velocity, clean.velocity, atol=0.08)
    np.testing.assert_allclose(dirty.spin, clean.spin, atol=15.0)


def test_a_mirrored_flight_has_the_mirrored_launch():
    track = seen(launch_of(), **NOISE)
    mirrored = fit(Track("mirror", track.times, track.positions * [1.0, -1.0, 1.0]))
    found = fit(track)

    # spin is axial: a mirror image in y turns x and z of it. The chains are random, and so is a share of a sigma
    apart = mirrored.spin * [-1.0, 1.0, -1.0] - found.spin
    np.testing.assert_allclose(mirrored.velocity * [1.0, -1.0, 1.0], found.velocity, atol=0.01)
    assert np.all(np.abs(apart) < found.sigmas[SPIN])


def test_the_tables_restitution_is_found_where_it_bounces():
    found = fit(seen(launch_of(), table=np.array([1.0, 0.25]), **NOISE))

    assert found.table[0] == pytest.approx(1.0, abs=0.012)
    assert found.sigmas[11] < 0.01


def test_a_serve_is_fitted_through_both_bounces():
    launch = launch_of(pos=(1.5, 0.2, 0.25), vel=(-5.2, -0.2, -2.0), spin=(0.0, 40.0, 10.0))
    found = fit(seen(launch, **NOISE))

    assert found.is_serve
    assert found.used_samples == found.samples
    assert found.rms < 3.5e-3  # the camera's noise
    np.testing.assert_allclose(found.velocity, launch[VELOCITY], atol=0.05)
    np.testing.assert_allclose(found.spin, launch[SPIN], atol=12.0)


def test_a_fast_camera_gives_the_same_launch():
    launch = launch_of()
    found = fit(seen(launch, rate=1000.0, noise=2e-3))

    assert found.used_samples == found.samples == 700
    np.testing.assert_allclose(found.position, launch[POSITION], atol=2e-3)
    np.testing.assert_allclose(found.velocity, launch[VELOCITY], atol=0.03)


def test_a_flight_alone_admits_a_spin_that_is_twice_as_fast():
    """Backspin of 200 rad/s with a lift factor of 1.6: a rate that the slope of the residuals denies."""
    launch = launch_of(vel=(-4.8, 0.1, 1.1), spin=(0.0, 200.0, 0.0), lift=1.6)
    found = fit(seen(launch, duration=0.35, noise=2e-3))

    assert found.rms < 5e-3
    assert found.spin_interval[0, 1] < 200.0 < found.spin_interval[1, 1]
    assert abs(found.spin[1] - 200.0) < 2.0 * found.sigmas[SPIN][1]


def test_too_short_a_flight_is_an_error():
    track = seen(launch_of(), duration=0.03)

    with pytest.raises(RecordingError, match=r"recording made: got 6 samples .* allowed: 8 or more"):
        fit(track)

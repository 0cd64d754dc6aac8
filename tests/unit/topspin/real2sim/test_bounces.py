"""Bounces and strokes are found in simulated tracks, where the touches are known."""

import numpy as np
import pytest

from common.physics.flight import FULL
from tests.unit.topspin.real2sim.flights import launch_of, seen
from topspin.real2sim.fit.bounces import noise_of, touches
from topspin.real2sim.fit.predict import touch_down
from topspin.real2sim.formats.tracks import Track

# of a real camera: 1 mm across, 0.35 ms of the stamps
SERVE = {"pos": (1.5, 0.2, 0.25), "vel": (-5.2, -0.2, -2.0), "spin": (0.0, 40.0, 10.0)}
NOISE = {"noise": 1e-3, "jitter": 0.35e-3}


@pytest.mark.parametrize("seed", range(8))
def test_a_bounce_is_found_within_millimetres(seed):
    launch = launch_of()
    moment, place, _ = touch_down(launch, FULL, 2.0)
    found = touches(seen(launch, seed=seed, **NOISE))

    assert len(found.bounces) == 1
    bounce = found.bounces[0]
    assert bounce.measured
    assert bounce.time == pytest.approx(moment, abs=2.5e-3)  # it includes the first stamp's jitter
    # three sigma of the two lines' mean: 2 mm along the flight over root 8, and the air's curvature
    np.testing.assert_allclose(bounce.position, place, atol=5e-3)


@pytest.mark.parametrize("seed", range(4))
def test_a_flight_without_a_bounce_has_none(seed):
    track = seen(launch_of(), duration=0.42, seed=seed, **NOISE)

    assert touches(track) == touches(track)
    assert touches(track).bounces == ()
    assert touches(track).end == len(track.times)


@pytest.mark.parametrize(
    ("rate", "noise"),
    [(60, 1e-3), (120, 2e-3), (180, 2e-3), (250, 6e-3), (500, 4e-3), (1000, 2e-3), (1000, 6e-3)],
)
@pytest.mark.parametrize("has_gaps", [False, True])
def test_a_bounce_is_found_at_any_rate_with_noise_and_gaps(rate, noise, has_gaps):
    track = seen(launch_of(), rate=float(rate), noise=noise, seed=rate)
    if has_gaps:  # 40 ms of every 200 ms are lost
        seen_by_it = track.times % 0.2 > 0.04
        track = Track("gaps", track.times[seen_by_it], track.positions[seen_by_it])
    moment, place, _ = touch_down(launch_of(), FULL, 2.0)
    found = touches(track)

    assert found.end == found.flight_end == len(track.times)
    (bounce,) = found.bounces
    assert bounce.time == pytest.approx(moment, abs=6e-3)
    np.testing.assert_allclose(bounce.position, place, atol=0.02)
    assert not found.is_serve


@pytest.mark.parametrize(("rate", "noise"), [(60, 1e-3), (180, 2e-3), (1000, 6e-3)])
def test_the_noise_is_estimated_from_the_track(rate, noise):
    track = seen(launch_of(), rate=float(rate), noise=noise)

    assert noise_of(track) == pytest.approx(noise, rel=0.35)  # 40 samples of three axes at 60 Hz


def test_a_serve_bounces_on_both_courts_and_flies_on_after_the_second():
    track = seen(launch_of(**SERVE), **NOISE)
    found = touches(track)

    assert [bounce.position[0] > 0.0 for bounce in found.bounces] == [True, False]
    assert found.is_serve
    assert found.flight_end == len(track.times)


def test_two_bounces_are_two():
    track = seen(launch_of(pos=(0.3, 0.0, 0.3), vel=(-1.5, 0.0, 0.0)), duration=0.9, **NOISE)

    assert len(touches(track).bounces) == 2


def test_a_bounce_in_a_gap_is_detected_but_not_measured():
    track = seen(launch_of(), **NOISE)
    moment, _, _ = touch_down(launch_of(), FULL, 2.0)
    near = np.abs(track.times - moment) > 0.035
    found = touches(Track("gap", track.times[near], track.positions[near]))

    assert [bounce.measured for bounce in found.bounces] == [False]


def test_a_stroke_ends_the_flight():
    coming = seen(launch_of(), duration=0.4, **NOISE)
    going = coming.positions[-1] + np.arange(1, 20)[:, None] / 180.0 * np.array([6.0, 0.0, 1.0])
    times = np.append(coming.times, coming.times[-1] + np.arange(1, 20) / 180.0)
    found = touches(Track("hit", times, np.vstack([coming.positions, going])))

    assert found.bounces == ()
    assert abs(found.end - len(coming.times)) <= 1

"""Bounces and strokes are found in simulated tracks, where the touches are known."""

import numpy as np
import pytest

from common.physics.flight import SIMPLE
from tests.unit.topspin.real2sim.flights import launch_of, seen
from topspin.real2sim.fit.bounces import touches
from topspin.real2sim.fit.predict import touch_down
from topspin.real2sim.formats.tracks import Track

# of a real camera: 1 mm across, 0.35 ms of the stamps
NOISE = {"noise": 1e-3, "jitter": 0.35e-3}


@pytest.mark.parametrize("seed", range(8))
def test_a_bounce_is_found_within_millimetres(seed):
    launch = launch_of()
    moment, place, _ = touch_down(launch, SIMPLE, 2.0)
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


def test_two_bounces_are_two():
    track = seen(launch_of(pos=(0.3, 0.0, 0.3), vel=(-1.5, 0.0, 0.0)), duration=0.9, **NOISE)

    assert len(touches(track).bounces) == 2


def test_a_bounce_in_a_gap_is_detected_but_not_measured():
    track = seen(launch_of(), **NOISE)
    moment, _, _ = touch_down(launch_of(), SIMPLE, 2.0)
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

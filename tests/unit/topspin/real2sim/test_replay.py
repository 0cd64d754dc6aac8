"""Recorded balls as rallies: what is recorded, what is drawn, and which are valid."""

import numpy as np
import pytest

from common.evaluation.unplayed_flight import unplayed_flight
from common.physics.flight import FULL, SIMPLE
from common.task.launch import DRAG_FACTOR, KIND, POSITION, SPIN, VELOCITY, Purpose, draw_rallies
from common.task.randomization import PROFILES, RALLY_PARAMETERS, draw_parameters
from tests.unit.topspin.real2sim.flights import launch_of, seen
from topspin.real2sim.fit.bounces import touches
from topspin.real2sim.fit.fit_problem import FitOptions
from topspin.real2sim.fit.identify import fit
from topspin.real2sim.formats.tracks import RecordingError, States
from topspin.real2sim.replay import of_fits, of_states, seed_of


def states_of(*launches):
    rows = np.array(launches)
    ids = tuple(f"s{k}" for k in range(len(rows)))
    unknown = ("",) * len(rows)
    return States(ids, rows[:, POSITION], rows[:, VELOCITY], rows[:, SPIN], unknown, unknown)


GOOD, INTO_NET, TOO_FAR = launch_of(), launch_of(vel=(-5.0, 0.0, 0.5)), launch_of(vel=(-14.0, 0.0, 2.0))


def test_a_state_is_launched_as_it_was_recorded():
    found = of_states(states_of(GOOD, INTO_NET, TOO_FAR))

    np.testing.assert_array_equal(found.launches[0, :9], GOOD[:9])
    np.testing.assert_array_equal(found.valid, [True, False, False])
    assert found.block().drawn == 3
    np.testing.assert_array_equal(found.block().launches, found.launches[:1])


def test_validity_is_the_generators():
    block = draw_rallies(50, seed=4)
    everything = draw_rallies(50, seed=4, purpose=Purpose.FALLBACK)

    assert of_states(states_of(*block.launches), randomization="off").valid.mean() > 0.9  # with other air
    assert of_states(states_of(*everything.launches), randomization="off").valid.mean() < 0.6


def test_a_rally_depends_on_its_recordings_name_alone():
    both, one = of_states(states_of(GOOD, TOO_FAR)), of_states(states_of(GOOD))
    other = of_states(states_of(GOOD), seed=2**64 - 1)

    np.testing.assert_array_equal(both.launches[0], one.launches[0])
    assert both.seeds[0] == one.seeds[0] != other.seeds[0]
    assert both.seeds[0] != both.seeds[1]


def test_no_other_purpose_has_a_recorded_rallys_seed():
    assert int(seed_of("a track", 5)) >> 62 == Purpose.RECORDED
    assert seed_of("a track", 5) == seed_of("a track", 5)


def test_air_is_drawn_within_the_profile():
    found = of_states(states_of(*[GOOD] * 64), air="standard")
    still = of_states(states_of(GOOD), air="off")

    low, high = PROFILES["standard"].drag_factor
    drag = found.launches[:, DRAG_FACTOR]
    assert low <= drag.min() < 0.9
    assert 1.1 < drag.max() < high
    np.testing.assert_array_equal(still.launches[0, DRAG_FACTOR:KIND], [1.0, 1.0])


def test_a_fitted_track_bounces_where_the_recording_did():
    launch = launch_of(spin=(3.0, -45.0, 5.0))
    track = seen(launch, noise=1e-3, jitter=0.35e-3)
    found = of_fits([fit(track)])
    parameters = np.zeros((1, RALLY_PARAMETERS))
    draw_parameters(found.seeds[0], *found.launches[0, DRAG_FACTOR:], PROFILES["off"], parameters[0])
    bounces, _ = unplayed_flight(found.launches, parameters, FULL)

    assert found.valid[0]
    np.testing.assert_allclose(bounces[0], touches(track).bounces[0].position, atol=6e-3)


def test_nothing_valid_is_an_error():
    with pytest.raises(RecordingError, match=r"got 1 recorded balls, none of which crosses the net"):
        of_states(states_of(INTO_NET)).block()


def test_fits_of_two_models_are_an_error():
    fits = [fit(seen(GOOD, flight=flight), FitOptions(flight=flight)) for flight in (SIMPLE, FULL)]

    with pytest.raises(RecordingError, match="got fits of 2 flight models; allowed: one or more fits of one"):
        of_fits(fits)

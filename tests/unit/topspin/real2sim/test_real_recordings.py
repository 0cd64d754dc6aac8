"""Real balls: the bounces of the mapped recordings, and fits to them (skipped without the recordings)."""

from pathlib import Path

import numpy as np
import pytest

from common.physics import flight
from common.physics.constants import BALL_RADIUS, TABLE_HALF_WIDTH
from common.physics.fly import NO_ROBOT
from common.task.launch import is_valid
from topspin.real2sim.fit.bounces import touches
from topspin.real2sim.fit.fit_problem import Air, FitOptions
from topspin.real2sim.fit.identify import fit
from topspin.real2sim.formats.recordings import load, load_folder

DATA = Path(__file__).resolve().parents[5] / "shared" / "data"

pytestmark = pytest.mark.skipif(
    not DATA.is_dir(), reason=f"no recordings in {DATA}: docs/real2sim.md says where to download them"
)


def gun_tracks():
    pytest.importorskip("h5py", reason="h5py is missing: pip install -e '.[real2sim]'")
    return [track for found in load_folder(DATA / "mpi_ball_gun", "*.hdf5") for track in found.tracks]


def test_a_ball_guns_balls_bounce_on_the_robots_court():
    bounces = [touches(track).bounces for track in gun_tracks()]
    places = np.array([found[0].position for found in bounces if found and found[0].measured])

    assert len(places) >= 15
    # the table's height is a constant of the loader: every bounce lies on it
    assert np.median(places[:, 2]) == pytest.approx(BALL_RADIUS, abs=0.002)
    assert np.all(np.abs(places[:, 2] - BALL_RADIUS) < 0.012)
    assert np.all((places[:, 0] < 0.0) & (places[:, 0] > -1.37))
    assert np.all(np.abs(places[:, 1]) < TABLE_HALF_WIDTH)


@pytest.mark.parametrize(("label", "turns"), [("topspin", 1.0), ("backspin", -1.0)])
def test_a_fit_distinguishes_topspin_from_backspin(label, turns):
    track = next(track for track in gun_tracks() if track.label == label)
    full = fit(track, FitOptions(through_bounce=False))
    dragged = fit(track, FitOptions(air=Air.DRAG, through_bounce=False))

    # flying towards -x, topspin is about -y
    assert full.spin[1] * turns < -35.0
    assert full.rms < 0.007 < dragged.rms


def test_deepminds_rallies_are_valid_rallies():
    found = load(DATA / "deepmind_ball_states" / "rallies.json").states
    rows = np.hstack([found.positions, found.velocities, found.spins])
    vectors = [tuple(tuple(map(float, row[k : k + 3])) for k in (0, 3, 6)) for row in rows]
    valid = [
        is_valid(*three, flight.Air(1.0, 1.0, flight.FULL), False, (0.98, 0.25), NO_ROBOT)
        for three in vectors
    ]

    assert len(rows) > 5000
    assert np.mean(valid) > 0.97

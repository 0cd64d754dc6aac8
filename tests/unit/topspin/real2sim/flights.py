"""Builders of synthetic recordings: simulated balls, sampled by a simulated camera."""

import numpy as np

from common.physics.constants import TABLE_FRICTION, TABLE_RESTITUTION0
from common.physics.flight import FULL
from topspin.real2sim.fit.predict import predict
from topspin.real2sim.formats.tracks import Track

TABLE = np.array([TABLE_RESTITUTION0, TABLE_FRICTION])


def launch_of(pos=(1.3, 0.0, 0.33), vel=(-5.0, 0.1, 1.8), spin=(5.0, -40.0, 12.0), drag=1.0, lift=1.0):
    """Return a launch record (11,) that bounces on the robot's court after 0.45 s."""
    return np.array([*pos, *vel, *spin, drag, lift])


def seen(launch, duration=0.7, rate=180.0, noise=0.0, jitter=0.0, seed=0, flight=FULL, table=TABLE):
    """Return the track of a launch: position noise [m], and time stamps, except the first, off by ``jitter`` [s]."""
    rng = np.random.default_rng(seed)
    times = np.arange(0.0, duration, 1.0 / rate)
    positions, velocities = np.empty((len(times), 3)), np.empty((len(times), 3))
    predict(launch, table, flight, times, positions, velocities)
    positions += noise * rng.standard_normal(positions.shape)
    stamps = times + jitter * rng.standard_normal(len(times))
    stamps[0] = 0.0  # the launch is at the track's time 0
    return Track("made", stamps, positions)

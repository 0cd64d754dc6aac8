"""Touches in a recorded track: bounces on the table, and strokes, which end a flight.

A touch changes the velocity at once, air only slowly. Before and after every moment a line is fitted to a few samples
(without gravity). Where the two slopes differ most, and by more than noise can explain, the ball touched something. The
point of a bounce is where both parabolas meet in height. It uses no model of air, spin or table, so these models can be
checked against it.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from common.physics.constants import BALL_RADIUS, GRAVITY, TABLE_HALF_LENGTH, TABLE_HALF_WIDTH
from topspin.real2sim.formats.tracks import Track

Array = npt.NDArray[np.float64]

WINDOW: Final = 8  # samples on each side: with 2 mm of noise at 180 Hz a slope's sigma is 0.06 m/s
FEWEST: Final = 5  # samples on a side, if the track has no more
FEWEST_AFTER: Final = 3  # samples after a bounce at the end of a track: the table's position confirms it
RISE: Final = 1.0  # m/s; a bounce changes the vertical velocity by more
STROKE: Final = 3.0  # m/s; a table's friction changes the horizontal velocity by less
NEAREST: Final = 0.03  # s; without a sample this near on both sides a bounce is detected, but not measured
SURFACE: Final = 0.04  # m; how far from a table's surface or edge a measured bounce may lie


@dataclass(frozen=True, slots=True)
class Bounce:
    """A bounce on the table.

    Attributes:
        first_after: Index of the first sample after it.
        time: Moment [s] on the track's clock.
        position: (3,) [m] of the ball's centre.
        measured: Samples on both sides are near enough for time and position to be accurate to some millimetres.
    """

    first_after: int
    time: float
    position: Array
    measured: bool


@dataclass(frozen=True, slots=True)
class Touches:
    """What a track's ball touched.

    Attributes:
        bounces: On the table, in order.
        end: Index of the first sample after free flight and table bounces: the number of samples, or the first one
            after a stroke or after a bounce elsewhere.
    """

    bounces: tuple[Bounce, ...]
    end: int


def _line(times: Array, positions: Array, at: float) -> tuple[Array, Array]:
    """Return position and velocity (3,) at ``at`` of the parabola under gravity through the samples.

    The slope is the median of all pairs' (Theil and Sen): one wrong sample does not change it.
    """
    t = times - at
    fall = np.array([0.0, 0.0, -0.5 * GRAVITY])
    free = positions - t[:, None] ** 2 * fall
    first, second = np.triu_indices(len(t), 1)
    slope = np.median((free[second] - free[first]) / (t[second] - t[first])[:, None], axis=0)
    return np.median(free - t[:, None] * slope, axis=0), slope


def _change(track: Track, k: int) -> Array:
    """Return the velocity (3,) after minus the one before, at the middle between samples k - 1 and k."""
    at = 0.5 * float(track.times[k - 1] + track.times[k])
    before = slice(max(0, k - WINDOW), k)
    after = slice(k, k + WINDOW)
    _, v0 = _line(track.times[before], track.positions[before], at)
    _, v1 = _line(track.times[after], track.positions[after], at)
    return v1 - v0


def _bounce(track: Track, k: int) -> Bounce | None:
    """Return the bounce between samples k - 1 and k, if it is one on the table."""
    t, p = track.times, track.positions
    start = 0.5 * float(t[k - 1] + t[k])
    for _ in range(2):
        # a sample on the other side of the parabolas' intersection than assumed is moved to that side
        before, after = slice(max(0, k - WINDOW), k), slice(k, k + WINDOW)
        p0, v0 = _line(t[before], p[before], start)
        p1, v1 = _line(t[after], p[after], start)
        rise = v1[2] - v0[2]
        if rise < RISE:
            return None
        moment = start + (p0[2] - p1[2]) / rise
        k = min(max(int(np.searchsorted(t, moment)), FEWEST), len(t) - FEWEST_AFTER)
    s = moment - start
    fall = np.array([0.0, 0.0, -0.5 * GRAVITY * s * s])
    position = 0.5 * (p0 + s * v0 + p1 + s * v1) + fall
    falling, rising = v0[2] - GRAVITY * s < 0.0, v1[2] - GRAVITY * s > 0.0
    on_table = (
        abs(position[0]) < TABLE_HALF_LENGTH + SURFACE
        and abs(position[1]) < TABLE_HALF_WIDTH + SURFACE
        and abs(position[2] - BALL_RADIUS) < SURFACE
    )
    if not (falling and rising and on_table):
        return None
    near = moment - t[k - 1] < NEAREST and t[k] - moment < NEAREST
    return Bounce(k, float(moment), position, bool(near))


def touches(track: Track) -> Touches:
    """Return the track's bounces, and where its free flight ends."""
    n = len(track.times)
    moments = range(FEWEST, n - FEWEST_AFTER + 1)
    changes = np.array([_change(track, k) for k in moments]).reshape(-1, 3)
    size = np.linalg.norm(changes, axis=1)
    turned = (changes[:, 2] > RISE) | (size > STROKE)
    bounces: list[Bounce] = []
    row = 0
    while row < len(size):
        if not turned[row]:
            row += 1
            continue
        # one touch appears in every window around it: the largest change marks it
        stop = row + 1
        while stop < len(size) and turned[stop] and stop - row < 2 * WINDOW:
            stop += 1
        k = moments[row + int(size[row:stop].argmax())]
        bounce = _bounce(track, k)
        if bounce is not None:
            bounces.append(bounce)
        elif n - k >= FEWEST:
            return Touches(tuple(bounces), k)
        row = stop
    return Touches(tuple(bounces), n)

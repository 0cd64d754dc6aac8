"""Touches in a recorded track: bounces on the table, and strokes, which end a flight.

A touch changes the velocity at once, air only slowly. Before and after every moment a line is fitted to the samples
within a window of time (without gravity). Where the two slopes differ by more than noise and air can explain, the ball
touched something. The noise is estimated from the track, and a noisy track has a longer window. So the rate of the
camera does not matter. The point of a bounce is where both parabolas meet in height. It uses no model of air, spin or
table, so these models can be checked against it.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from common.physics.constants import BALL_RADIUS, GRAVITY, TABLE_HALF_LENGTH, TABLE_HALF_WIDTH
from topspin.real2sim.formats.tracks import Track

Array = npt.NDArray[np.float64]

WINDOWS: Final = (0.045, 0.09)  # s; shortest and longest window on each side
SLOPE_SIGMA: Final = 0.14  # m/s; the window is as long as this sigma of a slope needs
LEAST_NOISE: Final = 2e-4  # m; no camera is better
FEWEST: Final = 5  # samples on a side; a window with fewer is extended to them, and one of them may be wrong
FEWEST_AFTER: Final = 3  # samples after a bounce at the end of a track: the table's position confirms it
RISE: Final = 1.0  # m/s; a bounce changes the vertical velocity by more
STROKE: Final = 3.0  # m/s; a table's friction changes the horizontal velocity by less
CERTAIN: Final = 5.0  # [sigma] a smaller change of the slope may be noise
AIR: Final = 0.2  # 1/m; drag and lift change the velocity by less than this times speed^2 times time
NEAREST: Final = 0.03  # s; without a sample this near on both sides a bounce is detected, but not measured
SURFACE: Final = 0.04  # m; how far from a table's surface or edge a measured bounce may lie
_MANY: Final = 12  # samples; with more, slopes of pairs that are half a window apart are enough
_MAD: Final = 1.4826  # median of |x| to sigma, normal distribution


@dataclass(frozen=True, slots=True)
class Turn:
    """A sudden change of the velocity.

    Attributes:
        first_after: Index of the first sample after it.
        time: Moment [s] on the track's clock.
        position: (3,) [m] of the ball's centre.
        before: (3,) velocity [m/s] just before.
        after: (3,) velocity [m/s] just after.
    """

    first_after: int
    time: float
    position: Array
    before: Array
    after: Array

    @property
    def is_from_below(self) -> bool:
        """Return whether the ball fell before and rises after it, as on a level surface."""
        rises = self.after[2] - self.before[2] > RISE
        across = float(np.linalg.norm((self.after - self.before)[:2]))
        return bool(rises and self.before[2] < 0.0 < self.after[2] and across < STROKE)

    @property
    def is_on_table(self) -> bool:
        """Return whether it is a bounce on the table."""
        x, y, z = self.position
        return (
            bool(self.before[2] < 0.0 < self.after[2])
            and abs(x) < TABLE_HALF_LENGTH + SURFACE
            and abs(y) < TABLE_HALF_WIDTH + SURFACE
            and abs(z - BALL_RADIUS) < SURFACE
        )


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

    @property
    def is_serve(self) -> bool:
        """Return whether the ball bounced on the server's own court (x > 0) first, and not a second time on it."""
        courts = [bool(bounce.position[0] > 0.0) for bounce in self.bounces[:2]]
        return courts[:1] == [True] != courts[1:]

    @property
    def flight_end(self) -> int:
        """Return the index of the first sample after the ball's way to the robot's stroke.

        It is the first one after the second bounce on the robot's court (``end`` if there is none); a serve may bounce
        on the server's court before.
        """
        allowed = 2 if self.is_serve else 1
        return self.bounces[allowed].first_after if len(self.bounces) > allowed else self.end


def noise_of(track: Track) -> float:
    """Return the noise of a track's samples [m] per axis (sigma), by their third differences.

    Third differences of a flight are nearly zero, also of one with drag and lift. Their median is used, so wrong
    samples and touches do not count.
    """
    t = np.stack([track.times[k : len(track.times) - 3 + k] for k in range(4)])
    weights = np.stack([1.0 / np.prod([t[i] - t[j] for j in range(4) if j != i], axis=0) for i in range(4)])
    p = [track.positions[k : len(track.positions) - 3 + k] for k in range(4)]
    difference = sum(w[:, None] * q for w, q in zip(weights, p, strict=True))
    scaled = np.abs(difference) / np.linalg.norm(weights, axis=0)[:, None]
    return max(LEAST_NOISE, _MAD * float(np.median(scaled)))


def _window(track: Track, noise: float) -> float:
    """Return the length of the window [s] on each side."""
    step = float(np.median(np.diff(track.times)))
    needed = (12.0 * noise**2 * step / SLOPE_SIGMA**2) ** (1.0 / 3.0)
    return float(np.clip(needed, *WINDOWS))


def _line(times: Array, positions: Array, at: float) -> tuple[Array, Array]:
    """Return position and velocity (3,) at ``at`` of the parabola under gravity through the samples.

    The slope is the median of pairs' slopes (Theil and Sen): one wrong sample does not change it.
    """
    t = times - at
    free = positions + t[:, None] ** 2 * np.array([0.0, 0.0, 0.5 * GRAVITY])
    if len(t) > _MANY:
        first = np.arange(len(t) - len(t) // 2)
        second = first + len(t) // 2
    else:
        first, second = np.triu_indices(len(t), 1)
    slope = np.median((free[second] - free[first]) / (t[second] - t[first])[:, None], axis=0)
    return np.median(free - t[:, None] * slope, axis=0), slope


class _Sides:
    """Lines before and after a moment of a track."""

    def __init__(self, track: Track) -> None:
        self.times, self.positions = track.times, track.positions
        self.noise = noise_of(track)
        self.length = _window(track, self.noise)

    def rows(self, k: int) -> tuple[slice, slice]:
        """Return the samples before and after the moment between samples k - 1 and k."""
        t, n = self.times, len(self.times)
        first = int(np.searchsorted(t, t[k - 1] - self.length - 1e-9))
        last = int(np.searchsorted(t, t[k] + self.length + 1e-9))
        return slice(max(0, min(first, k - FEWEST)), k), slice(k, min(n, max(last, k + FEWEST)))

    def lines(self, k: int, at: float) -> tuple[Array, Array, Array, Array]:
        """Return position and velocity at ``at`` of the line before, and of the line after."""
        before, after = self.rows(k)
        return (
            *_line(self.times[before], self.positions[before], at),
            *_line(self.times[after], self.positions[after], at),
        )

    def margin(self, k: int, speed: float) -> tuple[float, float]:
        """Return the sigma of the change of the velocity at k, and what air may change [m/s]."""
        variance, centres = 0.0, []
        for rows in self.rows(k):
            t = self.times[rows]
            variance += self.noise**2 / max(float(np.sum((t - t.mean()) ** 2)), 1e-12)
            centres.append(float(t.mean()))
        return float(np.sqrt(variance)), AIR * speed**2 * (centres[1] - centres[0])

    def turn(self, k: int) -> Turn:
        """Return the change of the velocity near the moment between samples k - 1 and k."""
        t = self.times
        start = 0.5 * float(t[k - 1] + t[k])
        moment = start
        for _ in range(3):
            # a sample on the other side of the parabolas' intersection than assumed is moved to that side
            p0, v0, p1, v1 = self.lines(k, start)
            change = v1 - v0
            if change[2] > RISE and np.linalg.norm(change[:2]) < STROKE:
                change = np.array([0.0, 0.0, change[2]])  # a bounce: only the height is certain to meet
            meeting = start + float((p0 - p1) @ change) / max(float(change @ change), 1e-12)
            moment = float(np.clip(meeting, t[k - 1] - 0.05, t[k] + 0.05))
            k_next = min(max(int(np.searchsorted(t, moment)), FEWEST), len(t) - FEWEST_AFTER)
            if k_next == k:
                break
            k = k_next
        s = moment - start
        fall = np.array([0.0, 0.0, GRAVITY * s])
        place = 0.5 * (p0 + s * v0 + p1 + s * v1) - 0.5 * s * fall
        return Turn(k, moment, place, v0 - fall, v1 - fall)


def turns(track: Track) -> tuple[Turn, ...]:
    """Return every sudden change of a track's velocity, in order."""
    n = len(track.times)
    if n < FEWEST + FEWEST_AFTER:
        return ()
    sides = _Sides(track)
    moments = range(FEWEST, n - FEWEST_AFTER + 1)
    excess, is_turned = np.empty(len(moments)), np.zeros(len(moments), np.bool_)
    for row, k in enumerate(moments):
        _, v0, _, v1 = sides.lines(k, 0.5 * float(track.times[k - 1] + track.times[k]))
        change, size = v1 - v0, float(np.linalg.norm(v1 - v0))
        sigma, air = sides.margin(k, float(min(np.linalg.norm(v0), np.linalg.norm(v1))))
        is_turned[row] = (
            change[2] > max(RISE, CERTAIN * sigma) + air or size > max(STROKE, CERTAIN * sigma) + air
        )
        excess[row] = size - 3.0 * sigma
    found: list[Turn] = []
    row = 0
    while row < len(excess):
        if not is_turned[row]:
            row += 1
            continue
        # one touch appears in every window around it: the largest change marks it
        last = track.times[moments[row]] + 2.0 * sides.length
        stop = row + 1
        while stop < len(excess) and is_turned[stop] and track.times[moments[stop]] < last:
            stop += 1
        turn = sides.turn(moments[row + int(excess[row:stop].argmax())])
        if not found or turn.first_after > found[-1].first_after:  # around a gap, a touch may appear twice
            found.append(turn)
        row = stop
    return tuple(found)


def touches(track: Track) -> Touches:
    """Return the track's bounces, and where its free flight ends."""
    t, n = track.times, len(track.times)
    bounces: list[Bounce] = []
    for turn in turns(track):
        k = turn.first_after
        if turn.is_on_table and turn.after[2] - turn.before[2] > RISE:
            near = turn.time - t[k - 1] < NEAREST and t[k] - turn.time < NEAREST
            bounces.append(Bounce(k, turn.time, turn.position, bool(near)))
        elif n - k >= FEWEST:
            return Touches(tuple(bounces), k)
    return Touches(tuple(bounces), n)

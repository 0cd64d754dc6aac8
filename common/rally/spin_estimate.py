"""What a ball's flight tells of its spin: least squares over the samples seen before the bounce.

Spin is not seen, but it bends the flight. Against a ball without spin that set out from the first sample, a sample at
time t lies off by (lift below its saturation, ``physics.flight``)

    dp(t) = dp_0 + dv_0 t + K w x X(t) + k D(t)          K = (rho A/2m) 1.067 r
    dv(t) =        dv_0   + K w x X'(t) + k D'(t)

with X the twice integrated velocity and D the twice integrated drag of that ball: linear in what isn't known (first
position and velocity, spin w, drag's share k), so the normal equations are summed sample by sample. Gaussian priors say
how large each may be; what doesn't show, spin along the flight, stays at 0. At the bounce the estimate turns by the law
of an average table, and from then on it stands.

On ``paper`` balls with ``standard`` noise the spin across the flight is found to 20 rad/s of the 44 that it varies by.
"""

import math

import numpy as np
import numpy.typing as npt

from common.jit import kernel
from common.physics.constants import AIR_FACTOR, BALL_RADIUS, TABLE_FRICTION, TABLE_RESTITUTION0
from common.physics.flight import SIMPLE, SIMPLE_DRAG, SIMPLE_LIFT_SLOPE, flight_step
from common.physics.table_bounce import table_bounce
from common.physics.vec import Vec

Array = npt.NDArray[np.float64]

UNKNOWNS = 10  # dp_0 (3), dv_0 (3), w / SPIN_SIGMA (3), k / DRAG_SIGMA
_SPIN, _DRAG = 6, 9

# Columns of a track's row
POS, VEL = 0, 3  # of the ball without spin, now
FIRST = 6  # its first position
PATH = 9  # X [m s]
SLOWED, SLOWED_PATH = 12, 15  # D' [m/s], D [m]
MOMENT = 18  # of the last sample, since launch [s]
BOUNCED = 19  # 1: the bounce was seen
SPIN = 20  # the estimate [rad/s] (3)
NORMAL = 23  # normal matrix (10, 10)
RIGHT = NORMAL + UNKNOWNS * UNKNOWNS  # right side (10)
TRACK = RIGHT + UNKNOWNS  # numbers in a row

SPIN_SIGMA = 50.0  # [rad/s] a axis; balls of the preset `paper`: 45
DRAG_SIGMA = 0.09  # [-] of the drag factor: uniform in 0.85..1.15
LEAST_POSITION_NOISE = 0.001  # [m] that samples are taken to have at least: the model isn't perfect either
LEAST_VELOCITY_NOISE = 0.02  # [m/s]
_LIFT = AIR_FACTOR * SIMPLE_LIFT_SLOPE * BALL_RADIUS
_DRAG_FACTOR = AIR_FACTOR * SIMPLE_DRAG


@kernel
def begin_track(track: Array, seen: Array, position_noise: float, velocity_noise: float) -> None:
    """Begin a row (TRACK,) with a ball's first sample (position, velocity, ...) and its noise [m], [m/s]."""
    track[:] = 0.0
    track[POS : POS + 6] = seen[:6]
    track[FIRST : FIRST + 3] = seen[:3]
    position, velocity = max(position_noise, LEAST_POSITION_NOISE), max(velocity_noise, LEAST_VELOCITY_NOISE)
    for k in range(UNKNOWNS):
        sigma = position if k < 3 else velocity if k < _SPIN else 1.0
        track[NORMAL + k * UNKNOWNS + k] = 1.0 / (sigma * sigma)


@kernel
def _weigh_in(track: Array, row: Array, rest: float, sigma: float) -> None:
    """Add the equation ``row . unknowns = rest`` (+- sigma) to the normal equations."""
    weight = 1.0 / (sigma * sigma)
    for i in range(UNKNOWNS):
        if row[i] != 0.0:
            scaled = weight * row[i]
            track[RIGHT + i] += scaled * rest
            for j in range(i + 1):
                track[NORMAL + i * UNKNOWNS + j] += scaled * row[j]


@kernel
def _advance(track: Array, h: float) -> None:
    """Fly the ball without spin ``h`` seconds on, with X and D along it."""
    p, v = (track[0], track[1], track[2]), (track[3], track[4], track[5])
    q, u = flight_step(p, v, (0.0, 0.0, 0.0), h, 1.0, 1.0, SIMPLE)
    before = math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    after = math.sqrt(u[0] * u[0] + u[1] * u[1] + u[2] * u[2])
    for k in range(3):
        track[PATH + k] += 0.5 * h * (p[k] + q[k] - 2.0 * track[FIRST + k])
        drag, later = -_DRAG_FACTOR * before * v[k], -_DRAG_FACTOR * after * u[k]
        track[SLOWED_PATH + k] += h * track[SLOWED + k] + h * h * (drag / 3.0 + later / 6.0)
        track[SLOWED + k] += 0.5 * h * (drag + later)
        track[POS + k], track[VEL + k] = q[k], u[k]
    track[MOMENT] += h


@kernel
def follow(track: Array, seen: Array, moment: float, position_noise: float, velocity_noise: float) -> None:
    """Let a sample of the flight before the bounce correct the estimate.

    Args:
        track: (TRACK,); written.
        seen: Position [m] and velocity [m/s], first six numbers.
        moment: When it was taken, since launch [s]; no later than the last: nothing new.
        position_noise: Its sigma a axis [m].
        velocity_noise: [m/s].
    """
    if moment <= track[MOMENT]:
        return
    _advance(track, moment - track[MOMENT])
    position, velocity = max(position_noise, LEAST_POSITION_NOISE), max(velocity_noise, LEAST_VELOCITY_NOISE)
    row = np.empty(UNKNOWNS)
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3  # (w x X)_k = w_i X_j - w_j X_i
        row[:] = 0.0
        row[k], row[3 + k] = 1.0, moment
        row[_SPIN + i] = _LIFT * SPIN_SIGMA * track[PATH + j]
        row[_SPIN + j] = -_LIFT * SPIN_SIGMA * track[PATH + i]
        row[_DRAG] = DRAG_SIGMA * track[SLOWED_PATH + k]
        _weigh_in(track, row, seen[k] - track[POS + k], position)
        row[:] = 0.0
        row[3 + k] = 1.0
        row[_SPIN + i] = _LIFT * SPIN_SIGMA * (track[POS + j] - track[FIRST + j])
        row[_SPIN + j] = -_LIFT * SPIN_SIGMA * (track[POS + i] - track[FIRST + i])
        row[_DRAG] = DRAG_SIGMA * track[SLOWED + k]
        _weigh_in(track, row, seen[3 + k] - track[VEL + k], velocity)
    _solve(track)


@kernel
def _solve(track: Array) -> None:
    """Write the spin that solves the normal equations (Cholesky; only the last unknowns are substituted back)."""
    lower = np.empty((UNKNOWNS, UNKNOWNS))
    found = np.empty(UNKNOWNS)
    for i in range(UNKNOWNS):
        for j in range(i + 1):
            rest = track[NORMAL + i * UNKNOWNS + j]
            for k in range(j):
                rest -= lower[i, k] * lower[j, k]
            lower[i, j] = math.sqrt(rest) if i == j else rest / lower[j, j]
        rest = track[RIGHT + i]
        for k in range(i):
            rest -= lower[i, k] * found[k]
        found[i] = rest / lower[i, i]
    for i in range(UNKNOWNS - 1, _SPIN - 1, -1):
        for k in range(i + 1, UNKNOWNS):
            found[i] -= lower[k, i] * found[k]
        found[i] /= lower[i, i]
    for k in range(3):
        track[SPIN + k] = SPIN_SIGMA * found[_SPIN + k]


@kernel
def turn_at_bounce(track: Array, last: Vec) -> None:
    """Turn the estimate by an average table's law; ``last`` is the velocity last seen before the bounce [m/s]."""
    vel = (last[0], last[1], min(last[2], -0.1))
    spin = (track[SPIN], track[SPIN + 1], track[SPIN + 2])
    _, spin = table_bounce(vel, spin, (0.0, 0.0, 1.0), TABLE_RESTITUTION0, TABLE_FRICTION)
    for k in range(3):
        track[SPIN + k] = spin[k]
    track[BOUNCED] = 1.0

"""Positions of a launched ball at given times: a rally's flight and bounce, at a camera's sample times.

Net, floor and robot are left out, since the recording shows that the ball missed them. The steps are otherwise the
environment's, at times that need not lie on its grid.
"""

import math

import numpy as np
import numpy.typing as npt

from common.jit import kernel
from common.physics.constants import (
    BALL_RADIUS,
    GRID_STEP,
    TABLE_HALF_LENGTH,
    TABLE_HALF_WIDTH,
)
from common.physics.flight import Air, flight_step
from common.physics.table_bounce import table_bounce
from common.physics.vec import Vec

Array = npt.NDArray[np.float64]

_ROOT_STEPS = 8  # of Newton's method on a height that is nearly a parabola: exact to rounding after four
_BOUNCES_A_STEP = 4


@kernel
def _time_to_table(pos: Vec, vel: Vec, spin: Vec, h: float, drag: float, lift: float, model: int) -> float:
    """Return when the ball descends to the table's height. It does so within the next ``h`` seconds."""
    t = h
    for _ in range(_ROOT_STEPS):
        p, v = flight_step(pos, vel, spin, t, Air(drag, lift, model))
        if v[2] >= 0.0:
            break
        t = min(max(t - (p[2] - BALL_RADIUS) / v[2], 0.0), h)
    return t


@kernel
def advance(
    pos: Vec, vel: Vec, spin: Vec, h: float, drag: float, lift: float, model: int, table: Array
) -> tuple[Vec, Vec, Vec]:
    """Return position, velocity and spin ``h`` seconds later, with every bounce in between.

    Args:
        pos: Position [m].
        vel: Velocity [m/s].
        spin: Spin [rad/s].
        h: Time [s], so short that the ball bounces a few times at most.
        drag: Drag factor [-].
        lift: Lift factor [-].
        model: ``flight.SIMPLE`` or ``flight.FULL``.
        table: Restitution e_0 and friction of the table [-]; empty: no table.
    """
    rest = h
    for _ in range(_BOUNCES_A_STEP):
        p, v = flight_step(pos, vel, spin, rest, Air(drag, lift, model))
        if table.size == 0 or not (pos[2] >= BALL_RADIUS > p[2] and v[2] < 0.0):
            return p, v, spin
        t = _time_to_table(pos, vel, spin, rest, drag, lift, model)
        at, arriving = flight_step(pos, vel, spin, t, Air(drag, lift, model))
        if abs(at[0]) > TABLE_HALF_LENGTH or abs(at[1]) > TABLE_HALF_WIDTH or arriving[2] >= 0.0:
            return p, v, spin
        vel, spin = table_bounce(arriving, spin, (0.0, 0.0, 1.0), table[0], table[1])
        pos = (at[0], at[1], BALL_RADIUS)
        rest -= t
    return pos, vel, spin


@kernel
def predict(
    launch: Array, table: Array, model: int, times: Array, positions: Array, velocities: Array
) -> None:
    """Write the positions and velocities of a ball at given times.

    Args:
        launch: Position, velocity, spin, drag factor and lift factor at time 0 (11,).
        table: Restitution e_0 and friction [-] (2,); empty: the ball flies on through the table.
        model: ``flight.SIMPLE`` or ``flight.FULL``.
        times: (n,) [s], rising, from 0 on.
        positions: (n, 3) [m], written.
        velocities: (n, 3) [m/s], written.
    """
    pos = (launch[0], launch[1], launch[2])
    vel = (launch[3], launch[4], launch[5])
    spin = (launch[6], launch[7], launch[8])
    now = 0.0
    for k in range(times.shape[0]):
        steps = math.ceil((times[k] - now) / GRID_STEP - 1e-9)
        for _ in range(steps):
            h = (times[k] - now) / steps
            pos, vel, spin = advance(pos, vel, spin, h, launch[9], launch[10], model, table)
        now = times[k]
        for j in range(3):
            positions[k, j], velocities[k, j] = pos[j], vel[j]


@kernel
def touch_down(launch: Array, model: int, longest: float) -> tuple[float, Vec, Vec]:
    """Return when [s] and where [m] a launched ball first comes down to the table's height, and its velocity there.

    Args:
        launch: As in ``predict``.
        model: ``flight.SIMPLE`` or ``flight.FULL``.
        longest: Time [s] after which the search ends; the time is nan then.
    """
    pos = (launch[0], launch[1], launch[2])
    vel = (launch[3], launch[4], launch[5])
    spin = (launch[6], launch[7], launch[8])
    for step in range(math.ceil(longest / GRID_STEP)):
        p, v = flight_step(pos, vel, spin, GRID_STEP, Air(launch[9], launch[10], model))
        if pos[2] >= BALL_RADIUS > p[2]:
            t = _time_to_table(pos, vel, spin, GRID_STEP, launch[9], launch[10], model)
            there, falling = flight_step(pos, vel, spin, t, Air(launch[9], launch[10], model))
            return step * GRID_STEP + t, there, falling
        pos, vel = p, v
    return np.nan, pos, vel


@kernel
def bounce_moments(launch: Array, table: Array, model: int, longest: float, moments: Array) -> int:
    """Write when a launched ball bounces on the table, and return how often it does.

    Args:
        launch: As in ``predict``.
        table: Restitution e_0 and friction of the table [-] (2,).
        model: ``flight.SIMPLE`` or ``flight.FULL``.
        longest: Time [s] after which the search ends.
        moments: (n,) [s], written; the search ends with the n-th bounce.
    """
    pos = (launch[0], launch[1], launch[2])
    vel = (launch[3], launch[4], launch[5])
    spin = (launch[6], launch[7], launch[8])
    drag, lift = launch[9], launch[10]
    count, now = 0, 0.0
    while now < longest and count < moments.shape[0]:
        p, v = flight_step(pos, vel, spin, GRID_STEP, Air(drag, lift, model))
        if not (pos[2] >= BALL_RADIUS > p[2] and v[2] < 0.0):
            now += GRID_STEP
            pos, vel = p, v
            continue
        t = _time_to_table(pos, vel, spin, GRID_STEP, drag, lift, model)
        at, vel = flight_step(pos, vel, spin, t, Air(drag, lift, model))
        if abs(at[0]) > TABLE_HALF_LENGTH or abs(at[1]) > TABLE_HALF_WIDTH or vel[2] >= 0.0:
            break
        now += t
        moments[count] = now
        count += 1
        vel, spin = table_bounce(vel, spin, (0.0, 0.0, 1.0), table[0], table[1])
        pos = (at[0], at[1], BALL_RADIUS)
    return count


@kernel
def whitened(
    predicted: Array,
    velocities: Array,
    measured: Array,
    position_sigma: float,
    timing_sigma: float,
    residuals: Array,
) -> None:
    """Write residuals in units of their sigma.

    An error dt of a time stamp moves the ball by v dt along its path. So the covariance of a sample is
    s^2 I + s_t^2 v v^T, and the residual is multiplied by the inverse of its root.

    Args:
        predicted: (n, 3) [m].
        velocities: (n, 3) [m/s], of the prediction.
        measured: (n, 3) [m].
        position_sigma: s [m].
        timing_sigma: s_t [s].
        residuals: (n, 3) [-], written.
    """
    for k in range(predicted.shape[0]):
        along, square = 0.0, 0.0
        for j in range(3):
            along += velocities[k, j] * (predicted[k, j] - measured[k, j])
            square += velocities[k, j] * velocities[k, j]
        wide = math.sqrt(position_sigma * position_sigma + timing_sigma * timing_sigma * square)
        share = along / square * (1.0 / wide - 1.0 / position_sigma) if square > 0.0 else 0.0
        for j in range(3):
            residuals[k, j] = (predicted[k, j] - measured[k, j]) / position_sigma + share * velocities[k, j]

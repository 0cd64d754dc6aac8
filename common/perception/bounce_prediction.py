"""Nominal flight of an estimated ball to the table, and what to expect after its bounce there."""

import math

import numpy as np

from common.jit import kernel
from common.perception.cholesky import factor
from common.perception.flight_track import DW, SPIN_SIGMA, Array, BallEstimate
from common.perception.spin_posterior import TABLE_FRICTION_MEAN, TABLE_FRICTION_SIGMA
from common.physics.constants import BALL_RADIUS
from common.physics.flight import LINEAR, Air, flight_step
from common.physics.table_bounce import table_bounce
from common.physics.vec import Vec, scale

TABLE_RESTITUTION0_MEAN, TABLE_RESTITUTION0_SIGMA = 0.975, 0.0144  # [-] of the tables of profile `standard`
BOUNCE_VELOCITY_SIGMA = 0.05  # [m/s] an axis, of the predicted velocity before the bounce
BOUNCE_SPIN_SIGMA = 1.0  # [rad/s] an axis: error of the table's law
MAX_HORIZON = 1.0  # [s] longest prediction
_STEP = 0.040  # [s] of the predicted flight: Runge-Kutta errs by less than 0.2 mm in it


@kernel
def fly_to_table(ball: BallEstimate) -> tuple[float, Vec, Vec]:
    """Return when a falling ball reaches the table's height [s], and its position and velocity then.

    A time longer than ``MAX_HORIZON``: it does not come down within the horizon. A ball that is lower is flown back.
    """
    pos, vel, spin, drag_factor = ball
    air = Air(drag_factor, 1.0, LINEAR)
    elapsed = 0.0
    while elapsed < MAX_HORIZON:
        next_pos, next_vel = flight_step(pos, vel, spin, _STEP, air)
        if next_pos[2] < BALL_RADIUS and next_vel[2] < 0.0:
            h = _STEP
            for _ in range(3):  # Newton: the speed of the fall is nearly constant
                h += (BALL_RADIUS - next_pos[2]) / min(next_vel[2], -0.1)
                # A ball that was measured lower than the table may never have been higher
                h = min(max(h, -_STEP), 2.0 * _STEP)
                next_pos, next_vel = flight_step(pos, vel, spin, h, air)
            return elapsed + h, next_pos, next_vel
        pos, vel = next_pos, next_vel
        elapsed += _STEP
    return 2.0 * MAX_HORIZON, pos, vel


@kernel
def fly(ball: BallEstimate, duration: float) -> tuple[Vec, Vec]:
    """Return position and velocity after ``duration`` seconds, which may be negative."""
    pos, vel, spin, drag_factor = ball
    steps = max(1, math.ceil(abs(duration) / _STEP))
    for _ in range(steps):
        pos, vel = flight_step(pos, vel, spin, duration / steps, Air(drag_factor, 1.0, LINEAR))
    return pos, vel


@kernel
def expected_bounce(
    vel: Vec, visible: Vec, ratio: float, ratio_sigma: float, variance: Array, covariance: Array
) -> tuple[Vec, Vec]:
    """Return the expected velocity [m/s] and spin [rad/s] after the bounce, and write their covariance (6, 6).

    Args:
        vel: Velocity before the bounce [m/s].
        visible: Spin before the bounce, as the flight shows it [rad/s].
        ratio: Expected spin / visible spin [-].
        ratio_sigma: Its sigma [-].
        variance: Covariance of the fit's unknowns (10, 10).
        covariance: Written.
    """
    spin = scale(ratio, visible)
    square, spread = np.empty((3, 3)), np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            fit = SPIN_SIGMA * SPIN_SIGMA * variance[DW + i, DW + j]
            square[i, j] = ratio * ratio * fit + ratio_sigma * ratio_sigma * (fit + visible[i] * visible[j])
    factor(square, spread)
    points = np.empty((10, 6))
    reach = math.sqrt(5.0)
    for p in range(10):
        axis, by = p // 2, reach if p % 2 == 0 else -reach
        point_spin = spin
        if axis < 3:
            point_spin = (
                spin[0] + (by * spread[0, 0] if axis == 0 else 0.0),
                spin[1] + (by * spread[1, axis] if axis <= 1 else 0.0),
                spin[2] + by * spread[2, axis],
            )
        restitution = TABLE_RESTITUTION0_MEAN + (by * TABLE_RESTITUTION0_SIGMA if axis == 3 else 0.0)
        friction = TABLE_FRICTION_MEAN + (by * TABLE_FRICTION_SIGMA if axis == 4 else 0.0)
        v, w = table_bounce(vel, point_spin, (0.0, 0.0, 1.0), restitution, friction)
        for k in range(3):
            points[p, k], points[p, 3 + k] = v[k], w[k]
    mean = np.zeros(6)
    for p in range(10):
        mean += 0.1 * points[p]
    for i in range(6):
        for j in range(6):
            total = 0.0
            for p in range(10):
                total += 0.1 * (points[p, i] - mean[i]) * (points[p, j] - mean[j])
            if i == j:
                total += BOUNCE_VELOCITY_SIGMA**2 if i < 3 else BOUNCE_SPIN_SIGMA**2
            covariance[i, j] = total
    return (mean[0], mean[1], mean[2]), (mean[3], mean[4], mean[5])

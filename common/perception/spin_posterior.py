"""The ball's spin after its bounce: a posterior from its flight, its change of velocity and a prior (ADR-0029).

Lift saturates (at 62 rad/s and 5 m/s), so a flight shows the direction of a fast spin and not its rate. The bounce
shows more. With c the velocity of the ball's lowest point, it changes the velocity along the table by
(``physics.table_bounce``)

    dv = -2/5 c                      if the ball leaves rolling: this gives the whole spin in the table's plane
    dv = -mu (1 + e)|v_n| c / |c|    if it slides throughout: this gives c's direction, and |c| >= 5/2 |dv|

Neither gives the sidespin. So this file draws spins that explain the measured change, one of either kind of bounce at
each of ``POINTS``: the change within its error, |c| along its line, sidespin as the flight shows it. The weight
of a spin is its likelihood from the flight, times the density of its friction, times its prior density, divided by
the density with which it was drawn (importance sampling). The result is the weighted mean. The share of mild spins in
the total weight is the posterior probability of a mild ball, which updates the expectation for the opponent.
"""

import math
from statistics import NormalDist
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from common.jit import kernel
from common.perception.cholesky import factor, inverse
from common.physics.constants import BALL_RADIUS, ROLLING_ALPHA, SPIN_PER_VELOCITY
from common.physics.vec import Vec, dot, vec_at

Array = npt.NDArray[np.float64]

# [rad/s] radii of the two spheres in which the spins of mild and of strong balls are uniform
MILD_RADIUS, STRONG_RADIUS = 100.0, 300.0
TABLE_FRICTION_MEAN, TABLE_FRICTION_SIGMA = 0.25, 0.029  # [-] of the tables of profile `standard`
_EDGE_WIDTH = 8.0  # [rad/s] the density falls to 0 over this much at a sphere's surface
_SIDESPIN_WIDENING = (
    1.3  # [-] sidespin is drawn wider than the flight's error by this factor, so no weight is large
)
_VISIBLE_SPIN_SIGMA = 50.0  # [rad/s] prior of the visible spin, for flights that show none
# Density just outside the strong sphere, relative to the density inside: a spin may be faster than the prior expects
_TAIL_DENSITY = 1e-3
_MIN_STRONG_PROBABILITY = 1e-9  # of a strong ball where none is expected
_MIN_NORMAL_CHANGE = 0.1  # [m/s]
_MAX_FRICTION_SIGMAS = 6.0  # [-] all friction farther off is equally improbable
_LIFT_SIGMA = 0.115  # [-] of the lift factor: uniform in 0.8..1.2
_ROOT_2_PI = math.sqrt(2.0 * math.pi)


class MeasuredBounce(NamedTuple):
    """A bounce on the table as the flight before and after it shows it."""

    before: Vec  # [m/s] velocity before the bounce
    change: Vec  # [m/s] measured change of velocity
    error: Vec  # [m/s] error of the change along the table: its covariance's Cholesky factor, xx, yx, yy


class FlightEvidence(NamedTuple):
    """Log likelihood of the visible spin s, from the flight before the bounce: ``vector`` . s - s' ``matrix`` s / 2.

    The visible spin is the spin that would cause the measured lift if lift did not saturate: the spin's direction, with
    a rate of at most ``saturation``.
    """

    vector: Vec  # [s/rad] information vector: ``flight_information``
    matrix: Array  # (3, 3) [s^2/rad^2] information matrix; only its lower triangle is read
    saturation: float  # [rad/s] rate from which on lift is saturated


def quasi_random(count: int) -> Array:
    """Return points (count, 4) of the R_4 sequence (Roberts 2018). Columns 0, 1 and 3 are standard normal."""
    ratio = 1.0
    for _ in range(64):  # the root of g^5 = g + 1
        ratio = (1.0 + ratio) ** 0.2
    points = (0.5 + np.outer(np.arange(1, count + 1), ratio ** -np.arange(1.0, 5.0))) % 1.0
    points[:, [0, 1, 3]] = np.vectorize(NormalDist().inv_cdf)(points[:, [0, 1, 3]])
    return points


POINTS: Final = quasi_random(96)


@kernel
def densities(rate: float) -> tuple[float, float]:
    """Return the density of spins of ``rate`` [rad/s] among mild balls, and among strong ones.

    Both kinds are uniform in a sphere of spins. The unit is the density in the larger sphere.
    """
    in_mild = min(max(0.5 + 0.5 * (MILD_RADIUS - rate) / _EDGE_WIDTH, 0.0), 1.0)
    in_strong = min(
        max(
            0.5 + 0.5 * (STRONG_RADIUS - rate) / _EDGE_WIDTH,
            _TAIL_DENSITY * (STRONG_RADIUS / max(rate, STRONG_RADIUS)) ** 5,
        ),
        1.0,
    )
    return in_mild * (STRONG_RADIUS / MILD_RADIUS) ** 3, in_strong


@kernel
def flight_information(visible: Vec, covariance: Array, prior: float, vector: Array, matrix: Array) -> None:
    """Write the flight's information on the visible spin (``FlightEvidence``): an estimate without its prior.

    The unknown lift factor makes the rate of the spin less certain (Sherman, Morrison 1950).

    Args:
        visible: The estimate [rad/s].
        covariance: Its covariance (3, 3) [rad^2/s^2].
        prior: Sigma an axis of the prior around 0 that the estimate contains [rad/s].
        vector: (3,) [s/rad]; written.
        matrix: (3, 3) [s^2/rad^2]; written.
    """
    lower, along = np.empty((3, 3)), np.empty(3)
    factor(covariance, lower)
    inverse(lower, matrix)
    for i in range(3):
        vector[i] = matrix[i, 0] * visible[0] + matrix[i, 1] * visible[1] + matrix[i, 2] * visible[2]
        along[i] = vector[i] - visible[i] / (prior * prior)
        matrix[i, i] -= 1.0 / (prior * prior)
    less = (
        _LIFT_SIGMA
        * _LIFT_SIGMA
        / (1.0 + _LIFT_SIGMA * _LIFT_SIGMA * max(dot(visible, vec_at(along, 0)), 0.0))
    )
    projection = dot(visible, vec_at(vector, 0))
    for i in range(3):
        vector[i] -= less * projection * along[i]
        for j in range(3):
            matrix[i, j] -= less * along[i] * along[j]


@kernel
def spin_after_bounce(
    bounce: MeasuredBounce, flight: FlightEvidence, mild_probability: float, fallback: Vec, points: Array
) -> tuple[Vec, float]:
    """Return the expected spin after a bounce on the table [rad/s], and the posterior probability of a mild ball.

    Args:
        bounce: The measured change of velocity.
        flight: Evidence of the flight before the bounce.
        mild_probability: Prior probability that the ball is a mild one.
        fallback: Spin to return if no drawn spin agrees with the evidence [rad/s].
        points: ``quasi_random`` (n, 4). The error with ``POINTS`` is a third of the posterior's spread, and increases
            it by a twentieth.
    """
    before, change, error = bounce
    vector, matrix, saturation = flight
    count = points.shape[0]
    weights, mild_weights = np.zeros(2 * count), np.zeros(2 * count)
    logs, spins = np.empty(2 * count), np.empty((2 * count, 3))
    normal_change = max(change[2], _MIN_NORMAL_CHANGE)  # (1 + e)|v_n|
    max_rate = (STRONG_RADIUS if mild_probability < 1.0 else MILD_RADIUS) + _EDGE_WIDTH
    sidespin_information = matrix[2, 2] + 1.0 / (_VISIBLE_SPIN_SIGMA * _VISIBLE_SPIN_SIGMA)
    sidespin_sigma = _SIDESPIN_WIDENING / math.sqrt(sidespin_information)
    top = -math.inf
    for p in range(count):
        dx = change[0] + error[0] * points[p, 0]
        dy = change[1] + error[1] * points[p, 0] + error[2] * points[p, 1]
        size = max(math.hypot(dx, dy), 1e-6)
        ux, uy = dx / size, dy / size
        friction_sigmas = min(
            (size / normal_change - TABLE_FRICTION_MEAN) / TABLE_FRICTION_SIGMA, _MAX_FRICTION_SIGMAS
        )
        rolling = (
            size / ROLLING_ALPHA
        )  # |c| of a ball that leaves rolling, and the least |c| of one that slides
        # c = -|c| u, so the spin in the table's plane lies on a line. Its slowest point has the rate ``slowest`` and
        # |c| = ``nearest``
        nearest = -(before[0] * ux + before[1] * uy)
        slowest = (before[0] * uy - before[1] * ux) / BALL_RADIUS
        for kind in range(2):
            if kind == 0:
                slip = rolling
                weight = 0.5 * math.erfc(friction_sigmas * math.sqrt(0.5)) / (ROLLING_ALPHA * ROLLING_ALPHA)
            else:
                half = BALL_RADIUS * math.sqrt(max(max_rate * max_rate - slowest * slowest, 0.0))
                if half == 0.0 or nearest + half <= rolling:
                    continue
                # |c| = nearest + half t |t|: dense near the slowest spin
                low = max((rolling - nearest) / half, -1.0)
                low = math.copysign(math.sqrt(abs(low)), low)
                t = low + (1.0 - low) * points[p, 2]
                slip = nearest + half * t * abs(t)
                weight = math.exp(-0.5 * friction_sigmas * friction_sigmas) / (
                    _ROOT_2_PI * TABLE_FRICTION_SIGMA
                )
                weight *= slip / (size * normal_change) * half * 2.0 * abs(t) * (1.0 - low)
            wx, wy = (-slip * uy - before[1]) / BALL_RADIUS, (before[0] + slip * ux) / BALL_RADIUS
            flat = wx * wx + wy * wy
            # The visible sidespin is drawn around the flight's estimate of it, and then scaled to the true sidespin
            part = min(1.0, saturation / math.sqrt(flat + 1e-9))
            middle = (vector[2] - part * (matrix[2, 0] * wx + matrix[2, 1] * wy)) / sidespin_information
            sz = min(max(middle, -0.9 * saturation), 0.9 * saturation) + sidespin_sigma * points[p, 3]
            wz, rest = sz, saturation * saturation - sz * sz
            if rest <= 0.0:
                continue
            if flat > rest:
                wz = sz * math.sqrt(flat / rest)
                weight *= saturation * saturation / rest * math.sqrt(flat / rest)
            rate = max(math.sqrt(flat + wz * wz), 1e-6)
            visible_share = min(rate, saturation) / rate
            sx, sy, sz = visible_share * wx, visible_share * wy, visible_share * wz
            i = 2 * p + kind
            logs[i] = (
                0.5 * points[p, 3] ** 2
                + (vector[0] * sx + vector[1] * sy + vector[2] * sz)
                - 0.5 * (matrix[0, 0] * sx * sx + matrix[1, 1] * sy * sy + matrix[2, 2] * sz * sz)
                - (matrix[1, 0] * sx * sy + matrix[2, 0] * sx * sz + matrix[2, 1] * sy * sz)
            )
            mild_density, strong_density = densities(rate)
            mild_weights[i] = weight * mild_probability * mild_density
            weights[i] = (
                mild_weights[i]
                + weight * max(1.0 - mild_probability, _MIN_STRONG_PROBABILITY) * strong_density
            )
            if weights[i] > 0.0:
                top = max(top, logs[i])
            spins[i, 0] = wx + SPIN_PER_VELOCITY * dy
            spins[i, 1] = wy - SPIN_PER_VELOCITY * dx
            spins[i, 2] = wz
    total, total_mild, x, y, z = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(2 * count):
        if weights[i] > 0.0:
            likelihood = math.exp(logs[i] - top)
            weight = weights[i] * likelihood
            total += weight
            total_mild += mild_weights[i] * likelihood
            x += weight * spins[i, 0]
            y += weight * spins[i, 1]
            z += weight * spins[i, 2]
    if not total > 0.0:
        return fallback, mild_probability
    return (x / total, y / total, z / total), total_mild / total

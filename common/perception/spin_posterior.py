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

A ball that is not mild is expected to be one of a large sphere of spins, or a stroke of a player (``STROKES``): players
choose spin and speed together, and a bounce in which the ball slides does not show the rate of its spin.
"""

import math
from statistics import NormalDist
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from common.jit import inlined, kernel
from common.perception.cholesky import factor, inverse
from common.physics.constants import BALL_RADIUS, ROLLING_ALPHA, SPIN_PER_VELOCITY
from common.physics.exponential import erfc, exp
from common.physics.vec import Vec, dot, vec_at

Array = npt.NDArray[np.float64]

# [rad/s] radii of the two spheres in which the spins of mild and of strong balls are uniform
MILD_RADIUS, STRONG_RADIUS = 100.0, 300.0
MAX_RATE = 900.0  # [rad/s] largest spin that is considered
STROKE_SHARE = 0.5  # [-] of players' strokes among balls that are not mild
# Spins of players' strokes given the speed v of the ball, two normal distributions: strokes with backspin, which are
# slow, and with topspin. Fitted by expectation maximization to 10,600 balls of the preset `match` at their bounce, in
# which launches that miss the table have no part
STROKES: Final = np.array(
    [  # share | v: mean, sigma | topspin: at v = 0, per m/s, sigma | sidespin: mean, sigma | along v: sigma
        [0.33, 4.8, 0.6, -507.0, 69.5, 90.0, 37.0, 110.0, 65.0],
        [0.67, 9.3, 2.9, 40.0, 40.0, 180.0, 37.0, 110.0, 65.0],
    ]
)
TABLE_FRICTION_MEAN, TABLE_FRICTION_SIGMA = 0.25, 0.029  # [-] of the tables of profile `standard`
_MILD_DENSITY = (STRONG_RADIUS / MILD_RADIUS) ** 3
_STRONG_VOLUME = 4.0 / 3.0 * math.pi * STRONG_RADIUS**3  # [rad^3/s^3] 1 / (the unit of densities)
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
_ROOT_HALF = math.sqrt(0.5)


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


@inlined
def densities(rate: float) -> tuple[float, float]:
    """Return the density of spins of ``rate`` [rad/s] among mild balls, and among strong ones.

    Both kinds are uniform in a sphere of spins. The unit is the density in the larger sphere.
    """
    in_mild = min(max(0.5 + 0.5 * (MILD_RADIUS - rate) / _EDGE_WIDTH, 0.0), 1.0)
    beyond = STRONG_RADIUS / max(rate, STRONG_RADIUS)
    tail = _TAIL_DENSITY * (beyond * beyond) * (beyond * beyond) * beyond
    in_strong = min(max(0.5 + 0.5 * (STRONG_RADIUS - rate) / _EDGE_WIDTH, tail), 1.0)
    return in_mild * _MILD_DENSITY, in_strong


class StrokePrior(NamedTuple):
    """Density of a player's spin given the ball's velocity: ``STROKES`` at one speed, in the unit of `densities`."""

    along: tuple[float, float]  # unit vector of the flight along the table: x, y
    peaks: tuple[float, float]  # densities of the two kinds at their means
    topspins: tuple[float, float]  # [rad/s] their means


@kernel
def stroke_prior(vel: Vec) -> StrokePrior:
    """Return the prior of a player's spin for a ball of velocity ``vel`` [m/s]."""
    flat = max(math.sqrt(vel[0] * vel[0] + vel[1] * vel[1]), 1e-6)
    speed = math.sqrt(flat * flat + vel[2] * vel[2])
    back, top = STROKES[0], STROKES[1]
    log_odds = math.log(back[0] * top[2] / (top[0] * back[2]))
    log_odds += 0.5 * ((speed - top[1]) / top[2]) ** 2 - 0.5 * ((speed - back[1]) / back[2]) ** 2
    share = 1.0 / (1.0 + math.exp(min(-log_odds, 500.0)))
    unit = _STRONG_VOLUME / _ROOT_2_PI**3
    return StrokePrior(
        (vel[0] / flat, vel[1] / flat),
        (
            share * unit / (back[5] * back[7] * back[8]),
            (1.0 - share) * unit / (top[5] * top[7] * top[8]),
        ),
        (back[3] + back[4] * speed, top[3] + top[4] * speed),
    )


@inlined
def stroke_density(prior: StrokePrior, wx: float, wy: float, wz: float) -> float:
    """Return the density of a spin [rad/s] among players' strokes; its unit is that of `densities`."""
    back, top = STROKES[0], STROKES[1]
    ex, ey = prior.along
    topspin, gyro, side = wy * ex - wx * ey, wx * ex + wy * ey, wz
    density = 0.0
    for kind, row in ((0, back), (1, top)):
        a, b, c = (topspin - prior.topspins[kind]) / row[5], (side - row[6]) / row[7], gyro / row[8]
        density += prior.peaks[kind] * exp(-0.5 * (a * a + b * b + c * c))
    return density


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


@inlined
def _sign(x: float) -> float:
    return 1.0 if x >= 0.0 else -1.0


@kernel
def _draw_slips(bounce: MeasuredBounce, max_rate: float, points: Array, slips: Array) -> None:
    """Draw slips c that explain the measured change, one of either kind of bounce a point.

    Args:
        bounce: The measured change of velocity.
        max_rate: Largest spin to consider [rad/s].
        points: ``quasi_random`` (n, 4).
        slips: Written (6, n): change of velocity along the table x, y [m/s]; |c| [m/s] and weight of a ball that leaves
            rolling, and of one that slides. A weight of 0: no such bounce.
    """
    before, change, error = bounce
    normal_change = max(change[2], _MIN_NORMAL_CHANGE)  # (1 + e)|v_n|
    for p in range(points.shape[0]):
        dx = change[0] + error[0] * points[p, 0]
        dy = change[1] + error[1] * points[p, 0] + error[2] * points[p, 1]
        size = max(math.sqrt(dx * dx + dy * dy), 1e-6)
        ux, uy = dx / size, dy / size
        friction_sigmas = min(
            (size / normal_change - TABLE_FRICTION_MEAN) / TABLE_FRICTION_SIGMA, _MAX_FRICTION_SIGMAS
        )
        rolling = (
            size / ROLLING_ALPHA
        )  # |c| of a ball that leaves rolling, and the least |c| of one that slides
        slips[0, p], slips[1, p], slips[2, p] = dx, dy, rolling
        slips[3, p] = 0.5 * erfc(friction_sigmas * _ROOT_HALF) / (ROLLING_ALPHA * ROLLING_ALPHA)
        # c = -|c| u, so the spin in the table's plane lies on a line. Its slowest point has the rate ``slowest`` and
        # |c| = ``nearest``
        nearest = -(before[0] * ux + before[1] * uy)
        slowest = (before[0] * uy - before[1] * ux) / BALL_RADIUS
        half = BALL_RADIUS * math.sqrt(max(max_rate * max_rate - slowest * slowest, 0.0))
        # |c| = nearest + half t |t|: dense near the slowest spin
        low = max((rolling - nearest) / max(half, 1e-9), -1.0)
        low = _sign(low) * math.sqrt(abs(low))
        t = low + (1.0 - low) * points[p, 2]
        slip = nearest + half * t * abs(t)
        weight = exp(-0.5 * friction_sigmas * friction_sigmas) / (_ROOT_2_PI * TABLE_FRICTION_SIGMA)
        weight *= slip / (size * normal_change) * half * 2.0 * abs(t) * (1.0 - low)
        slips[4, p], slips[5, p] = slip, weight if half > 0.0 and nearest + half > rolling else 0.0


@kernel
def _weigh_spins(
    before: Vec,
    flight: FlightEvidence,
    mild_probability: float,
    points: Array,
    slips: Array,
    kind: int,
    spins: Array,
) -> None:
    """Weigh the spins that belong to the slips of one kind of bounce.

    Args:
        before: Velocity before the bounce [m/s].
        flight: Evidence of the flight before the bounce.
        mild_probability: Prior probability that the ball is a mild one.
        points: ``quasi_random`` (n, 4).
        slips: Of ``_draw_slips``.
        kind: Row of its |c|: 2 or 4.
        spins: Written (6, n): log likelihood, weight, part of the weight of mild balls, spin after the bounce [rad/s].
    """
    vector, matrix, saturation = flight
    xx, xy, yy = matrix[0, 0], matrix[1, 0], matrix[1, 1]
    xz, yz, zz = matrix[2, 0], matrix[2, 1], matrix[2, 2]
    information = zz + 1.0 / (_VISIBLE_SPIN_SIGMA * _VISIBLE_SPIN_SIGMA)
    sidespin_sigma = _SIDESPIN_WIDENING / math.sqrt(information)
    strong_probability = max(1.0 - mild_probability, _MIN_STRONG_PROBABILITY)
    square = saturation * saturation
    strokes = stroke_prior(before)
    for p in range(points.shape[0]):
        dx, dy, slip, weight = slips[0, p], slips[1, p], slips[kind, p], slips[kind + 1, p]
        size = max(math.sqrt(dx * dx + dy * dy), 1e-6)
        wx = (-slip * (dy / size) - before[1]) / BALL_RADIUS
        wy = (before[0] + slip * (dx / size)) / BALL_RADIUS
        flat = wx * wx + wy * wy
        # The visible sidespin is drawn around the flight's estimate of it, and then scaled to the true sidespin
        part = min(1.0, saturation / math.sqrt(flat + 1e-9))
        middle = (vector[2] - part * (xz * wx + yz * wy)) / information
        seen = min(max(middle, -0.9 * saturation), 0.9 * saturation) + sidespin_sigma * points[p, 3]
        rest = square - seen * seen
        weight = weight if rest > 0.0 else 0.0
        rest = max(rest, 1e-9)
        stretch = math.sqrt(max(flat / rest, 1.0))
        wz = seen * stretch
        weight *= square / rest * stretch if stretch > 1.0 else 1.0
        rate = max(math.sqrt(flat + wz * wz), 1e-6)
        share = min(rate, saturation) / rate
        sx, sy, sz = share * wx, share * wy, share * wz
        spins[0, p] = (
            0.5 * points[p, 3] * points[p, 3]
            + (vector[0] * sx + vector[1] * sy + vector[2] * sz)
            - 0.5 * (xx * sx * sx + yy * sy * sy + zz * sz * sz)
            - (xy * sx * sy + xz * sx * sz + yz * sy * sz)
        )
        mild_density, strong_density = densities(rate)
        strong_density += STROKE_SHARE * (stroke_density(strokes, wx, wy, wz) - strong_density)
        spins[2, p] = weight * mild_probability * mild_density
        spins[1, p] = spins[2, p] + weight * strong_probability * strong_density
        spins[3, p] = wx + SPIN_PER_VELOCITY * dy
        spins[4, p] = wy - SPIN_PER_VELOCITY * dx
        spins[5, p] = wz


@kernel
def _top(spins: Array) -> float:
    """Return the largest log likelihood of spins (6, n) that have a weight."""
    top = -math.inf
    for p in range(spins.shape[1]):
        if spins[1, p] > 0.0:
            top = max(top, spins[0, p])
    return top


@kernel
def _weighted_sums(spins: Array, top: float) -> tuple[float, float, float, float, float]:
    """Return the sums of weights, of mild balls' weights, and of the weighted spins (6, n), relative to e^``top``."""
    count = spins.shape[1]
    for p in range(count):
        spins[0, p] = exp(min(spins[0, p] - top, 0.0))
    total, mild, x, y, z = 0.0, 0.0, 0.0, 0.0, 0.0
    for p in range(count):
        if spins[1, p] > 0.0:
            weight = spins[1, p] * spins[0, p]
            total += weight
            mild += spins[2, p] * spins[0, p]
            x += weight * spins[3, p]
            y += weight * spins[4, p]
            z += weight * spins[5, p]
    return total, mild, x, y, z


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
    count = points.shape[0]
    # Two arrays: columns of one are not contiguous, and LLVM would not vectorise
    slips, rolling, sliding = np.empty((6, count)), np.empty((6, count)), np.empty((6, count))
    max_rate = MAX_RATE if mild_probability < 1.0 else MILD_RADIUS + _EDGE_WIDTH
    _draw_slips(bounce, max_rate, points, slips)
    _weigh_spins(bounce.before, flight, mild_probability, points, slips, 2, rolling)
    _weigh_spins(bounce.before, flight, mild_probability, points, slips, 4, sliding)
    top = max(_top(rolling), _top(sliding))
    a, b = _weighted_sums(rolling, top), _weighted_sums(sliding, top)
    total = a[0] + b[0]
    if not total > 0.0:
        return fallback, mild_probability
    spin = ((a[2] + b[2]) / total, (a[3] + b[3]) / total, (a[4] + b[4]) / total)
    return spin, (a[1] + b[1]) / total

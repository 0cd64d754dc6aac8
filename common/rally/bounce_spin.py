"""How a ball spins behind its bounce, by Bayes' rule: from its flight, what the bounce did to it, and what is usual.

Lift saturates (at 62 rad/s and 5 m/s): a flight shows which way a fast ball spins, not how fast. The bounce shows more.
With c the velocity of the ball's lowest point, it changes the velocity along the table by (``physics.table_bounce``)

    dv = -2/5 c                      the ball leaves rolling: this tells all of the spin in the table's plane
    dv = -mu (1 + e)|v_n| c / |c|    it slides all through: this tells c's direction, and that |c| >= 5/2 |dv|

and neither tells of the sidespin. So spins are drawn that change the velocity as was seen, one for either kind of
bounce at each of ``POINTS``: the change within its own error, |c| along its line, sidespin as the flight shows it. Each
is weighed by its agreement with the flight, its friction's and its own density, over the density it was drawn with
(importance sampling). Their weighted mean is the answer; and by how much of the weight is a mild ball's, the other side
comes to be known.
"""

import math
from statistics import NormalDist
from typing import Final

import numpy as np
import numpy.typing as npt

from common.jit import kernel
from common.physics.constants import BALL_RADIUS, ROLLING_ALPHA, SPIN_PER_VELOCITY
from common.physics.vec import Vec, dot, vec_at
from common.rally.cholesky import factor, inverse

Array = npt.NDArray[np.float64]

INNER, OUTER = 100.0, 300.0  # [rad/s] radii of the spheres that mild and strong balls' spins are uniform in
TABLE_FRICTION_MEAN, TABLE_FRICTION_SIGMA = 0.25, 0.029  # [-] of the tables of profile `standard`
_EDGE = 8.0  # [rad/s] spins thin out over this much about a sphere's edge
_WIDER = 1.3  # by which sidespin is drawn wider than the flight's error, so that no weight is large
_SHOWN_SIGMA = 50.0  # [rad/s] that a shown spin is, where the flight doesn't tell
_FASTER = (
    1e-3  # density just beyond the outer sphere, of the one in it: a spin may be faster than was thought
)
_UNLIKELY = 1e-9  # that a ball is a strong one where none is expected
_LEAST_PUSH = 0.1  # [m/s]
_DISTANT = 6.0  # sigmas: farther off all friction is equally unlikely
_LIFT_SIGMA = 0.115  # [-] of the lift factor: uniform in 0.8..1.2
_ROOT_2_PI = math.sqrt(2.0 * math.pi)


def quasi_random(count: int) -> Array:
    """Return points (count, 4) of the R_4 sequence (Roberts 2018); columns 0, 1 and 3 made standard normal."""
    ratio = 1.0
    for _ in range(64):  # the root of g^5 = g + 1
        ratio = (1.0 + ratio) ** 0.2
    points = (0.5 + np.outer(np.arange(1, count + 1), ratio ** -np.arange(1.0, 5.0))) % 1.0
    points[:, [0, 1, 3]] = np.vectorize(NormalDist().inv_cdf)(points[:, [0, 1, 3]])
    return points


POINTS: Final = quasi_random(96)


@kernel
def densities(rate: float) -> tuple[float, float]:
    """Return how densely spins of ``rate`` [rad/s] lie among mild balls, and among strong ones.

    Either's are uniform in a sphere of spins; the unit is the density in the larger.
    """
    within_inner = min(max(0.5 + 0.5 * (INNER - rate) / _EDGE, 0.0), 1.0)
    within_outer = min(
        max(0.5 + 0.5 * (OUTER - rate) / _EDGE, _FASTER * (OUTER / max(rate, OUTER)) ** 5), 1.0
    )
    return within_inner * (OUTER / INNER) ** 3, within_outer


@kernel
def shown_likelihood(shown: Vec, covariance: Array, prior: float, pull: Array, agree: Array) -> None:
    """Write what a flight says of the spin s that its lift, were it not saturated, would come from.

    A log likelihood, pull . s - s' agree s / 2: the estimate, less the prior that is in it, and less sure of how much
    there is for a lift factor that isn't known (Sherman, Morrison 1950).

    Args:
        shown: The estimate [rad/s].
        covariance: Its covariance (3, 3) [rad^2/s^2].
        prior: Sigma a axis of the prior about 0 in it [rad/s].
        pull: (3,) [s/rad]; written.
        agree: (3, 3) [s^2/rad^2]; written.
    """
    lower, along = np.empty((3, 3)), np.empty(3)
    factor(covariance, lower)
    inverse(lower, agree)
    for i in range(3):
        pull[i] = agree[i, 0] * shown[0] + agree[i, 1] * shown[1] + agree[i, 2] * shown[2]
        along[i] = pull[i] - shown[i] / (prior * prior)
        agree[i, i] -= 1.0 / (prior * prior)
    less = (
        _LIFT_SIGMA * _LIFT_SIGMA / (1.0 + _LIFT_SIGMA * _LIFT_SIGMA * max(dot(shown, vec_at(along, 0)), 0.0))
    )
    pulled = dot(shown, vec_at(pull, 0))
    for i in range(3):
        pull[i] -= less * pulled * along[i]
        for j in range(3):
            agree[i, j] -= less * along[i] * along[j]


@kernel
def spin_behind_bounce(
    before: Vec,
    change: Vec,
    error: Vec,
    pull: Vec,
    agree: Array,
    saturated: float,
    mild: float,
    otherwise: Vec,
    points: Array,
) -> tuple[Vec, float]:
    """Return the spin to be expected behind a bounce on the table [rad/s], and how likely the ball is a mild one.

    Args:
        before: Velocity before the bounce [m/s].
        change: By how much the bounce changed it, as was seen [m/s].
        error: Of the change along the table: its covariance's Cholesky factor, xx, yx, yy [m/s].
        pull: What the flight before it showed: ``shown_likelihood`` [s/rad].
        agree: (3, 3), of which the lower triangle is read [s^2/rad^2].
        saturated: Spin from which on lift is saturated [rad/s].
        mild: How likely it was one before.
        otherwise: Returned where nothing agrees [rad/s].
        points: ``quasi_random``'s; ``POINTS`` err by a third of what is left uncertain, which adds a twentieth to it.
    """
    count = points.shape[0]
    weights, milds = np.zeros(2 * count), np.zeros(2 * count)
    logs, spins = np.empty(2 * count), np.empty((2 * count, 3))
    push = max(change[2], _LEAST_PUSH)  # (1 + e)|v_n|
    fastest = (OUTER if mild < 1.0 else INNER) + _EDGE
    own = agree[2, 2] + 1.0 / (_SHOWN_SIGMA * _SHOWN_SIGMA)
    wide = _WIDER / math.sqrt(own)
    top = -math.inf
    for p in range(count):
        dx = change[0] + error[0] * points[p, 0]
        dy = change[1] + error[1] * points[p, 0] + error[2] * points[p, 1]
        size = max(math.hypot(dx, dy), 1e-6)
        ux, uy = dx / size, dy / size
        off = min((size / push - TABLE_FRICTION_MEAN) / TABLE_FRICTION_SIGMA, _DISTANT)
        rolling = size / ROLLING_ALPHA  # |c| of a ball that leaves rolling, the least of one that slides
        # c = -|c| u, so the spin in the table's plane lies on a line; it is slowest, `beside`, where |c| is `nearest`
        nearest = -(before[0] * ux + before[1] * uy)
        beside = (before[0] * uy - before[1] * ux) / BALL_RADIUS
        for kind in range(2):
            if kind == 0:
                slip = rolling
                weight = 0.5 * math.erfc(off * math.sqrt(0.5)) / (ROLLING_ALPHA * ROLLING_ALPHA)
            else:
                half = BALL_RADIUS * math.sqrt(max(fastest * fastest - beside * beside, 0.0))
                if half == 0.0 or nearest + half <= rolling:
                    continue
                # densest about the slowest spin: |c| = nearest + half t |t|
                low = max((rolling - nearest) / half, -1.0)
                low = math.copysign(math.sqrt(abs(low)), low)
                t = low + (1.0 - low) * points[p, 2]
                slip = nearest + half * t * abs(t)
                weight = math.exp(-0.5 * off * off) / (_ROOT_2_PI * TABLE_FRICTION_SIGMA)
                weight *= slip / (size * push) * half * 2.0 * abs(t) * (1.0 - low)
            wx, wy = (-slip * uy - before[1]) / BALL_RADIUS, (before[0] + slip * ux) / BALL_RADIUS
            flat = wx * wx + wy * wy
            # Sidespin as it shows, drawn about what the flight says of it; then as fast as shows like that
            part = min(1.0, saturated / math.sqrt(flat + 1e-9))
            middle = (pull[2] - part * (agree[2, 0] * wx + agree[2, 1] * wy)) / own
            sz = min(max(middle, -0.9 * saturated), 0.9 * saturated) + wide * points[p, 3]
            wz, rest = sz, saturated * saturated - sz * sz
            if rest <= 0.0:
                continue
            if flat > rest:
                wz = sz * math.sqrt(flat / rest)
                weight *= saturated * saturated / rest * math.sqrt(flat / rest)
            rate = max(math.sqrt(flat + wz * wz), 1e-6)
            shows = min(rate, saturated) / rate
            sx, sy, sz = shows * wx, shows * wy, shows * wz
            i = 2 * p + kind
            logs[i] = (
                0.5 * points[p, 3] ** 2
                + (pull[0] * sx + pull[1] * sy + pull[2] * sz)
                - 0.5 * (agree[0, 0] * sx * sx + agree[1, 1] * sy * sy + agree[2, 2] * sz * sz)
                - (agree[1, 0] * sx * sy + agree[2, 0] * sx * sz + agree[2, 1] * sy * sz)
            )
            among_mild, among_strong = densities(rate)
            milds[i] = weight * mild * among_mild
            weights[i] = milds[i] + weight * max(1.0 - mild, _UNLIKELY) * among_strong
            if weights[i] > 0.0:
                top = max(top, logs[i])
            spins[i, 0] = wx + SPIN_PER_VELOCITY * dy
            spins[i, 1] = wy - SPIN_PER_VELOCITY * dx
            spins[i, 2] = wz
    total, total_mild, x, y, z = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(2 * count):
        if weights[i] > 0.0:
            agreement = math.exp(logs[i] - top)
            weight = weights[i] * agreement
            total += weight
            total_mild += milds[i] * agreement
            x += weight * spins[i, 0]
            y += weight * spins[i, 1]
            z += weight * spins[i, 2]
    if not total > 0.0:
        return otherwise, mild
    return (x / total, y / total, z / total), total_mild / total

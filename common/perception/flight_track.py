"""The row of one ball in the flight filter, and the linear model along its nominal flight.

A nominal ball starts at the first sample, with nominal air and spin w_0. The true ball differs from it by

    dp(t) = dp_0 + dv_0 E(t) + K dw x X(t) + k D(t)          K = (rho A/2m) C_L/S r
    dv(t) =        dv_0 E'(t) + K dw x X'(t) + k D'(t)

X' is the displacement of the nominal ball, D' is the change of its velocity by drag, and E' is the share of an
initial deviation of velocity that drag has left. All of them are damped by drag, as if drag acted on deviations
linearly. Lift is linear in spin up to its saturation (``physics.flight``). So dp and dv are linear in the ten
unknowns: deviations of first position and velocity, deviation of spin, and deviation k of the drag factor.
"""

import math
from collections.abc import Mapping
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from common.jit import kernel
from common.physics.constants import AIR_FACTOR, BALL_RADIUS
from common.physics.flight import LINEAR, LINEAR_DRAG, LINEAR_LIFT_MAX, LINEAR_LIFT_SLOPE, Air, flight_step
from common.physics.vec import Vec, add, axpy, cross, dot, norm, scale, vec_at
from common.task.observation import ExpectedSpin

Array = npt.NDArray[np.float64]

# Trajectory states of samples before the hit: 1 after the bounce on the robot's court
COMING, SERVED = 0, 4  # on its way to it; a serve on its way to the server's own court

UNKNOWNS = 10  # dp_0 (3), dv_0 (3), dw / SPIN_SIGMA (3), k / DRAG_SIGMA
DV, DW, DRAG = 3, 6, 9  # where dv_0, dw and k start

# Columns of a row. First the nominal ball, and what is integrated along its flight
POS, VEL = 0, 3  # of the nominal ball at the last sample [m], [m/s]
NOMINAL_SPIN, NOMINAL_DRAG = 6, 9  # w_0 [rad/s], drag factor
MOMENT, FIT_START = 10, 11  # time of the last sample, and of the start of the fit, on the samples' clock [s]
DISPLACEMENT, DISPLACEMENT_SUM = 12, 15  # X' [m], X [m s]
VEL_BY_DRAG, POS_BY_DRAG = 18, 21  # D' [m/s], D [m]
VEL_BY_VEL, POS_BY_VEL = 24, 25  # E' [-], E [s]
BOUNCED = 26  # 1: a sample from after the bounce was added
# The least squares
SOLUTION = 27  # unknowns (10)
NORMAL_MATRIX = SOLUTION + UNKNOWNS  # (10, 10), lower triangle
RIGHT_SIDE = NORMAL_MATRIX + UNKNOWNS * UNKNOWNS  # (10)
# What the policy may observe
PRESENT = RIGHT_SIDE + UNKNOWNS  # position [m] and velocity [m/s] now (6)
INTERCEPTION = PRESENT + 6  # time until the interception [s], position [m] and velocity [m/s] then (7)
SPIN = INTERCEPTION + 7  # spin after the bounce [rad/s] (3)
# For the spin posterior
BOUNCE_AS_PREDICTED = SPIN + 3  # 1: the bounce came as predicted, so it has information on the spin
VEL_BEFORE, VEL_BEFORE_SIGMA = (
    SPIN + 4,
    SPIN + 7,
)  # velocity before the bounce (3), and its sigma an axis [m/s]
INFORMATION_VECTOR, INFORMATION_MATRIX = SPIN + 8, SPIN + 11  # ``flight_information`` (3), (3, 3)
PRIOR_VEL = INFORMATION_MATRIX + 9  # velocity after the bounce with which the second fit starts [m/s] (3)
PRIOR_INFORMATION = PRIOR_VEL + 3  # inverse covariance of its part along the table, xx, xy, yy [s^2/m^2]
MILD_PROBABILITY = PRIOR_INFORMATION + 3  # that the ball is a mild one, before its launch
SPIN_RATIO, SPIN_RATIO_SIGMA = MILD_PROBABILITY + 1, MILD_PROBABILITY + 2  # expected spin / visible spin [-]
# These stay from ball to ball
PRIOR_MILD, CHANGE_PROBABILITY = MILD_PROBABILITY + 3, MILD_PROBABILITY + 4  # ``SpinPrior``
POSTERIOR_MILD = MILD_PROBABILITY + 5  # probability that the last ball with a predicted bounce was a mild one
IS_SERVED = MILD_PROBABILITY + 6  # 1: the ball has not yet bounced on the server's own court
TRACK = MILD_PROBABILITY + 7  # numbers in a row
PREDICTED = SPIN - PRESENT  # numbers of ``observation.PREDICTION``: present and interception

SPIN_SIGMA = 50.0  # [rad/s] prior an axis; balls of the preset `paper` have 45
DRAG_SIGMA = 0.09  # [-] prior of the drag factor: uniform in 0.85..1.15
MAX_SPIN = 1000.0  # [rad/s] bound of the estimate
MAX_DRAG_DEVIATION = 0.5  # [-] bound of the estimated drag factor's deviation from 1

# Spin / visible spin of mild and of strong balls, mean and sigma [-]: measured at the bounce of balls of the presets
# `paper` and `strong`
_MILD_RATIO, _STRONG_RATIO = (1.05, 0.3), (2.3, 0.9)
LIFT = AIR_FACTOR * LINEAR_LIFT_SLOPE * BALL_RADIUS  # K
SATURATION = LINEAR_LIFT_MAX / (LINEAR_LIFT_SLOPE * BALL_RADIUS)  # [1/m] spin / speed at which lift saturates
_DRAG_RATE = AIR_FACTOR * LINEAR_DRAG  # [1/m]


class SpinPrior(NamedTuple):
    """Expectation of a ball's spin. It matters because a flight hides the rate of a spin with saturated lift."""

    mild_probability: float  # that an unknown opponent's ball is a mild one (``spin_posterior``)
    change_probability: float  # that the opponent changes from one ball to the next; 1: nothing is learnt


SPIN_PRIORS: Final[Mapping[ExpectedSpin, SpinPrior]] = {
    "mild": SpinPrior(1.0, 1.0),
    "mixed": SpinPrior(0.5, 1.0),
    "strong": SpinPrior(0.0, 1.0),
    "learnt": SpinPrior(0.8, 0.03),
}
"""Priors by the setting ``expected_spin`` (ADR-0030)."""


class BallEstimate(NamedTuple):
    """A ball at one moment, as the fit estimates it."""

    pos: Vec  # m
    vel: Vec  # m/s
    spin: Vec  # rad/s
    drag_factor: float  # -


def new_tracks(count: int, expected: ExpectedSpin = "mild") -> Array:
    """Return rows (count, TRACK) for balls of unknown opponents, with the prior ``SPIN_PRIORS[expected]``."""
    tracks = np.zeros((count, TRACK))
    tracks[:, [PRIOR_MILD, CHANGE_PROBABILITY]] = SPIN_PRIORS[expected]
    tracks[:, POSTERIOR_MILD] = tracks[:, PRIOR_MILD]
    return tracks


@kernel
def update_spin_prior(track: Array) -> None:
    """Write the mild probability and the spin ratio of a new ball, from the posterior of the last one."""
    prior, stays = track[PRIOR_MILD], 1.0 - track[CHANGE_PROBABILITY]
    mild = prior + stays * (track[POSTERIOR_MILD] - prior)
    ratio = mild * _MILD_RATIO[0] + (1.0 - mild) * _STRONG_RATIO[0]
    variance = mild * ((_MILD_RATIO[0] - ratio) ** 2 + _MILD_RATIO[1] ** 2)
    variance += (1.0 - mild) * ((_STRONG_RATIO[0] - ratio) ** 2 + _STRONG_RATIO[1] ** 2)
    track[MILD_PROBABILITY], track[SPIN_RATIO], track[SPIN_RATIO_SIGMA] = mild, ratio, math.sqrt(variance)


@kernel
def add_equation(track: Array, coefficients: Array, right: float, sigma: float) -> None:
    """Add the equation ``coefficients . unknowns = right`` (+- sigma) to the normal equations."""
    weight = 1.0 / (sigma * sigma)
    for i in range(UNKNOWNS):
        if coefficients[i] != 0.0:
            scaled = weight * coefficients[i]
            track[RIGHT_SIDE + i] += scaled * right
            for j in range(i + 1):
                track[NORMAL_MATRIX + i * UNKNOWNS + j] += scaled * coefficients[j]


@kernel
def saturation_of(track: Array) -> tuple[float, Vec]:
    """Return the share of a change of spin that changes the nominal ball's lift, and the axis along which none does.

    With saturated lift only a change of the spin's direction changes the lift, and the faster the spin, the less.
    """
    nominal = vec_at(track, NOMINAL_SPIN)
    rate, limit = norm(nominal), SATURATION * norm(vec_at(track, VEL))
    if rate <= limit:
        return 1.0, (0.0, 0.0, 0.0)
    return limit / rate, scale(1.0 / rate, nominal)


@kernel
def visible_part(share: float, axis: Vec, w: Vec) -> Vec:
    """Return the part of ``w`` that changes the lift (``saturation_of``). The map from ``w`` to it is symmetric."""
    return scale(share, axpy(-dot(axis, w), axis, w))


@kernel
def advance(track: Array, h: float) -> None:
    """Fly the nominal ball for ``h`` seconds, and integrate along its flight."""
    v = vec_at(track, VEL)
    drag_factor = track[NOMINAL_DRAG]
    q, u = flight_step(vec_at(track, POS), v, vec_at(track, NOMINAL_SPIN), h, Air(drag_factor, 1.0, LINEAR))
    before, after = norm(v), norm(u)
    # Drag reduces a deviation of velocity to exp(-drag |v| h) of it
    left = math.exp(-0.5 * h * _DRAG_RATE * drag_factor * (before + after))
    for k in range(3):
        displacement = left * track[DISPLACEMENT + k] + 0.5 * h * (left * v[k] + u[k])
        track[DISPLACEMENT_SUM + k] += 0.5 * h * (track[DISPLACEMENT + k] + displacement)
        track[DISPLACEMENT + k] = displacement
        braked = -0.5 * h * _DRAG_RATE * (left * left * before * v[k] + after * u[k])
        vel_by_drag = (
            left * left * track[VEL_BY_DRAG + k] + braked
        )  # along the flight drag grows twice as fast
        track[POS_BY_DRAG + k] += 0.5 * h * (track[VEL_BY_DRAG + k] + vel_by_drag)
        track[VEL_BY_DRAG + k] = vel_by_drag
        track[POS + k], track[VEL + k] = q[k], u[k]
    track[POS_BY_VEL] += 0.5 * h * track[VEL_BY_VEL] * (1.0 + left)
    track[VEL_BY_VEL] *= left
    track[MOMENT] += h


@kernel
def limit_spin(spin: Vec) -> Vec:
    """Return the spin, shortened to ``MAX_SPIN``: bad samples must not give unbounded spins."""
    return scale(min(1.0, MAX_SPIN / max(norm(spin), 1.0)), spin)


@kernel
def estimate(track: Array) -> BallEstimate:
    """Return the ball at the last sample, as the fit estimates it."""
    solution = track[SOLUTION:NORMAL_MATRIX]
    dw = scale(SPIN_SIGMA, vec_at(solution, DW))
    share, hidden = saturation_of(track)
    lifting = visible_part(share * LIFT, hidden, dw)
    k = DRAG_SIGMA * solution[DRAG]
    pos = add(vec_at(track, POS), axpy(track[POS_BY_VEL], vec_at(solution, DV), vec_at(solution, 0)))
    pos = axpy(k, vec_at(track, POS_BY_DRAG), add(pos, cross(lifting, vec_at(track, DISPLACEMENT_SUM))))
    vel = axpy(track[VEL_BY_VEL], vec_at(solution, DV), vec_at(track, VEL))
    vel = axpy(k, vec_at(track, VEL_BY_DRAG), add(vel, cross(lifting, vec_at(track, DISPLACEMENT))))
    spin = add(vec_at(track, NOMINAL_SPIN), dw)
    drag_factor = min(max(track[NOMINAL_DRAG] + k, 1.0 - MAX_DRAG_DEVIATION), 1.0 + MAX_DRAG_DEVIATION)
    return BallEstimate(pos, vel, limit_spin(spin), drag_factor)

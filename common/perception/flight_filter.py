"""The flight filter: the ball now, its spin, and its predicted interception, from all samples of its flight (ADR-0024).

It is least squares over the samples since launch, with the linear model of ``flight_track``. The normal equations are
summed sample by sample. Gaussian priors limit the unknowns. What the flight does not show, such as spin along the
flight, keeps its prior.

At the bounce the estimate passes through the table's law. Ten points of equal weight represent the uncertainty of
spin, restitution and friction (cubature; Arasaratnam, Haykin 2009). Mean and covariance of the results are the prior
of a second fit, which starts there. The change of velocity that later samples show has more information on the spin
than a Gaussian can represent: ``spin_posterior`` evaluates it.

The prediction is the nominal flight from the estimate on, through the bounce of an average table, until
``INTERCEPTION_AFTER`` after the bounce.
"""

import math

import numpy as np

from common.jit import kernel
from common.perception.bounce_prediction import (
    MAX_HORIZON,
    TABLE_RESTITUTION0_MEAN,
    expected_bounce,
    fly,
    fly_to_table,
)
from common.perception.cholesky import factor, inverse, inverse_2, substitute
from common.perception.flight_track import (
    BOUNCE_AS_PREDICTED,
    BOUNCED,
    DISPLACEMENT,
    DISPLACEMENT_SUM,
    DRAG,
    DRAG_SIGMA,
    DV,
    DW,
    FIT_START,
    INFORMATION_MATRIX,
    INFORMATION_VECTOR,
    INTERCEPTION,
    IS_SERVED,
    LIFT,
    MILD_PROBABILITY,
    MOMENT,
    NOMINAL_DRAG,
    NOMINAL_SPIN,
    NORMAL_MATRIX,
    POS,
    POS_BY_DRAG,
    POS_BY_VEL,
    POSTERIOR_MILD,
    PRESENT,
    PRIOR_INFORMATION,
    PRIOR_MILD,
    PRIOR_VEL,
    RIGHT_SIDE,
    SATURATION,
    SERVED,
    SOLUTION,
    SPIN,
    SPIN_RATIO,
    SPIN_RATIO_SIGMA,
    SPIN_SIGMA,
    UNKNOWNS,
    VEL,
    VEL_BEFORE,
    VEL_BEFORE_SIGMA,
    VEL_BY_DRAG,
    VEL_BY_VEL,
    Array,
    BallEstimate,
    add_equation,
    advance,
    estimate,
    limit_spin,
    saturation_of,
    update_spin_prior,
    visible_part,
)
from common.perception.spin_posterior import (
    POINTS,
    TABLE_FRICTION_MEAN,
    FlightEvidence,
    MeasuredBounce,
    flight_information,
    spin_after_bounce,
)
from common.physics.table_bounce import table_bounce
from common.physics.vec import cross, norm, scale, vec_at

INTERCEPTION_AFTER = 0.12  # [s] after the bounce: about when a racket meets the ball
MIN_POSITION_NOISE = 0.001  # [m] smallest noise assumed for samples: the model has errors too
MIN_VELOCITY_NOISE = 0.02  # [m/s]
BOUNCE_POSITION_SIGMA = 0.006  # [m] an axis, of the predicted position of the bounce
BOUNCE_UPDATE_WINDOW = (
    0.15  # [s] after the bounce; later samples have no more information on it, at the same cost
)
FLIGHT_SHARE = 0.375  # [-] velocity noise of the whole flight before the bounce, relative to one sample's
_MIN_INFORMATION = 1.0  # [s^2/m^2] of the samples on a velocity
_MAX_BOUNCE_ERROR = 0.06  # [s] a bounce whose time was predicted with a larger error counts as not predicted


@kernel
def begin_track(
    track: Array, measurement: Array, moment: float, position_noise: float, velocity_noise: float
) -> None:
    """Begin a row (TRACK,) with a ball's first sample.

    Args:
        track: Written.
        measurement: Position [m], velocity [m/s], and trajectory state ``COMING`` or ``SERVED``.
        moment: Time stamp, on any clock [s].
        position_noise: Sigma of the position an axis [m].
        velocity_noise: Sigma of the velocity an axis [m/s].
    """
    track[:PRIOR_MILD] = 0.0
    track[IS_SERVED] = 1.0 if measurement[6] == SERVED else 0.0
    update_spin_prior(track)
    track[MOMENT], track[FIT_START] = moment, moment
    track[POS : POS + 6] = measurement[:6]
    track[NOMINAL_DRAG], track[VEL_BY_VEL] = 1.0, 1.0
    position, velocity = max(position_noise, MIN_POSITION_NOISE), max(velocity_noise, MIN_VELOCITY_NOISE)
    for k in range(UNKNOWNS):
        sigma = position if k < DV else velocity if k < DW else 1.0
        track[NORMAL_MATRIX + k * UNKNOWNS + k] = 1.0 / (sigma * sigma)


@kernel
def _update_spin(track: Array, lower: Array) -> None:
    """Write the spin after the bounce, from samples after it, and the posterior probability of a mild ball.

    Args:
        track: Written.
        lower: Cholesky factor of its normal matrix.
    """
    unit, column = np.zeros(UNKNOWNS), np.empty(UNKNOWNS)
    unit[DV] = 1.0
    substitute(lower, unit, column)
    xx, xy = column[DV], column[DV + 1]
    unit[DV], unit[DV + 1] = 0.0, 1.0
    substitute(lower, unit, column)
    yy = column[DV + 1]
    # Of the samples alone: the fit's information on the velocity along the table, without that of the fit's prior
    info_xx, info_xy, info_yy = inverse_2(xx, xy, yy)
    dx, dy = track[SOLUTION + DV], track[SOLUTION + DV + 1]
    vector_x, vector_y = info_xx * dx + info_xy * dy, info_xy * dx + info_yy * dy
    info_xx = max(info_xx - track[PRIOR_INFORMATION], _MIN_INFORMATION)
    info_yy = max(info_yy - track[PRIOR_INFORMATION + 2], _MIN_INFORMATION)
    limit = 0.9 * math.sqrt(info_xx * info_yy)
    info_xy = min(max(info_xy - track[PRIOR_INFORMATION + 1], -limit), limit)
    xx, xy, yy = inverse_2(info_xx, info_xy, info_yy)
    before, prior = vec_at(track, VEL_BEFORE), vec_at(track, PRIOR_VEL)
    change = (
        prior[0] + xx * vector_x + xy * vector_y - before[0],
        prior[1] + xy * vector_x + yy * vector_y - before[1],
        prior[2] + track[SOLUTION + DV + 2] - before[2],
    )
    variance_before = track[VEL_BEFORE_SIGMA] * track[VEL_BEFORE_SIGMA]
    error_xx = math.sqrt(xx + variance_before)
    error_yx = xy / error_xx
    error_yy = math.sqrt(yy + variance_before - error_yx * error_yx)
    evidence = FlightEvidence(
        vec_at(track, INFORMATION_VECTOR),
        track[INFORMATION_MATRIX:PRIOR_VEL].reshape(3, 3),
        SATURATION * norm(before),
    )
    bounce = MeasuredBounce(before, change, (error_xx, error_yx, error_yy))
    spin, track[POSTERIOR_MILD] = spin_after_bounce(
        bounce, evidence, track[MILD_PROBABILITY], estimate(track).spin, POINTS
    )
    track[SPIN], track[SPIN + 1], track[SPIN + 2] = limit_spin(spin)


@kernel
def _add_sample(
    track: Array, measurement: Array, moment: float, position_noise: float, velocity_noise: float
) -> None:
    """Add a sample to the fit, and solve it."""
    advance(track, moment - track[MOMENT])
    position, velocity = max(position_noise, MIN_POSITION_NOISE), max(velocity_noise, MIN_VELOCITY_NOISE)
    share, hidden = saturation_of(track)
    unit = share * LIFT * SPIN_SIGMA
    row = np.empty(UNKNOWNS)
    for k in range(3):
        axis = (1.0 if k == 0 else 0.0, 1.0 if k == 1 else 0.0, 1.0 if k == 2 else 0.0)
        row[:] = 0.0
        row[k], row[DV + k] = 1.0, track[POS_BY_VEL]
        # (w x X)_k = w . (X x e_k), and the map from w to its visible part is symmetric
        lift = visible_part(unit, hidden, cross(vec_at(track, DISPLACEMENT_SUM), axis))
        row[DW], row[DW + 1], row[DW + 2] = lift[0], lift[1], lift[2]
        row[DRAG] = DRAG_SIGMA * track[POS_BY_DRAG + k]
        add_equation(track, row, measurement[k] - track[POS + k], position)
        row[:] = 0.0
        row[DV + k] = track[VEL_BY_VEL]
        lift = visible_part(unit, hidden, cross(vec_at(track, DISPLACEMENT), axis))
        row[DW], row[DW + 1], row[DW + 2] = lift[0], lift[1], lift[2]
        row[DRAG] = DRAG_SIGMA * track[VEL_BY_DRAG + k]
        add_equation(track, row, measurement[3 + k] - track[VEL + k], velocity)
    lower = np.empty((UNKNOWNS, UNKNOWNS))
    factor(track[NORMAL_MATRIX:RIGHT_SIDE].reshape(UNKNOWNS, UNKNOWNS), lower)
    substitute(lower, track[RIGHT_SIDE:PRESENT], track[SOLUTION:NORMAL_MATRIX])
    if track[BOUNCE_AS_PREDICTED] == 1.0 and track[MOMENT] - track[FIT_START] < BOUNCE_UPDATE_WINDOW:
        _update_spin(track, lower)


@kernel
def _restart_fit(
    track: Array, moment: float, prior: BallEstimate, covariance: Array, drag_variance: float
) -> None:
    """Start a fit at the bounce.

    Args:
        track: Written.
        moment: Time of the bounce [s].
        prior: The ball just after it.
        covariance: Covariance of its velocity and spin (6, 6).
        drag_variance: Of the drag factor, in units of DRAG_SIGMA squared.
    """
    lower, weight = np.empty((6, 6)), np.empty((6, 6))
    factor(covariance, lower)
    inverse(lower, weight)
    track[:BOUNCED] = 0.0
    track[SOLUTION:PRESENT] = 0.0
    for k in range(3):
        track[POS + k], track[VEL + k] = prior.pos[k], prior.vel[k]
        track[NOMINAL_SPIN + k] = prior.spin[k]
    track[NOMINAL_DRAG], track[VEL_BY_VEL] = prior.drag_factor, 1.0
    track[MOMENT], track[FIT_START] = moment, moment
    for k in range(3):
        track[NORMAL_MATRIX + k * UNKNOWNS + k] = 1.0 / (BOUNCE_POSITION_SIGMA * BOUNCE_POSITION_SIGMA)
    for i in range(6):
        for j in range(i + 1):
            unit = (SPIN_SIGMA if i >= 3 else 1.0) * (SPIN_SIGMA if j >= 3 else 1.0)
            track[NORMAL_MATRIX + (DV + i) * UNKNOWNS + DV + j] = unit * weight[i, j]
    track[NORMAL_MATRIX + UNKNOWNS * UNKNOWNS - 1] = 1.0 / drag_variance
    track[BOUNCED] = 1.0


@kernel
def _pass_bounce(track: Array, measurement: Array, moment: float, velocity_noise: float) -> None:
    """Pass the estimate through the bounce, and start the second fit there.

    Args:
        track: Written.
        measurement: The first sample after the bounce: position [m] and velocity [m/s].
        moment: Its time stamp [s].
        velocity_noise: Sigma of its velocity an axis [m/s].
    """
    ball = estimate(track)
    wait, pos, falling = fly_to_table(ball)
    at = track[MOMENT] + wait
    lower, variance = np.empty((UNKNOWNS, UNKNOWNS)), np.empty((UNKNOWNS, UNKNOWNS))
    factor(track[NORMAL_MATRIX:RIGHT_SIDE].reshape(UNKNOWNS, UNKNOWNS), lower)
    inverse(lower, variance)
    is_unexpected = abs(at - moment) > _MAX_BOUNCE_ERROR or at <= track[FIT_START] or falling[2] >= 0.0
    if is_unexpected:
        falling = (measurement[3], measurement[4], -abs(measurement[5]))
    covariance = np.empty((6, 6))
    rising, spin = expected_bounce(
        falling, ball.spin, track[SPIN_RATIO], track[SPIN_RATIO_SIGMA], variance, covariance
    )
    if is_unexpected:  # only the sample shows where and how fast the ball is, and nothing shows its spin
        at, pos, rising = moment, vec_at(measurement, 0), vec_at(measurement, 3)
        covariance[:3] = 0.0
        covariance[:, :3] = 0.0
        for k in range(3):
            covariance[k, k] = max(velocity_noise, MIN_VELOCITY_NOISE) ** 2
    else:
        spin_covariance = SPIN_SIGMA * SPIN_SIGMA * variance[DW:DRAG, DW:DRAG]
        flight_information(
            ball.spin,
            spin_covariance,
            SPIN_SIGMA,
            track[INFORMATION_VECTOR:INFORMATION_MATRIX],
            track[INFORMATION_MATRIX:PRIOR_VEL].reshape(3, 3),
        )
        track[VEL_BEFORE_SIGMA] = FLIGHT_SHARE * max(velocity_noise, MIN_VELOCITY_NOISE)
        information = inverse_2(covariance[0, 0], covariance[1, 0], covariance[1, 1])
        for k in range(3):
            track[PRIOR_INFORMATION + k] = information[k]
            track[VEL_BEFORE + k], track[PRIOR_VEL + k] = falling[k], rising[k]
    track[BOUNCE_AS_PREDICTED] = 0.0 if is_unexpected else 1.0
    prior = BallEstimate(pos, rising, spin, ball.drag_factor)
    _restart_fit(track, at, prior, covariance, variance[DRAG, DRAG])


@kernel
def add_measurement(
    track: Array,
    measurement: Array,
    moment: float,
    bounced: bool,
    position_noise: float,
    velocity_noise: float,
) -> None:
    """Correct the estimate by a sample.

    Args:
        track: (TRACK,); written.
        measurement: Position [m] and velocity [m/s] in its first six numbers.
        moment: Time stamp, on the same clock [s]. A sample that is not newer than the last one changes nothing.
        bounced: Whether the sample is from after the bounce.
        position_noise: Sigma of the position an axis [m].
        velocity_noise: Sigma of the velocity an axis [m/s].
    """
    if moment <= track[MOMENT]:
        return
    if bounced and track[BOUNCED] == 0.0:
        _pass_bounce(track, measurement, moment, velocity_noise)
    _add_sample(track, measurement, moment, position_noise, velocity_noise)


@kernel
def predict_interception(track: Array, now: float) -> None:
    """Write the ball at ``now`` [s, on the samples' clock] and its predicted interception."""
    ball = estimate(track)
    ahead = now - track[MOMENT]
    until = INTERCEPTION_AFTER - (
        track[MOMENT] - track[FIT_START]
    )  # from the last sample to the interception
    here, speed = ball.pos, ball.vel
    there, then = here, speed
    spin = ball.spin
    if track[BOUNCED] == 0.0:
        until, ratio = 0.0, track[SPIN_RATIO]
        # A serve has another bounce before the one on the robot's court
        for bounces_left in range(2 if track[IS_SERVED] == 1.0 else 1, 0, -1):
            wait, there, then = fly_to_table(ball)
            if until <= ahead < until + wait:
                here, speed = fly(ball, min(ahead - until, MAX_HORIZON))
            if wait > MAX_HORIZON:  # no bounce within the horizon: the prediction ends there
                until += MAX_HORIZON
                break
            falling = (then[0], then[1], min(then[2], -0.1))
            rising, spin = table_bounce(
                falling,
                scale(ratio, ball.spin),
                (0.0, 0.0, 1.0),
                TABLE_RESTITUTION0_MEAN,
                TABLE_FRICTION_MEAN,
            )
            ball = BallEstimate(there, rising, spin, ball.drag_factor)
            until, ratio = until + wait, 1.0  # then the spin is the law's, and not what a flight shows of it
            if bounces_left == 1:
                if ahead >= until:
                    here, speed = fly(ball, ahead - until)
                until += INTERCEPTION_AFTER
                there, then = fly(ball, INTERCEPTION_AFTER)
    else:
        here, speed = fly(ball, ahead)
        there, then = fly(ball, until)
    track[INTERCEPTION] = until - ahead
    for k in range(3):
        track[PRESENT + k], track[PRESENT + 3 + k] = here[k], speed[k]
        track[INTERCEPTION + 1 + k], track[INTERCEPTION + 4 + k] = there[k], then[k]
        if track[BOUNCE_AS_PREDICTED] == 0.0:
            track[SPIN + k] = spin[k]

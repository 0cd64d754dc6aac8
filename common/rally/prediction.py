"""What a ball's flight tells: where it is now, how it spins, and how it will come to be met.

Least squares over the samples seen since launch, and anew since the bounce. Against a nominal ball that sets out from
the first sample with nominal air and spin w_0, a sample at time t lies off by (lift below its saturation,
``physics.flight``; drag brakes what is off as well, as if it were linear)

    dp(t) = dp_0 + dv_0 E(t) + K dw x X(t) + k D(t)          K = (rho A/2m) 1.067 r
    dv(t) =        dv_0 E'(t) + K dw x X'(t) + k D'(t)

with X' the nominal ball's way, D' what its drag has taken off it, E' the share of a disturbance that is left: linear in
what isn't known (first position and velocity, spin, drag's share k), so the normal equations are summed sample by
sample. Gaussian priors say how large each may be; what doesn't show, spin along the flight, keeps its prior.

At the bounce what is known is taken through the table's law: ten points of equal weight stand for spin, restitution and
friction as uncertain as they are (cubature; Arasaratnam, Haykin 2009), and the mean and covariance of what becomes of
them are the prior of the fit that begins there. How the velocity that is then seen differs from the one before it tells
of the spin, by more than a Gaussian can say: ``bounce_spin``.

The prediction is the nominal flight from there on, through an average table's bounce, to ``MEETING_AFTER`` behind it.
"""

import math
from collections.abc import Mapping
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from common.jit import kernel
from common.physics.constants import AIR_FACTOR, BALL_RADIUS
from common.physics.flight import SIMPLE, SIMPLE_DRAG, SIMPLE_LIFT_MAX, SIMPLE_LIFT_SLOPE, flight_step
from common.physics.table_bounce import table_bounce
from common.physics.vec import Vec, add, axpy, cross, dot, norm, scale, vec_at
from common.rally.bounce_spin import (
    POINTS,
    TABLE_FRICTION_MEAN,
    TABLE_FRICTION_SIGMA,
    shown_likelihood,
    spin_behind_bounce,
)
from common.rally.cholesky import factor, inverse, inverse_2, substitute
from common.rally.observation import Expectation

Array = npt.NDArray[np.float64]

UNKNOWNS = 10  # dp_0 (3), dv_0 (3), dw / SPIN_SIGMA (3), k / DRAG_SIGMA
_DV, _SPIN, _DRAG = 3, 6, 9

# Columns of a track's row
POS, VEL = 0, 3  # of the nominal ball at the last sample
NOMINAL_SPIN, NOMINAL_DRAG = 6, 9  # w_0 [rad/s], drag factor
MOMENT, BEGUN = 10, 11  # of the last sample, and of the fit's beginning, on the samples' clock [s]
WAY, PATH = 12, 15  # X' [m], X [m s]
SLOWED, SLOWED_PATH = 18, 21  # D' [m/s], D [m]
LEFT, LEFT_PATH = 24, 25  # E' [-], E [s]
BOUNCED = 26  # 1: the bounce was seen
FOUND = 27  # the solution (10)
NORMAL = FOUND + UNKNOWNS  # normal matrix (10, 10), lower triangle
RIGHT = NORMAL + UNKNOWNS * UNKNOWNS  # right side (10)
# ... and what the policy may be told
PRESENT = RIGHT + UNKNOWNS  # position [m] and velocity [m/s] now (6)
MEETING = PRESENT + 6  # in how long [s], position [m] and velocity [m/s] then (7)
SPIN = MEETING + 7  # spin behind the bounce [rad/s] (3)
# What the flight before the bounce showed, for ``bounce_spin``
FORESEEN = SPIN + 3  # 1: the bounce came as foreseen, so that it tells of the spin
BEFORE, BEFORE_SIGMA = FORESEEN + 1, FORESEEN + 4  # velocity before it (3), and its sigma a axis [m/s]
PULL, AGREE = BEFORE + 4, BEFORE + 7  # ``shown_likelihood`` (3), (3, 3)
GUESS = AGREE + 9  # guess at the velocity behind it, with which the fit begins anew [m/s] (3)
GUESS_INFORMATION = GUESS + 3  # its inverse covariance along the table, xx, xy, yy [s^2/m^2]
MILD = GUESS_INFORMATION + 3  # how likely the ball was a mild one before it was launched
FACTOR, FACTOR_SIGMA = MILD + 1, MILD + 2  # so by how much faster it spins than its flight shows
# ... and what a row keeps from ball to ball
FIRST_MILD, RENEWED = MILD + 3, MILD + 4  # ``Expected``
FOUND_MILD = MILD + 5  # how likely the last ball whose bounce was foreseen was a mild one
TRACK = MILD + 6  # numbers in a row
PREDICTED = SPIN - PRESENT  # numbers of ``observation.PREDICTION``: present and meeting

MEETING_AFTER = 0.12  # [s] behind the bounce: about when a racket meets the ball
SPIN_SIGMA = 50.0  # [rad/s] a axis; balls of the preset `paper`: 45
DRAG_SIGMA = 0.09  # [-] of the drag factor: uniform in 0.85..1.15
MOST_SPIN = 600.0  # [rad/s] that is believed
MOST_DRAG = 0.5  # [-] that a drag factor is believed to be off
LEAST_POSITION_NOISE = 0.001  # [m] that samples are taken to have at least: the model isn't perfect either
LEAST_VELOCITY_NOISE = 0.02  # [m/s]
TABLE_RESTITUTION0_MEAN, TABLE_RESTITUTION0_SIGMA = 0.975, 0.0144  # [-] of the tables of profile `standard`
BOUNCE_PLACE_SIGMA = 0.006  # [m] a axis: where the bounce was, as foreseen
BOUNCE_SPEED_SIGMA = 0.05  # [m/s] a axis: with what velocity
TELLING = 0.15  # [s] behind the bounce later samples tell no more of it, and cost as much
FLIGHT_SHARE = 0.375  # [-] of a sample's velocity noise is left after a flight's many
BOUNCE_SPIN_SIGMA = 1.0  # [rad/s] a axis: what the law leaves open


class Expected(NamedTuple):
    """What spins are expected, for a flight hides how fast a ball spins once its lift is saturated."""

    mild: float  # how likely a stranger's ball is a mild one (``bounce_spin``)
    # how likely the other side is another one from a ball to the next; 1: nothing is learnt of it
    renewed: float


EXPECTED: Final[Mapping[Expectation, Expected]] = {
    "mild": Expected(1.0, 1.0),
    "mixed": Expected(0.5, 1.0),
    "strong": Expected(0.0, 1.0),
    "learnt": Expected(0.8, 0.01),
}
# By how much faster a ball spins than its flight shows, mean and sigma [-]: measured at the bounce of balls of the
# presets `paper` and `strong`
_MILD_FACTOR, _STRONG_FACTOR = (1.2, 0.2), (3.3, 1.0)
_LIFT = AIR_FACTOR * SIMPLE_LIFT_SLOPE * BALL_RADIUS
_SATURATION = SIMPLE_LIFT_MAX / (
    SIMPLE_LIFT_SLOPE * BALL_RADIUS
)  # [1/m] of spin by speed, from which on lift is saturated
_DRAG_FACTOR = AIR_FACTOR * SIMPLE_DRAG
_LEAST_INFORMATION = 1.0  # [s^2/m^2] that samples have on a velocity
_STEP = 0.020  # [s] of the flight that is foretold: Runge-Kutta errs by less than 0.01 mm in it
_LONGEST = 1.0  # [s] farther ahead nothing is foretold
_SURPRISE = 0.06  # [s] a bounce that was foreseen farther off than this was not foreseen


def new_tracks(count: int, expected: Expectation = "mild") -> Array:
    """Return rows (count, TRACK) for balls that are expected to spin as ``EXPECTED`` says."""
    tracks = np.zeros((count, TRACK))
    tracks[:, [FIRST_MILD, RENEWED]] = EXPECTED[expected]
    tracks[:, FOUND_MILD] = tracks[:, FIRST_MILD]
    return tracks


@kernel
def begin_track(
    track: Array, seen: Array, moment: float, position_noise: float, velocity_noise: float
) -> None:
    """Begin a row (TRACK,) with a ball's first sample.

    Args:
        track: Written.
        seen: Position [m] and velocity [m/s], first six numbers.
        moment: When it was taken, on whatever clock [s].
        position_noise: Its sigma a axis [m].
        velocity_noise: [m/s].
    """
    track[:FIRST_MILD] = 0.0
    first, stays = track[FIRST_MILD], 1.0 - track[RENEWED]
    mild = first + stays * (track[FOUND_MILD] - first)
    factor = mild * _MILD_FACTOR[0] + (1.0 - mild) * _STRONG_FACTOR[0]
    variance = mild * ((_MILD_FACTOR[0] - factor) ** 2 + _MILD_FACTOR[1] ** 2)
    variance += (1.0 - mild) * ((_STRONG_FACTOR[0] - factor) ** 2 + _STRONG_FACTOR[1] ** 2)
    track[MILD], track[FACTOR], track[FACTOR_SIGMA] = mild, factor, math.sqrt(variance)
    track[MOMENT], track[BEGUN] = moment, moment
    track[POS : POS + 6] = seen[:6]
    track[NOMINAL_DRAG], track[LEFT] = 1.0, 1.0
    position, velocity = max(position_noise, LEAST_POSITION_NOISE), max(velocity_noise, LEAST_VELOCITY_NOISE)
    for k in range(UNKNOWNS):
        sigma = position if k < _DV else velocity if k < _SPIN else 1.0
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
def _saturation(track: Array) -> tuple[float, Vec]:
    """Return which share of more spin shows in the nominal ball's lift, and the axis along which none does.

    Where its lift is saturated only the spin's direction shows, and the less the faster it spins.
    """
    nominal = vec_at(track, NOMINAL_SPIN)
    rate, most = norm(nominal), _SATURATION * norm(vec_at(track, VEL))
    if rate <= most:
        return 1.0, (0.0, 0.0, 0.0)
    return most / rate, scale(1.0 / rate, nominal)


@kernel
def _shown(share: float, axis: Vec, w: Vec) -> Vec:
    """Return what of ``w`` shows, as unsaturated lift would show it; a symmetric map."""
    return scale(share, axpy(-dot(axis, w), axis, w))


@kernel
def _advance(track: Array, h: float) -> None:
    """Fly the nominal ball ``h`` seconds on, with all that is summed along it."""
    v = vec_at(track, VEL)
    drag_factor = track[NOMINAL_DRAG]
    q, u = flight_step(vec_at(track, POS), v, vec_at(track, NOMINAL_SPIN), h, drag_factor, 1.0, SIMPLE)
    before, after = norm(v), norm(u)
    # Half a step of nominal motion, braked all along: what is left of it is exp(-drag |v| h)
    left = math.exp(-0.5 * h * _DRAG_FACTOR * drag_factor * (before + after))
    for k in range(3):
        way = left * track[WAY + k] + 0.5 * h * (left * v[k] + u[k])
        track[PATH + k] += 0.5 * h * (track[WAY + k] + way)
        track[WAY + k] = way
        braked = -0.5 * h * _DRAG_FACTOR * (left * left * before * v[k] + after * u[k])
        slowed = left * left * track[SLOWED + k] + braked  # along the flight drag grows twice as fast
        track[SLOWED_PATH + k] += 0.5 * h * (track[SLOWED + k] + slowed)
        track[SLOWED + k] = slowed
        track[POS + k], track[VEL + k] = q[k], u[k]
    track[LEFT_PATH] += 0.5 * h * track[LEFT] * (1.0 + left)
    track[LEFT] *= left
    track[MOMENT] += h


@kernel
def _believed(spin: Vec) -> Vec:
    """Return the spin, or as much of it as is believed: bad samples must not lead beyond all bounds."""
    return scale(min(1.0, MOST_SPIN / max(norm(spin), 1.0)), spin)


@kernel
def _estimate(track: Array) -> tuple[Vec, Vec, Vec, float]:
    """Return position, velocity, spin and drag factor at the last sample, as the fit has them."""
    found = track[FOUND:NORMAL]
    dw = scale(SPIN_SIGMA, vec_at(found, _SPIN))
    share, hidden = _saturation(track)
    lifting = _shown(share * _LIFT, hidden, dw)
    k = DRAG_SIGMA * found[_DRAG]
    pos = add(vec_at(track, POS), axpy(track[LEFT_PATH], vec_at(found, _DV), vec_at(found, 0)))
    pos = axpy(k, vec_at(track, SLOWED_PATH), add(pos, cross(lifting, vec_at(track, PATH))))
    vel = axpy(track[LEFT], vec_at(found, _DV), vec_at(track, VEL))
    vel = axpy(k, vec_at(track, SLOWED), add(vel, cross(lifting, vec_at(track, WAY))))
    spin = add(vec_at(track, NOMINAL_SPIN), dw)
    return pos, vel, _believed(spin), min(max(track[NOMINAL_DRAG] + k, 1.0 - MOST_DRAG), 1.0 + MOST_DRAG)


@kernel
def _tell_spin(track: Array, lower: Array) -> None:
    """Write the spin behind the bounce, as samples from there tell it, and how likely the ball is a mild one.

    Args:
        track: Written.
        lower: Cholesky factor of its normal matrix.
    """
    unit, column = np.zeros(UNKNOWNS), np.empty(UNKNOWNS)
    unit[_DV] = 1.0
    substitute(lower, unit, column)
    xx, xy = column[_DV], column[_DV + 1]
    unit[_DV], unit[_DV + 1] = 0.0, 1.0
    substitute(lower, unit, column)
    yy = column[_DV + 1]
    # The samples alone: the fit's information on the velocity along the table, less that of the guess it began with
    info_xx, info_xy, info_yy = inverse_2(xx, xy, yy)
    dx, dy = track[FOUND + _DV], track[FOUND + _DV + 1]
    pull_x, pull_y = info_xx * dx + info_xy * dy, info_xy * dx + info_yy * dy
    info_xx = max(info_xx - track[GUESS_INFORMATION], _LEAST_INFORMATION)
    info_yy = max(info_yy - track[GUESS_INFORMATION + 2], _LEAST_INFORMATION)
    most = 0.9 * math.sqrt(info_xx * info_yy)
    info_xy = min(max(info_xy - track[GUESS_INFORMATION + 1], -most), most)
    xx, xy, yy = inverse_2(info_xx, info_xy, info_yy)
    before, guess = vec_at(track, BEFORE), vec_at(track, GUESS)
    change = (
        guess[0] + xx * pull_x + xy * pull_y - before[0],
        guess[1] + xy * pull_x + yy * pull_y - before[1],
        guess[2] + track[FOUND + _DV + 2] - before[2],
    )
    known = track[BEFORE_SIGMA] * track[BEFORE_SIGMA]
    error_xx = math.sqrt(xx + known)
    error_yx = xy / error_xx
    error_yy = math.sqrt(yy + known - error_yx * error_yx)
    _, _, otherwise, _ = _estimate(track)
    spin, track[FOUND_MILD] = spin_behind_bounce(
        before,
        change,
        (error_xx, error_yx, error_yy),
        vec_at(track, PULL),
        track[AGREE:GUESS].reshape(3, 3),
        _SATURATION * norm(before),
        track[MILD],
        otherwise,
        POINTS,
    )
    track[SPIN], track[SPIN + 1], track[SPIN + 2] = _believed(spin)


@kernel
def _take(track: Array, seen: Array, moment: float, position_noise: float, velocity_noise: float) -> None:
    """Add a sample to the fit, and solve it."""
    _advance(track, moment - track[MOMENT])
    position, velocity = max(position_noise, LEAST_POSITION_NOISE), max(velocity_noise, LEAST_VELOCITY_NOISE)
    share, hidden = _saturation(track)
    unit = share * _LIFT * SPIN_SIGMA
    row = np.empty(UNKNOWNS)
    for k in range(3):
        axis = (1.0 if k == 0 else 0.0, 1.0 if k == 1 else 0.0, 1.0 if k == 2 else 0.0)
        row[:] = 0.0
        row[k], row[_DV + k] = 1.0, track[LEFT_PATH]
        # (w x X)_k = w . (X x e_k), and what shows of w is a symmetric map
        lift = _shown(unit, hidden, cross(vec_at(track, PATH), axis))
        row[_SPIN], row[_SPIN + 1], row[_SPIN + 2] = lift[0], lift[1], lift[2]
        row[_DRAG] = DRAG_SIGMA * track[SLOWED_PATH + k]
        _weigh_in(track, row, seen[k] - track[POS + k], position)
        row[:] = 0.0
        row[_DV + k] = track[LEFT]
        lift = _shown(unit, hidden, cross(vec_at(track, WAY), axis))
        row[_SPIN], row[_SPIN + 1], row[_SPIN + 2] = lift[0], lift[1], lift[2]
        row[_DRAG] = DRAG_SIGMA * track[SLOWED + k]
        _weigh_in(track, row, seen[3 + k] - track[VEL + k], velocity)
    lower = np.empty((UNKNOWNS, UNKNOWNS))
    factor(track[NORMAL:RIGHT].reshape(UNKNOWNS, UNKNOWNS), lower)
    substitute(lower, track[RIGHT:PRESENT], track[FOUND:NORMAL])
    if track[FORESEEN] == 1.0 and track[MOMENT] - track[BEGUN] < TELLING:
        _tell_spin(track, lower)


@kernel
def _to_table(pos: Vec, vel: Vec, spin: Vec, drag: float) -> tuple[float, Vec, Vec]:
    """Return in how long a falling ball is down on the table's height [s], and its position and velocity then.

    Longer than ``_LONGEST``: it doesn't come down so soon. A ball that is down already is flown back.
    """
    gone = 0.0
    while gone < _LONGEST:
        following, speed = flight_step(pos, vel, spin, _STEP, drag, 1.0, SIMPLE)
        if following[2] < BALL_RADIUS and speed[2] < 0.0:
            h = _STEP
            there, then = following, speed
            for _ in range(3):  # Newton: the fall is nearly uniform
                h += (BALL_RADIUS - there[2]) / min(then[2], -0.1)
                # A ball that was seen below the table may never have been above it
                h = min(max(h, -_STEP), 2.0 * _STEP)
                there, then = flight_step(pos, vel, spin, h, drag, 1.0, SIMPLE)
            return gone + h, there, then
        pos, vel = following, speed
        gone += _STEP
    return 2.0 * _LONGEST, pos, vel


@kernel
def _fly(pos: Vec, vel: Vec, spin: Vec, drag: float, duration: float) -> tuple[Vec, Vec]:
    """Return position and velocity ``duration`` seconds later; it may be negative."""
    steps = max(1, math.ceil(abs(duration) / _STEP))
    for _ in range(steps):
        pos, vel = flight_step(pos, vel, spin, duration / steps, drag, 1.0, SIMPLE)
    return pos, vel


@kernel
def _through_bounce(
    vel: Vec, shown: Vec, expected: float, sigma: float, variance: Array, covariance: Array
) -> tuple[Vec, Vec]:
    """Return velocity and spin to be expected behind the bounce, and write their covariance (6, 6).

    Args:
        vel: Velocity before it [m/s].
        shown: Spin before it, as the flight shows it [rad/s].
        expected: By how much faster it is expected to spin [-].
        sigma: Of that [-].
        variance: Of the fit's unknowns (10, 10).
        covariance: Written.
    """
    spin = scale(expected, shown)
    square, spread = np.empty((3, 3)), np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            fit = SPIN_SIGMA * SPIN_SIGMA * variance[_SPIN + i, _SPIN + j]
            square[i, j] = expected * expected * fit + sigma * sigma * (fit + shown[i] * shown[j])
    factor(square, spread)
    points = np.empty((10, 6))
    reach = math.sqrt(5.0)
    for p in range(10):
        axis, by = p // 2, reach if p % 2 == 0 else -reach
        turned = spin
        if axis < 3:
            turned = (
                spin[0] + (by * spread[0, 0] if axis == 0 else 0.0),
                spin[1] + (by * spread[1, axis] if axis <= 1 else 0.0),
                spin[2] + by * spread[2, axis],
            )
        restitution = TABLE_RESTITUTION0_MEAN + (by * TABLE_RESTITUTION0_SIGMA if axis == 3 else 0.0)
        friction = TABLE_FRICTION_MEAN + (by * TABLE_FRICTION_SIGMA if axis == 4 else 0.0)
        v, w = table_bounce(vel, turned, (0.0, 0.0, 1.0), restitution, friction)
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
                total += BOUNCE_SPEED_SIGMA**2 if i < 3 else BOUNCE_SPIN_SIGMA**2
            covariance[i, j] = total
    return (mean[0], mean[1], mean[2]), (mean[3], mean[4], mean[5])


@kernel
def _begin_anew(
    track: Array,
    moment: float,
    pos: Vec,
    vel: Vec,
    spin: Vec,
    covariance: Array,
    drag: float,
    drag_variance: float,
) -> None:
    """Let the fit begin at the bounce, with what was known of it as its prior."""
    lower, weight = np.empty((6, 6)), np.empty((6, 6))
    factor(covariance, lower)
    inverse(lower, weight)
    track[:BOUNCED] = 0.0
    track[FOUND:PRESENT] = 0.0
    for k in range(3):
        track[POS + k], track[VEL + k], track[NOMINAL_SPIN + k] = pos[k], vel[k], spin[k]
    track[NOMINAL_DRAG], track[LEFT] = drag, 1.0
    track[MOMENT], track[BEGUN] = moment, moment
    for k in range(3):
        track[NORMAL + k * UNKNOWNS + k] = 1.0 / (BOUNCE_PLACE_SIGMA * BOUNCE_PLACE_SIGMA)
    for i in range(6):
        for j in range(i + 1):
            unit = (SPIN_SIGMA if i >= 3 else 1.0) * (SPIN_SIGMA if j >= 3 else 1.0)
            track[NORMAL + (_DV + i) * UNKNOWNS + _DV + j] = unit * weight[i, j]
    track[NORMAL + UNKNOWNS * UNKNOWNS - 1] = 1.0 / drag_variance
    track[BOUNCED] = 1.0


@kernel
def _bounce(track: Array, seen: Array, moment: float, velocity_noise: float) -> None:
    """Take what is known through the bounce, behind which ``seen`` was seen."""
    pos, vel, spin, drag = _estimate(track)
    wait, there, then = _to_table(pos, vel, spin, drag)
    at = track[MOMENT] + wait
    lower, variance = np.empty((UNKNOWNS, UNKNOWNS)), np.empty((UNKNOWNS, UNKNOWNS))
    factor(track[NORMAL:RIGHT].reshape(UNKNOWNS, UNKNOWNS), lower)
    inverse(lower, variance)
    surprises = abs(at - moment) > _SURPRISE or at <= track[BEGUN] or then[2] >= 0.0
    if surprises:
        then = (seen[3], seen[4], -abs(seen[5]))
    covariance = np.empty((6, 6))
    rising, turned = _through_bounce(then, spin, track[FACTOR], track[FACTOR_SIGMA], variance, covariance)
    if surprises:  # where and how fast the ball is is what the sample says, and nothing tells of its spin
        at, there, rising = moment, vec_at(seen, 0), vec_at(seen, 3)
        covariance[:3] = 0.0
        covariance[:, :3] = 0.0
        for k in range(3):
            covariance[k, k] = max(velocity_noise, LEAST_VELOCITY_NOISE) ** 2
    else:
        showing = SPIN_SIGMA * SPIN_SIGMA * variance[_SPIN:_DRAG, _SPIN:_DRAG]
        shown_likelihood(spin, showing, SPIN_SIGMA, track[PULL:AGREE], track[AGREE:GUESS].reshape(3, 3))
        track[BEFORE_SIGMA] = FLIGHT_SHARE * max(velocity_noise, LEAST_VELOCITY_NOISE)
        information = inverse_2(covariance[0, 0], covariance[1, 0], covariance[1, 1])
        for k in range(3):
            track[GUESS_INFORMATION + k] = information[k]
            track[BEFORE + k], track[GUESS + k] = then[k], rising[k]
    track[FORESEEN] = 0.0 if surprises else 1.0
    _begin_anew(track, at, there, rising, turned, covariance, drag, variance[_DRAG, _DRAG])


@kernel
def follow(
    track: Array, seen: Array, moment: float, bounced: bool, position_noise: float, velocity_noise: float
) -> None:
    """Let a sample correct the estimate.

    Args:
        track: (TRACK,); written.
        seen: Position [m] and velocity [m/s], first six numbers.
        moment: When it was taken, on the same clock [s]; no later than the last: nothing new.
        bounced: Whether it was taken behind the bounce.
        position_noise: Its sigma a axis [m].
        velocity_noise: [m/s].
    """
    if moment <= track[MOMENT]:
        return
    if bounced and track[BOUNCED] == 0.0:
        _bounce(track, seen, moment, velocity_noise)
    _take(track, seen, moment, position_noise, velocity_noise)


@kernel
def predict(track: Array, now: float) -> None:
    """Write where the ball is ``now`` [s, on the samples' clock], and how it will come to be met."""
    pos, vel, spin, drag = _estimate(track)
    ahead = now - track[MOMENT]
    until = MEETING_AFTER - (track[MOMENT] - track[BEGUN])  # from the last sample to the meeting
    here, speed = pos, vel
    if track[BOUNCED] == 0.0:
        wait, there, then = _to_table(pos, vel, spin, drag)
        if ahead < wait:
            here, speed = _fly(pos, vel, spin, drag, min(ahead, _LONGEST))
        if wait > _LONGEST:  # not down so soon: as far as is foretold
            until = _LONGEST
        else:
            flat = (then[0], then[1], min(then[2], -0.1))
            pos = there
            vel, spin = table_bounce(
                flat,
                scale(track[FACTOR], spin),
                (0.0, 0.0, 1.0),
                TABLE_RESTITUTION0_MEAN,
                TABLE_FRICTION_MEAN,
            )
            if ahead >= wait:
                here, speed = _fly(pos, vel, spin, drag, ahead - wait)
            until = wait + MEETING_AFTER
            there, then = _fly(pos, vel, spin, drag, MEETING_AFTER)
    else:
        here, speed = _fly(pos, vel, spin, drag, ahead)
        there, then = _fly(pos, vel, spin, drag, until)
    track[MEETING] = until - ahead
    for k in range(3):
        track[PRESENT + k], track[PRESENT + 3 + k] = here[k], speed[k]
        track[MEETING + 1 + k], track[MEETING + 4 + k] = there[k], then[k]
        if track[FORESEEN] == 0.0:
            track[SPIN + k] = spin[k]

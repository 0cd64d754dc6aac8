"""The camera filter: position, velocity and trajectory state of the ball, estimated from a camera's detections alone.

It is causal least squares against the flight model (ADR-0019). Position, velocity and the acceleration in excess of
the nominal ball's are fitted to the detections since the last touch. The fit has the freedom of a quadratic, and a
prior keeps the extra acceleration small unless the detections require it. It is solved detection by detection, with a
normal matrix (3, 3) per axis, so the cost of a detection does not grow with their number (a Kalman filter).

- A bounce on the table is predicted. The fit continues through it by the nominal table law, with the spin that the
  extra acceleration implies. Its covariance grows by the uncertainty of friction and spin.
- A detection far from the prediction is rejected and stored. If the next one is far from it as well, and both lie on
  one path, the ball was touched: the fit starts again from these two. The change of velocity shows whether it was the
  racket or the table.
- Lost detections need no special case: the estimate flies on.
- For a moment before the last detection the estimate flies back, across a touch into the path before it.

A ball's estimate is one row of numbers. The same functions serve the environment, ball by ball, and recorded tracks.
"""

import math
from typing import Final

import numpy as np
import numpy.typing as npt

from common.jit import kernel
from common.perception.flight_track import COMING, SERVED
from common.perception.nominal_motion import (
    MAX_HORIZON,
    MAX_STEP,
    BallMotion,
    bounce,
    closest_approach,
    glide,
    state_after_bounce,
    state_after_touch,
    time_to_table,
)
from common.physics.vec import Vec, dot, norm, scale, sub, vec_at

Array = npt.NDArray[np.float64]

# Columns of a ball's row
MOMENT, POS, VEL, EXTRA = 0, 1, 4, 7  # time [s], position [m], velocity [m/s], extra acceleration [m/s^2]
COVARIANCE = (
    10  # of position (p), velocity (v), extra acceleration (e), per axis: pp, pv, pe, vv, ve, ee (18)
)
COUNT = 28  # detections accepted since the fit started
STATE = 29  # trajectory state 0..3, or SERVED
TOUCH = 30  # time of the last touch [s]; NO_TOUCH if there was none
BEFORE_TOUCH = 31  # position, velocity and extra acceleration just before it (9)
STATE_BEFORE_TOUCH = 40
REJECTED = 41  # time and position of the last rejected detection (4)
REJECTED_COUNT = 45  # consecutive rejected detections
ACCEPTED_MOMENT = 46  # time of the last accepted detection [s]
ESTIMATE: Final = 47  # numbers in a row

NO_TOUCH: Final = -1.0e9  # [s]
MIN_SIGMA: Final = 0.0005  # [m] of a detection: a camera without noise still leaves the error of the model

# Prior of a fit that starts with one detection: balls come towards the robot
FIRST_SPEED: Final = -6.0  # [m/s] along x
SPEED_SIGMA: Final = 8.0  # [m/s] an axis
# Prior of the extra acceleration. It grows with |v|^2: the lift of spin, C_L up to 0.27, and the deviation of the drag
# factor
EXTRA_PER_SPEED2: Final = 0.05  # [1/m] its sigma divided by |v|^2
MIN_EXTRA_SIGMA: Final = 1.5  # [m/s^2]
MAX_EXTRA: Final = 60.0  # [m/s^2] lift at 28 m/s
EXTRA_DRIFT: Final = 3.0  # [m/s^2/sqrt(s)] its random walk
# Uncertainty of the nominal table law: friction, restitution, and spin that the flight does not show
BOUNCE_ALONG_SIGMA: Final = 0.35  # [m/s] of the velocity along the table
BOUNCE_RESTITUTION_SIGMA: Final = 0.03  # [-] of the restitution
BOUNCE_POSITION_SIGMA: Final = 0.002  # [m] of the position, due to the time of the bounce

# Squared distance from the prediction, in sigmas (3 axes), up to which a detection is accepted
GATE: Final = 30.0
MIN_FIT_COUNT: Final = 4  # detections: a fit with fewer has no path that a touch must lie on
MIN_ESTIMATE_COUNT: Final = 12  # accepted detections, from which on the data outweigh the prior
MAX_PAIR_GAP: Final = 0.030  # [s] between two rejected detections of one path: five of the camera's periods
MAX_SPEED: Final = 35.0  # [m/s] no ball in play is faster
PATH_GATE: Final = 25.0  # [-] squared distance between old and new path at a touch, in sigmas of the new
TOUCH_MARGIN: Final = 0.004  # [s] a touch may lie this long before the last accepted detection


@kernel
def _read_motion(row: Array, at: int) -> BallMotion:
    return vec_at(row, at), vec_at(row, at + 3), vec_at(row, at + 6)


@kernel
def _write_motion(row: Array, at: int, pos: Vec, vel: Vec, extra: Vec) -> None:
    for k in range(3):
        row[at + k], row[at + 3 + k], row[at + 6 + k] = pos[k], vel[k], extra[k]


@kernel
def _start_fit(row: Array, moment: float, pos: Vec, vel: Vec, sigma: float) -> None:
    """Start a fit with one detection and the prior ``vel`` of its velocity."""
    row[MOMENT] = moment
    _write_motion(row, POS, pos, vel, (0.0, 0.0, 0.0))
    extra = max(MIN_EXTRA_SIGMA, EXTRA_PER_SPEED2 * min(dot(vel, vel), MAX_SPEED * MAX_SPEED))
    for axis in range(3):
        c = row[COVARIANCE + 6 * axis : COVARIANCE + 6 * axis + 6]
        c[0], c[1], c[2] = sigma * sigma, 0.0, 0.0
        c[3], c[4], c[5] = SPEED_SIGMA * SPEED_SIGMA, 0.0, extra * extra
    row[COUNT], row[ACCEPTED_MOMENT] = 1.0, moment
    row[REJECTED_COUNT] = 0.0


@kernel
def _propagate_covariance(row: Array, h: float) -> None:
    """Propagate the covariance over ``h`` seconds of flight."""
    drift = EXTRA_DRIFT * EXTRA_DRIFT * h
    g = 0.5 * h * h
    for axis in range(3):
        c = row[COVARIANCE + 6 * axis : COVARIANCE + 6 * axis + 6]
        pp, pv, pe, vv, ve, ee = c[0], c[1], c[2], c[3], c[4], c[5]
        c[0] = pp + h * (2.0 * pv + h * vv) + g * (2.0 * pe + 2.0 * h * ve + g * ee)
        c[1] = pv + h * (pe + vv) + h * h * ve + g * (ve + h * ee)
        c[2] = pe + h * ve + g * ee
        c[3] = vv + h * (2.0 * ve + h * ee)
        c[4] = ve + h * ee
        c[5] = ee + drift


@kernel
def _widen_covariance(row: Array, before: Vec, after: Vec) -> None:
    """Change the covariance by a bounce with velocities ``before`` and ``after``."""
    extra = max(MIN_EXTRA_SIGMA, EXTRA_PER_SPEED2 * dot(after, after))
    reversal = after[2] / min(before[2], -0.1)  # -e_n: the bounce mirrors height and fall
    for axis in range(3):
        c = row[COVARIANCE + 6 * axis : COVARIANCE + 6 * axis + 6]
        factor = reversal if axis == 2 else 1.0
        speed_sigma = BOUNCE_RESTITUTION_SIGMA * before[2] if axis == 2 else BOUNCE_ALONG_SIGMA
        c[0] = factor * factor * c[0] + BOUNCE_POSITION_SIGMA * BOUNCE_POSITION_SIGMA
        c[1] = factor * factor * c[1]
        c[3] = factor * factor * c[3] + speed_sigma * speed_sigma
        c[2], c[4], c[5] = 0.0, 0.0, extra * extra


@kernel
def _predict(row: Array, moment: float) -> None:
    """Fly the fit to ``moment``, through bounces on the table."""
    pos, vel, extra = _read_motion(row, POS)
    rest = min(moment - row[MOMENT], MAX_HORIZON)
    now = moment - rest
    while rest > 0.0:
        h = min(rest, MAX_STEP)
        later = glide(pos, vel, extra, h)
        table_time = time_to_table(pos, vel, later[0], h)
        if table_time < 0.0:
            pos, vel, extra = later
            _propagate_covariance(row, h)
        else:
            h = table_time
            pos, vel, extra = glide(pos, vel, extra, h)
            _propagate_covariance(row, h)
            row[TOUCH], row[STATE_BEFORE_TOUCH] = now + h, row[STATE]
            _write_motion(row, BEFORE_TOUCH, pos, vel, extra)
            after, extra = bounce(vel, extra)
            _widen_covariance(row, vel, after)
            vel = after
            row[STATE] = state_after_bounce(int(row[STATE]), pos)
        now += h
        rest -= h
    row[MOMENT] = moment
    _write_motion(row, POS, pos, vel, extra)


@kernel
def _squared_distance(row: Array, pos: Vec, sigma: float) -> float:
    """Return a detection's squared distance from the prediction, in sigmas of both."""
    total = 0.0
    for axis in range(3):
        off = pos[axis] - row[POS + axis]
        total += off * off / (row[COVARIANCE + 6 * axis] + sigma * sigma)
    return total


@kernel
def _limit(vector: Array, most: float) -> None:
    """Shorten a vector (3,) to a length of at most ``most``."""
    length = math.sqrt(vector[0] * vector[0] + vector[1] * vector[1] + vector[2] * vector[2])
    if length > most:
        for k in range(3):
            vector[k] *= most / length


@kernel
def _update(row: Array, pos: Vec, sigma: float) -> None:
    """Correct the fit by an accepted detection at the fit's moment."""
    for axis in range(3):
        c = row[COVARIANCE + 6 * axis : COVARIANCE + 6 * axis + 6]
        pp, pv, pe = c[0], c[1], c[2]
        gain = 1.0 / (pp + sigma * sigma)
        off = gain * (pos[axis] - row[POS + axis])
        row[POS + axis] += pp * off
        row[VEL + axis] += pv * off
        row[EXTRA + axis] += pe * off
        c[3] -= gain * pv * pv
        c[4] -= gain * pv * pe
        c[5] -= gain * pe * pe
        shrink = gain * sigma * sigma
        c[0], c[1], c[2] = shrink * pp, shrink * pv, shrink * pe
    # Bounds for any detections: no ball in play is faster, and the air accelerates no ball more
    _limit(row[VEL : VEL + 3], MAX_SPEED)
    v = row[VEL : VEL + 3]
    square = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
    _limit(row[EXTRA : EXTRA + 3], min(4.0 * max(MIN_EXTRA_SIGMA, EXTRA_PER_SPEED2 * square), MAX_EXTRA))
    row[COUNT], row[ACCEPTED_MOMENT] = row[COUNT] + 1.0, row[MOMENT]
    row[REJECTED_COUNT] = 0.0


@kernel
def _restart(row: Array, first: Vec, first_moment: float, second: Vec, moment: float, sigma: float) -> bool:
    """Start the fit again from two rejected detections if they lie on one path that meets the old one.

    Args:
        row: (ESTIMATE,), predicted to ``moment``; written.
        first: Position of the first detection [m].
        first_moment: Its time stamp [s].
        second: Position of the second detection [m].
        moment: Its time stamp [s].
        sigma: Noise of the detections [m] an axis.

    Returns:
        Whether the fit was started again.
    """
    h = moment - first_moment
    vel = scale(1.0 / h, sub(second, first))
    if norm(vel) > MAX_SPEED:
        return False
    pos, old_vel, extra = _read_motion(row, POS)
    # Time 0 of both paths is ``moment``. The touch lies between the last accepted detection and the first rejected one.
    # It may lie a little earlier: a detection right after a touch may still fit the old path
    since = min(row[ACCEPTED_MOMENT] - TOUCH_MARGIN, first_moment) - moment
    when, squared_gap = closest_approach(pos, old_vel, second, vel, since, -h)
    noise = sigma * (0.5 - when / h)
    is_path = squared_gap < PATH_GATE * noise * noise
    if row[COUNT] >= MIN_FIT_COUNT and row[REJECTED_COUNT] < 2.0 and not is_path:
        return False
    touch_pos, touch_vel, touch_extra = glide(pos, old_vel, extra, when)
    if row[COUNT] >= MIN_FIT_COUNT:
        row[STATE_BEFORE_TOUCH] = row[STATE]
        row[TOUCH] = moment + when
        _write_motion(row, BEFORE_TOUCH, touch_pos, touch_vel, touch_extra)
        row[STATE] = state_after_touch(int(row[STATE]), touch_pos, touch_vel, vel)
    _start_fit(row, first_moment, first, vel, sigma)
    _predict(row, moment)
    _update(row, second, sigma)
    return True


@kernel
def begin_filter(row: Array, moment: float, pos: Vec, sigma: float, state: int) -> None:
    """Begin a track with its first detection.

    Args:
        row: (ESTIMATE,); written.
        moment: Time stamp [s].
        pos: Of the detection [m].
        sigma: Noise of the detections [m] an axis.
        state: Trajectory state at the start: ``COMING``, or ``SERVED`` if the opponent serves, which the rules tell.
    """
    row[STATE], row[STATE_BEFORE_TOUCH], row[TOUCH] = state, state, NO_TOUCH
    _start_fit(row, moment, pos, (FIRST_SPEED, 0.0, 0.0), max(sigma, MIN_SIGMA))


@kernel
def add_detection(row: Array, moment: float, pos: Vec, sigma: float) -> bool:
    """Correct the estimate by a detection; return whether it was accepted.

    Args:
        row: (ESTIMATE,); written.
        moment: Time stamp [s], later than that of the detection before.
        pos: Of the detection [m].
        sigma: Noise of the detections [m] an axis.
    """
    if not (moment > row[MOMENT] and math.isfinite(pos[0] + pos[1] + pos[2])):
        return False
    sigma = max(sigma, MIN_SIGMA)
    _predict(row, moment)
    if _squared_distance(row, pos, sigma) <= GATE:
        _update(row, pos, sigma)
        return True
    rejected = row[REJECTED : REJECTED + 4]
    is_pair = row[REJECTED_COUNT] > 0.0 and moment - rejected[0] < MAX_PAIR_GAP
    if is_pair and _restart(row, vec_at(rejected, 1), rejected[0], pos, moment, sigma):
        return True
    row[REJECTED_COUNT] += 1.0
    rejected[0], rejected[1], rejected[2], rejected[3] = moment, pos[0], pos[1], pos[2]
    return False


@kernel
def estimate_at(row: Array, moment: float) -> tuple[Vec, Vec, int]:
    """Return position [m], velocity [m/s] and trajectory state at any moment, before or after the last detection.

    Args:
        row: (ESTIMATE,).
        moment: Time of the estimate [s].
    """
    if moment < row[TOUCH] and row[TOUCH] <= row[MOMENT]:
        pos, vel, extra = _read_motion(row, BEFORE_TOUCH)
        state, rest = int(row[STATE_BEFORE_TOUCH]), moment - row[TOUCH]
    else:
        pos, vel, extra = _read_motion(row, POS)
        state, rest = int(row[STATE]), moment - row[MOMENT]
    rest = min(max(rest, -MAX_HORIZON), MAX_HORIZON)
    while abs(rest) > 0.0:
        h = min(max(rest, -MAX_STEP), MAX_STEP)
        later = glide(pos, vel, extra, h)
        table_time = time_to_table(pos, vel, later[0], h) if h > 0.0 else -1.0
        if table_time < 0.0:
            pos, vel, extra = later
        else:
            h = table_time
            pos, vel, extra = glide(pos, vel, extra, h)
            vel, extra = bounce(vel, extra)
            state = state_after_bounce(state, pos)
        rest -= h
    return pos, vel, state


@kernel
def is_guess(row: Array) -> bool:
    """Return whether an estimate still rests mostly on the prior of its fit."""
    few: bool = row[COUNT] < MIN_ESTIMATE_COUNT
    return few


@kernel
def _track(
    times: Array, positions: Array, latency: float, sigma: float, first_state: int, out: Array
) -> None:
    row = np.zeros(ESTIMATE)
    for k in range(times.shape[0]):
        detection = vec_at(positions[k], 0)
        if k == 0:
            begin_filter(row, times[0], detection, sigma, first_state)
        else:
            add_detection(row, times[k], detection, sigma)
        pos, vel, state = estimate_at(row, times[k] + latency)
        for j in range(3):
            out[k, j], out[k, 3 + j] = pos[j], vel[j]
        out[k, 6] = state


def track(
    times: Array, positions: Array, latency: float = 0.0, sigma: float = 0.002, *, is_serve: bool = False
) -> Array:
    """Return causal estimates (n, 7) of a recorded ball: position [m], velocity [m/s], trajectory state.

    Row k uses detections 0..k, and is the estimate for the moment ``times[k] + latency``.

    Args:
        times: Time stamps [s] (n,), increasing.
        positions: Table frame [m] (n, 3).
        latency: Time from each detection to its estimate [s].
        sigma: Noise of the detections [m] an axis.
        is_serve: Whether the ball bounces on the server's own court first; its state is ``SERVED`` until then.
    """
    if positions.shape != (len(times), 3) or len(times) == 0:
        raise ValueError(
            f"times of shape {times.shape} and positions of shape {positions.shape}; allowed: (n,) and (n, 3), n > 0"
        )
    if not (np.all(np.diff(times) > 0.0) and np.isfinite(times).all() and np.isfinite(positions[0]).all()):
        raise ValueError(
            "times or first position not finite, or times not increasing; allowed: finite and increasing times, and a "
            "finite first position"
        )
    out = np.empty((len(times), 7))
    _track(
        np.ascontiguousarray(times, np.float64),
        np.ascontiguousarray(positions, np.float64),
        latency,
        sigma,
        SERVED if is_serve else COMING,
        out,
    )
    return out

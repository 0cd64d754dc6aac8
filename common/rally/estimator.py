"""Where the ball is, how fast, and in which state: a causal estimate from a camera's shots alone.

Least squares against the flight model: what is fitted to the shots since the last touch is position, velocity and
the acceleration beyond the nominal ball's (gravity and drag of a ball without spin), which is spin's and a draught's.
That keeps a quadratic's freedom and pays for it only as far as the shots ask for it. It is solved shot by shot, a
normal matrix (3, 3) an axis, so that a shot costs the same however long the window (a Kalman filter, in other words).

- A bounce on the table is foreseen: the fit goes through it by the nominal table law, with the spin that the
  acceleration tells of, and becomes as uncertain as friction and spin leave it.
- A shot off the prediction is left out and remembered. If the next one is off too and both lie on one path, the ball
  was touched: the fit begins anew from them. Whether it was racket or table is told by how the velocity changed.
- Lost shots need nothing: the estimate flies on.
- Asked for a moment before the last shot, the estimate flies back, over a touch into the path before it.

A ball's estimate is one row of numbers. The same functions serve the environment, ball by ball, and recorded tracks.
"""

import math
from typing import Final

import numpy as np
import numpy.typing as npt

from common.jit import kernel
from common.physics.constants import (
    AIR_FACTOR,
    BALL_RADIUS,
    TABLE_FRICTION,
    TABLE_HALF_LENGTH,
    TABLE_HALF_WIDTH,
    TABLE_RESTITUTION0,
)
from common.physics.flight import SIMPLE, SIMPLE_LIFT_SLOPE, acceleration
from common.physics.table_bounce import table_bounce
from common.physics.vec import Vec, add, axpy, cross, dot, norm, scale, sub

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

# A ball's row: moment [s], position [m], velocity [m/s], acceleration beyond the nominal [m/s^2] ...
MOMENT, POS, VEL, EXTRA = 0, 1, 4, 7
COVARIANCE = 10  # ... and per axis their covariance: pp, pv, pe, vv, ve, ee
COUNT = 28  # shots believed since the fit began
STATE = 29  # trajectory state 0..3
TOUCH = 30  # moment of the last touch [s]; FIRST before any
BEFORE = 31  # position, velocity, acceleration beyond the nominal right before it (9)
BEFORE_STATE = 40
SUSPECT = 41  # moment and position of a shot that was not believed (4)
SUSPECTS = 45  # how many in a row
BELIEVED = 46  # moment of the last shot that was believed [s]
ESTIMATE: Final = 47  # numbers in a row

FIRST: Final = -1.0e9  # [s] a touch that never was
SMALLEST_SIGMA: Final = 0.0005  # [m] of a shot: a camera without noise still has a model beside it

# Before the second shot, all that is known is that balls come towards the robot
FIRST_SPEED: Final = -6.0  # [m/s] along x
SPEED_SIGMA: Final = 8.0  # [m/s] a axis, of a fit without a past
# The acceleration beyond the nominal grows with |v|^2: spin's lift, C_L up to 0.27, and what the drag factor leaves
EXTRA_PER_SPEED2: Final = 0.05  # [1/m] sigma of it by |v|^2
SMALLEST_EXTRA: Final = 1.5  # [m/s^2] sigma of it at least
LARGEST_EXTRA: Final = 60.0  # [m/s^2] of it: lift at 28 m/s
EXTRA_DRIFT: Final = 3.0  # [m/s^2/sqrt(s)] by how much it wanders
# What the nominal table law leaves open: friction, restitution, and the spin that can't be seen
BOUNCE_ALONG: Final = 0.35  # [m/s] sigma of the velocity along the table
BOUNCE_RESTITUTION: Final = 0.03  # [-] sigma of the restitution
BOUNCE_PLACE: Final = 0.002  # [m] sigma that the bounce's own moment adds

GATE: Final = 30.0  # squared distance from the prediction, in sigmas, that a shot is believed up to (3 axes)
YOUNG: Final = 4  # shots: a fit with fewer has no path that a touch would have to lie on
FEWEST_SHOTS: Final = 12  # believed, before an estimate is more than a guess
LONGEST_PAIR: Final = 0.030  # [s] between two unbelieved shots of one path: five of the camera's periods
FASTEST: Final = 35.0  # [m/s] no ball in play is faster
PATH_SIGMAS: Final = 25.0  # [-] squared distance between old and new path at a touch, in sigmas of the new
BEFORE_BELIEVED: Final = 0.004  # [s]
HIT: Final = 2.5  # [m/s] a change of the velocity towards the opponent beyond this is a racket's
_LONGEST_STEP: Final = 0.010  # [s] a midpoint step of that length errs by 2e-5 m at 10 m/s
_LOW: Final = 0.08  # [m] below this height of its centre a ball may have met the table
_UNDER: Final = -0.03  # [m] a ball whose centre is deeper has passed the table's edge
_NEAR_TABLE: Final = 0.03  # [m] by how much a bounce may seem to lie beside the table
_LONGEST_FLIGHT: Final = 1.0  # [s] an estimate flies no further: whoever asks for more gets that

Body = tuple[Vec, Vec, Vec]  # position, velocity, acceleration beyond the nominal


@kernel
def _turned(extra: Vec, vel: Vec, later: Vec) -> Vec:
    """Return an extra acceleration as the velocity changes: its part across is spin's, along it is drag's.

    With w = v x e / (K |v|^2) the lift K w x v' is (v x e) x v' / |v|^2, whatever K is; drag goes with |v|^2. A ball
    that gets faster keeps the part along: a wrong one that pushes would feed on itself.
    """
    square = dot(vel, vel)
    if square < 1.0:  # too slow to tell across from along; the air does next to nothing
        return extra
    share = dot(extra, vel) / square
    across = scale(1.0 / square, cross(cross(vel, extra), later))
    return axpy(share * min(norm(later) / math.sqrt(square), 1.0), later, across)


@kernel
def _glide(pos: Vec, vel: Vec, extra: Vec, h: float) -> Body:
    """Return the ball ``h`` seconds on (or back), with no touch: one midpoint step."""
    none = (0.0, 0.0, 0.0)
    start = add(acceleration(vel, none, 1.0, 1.0, SIMPLE), extra)
    middle = axpy(0.5 * h, start, vel)
    rate = add(acceleration(middle, none, 1.0, 1.0, SIMPLE), _turned(extra, vel, middle))
    later = axpy(h, rate, vel)
    return axpy(h, middle, pos), later, _turned(extra, vel, later)


@kernel
def _meets_table(pos: Vec, vel: Vec, after: Vec, h: float) -> float:
    """Return when within ``h`` seconds a falling ball meets the table, or -1; ``after`` is where it would be."""
    if vel[2] >= 0.0 or after[2] >= BALL_RADIUS or pos[2] < _UNDER:
        return -1.0
    if abs(after[0]) > TABLE_HALF_LENGTH + _NEAR_TABLE or abs(after[1]) > TABLE_HALF_WIDTH + _NEAR_TABLE:
        return -1.0
    height, fall = pos[2] - BALL_RADIUS, -vel[2]
    if height <= 0.0:
        return 0.0
    # the parabola through both heights with the first's speed
    curve = (pos[2] - fall * h - after[2]) / (h * h)
    return min(2.0 * height / (fall + math.sqrt(max(fall * fall + 4.0 * curve * height, 0.0))), h)


@kernel
def _bounced(vel: Vec, extra: Vec) -> tuple[Vec, Vec]:
    """Return velocity and extra acceleration after the nominal table, for the spin that the latter tells of."""
    square = max(dot(vel, vel), 1.0)
    per_spin = AIR_FACTOR * SIMPLE_LIFT_SLOPE * BALL_RADIUS
    spin = scale(1.0 / (per_spin * square), cross(vel, extra))
    after, turned = table_bounce(vel, spin, (0.0, 0.0, 1.0), TABLE_RESTITUTION0, TABLE_FRICTION)
    drag = dot(extra, vel) / square
    lift = scale(per_spin, cross(turned, after))
    return after, axpy(drag * norm(after) / math.sqrt(square), after, lift)


@kernel
def _bounced_state(state: int, pos: Vec) -> int:
    """Return the trajectory state after a bounce on the table."""
    if state == 0 and pos[0] < 0.0:
        return 1
    if state == 2 and pos[0] > 0.0:
        return 3
    return state


@kernel
def _body(row: Array, at: int) -> Body:
    return (
        (row[at], row[at + 1], row[at + 2]),
        (row[at + 3], row[at + 4], row[at + 5]),
        (row[at + 6], row[at + 7], row[at + 8]),
    )


@kernel
def _put(row: Array, at: int, pos: Vec, vel: Vec, extra: Vec) -> None:
    for k in range(3):
        row[at + k], row[at + 3 + k], row[at + 6 + k] = pos[k], vel[k], extra[k]


@kernel
def _begin_fit(row: Array, moment: float, pos: Vec, vel: Vec, sigma: float) -> None:
    """Begin a fit with one shot, and a velocity that is a guess."""
    row[MOMENT] = moment
    _put(row, POS, pos, vel, (0.0, 0.0, 0.0))
    extra = max(SMALLEST_EXTRA, EXTRA_PER_SPEED2 * min(dot(vel, vel), FASTEST * FASTEST))
    for axis in range(3):
        c = row[COVARIANCE + 6 * axis : COVARIANCE + 6 * axis + 6]
        c[0], c[1], c[2] = sigma * sigma, 0.0, 0.0
        c[3], c[4], c[5] = SPEED_SIGMA * SPEED_SIGMA, 0.0, extra * extra
    row[COUNT], row[BELIEVED] = 1.0, moment
    row[SUSPECTS] = 0.0


@kernel
def _grow(row: Array, h: float) -> None:
    """Let the covariance fly for ``h`` seconds."""
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
def _open_up(row: Array, before: Vec, after: Vec) -> None:
    """Make the covariance as wide as a bounce leaves it."""
    extra = max(SMALLEST_EXTRA, EXTRA_PER_SPEED2 * dot(after, after))
    back = after[2] / min(before[2], -0.1)  # -e_n: height and fall are mirrored
    for axis in range(3):
        c = row[COVARIANCE + 6 * axis : COVARIANCE + 6 * axis + 6]
        turn = back if axis == 2 else 1.0
        open_speed = BOUNCE_RESTITUTION * before[2] if axis == 2 else BOUNCE_ALONG
        c[0] = turn * turn * c[0] + BOUNCE_PLACE * BOUNCE_PLACE
        c[1] = turn * turn * c[1]
        c[3] = turn * turn * c[3] + open_speed * open_speed
        c[2], c[4], c[5] = 0.0, 0.0, extra * extra


@kernel
def _predict(row: Array, moment: float) -> None:
    """Fly the fit to ``moment``, through bounces on the table."""
    pos, vel, extra = _body(row, POS)
    rest = min(moment - row[MOMENT], _LONGEST_FLIGHT)
    now = moment - rest
    while rest > 0.0:
        h = min(rest, _LONGEST_STEP)
        later = _glide(pos, vel, extra, h)
        meets = _meets_table(pos, vel, later[0], h)
        if meets < 0.0:
            pos, vel, extra = later
            _grow(row, h)
        else:
            h = meets
            pos, vel, extra = _glide(pos, vel, extra, h)
            _grow(row, h)
            row[TOUCH], row[BEFORE_STATE] = now + h, row[STATE]
            _put(row, BEFORE, pos, vel, extra)
            after, extra = _bounced(vel, extra)
            _open_up(row, vel, after)
            vel = after
            row[STATE] = _bounced_state(int(row[STATE]), pos)
        now += h
        rest -= h
    row[MOMENT] = moment
    _put(row, POS, pos, vel, extra)


@kernel
def _distance2(row: Array, pos: Vec, sigma: float) -> float:
    """Return a shot's squared distance from the prediction, in sigmas of both."""
    total = 0.0
    for axis in range(3):
        off = pos[axis] - row[POS + axis]
        total += off * off / (row[COVARIANCE + 6 * axis] + sigma * sigma)
    return total


@kernel
def _limit(vector: Array, most: float) -> None:
    """Shorten a vector (3,) to at most ``most``."""
    length = math.sqrt(vector[0] * vector[0] + vector[1] * vector[1] + vector[2] * vector[2])
    if length > most:
        for k in range(3):
            vector[k] *= most / length


@kernel
def _believe(row: Array, pos: Vec, sigma: float) -> None:
    """Let a shot at the fit's moment correct it."""
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
    # Whatever the shots were: a ball in play is no faster, and the air pushes it no harder
    _limit(row[VEL : VEL + 3], FASTEST)
    v = row[VEL : VEL + 3]
    square = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
    _limit(row[EXTRA : EXTRA + 3], min(4.0 * max(SMALLEST_EXTRA, EXTRA_PER_SPEED2 * square), LARGEST_EXTRA))
    row[COUNT], row[BELIEVED] = row[COUNT] + 1.0, row[MOMENT]
    row[SUSPECTS] = 0.0


@kernel
def _meeting(
    pos: Vec, vel: Vec, new_pos: Vec, new_vel: Vec, since: float, until: float
) -> tuple[float, float]:
    """Return when in [since, until] two straight paths come nearest [s], and their squared distance then [m^2].

    Args:
        pos: Of the old path at time 0 [m].
        vel: Of the old path [m/s].
        new_pos: Of the new path at time 0 [m].
        new_vel: Of the new path [m/s].
        since: [s].
        until: [s].
    """
    apart, closing = sub(new_pos, pos), sub(new_vel, vel)
    square = dot(closing, closing)
    when = until
    if square > 0.0:
        when = min(max(-dot(apart, closing) / square, since), until)
    gap = axpy(when, closing, apart)
    return when, dot(gap, gap)


@kernel
def _state_after(state: int, pos: Vec, before: Vec, after: Vec) -> int:
    """Return the trajectory state after a touch that nobody foresaw, by where it was and what it did."""
    over_table = (
        abs(pos[0]) < TABLE_HALF_LENGTH + _NEAR_TABLE and abs(pos[1]) < TABLE_HALF_WIDTH + _NEAR_TABLE
    )
    turned_up = before[2] < 0.0 < after[2]
    pushed = after[0] - before[0]
    if over_table and pos[2] < _LOW and turned_up and after[0] * before[0] > 0.0 and abs(pushed) < 3.0:
        return _bounced_state(state, pos)
    if state == 1 and pushed > HIT:
        return 2
    return state


@kernel
def _restart(row: Array, first: Vec, first_moment: float, second: Vec, moment: float, sigma: float) -> bool:
    """Begin anew from two shots off the prediction, if they lie on one path that meets the old; return whether."""
    h = moment - first_moment
    vel = scale(1.0 / h, sub(second, first))
    if norm(vel) > FASTEST:
        return False
    pos, old_vel, extra = _body(row, POS)
    # Both paths are written from ``moment``. The touch was between the last believed shot (or a little before it: one
    # right after a touch may still look right) and the first that was not
    since = min(row[BELIEVED] - BEFORE_BELIEVED, first_moment) - moment
    when, apart2 = _meeting(pos, old_vel, second, vel, since, -h)
    noise = sigma * (0.5 - when / h)
    is_path = apart2 < PATH_SIGMAS * noise * noise
    if row[COUNT] >= YOUNG and row[SUSPECTS] < 2.0 and not is_path:
        return False
    touched, touched_vel, touched_extra = _glide(pos, old_vel, extra, when)
    if row[COUNT] >= YOUNG:
        row[BEFORE_STATE] = row[STATE]
        row[TOUCH] = moment + when
        _put(row, BEFORE, touched, touched_vel, touched_extra)
        row[STATE] = _state_after(int(row[STATE]), touched, touched_vel, vel)
    _begin_fit(row, first_moment, first, vel, sigma)
    _predict(row, moment)
    _believe(row, second, sigma)
    return True


@kernel
def begin_estimate(row: Array, moment: float, pos: Vec, sigma: float) -> None:
    """Begin a track with its first shot.

    Args:
        row: (ESTIMATE,); written.
        moment: Time stamp [s].
        pos: Of the shot [m].
        sigma: The shots' noise [m] an axis.
    """
    row[STATE], row[BEFORE_STATE], row[TOUCH] = 0.0, 0.0, FIRST
    _begin_fit(row, moment, pos, (FIRST_SPEED, 0.0, 0.0), max(sigma, SMALLEST_SIGMA))


@kernel
def take_shot(row: Array, moment: float, pos: Vec, sigma: float) -> bool:
    """Let a shot correct the estimate; return whether it was believed.

    Args:
        row: (ESTIMATE,); written.
        moment: Time stamp [s], after the one before.
        pos: Of the shot [m].
        sigma: The shots' noise [m] an axis.
    """
    if not (moment > row[MOMENT] and math.isfinite(pos[0] + pos[1] + pos[2])):
        return False
    sigma = max(sigma, SMALLEST_SIGMA)
    _predict(row, moment)
    if _distance2(row, pos, sigma) <= GATE:
        _believe(row, pos, sigma)
        return True
    s = row[SUSPECT : SUSPECT + 4]
    is_pair = row[SUSPECTS] > 0.0 and moment - s[0] < LONGEST_PAIR
    if is_pair and _restart(row, (s[1], s[2], s[3]), s[0], pos, moment, sigma):
        return True
    row[SUSPECTS] += 1.0
    s[0], s[1], s[2], s[3] = moment, pos[0], pos[1], pos[2]
    return False


@kernel
def estimate_at(row: Array, moment: float) -> tuple[Vec, Vec, int]:
    """Return position, velocity and trajectory state 0..3 at any moment: before the last shot, or ahead of it.

    Args:
        row: (ESTIMATE,).
        moment: Asked for [s].
    """
    if moment < row[TOUCH] and row[TOUCH] <= row[MOMENT]:
        pos, vel, extra = _body(row, BEFORE)
        state, rest = int(row[BEFORE_STATE]), moment - row[TOUCH]
    else:
        pos, vel, extra = _body(row, POS)
        state, rest = int(row[STATE]), moment - row[MOMENT]
    rest = min(max(rest, -_LONGEST_FLIGHT), _LONGEST_FLIGHT)
    while abs(rest) > 0.0:
        h = min(max(rest, -_LONGEST_STEP), _LONGEST_STEP)
        later = _glide(pos, vel, extra, h)
        meets = _meets_table(pos, vel, later[0], h) if h > 0.0 else -1.0
        if meets < 0.0:
            pos, vel, extra = later
        else:
            h = meets
            pos, vel, extra = _glide(pos, vel, extra, h)
            vel, extra = _bounced(vel, extra)
            state = _bounced_state(state, pos)
        rest -= h
    return pos, vel, state


@kernel
def is_guess(row: Array) -> bool:
    """Return whether an estimate is, for the most part, still the guess at what balls do that its fit began with."""
    few: bool = row[COUNT] < FEWEST_SHOTS
    return few


@kernel
def _track(times: Array, positions: Array, latency: float, sigma: float, out: Array) -> None:
    row = np.zeros(ESTIMATE)
    for k in range(times.shape[0]):
        shot = (positions[k, 0], positions[k, 1], positions[k, 2])
        if k == 0:
            begin_estimate(row, times[0], shot, sigma)
        else:
            take_shot(row, times[k], shot, sigma)
        pos, vel, state = estimate_at(row, times[k] + latency)
        for j in range(3):
            out[k, j], out[k, 3 + j] = pos[j], vel[j]
        out[k, 6] = state


def track(times: Array, positions: Array, latency: float = 0.0, sigma: float = 0.002) -> Array:
    """Return causal estimates (n, 7) of a recorded ball: position [m], velocity [m/s], trajectory state.

    Row k knows shots 0..k, and is for the moment ``times[k] + latency``.

    Args:
        times: Time stamps [s] (n,), increasing.
        positions: Table frame [m] (n, 3).
        latency: How far ahead of each shot to estimate [s].
        sigma: The shots' noise [m] an axis.
    """
    if positions.shape != (len(times), 3) or len(times) == 0:
        raise ValueError(
            f"times of shape {times.shape} and positions of shape {positions.shape}; allowed: (n,) and (n, 3), n > 0"
        )
    if not (np.all(np.diff(times) > 0.0) and np.isfinite(times).all() and np.isfinite(positions[0]).all()):
        raise ValueError("times must be finite and increasing, and the first position finite")
    out = np.empty((len(times), 7))
    _track(
        np.ascontiguousarray(times, np.float64),
        np.ascontiguousarray(positions, np.float64),
        latency,
        sigma,
        out,
    )
    return out

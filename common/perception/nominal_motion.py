"""Motion model of the camera filter: flight, bounces and touches of a nominal ball with an extra acceleration.

The extra acceleration is the difference between a ball's acceleration and that of the nominal ball (gravity, and drag
of a ball without spin). Spin and drag factor cause it.
"""

import math
from typing import Final

from common.jit import kernel
from common.perception.flight_track import COMING, SERVED
from common.physics.constants import (
    AIR_FACTOR,
    BALL_RADIUS,
    TABLE_FRICTION,
    TABLE_HALF_LENGTH,
    TABLE_HALF_WIDTH,
    TABLE_RESTITUTION0,
)
from common.physics.flight import LINEAR, LINEAR_LIFT_SLOPE, Air, acceleration
from common.physics.table_bounce import table_bounce
from common.physics.vec import Vec, add, axpy, cross, dot, norm, scale, sub

MAX_STEP: Final = 0.010  # [s] a midpoint step of this length errs by 2e-5 m at 10 m/s
MAX_HORIZON: Final = 1.0  # [s] longest extrapolation; requests for more get the estimate at this limit
TABLE_MARGIN: Final = 0.03  # [m] a bounce may be estimated this far outside the table
HIT_SPEED_CHANGE: Final = 2.5  # [m/s] a larger change of the velocity towards the opponent is a racket's
_MAX_BOUNCE_HEIGHT: Final = 0.08  # [m] with its centre lower than this a ball may have met the table
_MAX_BOUNCE_CHANGE: Final = 3.0  # [m/s] a bounce changes the velocity along x by less
_MIN_HEIGHT: Final = -0.03  # [m] a ball whose centre is lower has passed the table's edge

BallMotion = tuple[Vec, Vec, Vec]  # position [m], velocity [m/s], extra acceleration [m/s^2]


@kernel
def _turn_extra(extra: Vec, vel: Vec, later: Vec) -> Vec:
    """Return the extra acceleration after a change of velocity from ``vel`` to ``later``.

    Its part across the velocity is due to spin, its part along the velocity to drag. With w = v x e / (K |v|^2) the
    lift K w x v' is (v x e) x v' / |v|^2 for every K. Drag is proportional to |v|^2. If the ball gets faster, the
    part along stays constant: an erroneous part that accelerates the ball would amplify itself.
    """
    square = dot(vel, vel)
    if square < 1.0:  # too slow to separate the two parts; the effect of the air is negligible
        return extra
    share = dot(extra, vel) / square
    across = scale(1.0 / square, cross(cross(vel, extra), later))
    return axpy(share * min(norm(later) / math.sqrt(square), 1.0), later, across)


@kernel
def glide(pos: Vec, vel: Vec, extra: Vec, h: float) -> BallMotion:
    """Return the ball after ``h`` seconds (negative: before) without touches: one midpoint step."""
    none = (0.0, 0.0, 0.0)
    start = add(acceleration(vel, none, Air(1.0, 1.0, LINEAR)), extra)
    middle = axpy(0.5 * h, start, vel)
    rate = add(acceleration(middle, none, Air(1.0, 1.0, LINEAR)), _turn_extra(extra, vel, middle))
    later = axpy(h, rate, vel)
    return axpy(h, middle, pos), later, _turn_extra(extra, vel, later)


@kernel
def time_to_table(pos: Vec, vel: Vec, after: Vec, h: float) -> float:
    """Return when a falling ball meets the table within ``h`` seconds [s], or -1.

    Args:
        pos: Position now [m].
        vel: Velocity now [m/s].
        after: Position after ``h`` seconds if there were no table [m].
        h: Duration [s].
    """
    if vel[2] >= 0.0 or after[2] >= BALL_RADIUS or pos[2] < _MIN_HEIGHT:
        return -1.0
    if abs(after[0]) > TABLE_HALF_LENGTH + TABLE_MARGIN or abs(after[1]) > TABLE_HALF_WIDTH + TABLE_MARGIN:
        return -1.0
    height, fall = pos[2] - BALL_RADIUS, -vel[2]
    if height <= 0.0:
        return 0.0
    # the parabola through both heights with the initial speed
    curve = (pos[2] - fall * h - after[2]) / (h * h)
    return min(2.0 * height / (fall + math.sqrt(max(fall * fall + 4.0 * curve * height, 0.0))), h)


@kernel
def bounce(vel: Vec, extra: Vec) -> tuple[Vec, Vec]:
    """Return velocity and extra acceleration after the nominal table, for the spin that ``extra`` implies."""
    square = max(dot(vel, vel), 1.0)
    per_spin = AIR_FACTOR * LINEAR_LIFT_SLOPE * BALL_RADIUS
    spin = scale(1.0 / (per_spin * square), cross(vel, extra))
    after, spin_after = table_bounce(vel, spin, (0.0, 0.0, 1.0), TABLE_RESTITUTION0, TABLE_FRICTION)
    drag = dot(extra, vel) / square
    lift = scale(per_spin, cross(spin_after, after))
    return after, axpy(drag * norm(after) / math.sqrt(square), after, lift)


@kernel
def state_after_bounce(state: int, pos: Vec) -> int:
    """Return the trajectory state 0..3, or ``SERVED``, after a bounce on the table at ``pos``."""
    if state == COMING and pos[0] < 0.0:
        return 1
    if state == SERVED and pos[0] > 0.0:
        return COMING
    if state == 2 and pos[0] > 0.0:
        return 3
    return state


@kernel
def closest_approach(
    pos: Vec, vel: Vec, new_pos: Vec, new_vel: Vec, since: float, until: float
) -> tuple[float, float]:
    """Return the time in [since, until] at which two straight paths are nearest [s], and their squared distance [m^2].

    Args:
        pos: Of the old path at time 0 [m].
        vel: Of the old path [m/s].
        new_pos: Of the new path at time 0 [m].
        new_vel: Of the new path [m/s].
        since: Earliest time [s].
        until: Latest time [s].
    """
    apart, closing = sub(new_pos, pos), sub(new_vel, vel)
    square = dot(closing, closing)
    when = until
    if square > 0.0:
        when = min(max(-dot(apart, closing) / square, since), until)
    gap = axpy(when, closing, apart)
    return when, dot(gap, gap)


@kernel
def state_after_touch(state: int, pos: Vec, before: Vec, after: Vec) -> int:
    """Return the trajectory state after a touch that was not predicted, from its place and its change of velocity."""
    over_table = (
        abs(pos[0]) < TABLE_HALF_LENGTH + TABLE_MARGIN and abs(pos[1]) < TABLE_HALF_WIDTH + TABLE_MARGIN
    )
    turned_up = before[2] < 0.0 < after[2]
    change = after[0] - before[0]
    keeps_direction = after[0] * before[0] > 0.0 and abs(change) < _MAX_BOUNCE_CHANGE
    if over_table and pos[2] < _MAX_BOUNCE_HEIGHT and turned_up and keeps_direction:
        return state_after_bounce(state, pos)
    if state == 1 and change > HIT_SPEED_CHANGE:
        return 2
    return state

"""Whether a launch is a valid rally, from a coarse flight, where that is certain.

An exact flight takes 100 steps of 5 ms and looks for touches within each. Most launches need no such care: the ball
clears the net by a hand and lands in the middle of a court. A flight in steps of 30 ms errs by 0.2 mm at 9 m/s and by
2 mm at 25 m/s; what it decides by a margin that is much larger, the exact flight decides in the same way. The rest is
left to it. So generators and actors agree bit for bit, and a valid rally costs a fifth (ADR-0043).
"""

from typing import Final

from common.jit import kernel
from common.physics.constants import (
    BALL_RADIUS,
    NET_HALF_WIDTH,
    NET_HEIGHT,
    TABLE_HALF_LENGTH,
    TABLE_HALF_WIDTH,
)
from common.physics.flight import Air, flight_step
from common.physics.fly import Segment, path_at
from common.physics.touch import NET_HALF_THICKNESS, PLAY_X, PLAY_Y
from common.physics.vec import Vec, norm

INVALID: Final = 0
VALID: Final = 1
UNSURE: Final = 2

MARGIN: Final = 0.01  # [m] five times the error of the coarse flight
SLOW: Final = 10.0  # [m/s] up to here it errs by a tenth of that
SLOW_MARGIN: Final = 0.003  # [m]
_STEP: Final = 0.03  # [s]
_STEPS: Final = 40  # flights of more than 1.2 s are left to the exact one
_NET_ZONE: Final = BALL_RADIUS + NET_HALF_THICKNESS  # [m] |x| in which a ball may touch the net


@kernel
def _height_at(x: float, segment: Segment) -> float:
    """Return the ball's height where it passes ``x`` [m], or at the end that is nearer to it."""
    x0, x1 = segment.p0[0], segment.p1[0]
    share = (x - x0) / (x1 - x0) if x1 != x0 else 0.0
    return path_at(segment, min(max(share, 0.0), 1.0) * segment.h)[2]


@kernel
def _meets_net(segment: Segment, margin: float) -> tuple[bool, bool]:
    """Return whether the ball may touch the net in this piece of flight, and whether it must have by its end."""
    p0, p1, zone = segment.p0, segment.p1, _NET_ZONE + margin
    if min(p0[0], p1[0]) > zone or max(p0[0], p1[0]) < -zone:
        return False, False
    lowest = min(_height_at(zone, segment), _height_at(-zone, segment))
    may = lowest < NET_HEIGHT + BALL_RADIUS + margin
    is_between_posts = max(abs(p0[1]), abs(p1[1])) < NET_HALF_WIDTH - margin
    crosses = p0[0] > 0.0 >= p1[0]
    return may, crosses and is_between_posts and _height_at(0.0, segment) < NET_HEIGHT - margin


@kernel
def _lands(segment: Segment, margin: float) -> int:
    """Return whether a ball that comes down to the table's height in this piece of flight is on the robot's court."""
    low, high = 0.0, segment.h
    for _ in range(6):  # the height is nearly linear near the end: bisection to 0.5 ms, then the chord
        middle = 0.5 * (low + high)
        if path_at(segment, middle)[2] > BALL_RADIUS:
            low = middle
        else:
            high = middle
    before, after = path_at(segment, low), path_at(segment, high)
    fall = before[2] - after[2]
    share = (before[2] - BALL_RADIUS) / fall if fall > 0.0 else 0.5
    x = before[0] + share * (after[0] - before[0])
    y = abs(before[1] + share * (after[1] - before[1]))
    if abs(x) > TABLE_HALF_LENGTH + BALL_RADIUS + margin or y > TABLE_HALF_WIDTH + BALL_RADIUS + margin:
        return INVALID  # beside the table
    if abs(x) > TABLE_HALF_LENGTH - margin or y > TABLE_HALF_WIDTH - margin or abs(x) < _NET_ZONE + margin:
        return UNSURE
    return VALID if x < 0.0 else INVALID


@kernel
def coarse_verdict(pos: Vec, vel: Vec, spin: Vec, air: Air) -> int:
    """Return VALID or INVALID where the exact flight certainly decides so, and UNSURE elsewhere.

    Args:
        pos: Of the launch [m].
        vel: [m/s].
        spin: [rad/s].
        air: Of the rally.
    """
    margin = SLOW_MARGIN if norm(vel) < SLOW else MARGIN
    if pos[0] < _NET_ZONE + margin or pos[2] < BALL_RADIUS + margin:
        return UNSURE
    may_touch_net = False
    for _ in range(_STEPS):
        later, later_vel = flight_step(pos, vel, spin, _STEP, air)
        segment = Segment(pos, vel, later, later_vel, _STEP)
        may, must = _meets_net(segment, margin)
        if must:
            return INVALID
        may_touch_net = may_touch_net or may
        if later[2] < BALL_RADIUS:
            fate = _lands(segment, margin)
            return UNSURE if fate == VALID and may_touch_net else fate
        is_low = later[2] < BALL_RADIUS + margin and later_vel[2] > 0.0  # it may have touched the table
        if is_low or abs(later[0]) > PLAY_X - margin or abs(later[1]) > PLAY_Y - margin:
            return UNSURE
        pos, vel = later, later_vel
    return UNSURE

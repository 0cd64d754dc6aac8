"""Flight to the next touch, on one time grid. Contacts are found in time, so no ball tunnels through an obstacle.

A ball advances on a grid of ``GRID_STEP`` (Runge-Kutta 4), which divides every control period. The grid restarts only
at touches, so generator and actor get the same bits for the same launch (ADR-0005). Inside a step the path is the
cubic through both ends. It is searched for the first touch: obstacles at rest first, then the robot. So a robot that
is not touched changes no bit of the flight (ADR-0006). The ball's state at the touch comes from a Runge-Kutta step
of that length.
"""

import math
from typing import Final, NamedTuple

import numpy as np

from common.jit import inlined, kernel
from common.physics import touch
from common.physics.chain import Array, Chain, joints_at, racket_pose
from common.physics.constants import (
    AIR_FACTOR,
    BALL_RADIUS,
    FLOOR_Z,
    GRAVITY,
    GRID_STEP,
    NET_HALF_WIDTH,
    NET_HEIGHT,
    TABLE_HALF_LENGTH,
    TABLE_HALF_WIDTH,
    TABLE_THICKNESS,
)
from common.physics.flight import Air, flight_step
from common.physics.touch import BODY, FLOOR, NET, NET_HALF_THICKNESS, NONE, OUT, RACKET
from common.physics.vec import Vec, norm


class RobotPath(NamedTuple):
    """The robot's motion while a ball flies."""

    joints: (
        Array  # (n, 7) joint positions at times 0, step, 2 step ... [m, rad]; without rows there is no robot
    )
    step: float  # [s] between rows
    speed: float  # [m/s] upper bound for all points of the robot: ``chain.speed_bound``
    chain: Chain


class Segment(NamedTuple):
    """A piece of flight without touches. Its path is the cubic through both ends."""

    p0: Vec  # [m] at its start
    v0: Vec  # [m/s]
    p1: Vec  # [m] at its end
    v1: Vec  # [m/s] before any bounce
    h: float  # [s] duration


_NO_JOINTS = np.zeros((0, 7))
_NO_JOINTS.flags.writeable = False
NO_CHAIN: Final = Chain(np.zeros((0, 7)), np.zeros((0, 8)), np.zeros(0), 0, (0.0, 0.0, 0.0), 0.0)
NO_ROBOT: Final = RobotPath(_NO_JOINTS, 1.0, 0.0, NO_CHAIN)

SMALLEST_MARCH = 2e-5  # [s] 0.6 mm at 30 m/s: a grazing contact of less than 3 um depth may be missed
_ROOT_TOLERANCE = 1e-12  # [s]
_TABLE, _NET, _FLOOR, _RACKET, _BODY = 0, 1, 2, 3, 4


@inlined
def path_at(segment: Segment, t: float) -> Vec:
    """Return the position [m] at time ``t`` [s] after the segment's start (error below 1e-8 m)."""
    p0, v0, p1, v1, h = segment
    s = t / h
    a = (1.0 + 2.0 * s) * (1.0 - s) * (1.0 - s)
    b = s * (1.0 - s) * (1.0 - s) * h
    c = s * s * (3.0 - 2.0 * s)
    d = s * s * (s - 1.0) * h
    return (
        a * p0[0] + b * v0[0] + c * p1[0] + d * v1[0],
        a * p0[1] + b * v0[1] + c * p1[1] + d * v1[1],
        a * p0[2] + b * v0[2] + c * p1[2] + d * v1[2],
    )


@kernel
def _gap(what: int, pos: Vec, robot: RobotPath, moment: float) -> float:
    """Return the gap [m] to one obstacle."""
    if what == _TABLE:
        return touch.table_gap(pos)[0]
    if what == _NET:
        return touch.net_gap(pos)[0]
    if what == _FLOOR:
        return touch.floor_gap(pos)[0]
    q = joints_at(robot.joints, moment, robot.step)
    if what == _RACKET:
        return touch.racket_gap(pos, racket_pose(robot.chain, q))[0]
    return touch.body_gap(pos, robot.chain, q)[0]


@kernel
def _march(what: int, segment: Segment, end: float, closing: float, robot: RobotPath, start: float) -> float:
    """Return the first time in [0, end) at which the gap to an obstacle closes, or -1.

    Conservative advancement up to the first negative gap, then regula falsi (Illinois) between the last two moments.
    A gap that is negative at the start counts only if it closes: after a bounce the ball has gap zero and leaves.
    """
    t = 0.0
    gap = _gap(what, segment.p0, robot, start)
    if gap <= 0.0:
        later = _gap(what, path_at(segment, SMALLEST_MARCH), robot, start + SMALLEST_MARCH)
        if later < gap:
            return 0.0
    while t < end:
        last_t, last_gap = t, gap
        t = min(t + max(gap / closing, SMALLEST_MARCH), end)
        gap = _gap(what, path_at(segment, t), robot, start + t)
        if gap < 0.0 and last_gap >= 0.0:
            low, high, f_low, f_high = last_t, t, last_gap, gap
            for _ in range(60):
                if high - low < _ROOT_TOLERANCE:
                    break
                middle = low + (high - low) * f_low / (f_low - f_high)
                f = _gap(what, path_at(segment, middle), robot, start + middle)
                if f >= 0.0:
                    if f < 1e-13:
                        return middle
                    low, f_low = middle, f
                    f_high *= 0.5
                else:
                    high, f_high = middle, f
                    f_low *= 0.5
            return low
    return -1.0


@inlined
def _closing_bound(segment: Segment) -> tuple[float, float]:
    """Return bounds [m/s] of the ball's speed and of its downward speed inside a step."""
    _, v0, _, v1, h = segment
    speed = max(norm(v0), norm(v1))
    # Drag and lift factors are less than 2 in every randomization profile: 2 (0.55 + 0.27) A |v|^2 bounds the air's
    # part.
    change = h * (GRAVITY + 1.7 * AIR_FACTOR * speed * speed)
    return speed + change, max(-v0[2], -v1[2], 0.0) + change


@inlined
def _still_touch(segment: Segment, robot: RobotPath) -> tuple[float, int]:
    """Return time and obstacle of the first touch with an obstacle at rest: table, net or floor; (h, -1) if none."""
    p0, _, p1, _, h = segment
    speed, falling = _closing_bound(segment)
    reach = speed * h + BALL_RADIUS
    low = min(p0[2], p1[2]) - falling * h
    first, what = h, -1
    if (
        low < BALL_RADIUS
        and abs(p0[0]) < TABLE_HALF_LENGTH + reach
        and abs(p0[1]) < TABLE_HALF_WIDTH + reach
        and max(p0[2], p1[2]) > -reach - TABLE_THICKNESS
    ):
        # Over the table the gap is the height, so it closes no faster than the ball falls.
        over = (
            min(p0[2], p1[2]) > 0.0
            and max(abs(p0[0]), abs(p1[0])) < TABLE_HALF_LENGTH
            and max(abs(p0[1]), abs(p1[1])) < TABLE_HALF_WIDTH
        )
        t = _march(_TABLE, segment, first, falling if over else speed, robot, 0.0)
        if t >= 0.0:
            first, what = t, _TABLE
    if (
        abs(p0[0]) < reach + NET_HALF_THICKNESS
        and low < NET_HEIGHT + BALL_RADIUS
        and abs(p0[1]) < NET_HALF_WIDTH + reach
    ):
        t = _march(_NET, segment, first, speed, robot, 0.0)
        if t >= 0.0:
            first, what = t, _NET
    if low < FLOOR_Z + BALL_RADIUS:
        t = _march(_FLOOR, segment, first, falling, robot, 0.0)
        if t >= 0.0:
            first, what = t, _FLOOR
    return first, what


@inlined
def _robot_touch(segment: Segment, end: float, robot: RobotPath, start: float) -> tuple[float, int]:
    """Return time and obstacle of the first touch with the robot before ``end``; (end, -1) if none."""
    p0 = segment.p0
    speed, _ = _closing_bound(segment)
    closing = speed + robot.speed
    q = joints_at(robot.joints, start, robot.step)
    first, what = end, -1
    if touch.robot_gap_bound(p0, robot.chain, q) > closing * end:
        return first, what
    if touch.racket_gap(p0, racket_pose(robot.chain, q))[0] <= closing * first:
        t = _march(_RACKET, segment, first, closing, robot, start)
        if t >= 0.0:
            first, what = t, _RACKET
    if touch.body_gap(p0, robot.chain, q)[0] <= closing * first:
        t = _march(_BODY, segment, first, closing, robot, start)
        if t >= 0.0:
            first, what = t, _BODY
    return first, what


@kernel
def fly_step(
    pos: Vec, vel: Vec, spin: Vec, h: float, air: Air, robot: RobotPath, start: float
) -> tuple[Vec, Vec, float, int, Vec]:
    """Fly for ``h`` seconds, or to the first touch if it comes before.

    Args:
        pos: Ball's position [m], world.
        vel: Ball's velocity [m/s].
        spin: Ball's spin [rad/s], constant in flight.
        h: Rest of the grid step [s]: GRID_STEP, or the part after a touch.
        air: Of the rally.
        robot: Motion of the robot; ``NO_ROBOT`` for a flight without one.
        start: Time [s] of ``pos`` since the robot path's first row.

    Returns:
        Position, velocity, time flown [s], touch (``touch.NONE`` if there was none), and the unit normal towards the
        ball there. The caller computes the bounce.
    """
    p1, v1 = flight_step(pos, vel, spin, h, air)
    segment = Segment(pos, vel, p1, v1, h)
    end, what = _still_touch(segment, robot)
    if robot.joints.shape[0] > 0:
        sooner, part = _robot_touch(segment, end, robot, start)
        if part >= 0:
            end, what = sooner, part
    if what < 0:
        beyond = abs(p1[0]) > touch.PLAY_X or abs(p1[1]) > touch.PLAY_Y
        return p1, v1, h, OUT if beyond else NONE, (0.0, 0.0, 0.0)
    p, v = flight_step(pos, vel, spin, end, air)
    if what == _TABLE:
        return p, v, end, touch.table_touch(p), touch.table_gap(p)[1]
    if what == _NET:
        return p, v, end, NET, touch.net_gap(p)[1]
    if what == _FLOOR:
        return p, v, end, FLOOR, (0.0, 0.0, 1.0)
    q = joints_at(robot.joints, start + end, robot.step)
    if what == _RACKET:
        return p, v, end, RACKET, touch.racket_gap(p, racket_pose(robot.chain, q))[1]
    return p, v, end, BODY, touch.body_gap(p, robot.chain, q)[1]


@kernel
def fly_to_touch(
    pos: Vec, vel: Vec, spin: Vec, duration: float, air: Air, no_robot: RobotPath
) -> tuple[Vec, Vec, float, int, Vec]:
    """Fly to the first touch, without a robot, for at most ``duration`` seconds.

    Args:
        pos: Position [m].
        vel: Velocity [m/s].
        spin: Spin [rad/s].
        duration: Longest flight [s]. The last step ends on the grid, at this time or after it.
        air: Of the rally.
        no_robot: ``NO_ROBOT``. It is an argument, because numba compiles global arrays into the code as constants.

    Returns:
        Position, velocity, time flown [s], touch and normal, as from ``fly_step``.
    """
    steps = math.ceil(duration / GRID_STEP - 1e-9)
    flown = 0.0
    what = NONE
    normal = (0.0, 0.0, 0.0)
    for _ in range(steps):
        pos, vel, h, what, normal = fly_step(pos, vel, spin, GRID_STEP, air, no_robot, 0.0)
        flown += h
        if what != NONE:
            break
    return pos, vel, flown, what, normal

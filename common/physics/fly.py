"""Flying to the next touch: one integration grid, contacts found in time, nothing tunnels.

A ball advances on a grid of ``GRID_STEP`` (Runge-Kutta 4), which divides every control period, and is restarted
only at touches: whoever flies a launch, generator or actor, gets the same bits. Inside a step the path is the
cubic through both ends; it is searched for the first touch, first of what stands still, then of the robot, so
that the robot's presence doesn't change a bit of a flight it doesn't touch. The ball's state at the touch comes
from a Runge-Kutta step of just that length.
"""

import math

import numpy as np

from common.jit import kernel
from common.physics import touch
from common.physics.arm import Array, joints_at, racket_pose
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
from common.physics.flight import flight_step
from common.physics.touch import BODY, FLOOR, NET, NET_HALF_THICKNESS, NONE, OUT, RACKET
from common.physics.vec import Vec, norm

NO_ROBOT: Array = np.zeros((0, 7))  # the trajectory of a robot that is not there
NO_ROBOT.flags.writeable = False

SMALLEST_MARCH = 2e-5  # [s] at 30 m/s 0.6 mm: a grazing contact of less than 3 um depth may be passed over
_ROOT_TOLERANCE = 1e-12  # [s]
_TABLE, _NET, _FLOOR, _RACKET, _BODY = 0, 1, 2, 3, 4


@kernel
def path_at(p0: Vec, v0: Vec, p1: Vec, v1: Vec, h: float, t: float) -> Vec:
    """Return the position at time t of the cubic through both ends of a step (error below 1e-8 m)."""
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
def _gap(what: int, pos: Vec, trajectory: Array, moment: float, robot_step: float) -> float:
    """Return the gap [m] to one obstacle."""
    if what == _TABLE:
        return touch.table_gap(pos)[0]
    if what == _NET:
        return touch.net_gap(pos)[0]
    if what == _FLOOR:
        return touch.floor_gap(pos)[0]
    q = joints_at(trajectory, moment, robot_step)
    if what == _RACKET:
        return touch.racket_gap(pos, racket_pose(q))[0]
    return touch.body_gap(pos, q)[0]


@kernel
def _march(
    what: int,
    p0: Vec,
    v0: Vec,
    p1: Vec,
    v1: Vec,
    h: float,
    end: float,
    closing: float,
    trajectory: Array,
    start: float,
    robot_step: float,
) -> float:
    """Return the first time in [0, end) at which the gap to an obstacle closes, or -1.

    Conservative advancement up to the first negative gap, then regula falsi (Illinois) between the last two.
    A gap that is negative from the outset counts only if it is closing: after a bounce the ball stands at
    gap zero and leaves.
    """
    t = 0.0
    gap = _gap(what, p0, trajectory, start, robot_step)
    if gap <= 0.0:
        later = _gap(
            what, path_at(p0, v0, p1, v1, h, SMALLEST_MARCH), trajectory, start + SMALLEST_MARCH, robot_step
        )
        if later < gap:
            return 0.0
    while t < end:
        last_t, last_gap = t, gap
        t = min(t + max(gap / closing, SMALLEST_MARCH), end)
        gap = _gap(what, path_at(p0, v0, p1, v1, h, t), trajectory, start + t, robot_step)
        if gap < 0.0 and last_gap >= 0.0:
            low, high, f_low, f_high = last_t, t, last_gap, gap
            for _ in range(60):
                if high - low < _ROOT_TOLERANCE:
                    break
                middle = low + (high - low) * f_low / (f_low - f_high)
                f = _gap(what, path_at(p0, v0, p1, v1, h, middle), trajectory, start + middle, robot_step)
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


@kernel
def _closing_bound(v0: Vec, v1: Vec, h: float) -> tuple[float, float]:
    """Return bounds [m/s] of the ball's speed and of its downward speed inside a step."""
    speed = max(norm(v0), norm(v1))
    # Drag and lift factors stay below 2 in every noise profile: 2 (0.55 + 0.27) A |v|^2 bounds the air's part.
    change = h * (GRAVITY + 1.7 * AIR_FACTOR * speed * speed)
    return speed + change, max(-v0[2], -v1[2], 0.0) + change


@kernel
def _still_touch(p0: Vec, v0: Vec, p1: Vec, v1: Vec, h: float, unused: Array) -> tuple[float, int]:
    """Return time and obstacle of the first touch with what stands still: table, net or floor; (h, -1) if none."""
    speed, falling = _closing_bound(v0, v1, h)
    way = speed * h + BALL_RADIUS
    low = min(p0[2], p1[2]) - falling * h
    first, what = h, -1
    if (
        low < BALL_RADIUS
        and abs(p0[0]) < TABLE_HALF_LENGTH + way
        and abs(p0[1]) < TABLE_HALF_WIDTH + way
        and max(p0[2], p1[2]) > -way - TABLE_THICKNESS
    ):
        # Over the table the gap is the height: it closes no faster than the ball falls.
        over = (
            min(p0[2], p1[2]) > 0.0
            and max(abs(p0[0]), abs(p1[0])) < TABLE_HALF_LENGTH
            and max(abs(p0[1]), abs(p1[1])) < TABLE_HALF_WIDTH
        )
        t = _march(_TABLE, p0, v0, p1, v1, h, first, falling if over else speed, unused, 0.0, 1.0)
        if t >= 0.0:
            first, what = t, _TABLE
    if (
        abs(p0[0]) < way + NET_HALF_THICKNESS
        and low < NET_HEIGHT + BALL_RADIUS
        and abs(p0[1]) < NET_HALF_WIDTH + way
    ):
        t = _march(_NET, p0, v0, p1, v1, h, first, speed, unused, 0.0, 1.0)
        if t >= 0.0:
            first, what = t, _NET
    if low < FLOOR_Z + BALL_RADIUS:
        t = _march(_FLOOR, p0, v0, p1, v1, h, first, falling, unused, 0.0, 1.0)
        if t >= 0.0:
            first, what = t, _FLOOR
    return first, what


@kernel
def _robot_touch(
    p0: Vec,
    v0: Vec,
    p1: Vec,
    v1: Vec,
    h: float,
    end: float,
    trajectory: Array,
    start: float,
    robot_step: float,
    robot_speed: float,
) -> tuple[float, int]:
    """Return time and obstacle of the first touch with the robot before ``end``; (end, -1) if none."""
    speed, _ = _closing_bound(v0, v1, h)
    closing = speed + robot_speed
    q = joints_at(trajectory, start, robot_step)
    first, what = end, -1
    if touch.robot_gap_bound(p0, q) > closing * end:
        return first, what
    if touch.racket_gap(p0, racket_pose(q))[0] <= closing * first:
        t = _march(_RACKET, p0, v0, p1, v1, h, first, closing, trajectory, start, robot_step)
        if t >= 0.0:
            first, what = t, _RACKET
    if touch.body_gap(p0, q)[0] <= closing * first:
        t = _march(_BODY, p0, v0, p1, v1, h, first, closing, trajectory, start, robot_step)
        if t >= 0.0:
            first, what = t, _BODY
    return first, what


@kernel
def fly_step(
    pos: Vec,
    vel: Vec,
    spin: Vec,
    h: float,
    drag_factor: float,
    lift_factor: float,
    model: int,
    trajectory: Array,
    start: float,
    robot_step: float,
    robot_speed: float,
) -> tuple[Vec, Vec, float, int, Vec]:
    """Fly for ``h`` seconds or to the first touch, whichever comes first.

    Args:
        pos: Ball's position [m], world.
        vel: Ball's velocity [m/s].
        spin: Ball's spin [rad/s], constant in flight.
        h: Rest of the grid step [s]: GRID_STEP, or what a touch has left of it.
        drag_factor: Scales drag [-].
        lift_factor: Scales lift [-].
        model: ``flight.SIMPLE`` or ``flight.FULL``.
        trajectory: Joint positions at the robot's time steps (n, 7); ``NO_ROBOT``: none.
        start: Time [s] of ``pos`` since the trajectory's first row.
        robot_step: Time [s] between the trajectory's rows.
        robot_speed: ``arm.speed_bound(trajectory, robot_step)`` [m/s].

    Returns:
        Position, velocity, time flown [s], touch (``touch.NONE`` where nothing was touched), and the unit normal
        towards the ball there. The bounce is the caller's.
    """
    p1, v1 = flight_step(pos, vel, spin, h, drag_factor, lift_factor, model)
    end, what = _still_touch(pos, vel, p1, v1, h, trajectory)
    if trajectory.shape[0] > 0:
        sooner, robot = _robot_touch(pos, vel, p1, v1, h, end, trajectory, start, robot_step, robot_speed)
        if robot >= 0:
            end, what = sooner, robot
    if what < 0:
        beyond = abs(p1[0]) > touch.PLAY_X or abs(p1[1]) > touch.PLAY_Y
        return p1, v1, h, OUT if beyond else NONE, (0.0, 0.0, 0.0)
    p, v = flight_step(pos, vel, spin, end, drag_factor, lift_factor, model)
    if what == _TABLE:
        return p, v, end, touch.table_touch(p), touch.table_gap(p)[1]
    if what == _NET:
        return p, v, end, NET, touch.net_gap(p)[1]
    if what == _FLOOR:
        return p, v, end, FLOOR, (0.0, 0.0, 1.0)
    q = joints_at(trajectory, start + end, robot_step)
    if what == _RACKET:
        return p, v, end, RACKET, touch.racket_gap(p, racket_pose(q))[1]
    return p, v, end, BODY, touch.body_gap(p, q)[1]


@kernel
def fly_to_touch(
    pos: Vec,
    vel: Vec,
    spin: Vec,
    duration: float,
    drag_factor: float,
    lift_factor: float,
    model: int,
    no_robot: Array,
) -> tuple[Vec, Vec, float, int, Vec]:
    """Fly to the first touch with no robot about, for at most ``duration`` seconds.

    Args:
        pos: Position [m].
        vel: Velocity [m/s].
        spin: Spin [rad/s].
        duration: Longest flight [s]; the last step ends on the grid, at or after it.
        drag_factor: Scales drag [-].
        lift_factor: Scales lift [-].
        model: ``flight.SIMPLE`` or ``flight.FULL``.
        no_robot: ``NO_ROBOT`` (an argument, since numba freezes global arrays into the code).

    Returns:
        Position, velocity, time flown [s], touch and normal, as ``fly_step``.
    """
    steps = math.ceil(duration / GRID_STEP - 1e-9)
    flown = 0.0
    what = NONE
    normal = (0.0, 0.0, 0.0)
    for _ in range(steps):
        pos, vel, h, what, normal = fly_step(
            pos, vel, spin, GRID_STEP, drag_factor, lift_factor, model, no_robot, 0.0, 1.0, 0.0
        )
        flown += h
        if what != NONE:
            break
    return pos, vel, flown, what, normal

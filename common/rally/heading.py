"""Where a ball is heading: after a hit, and before one, if the racket goes on as it moves.

Nothing here is seen by the policy. The first is what stage 3's bonus pays for, the second what the critic is told in
training: a few control steps before the contact it is most of what there is to know about the rally's end, so that the
critic can tell a good action from a bad one at once, instead of by what became of it many noisy actions later.
"""

import math
from typing import NamedTuple

from common.jit import kernel
from common.physics.arm import (
    RACKET_HALF_THICKNESS,
    Array,
    Joints,
    point_velocity,
    racket_motion,
    racket_pose,
)
from common.physics.constants import BALL_RADIUS, NET_HEIGHT
from common.physics.flight import flight_step
from common.physics.racket_bounce import racket_bounce
from common.physics.vec import Vec, axpy, dot, sub

LONGEST_FLIGHT = 3.0  # [s] of a ball that was hit, to the floor at the latest
LOOK_AHEAD = 0.2  # [s] how far ahead a meeting of ball and racket is looked for
LOOK_STEP = 0.01  # [s] of that search
COARSE_STEP = (
    0.02  # [s] Runge-Kutta step of the flight after a foreseen hit: within a millimetre of the fine one
)
REACH = 1.5  # [m] a ball farther from the racket is not looked at
FARTHEST = 3.0  # [m] bound of a foreseen landing's distance to the target, along each axis
NET_MARGIN = 1.0  # [m] bound of the height over the net


class Foresight(NamedTuple):
    """What would come if every joint went on at its present rate."""

    meets: float  # 1: the ball would come to the racket's plane within LOOK_AHEAD
    time: float  # [s] until then; LOOK_AHEAD where it doesn't
    side: float  # [m] where on that plane, from the racket's centre: along its y axis
    up: float  # [m] and along its z axis
    miss_x: float  # [m] from the target to where the ball would be heading
    miss_y: float  # [m]
    over_net: float  # [m] its height over the net's edge


@kernel
def heading(
    pos: Vec, vel: Vec, spin: Vec, condition: Array, model: int, step: float
) -> tuple[float, float, float]:
    """Return where a ball would come down to the table's height, were nothing in its way.

    Args:
        pos: Position [m] right after the hit.
        vel: Velocity [m/s].
        spin: Spin [rad/s].
        condition: The rally's ``noise.Condition`` (14,).
        model: ``flight.SIMPLE`` or ``flight.FULL``.
        step: Of the Runge-Kutta integration [s].

    Returns:
        x and y there [m], and by how much the ball clears the net on its way [m]; -1 if it doesn't come that far.
    """
    over_net = -NET_MARGIN
    for _ in range(math.ceil(LONGEST_FLIGHT / step)):
        before = pos
        pos, vel = flight_step(pos, vel, spin, step, condition[0], condition[1], model)
        if before[0] < 0.0 <= pos[0]:
            share = -before[0] / (pos[0] - before[0])
            over_net = before[2] + share * (pos[2] - before[2]) - NET_HEIGHT - BALL_RADIUS
        if pos[2] < BALL_RADIUS and vel[2] < 0.0:
            if before[2] <= BALL_RADIUS:
                break  # hit below the table's height, and never above it
            share = (before[2] - BALL_RADIUS) / (before[2] - pos[2])
            x, y = before[0] + share * (pos[0] - before[0]), before[1] + share * (pos[1] - before[1])
            return x, y, over_net
    return pos[0], pos[1], over_net


@kernel
def _joints_after(joints: Joints, rates: Joints, t: float) -> Joints:
    """Return joint positions after ``t`` seconds at constant rates."""
    return (
        joints[0] + t * rates[0],
        joints[1] + t * rates[1],
        joints[2] + t * rates[2],
        joints[3] + t * rates[3],
        joints[4] + t * rates[4],
        joints[5] + t * rates[5],
        joints[6] + t * rates[6],
    )


@kernel
def foresight(
    pos: Vec, vel: Vec, spin: Vec, condition: Array, joints: Joints, rates: Joints, model: int
) -> Foresight:
    """Return what would come of a bounced ball if every joint went on at its present rate.

    Args:
        pos: Ball's position [m].
        vel: Its velocity [m/s].
        spin: Its spin [rad/s].
        condition: The rally's ``noise.Condition`` (14,): air, rubber and target.
        joints: Joint positions [m, rad].
        rates: Joint velocities [m/s, rad/s].
        model: ``flight.SIMPLE`` or ``flight.FULL``.
    """
    pose = racket_pose(joints)
    offset = sub(pos, pose.centre)
    front = BALL_RADIUS + RACKET_HALF_THICKNESS
    height = dot(offset, pose.normal)
    if dot(offset, offset) > REACH * REACH or height <= front:
        return Foresight(0.0, LOOK_AHEAD, 0.0, 0.0, 0.0, 0.0, 0.0)
    t = 0.0
    while t < LOOK_AHEAD - 1e-9:
        before, before_vel, before_height = pos, vel, height
        t += LOOK_STEP
        pos, vel = flight_step(pos, vel, spin, LOOK_STEP, condition[0], condition[1], model)
        pose = racket_pose(_joints_after(joints, rates, t))
        height = dot(sub(pos, pose.centre), pose.normal)
        if height > front:
            continue
        back = LOOK_STEP * (front - height) / (before_height - height)  # since the meeting
        t -= back
        share = 1.0 - back / LOOK_STEP
        pos = axpy(share, sub(pos, before), before)
        vel = axpy(share, sub(vel, before_vel), before_vel)
        then = _joints_after(joints, rates, t)
        pose = racket_pose(then)
        offset = sub(pos, pose.centre)
        side, up = dot(offset, pose.side), dot(offset, pose.up)
        racket_vel, racket_spin = racket_motion(then, rates)
        contact = axpy(-BALL_RADIUS, pose.normal, pos)
        surface_vel = point_velocity(pose.centre, racket_vel, racket_spin, contact)
        if dot(sub(vel, surface_vel), pose.normal) >= 0.0:
            break
        vel, spin = racket_bounce(
            vel,
            spin,
            pose.normal,
            surface_vel,
            condition[4],
            condition[5],
            condition[6],
            condition[7],
            math.inf,
        )
        x, y, over_net = heading(pos, vel, spin, condition, model, COARSE_STEP)
        return Foresight(
            1.0,
            t,
            side,
            up,
            min(max(x - condition[8], -FARTHEST), FARTHEST),
            min(max(y - condition[9], -FARTHEST), FARTHEST),
            min(max(over_net, -NET_MARGIN), NET_MARGIN),
        )
    return Foresight(0.0, LOOK_AHEAD, 0.0, 0.0, 0.0, 0.0, 0.0)

"""Obstacles that the ball can touch, and its distance to them.

Every obstacle is a *gap*: the distance [m] between the ball's surface and the obstacle's, negative inside, with
the unit normal towards the ball. ``fly.py`` uses these gaps for conservative advancement (ADR-0006): a step of
gap / (bound of the closing speed) can't pass through an obstacle, at any thickness.
"""

import math
from enum import IntEnum

import numpy as np

from common.jit import inlined, kernel
from common.physics.chain import (
    END,
    JOINTS,
    MOVED_BY,
    RADIUS,
    START,
    Chain,
    Frame,
    Joints,
    RacketPose,
    next_frame,
    point_of,
    row,
    world_frame,
)
from common.physics.constants import (
    BALL_RADIUS,
    FLOOR_Z,
    NET_HALF_WIDTH,
    NET_HEIGHT,
    TABLE_HALF_LENGTH,
    TABLE_HALF_WIDTH,
    TABLE_THICKNESS,
)
from common.physics.vec import Vec, axpy, dot, norm, scale, sub


class Touch(IntEnum):
    """An obstacle that a ball can touch."""

    NONE = 0
    ROBOT_COURT = 1
    OPPONENT_COURT = 2
    NET = 3
    RACKET = 4
    BODY = 5  # the robot without its racket's blade
    EDGE = 6  # the table's edges and sides
    FLOOR = 7
    OUT = 8  # left the space from which a rally can return


# Kernels take plain integers.
NONE, ROBOT_COURT, OPPONENT_COURT, NET, RACKET, BODY, EDGE, FLOOR, OUT = (int(t) for t in Touch)

NET_HALF_THICKNESS = 0.003  # [m] cord and mesh
PLAY_X = 3.6  # [m] beyond these limits only the floor can be touched
PLAY_Y = 2.3  # [m]


@kernel
def _box_gap(pos: Vec, half_x: float, half_y: float, z_low: float, z_high: float) -> tuple[float, Vec]:
    """Return gap and normal of a box centred on the z axis."""
    nearest = (
        min(max(pos[0], -half_x), half_x),
        min(max(pos[1], -half_y), half_y),
        min(max(pos[2], z_low), z_high),
    )
    offset = sub(pos, nearest)
    distance = norm(offset)
    if distance == 0.0:  # the centre is inside: a ball from outside never gets that far
        return -BALL_RADIUS, (0.0, 0.0, 1.0)
    return distance - BALL_RADIUS, scale(1.0 / distance, offset)


@kernel
def table_gap(pos: Vec) -> tuple[float, Vec]:
    """Return gap and normal of the table, a box with its top at z = 0."""
    return _box_gap(pos, TABLE_HALF_LENGTH, TABLE_HALF_WIDTH, -TABLE_THICKNESS, 0.0)


@kernel
def net_gap(pos: Vec) -> tuple[float, Vec]:
    """Return gap and normal of the net, a thin box that reaches 0.1525 m beyond the table's sides."""
    return _box_gap(pos, NET_HALF_THICKNESS, NET_HALF_WIDTH, 0.0, NET_HEIGHT)


@kernel
def floor_gap(pos: Vec) -> tuple[float, Vec]:
    """Return gap and normal of the floor."""
    return pos[2] - FLOOR_Z - BALL_RADIUS, (0.0, 0.0, 1.0)


@kernel
def table_touch(pos: Vec) -> int:
    """Return the part of the table that a ball at gap zero touches: a court, or an edge."""
    if abs(pos[0]) > TABLE_HALF_LENGTH or abs(pos[1]) > TABLE_HALF_WIDTH or pos[2] < 0.0:
        return EDGE
    return ROBOT_COURT if pos[0] <= 0.0 else OPPONENT_COURT


@kernel
def _capsule_gap(pos: Vec, start: Vec, end: Vec, radius: float) -> tuple[float, Vec]:
    axis = sub(end, start)
    along = dot(sub(pos, start), axis) / dot(axis, axis)
    offset = sub(pos, axpy(min(max(along, 0.0), 1.0), axis, start))
    distance = max(norm(offset), 1e-12)
    return distance - radius - BALL_RADIUS, scale(1.0 / distance, offset)


@kernel
def racket_gap(pos: Vec, racket: RacketPose) -> tuple[float, Vec]:
    """Return gap and normal of the racket: a flat disc thickened to a round rim.

    On both faces the normal is the face's. At the rim it turns outwards, so a ball on the edge is deflected.
    """
    offset = sub(pos, racket.centre)
    height = dot(offset, racket.normal)
    radial = axpy(-height, racket.normal, offset)
    radius = norm(radial)
    beyond = radius - (racket.radius - racket.half_thickness)
    if beyond <= 0.0:
        normal = racket.normal if height >= 0.0 else scale(-1.0, racket.normal)
        return abs(height) - racket.half_thickness - BALL_RADIUS, normal
    distance = math.sqrt(height * height + beyond * beyond)
    normal = axpy(height / distance, racket.normal, scale(beyond / (radius * distance), radial))
    return distance - racket.half_thickness - BALL_RADIUS, normal


@inlined
def _parts_gap(pos: Vec, chain: Chain, q: Joints, joints: int) -> tuple[float, Vec, Frame]:
    """Return gap and normal of the parts that the first ``joints`` joints move, and the frame of the last of these."""
    gap, normal = np.inf, (0.0, 0.0, 1.0)
    parts, frame, part = chain.capsules, world_frame(), 0
    for joint in range(-1, joints):
        if joint >= 0:
            frame = next_frame(chain, joint, q[joint], frame)
        while part < parts.shape[0] and parts[part, MOVED_BY] == joint:
            start, end = point_of(frame, row(parts, part, START)), point_of(frame, row(parts, part, END))
            to_part, part_normal = _capsule_gap(pos, start, end, parts[part, RADIUS])
            if to_part < gap:
                gap, normal = to_part, part_normal
            part += 1
    return gap, normal, frame


@kernel
def body_gap(pos: Vec, chain: Chain, q: Joints) -> tuple[float, Vec]:
    """Return gap and normal of the robot without its racket's blade."""
    gap, normal, _ = _parts_gap(pos, chain, q, JOINTS)
    return gap, normal


@inlined
def robot_gap_bound(pos: Vec, chain: Chain, q: Joints) -> float:
    """Return a lower bound [m] of the gap to all parts of the robot, computed without trigonometry."""
    carried, _, frame = _parts_gap(pos, chain, q, chain.slides)
    moved = norm(sub(pos, point_of(frame, chain.hub))) - chain.hub_reach - BALL_RADIUS
    return min(carried, moved)

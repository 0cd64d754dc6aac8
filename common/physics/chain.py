"""A robot's kinematic chain as a value, and its kinematics: poses and motions of racket and links from seven joints.

The ball flies outside MuJoCo, so its kernels need the robot's pose at any moment inside a MuJoCo step (ADR-0005).
Joint positions are interpolated linearly between steps, as MuJoCo's semi-implicit step moves them. The pose is then
exact, rigid at every moment, and about 30 times cheaper than a recording of MuJoCo's own frames. A test compares it
with ``mj_forward`` for every robot.

A chain is read from a robot's MJCF (``common/robot/chain_of.py``). Every joint has a frame. With all joints at zero
all frames are parallel to the world's, and each joint's axis is one of its frame's axes. So a hinge turns two axes of
the frame in their plane: twelve products instead of a product of matrices.
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from common.jit import inlined, kernel
from common.physics.vec import Vec, axpy, cross, scale, vec_at

Array = npt.NDArray[np.float64]
Joints = tuple[float, float, float, float, float, float, float]
JOINTS = 7  # of every robot: the sizes of actions and observations


# Columns of ``Chain.joints``
IS_HINGE, AXIS, SIGN, REACH, OFFSET = 0, 1, 2, 3, 4
# Columns of ``Chain.capsules``
MOVED_BY, START, END, RADIUS = 0, 1, 4, 7
# Numbers of ``Chain.racket``
CENTRE, NORMAL, SIDE, UP, DISC_RADIUS, DISC_HALF_THICKNESS = 0, 3, 6, 9, 12, 13


class Chain(NamedTuple):
    """A robot's geometry. Lengths in metres; frames as in the module's docstring.

    Few arrays with many columns: every call of a kernel counts the references of each array that it is given.
    """

    # (7, 7) 1 for a hinge and 0 for a slide; its axis: 0 x, 1 y, 2 z; +1, or -1 where it moves against its axis; a
    # hinge's largest distance to a point of the robot that it moves, and 1 for a slide; x, y, z of its frame in the
    # frame before (the world's for the first)
    joints: Array
    # (n, 8) parts that the ball can hit: the joint that moves them, ascending (-1: none); start, end and radius in that
    # joint's frame
    capsules: Array
    # (14,) the racket in the last frame: its centre; its normal, side and up (towards the handle); the disc's radius
    # and half of its thickness
    racket: Array
    slides: int  # joints before the first hinge
    hub: Vec  # a point in the frame of the last of these slides ...
    hub_reach: float  # ... and the largest distance from it of any point that hinges move


class Frame(NamedTuple):
    """A joint's frame in the world: its origin and axes."""

    origin: Vec
    x: Vec
    y: Vec
    z: Vec


class RacketPose(NamedTuple):
    """The racket at one moment in the world frame: its centre, the three axes of its frame, and its size."""

    centre: Vec
    normal: Vec  # x axis: the face's normal
    side: Vec  # y axis
    up: Vec  # z axis: towards the handle
    radius: float  # [m]
    half_thickness: float  # [m]


@kernel
def joints_at(trajectory: Array, moment: float, step: float) -> Joints:
    """Return the seven joint positions [m, rad] at a moment, interpolated linearly between rows of ``trajectory``.

    Args:
        trajectory: Joint positions at times 0, step, 2 step ... (n, 7).
        moment: Time [s] since the first row.
        step: Time [s] between rows.
    """
    row = min(max(int(moment / step), 0), trajectory.shape[0] - 2)
    w = moment / step - row
    a, b = trajectory[row], trajectory[row + 1]
    return (
        a[0] + w * (b[0] - a[0]),
        a[1] + w * (b[1] - a[1]),
        a[2] + w * (b[2] - a[2]),
        a[3] + w * (b[3] - a[3]),
        a[4] + w * (b[4] - a[4]),
        a[5] + w * (b[5] - a[5]),
        a[6] + w * (b[6] - a[6]),
    )


@kernel
def joint_rates_at(trajectory: Array, moment: float, step: float) -> Joints:
    """Return the joint velocities [m/s, rad/s] of the path of ``joints_at``.

    These are not MuJoCo's velocities, interpolated. With those, the racket's velocity would differ from the slope of
    its path, and a ball could touch a racket whose velocity points away from it.
    """
    row = min(max(int(moment / step), 0), trajectory.shape[0] - 2)
    a, b = trajectory[row], trajectory[row + 1]
    return (
        (b[0] - a[0]) / step,
        (b[1] - a[1]) / step,
        (b[2] - a[2]) / step,
        (b[3] - a[3]) / step,
        (b[4] - a[4]) / step,
        (b[5] - a[5]) / step,
        (b[6] - a[6]) / step,
    )


@inlined
def row(table: Array, k: int, first: int = 0) -> Vec:
    """Return three numbers of a row of ``table`` (n, m), from column ``first`` on."""
    return table[k, first], table[k, first + 1], table[k, first + 2]


@inlined
def to_world(frame: Frame, v: Vec) -> Vec:
    """Return a direction of a frame in the world."""
    return axpy(v[0], frame.x, axpy(v[1], frame.y, scale(v[2], frame.z)))


@inlined
def point_of(frame: Frame, v: Vec) -> Vec:
    """Return a point of a frame in the world [m]."""
    return axpy(v[0], frame.x, axpy(v[1], frame.y, axpy(v[2], frame.z, frame.origin)))


@inlined
def axis_of(frame: Frame, axis: float) -> Vec:
    """Return one of a frame's axes."""
    if axis == 0:
        return frame.x
    if axis == 1:
        return frame.y
    return frame.z


@inlined
def world_frame() -> Frame:
    """Return the frame that a chain begins with."""
    return Frame((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


@inlined
def next_frame(chain: Chain, joint: int, position: float, frame: Frame) -> Frame:
    """Return a joint's frame at a position [m, rad], from the frame before."""
    origin = point_of(frame, row(chain.joints, joint, OFFSET))
    along = chain.joints[joint, SIGN] * position
    axis = chain.joints[joint, AXIS]
    x, y, z = frame.x, frame.y, frame.z
    if chain.joints[joint, IS_HINGE] == 0.0:
        return Frame(axpy(along, axis_of(frame, axis), origin), x, y, z)
    s, c = math.sin(along), math.cos(along)
    if axis == 0:
        return Frame(origin, x, axpy(s, z, scale(c, y)), axpy(-s, y, scale(c, z)))
    if axis == 1:
        return Frame(origin, axpy(-s, z, scale(c, x)), y, axpy(s, x, scale(c, z)))
    return Frame(origin, axpy(s, y, scale(c, x)), axpy(-s, x, scale(c, y)), z)


@inlined
def last_frame(chain: Chain, q: Joints) -> Frame:
    """Return the frame of the last joint."""
    frame = world_frame()
    for joint in range(JOINTS):
        frame = next_frame(chain, joint, q[joint], frame)
    return frame


@inlined
def racket_on(chain: Chain, frame: Frame) -> RacketPose:
    """Return the racket's pose, given the frame of the last joint."""
    disc = chain.racket
    return RacketPose(
        point_of(frame, vec_at(disc, CENTRE)),
        to_world(frame, vec_at(disc, NORMAL)),
        to_world(frame, vec_at(disc, SIDE)),
        to_world(frame, vec_at(disc, UP)),
        disc[DISC_RADIUS],
        disc[DISC_HALF_THICKNESS],
    )


@kernel
def racket_pose(chain: Chain, q: Joints) -> RacketPose:
    """Return the racket's centre and axes."""
    return racket_on(chain, last_frame(chain, q))


@kernel
def racket_motion(chain: Chain, q: Joints, qd: Joints) -> tuple[Vec, Vec]:
    """Return the racket centre's velocity [m/s] and the racket's angular velocity [rad/s], world frame."""
    _, vel, angular = racket_state(chain, q, qd)
    return vel, angular


@kernel
def racket_state(chain: Chain, q: Joints, qd: Joints) -> tuple[RacketPose, Vec, Vec]:
    """Return the racket's pose, its centre's velocity [m/s] and its angular velocity [rad/s], world frame."""
    frame = world_frame()
    vel, angular = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    for joint in range(JOINTS):
        vel = axpy(1.0, cross(angular, to_world(frame, row(chain.joints, joint, OFFSET))), vel)
        before = frame
        frame = next_frame(chain, joint, q[joint], frame)
        rate = chain.joints[joint, SIGN] * qd[joint]
        axis = axis_of(before, chain.joints[joint, AXIS])
        if chain.joints[joint, IS_HINGE] != 0.0:
            angular = axpy(rate, axis, angular)
        else:
            slid = scale(chain.joints[joint, SIGN] * q[joint], axis)
            vel = axpy(rate, axis, axpy(1.0, cross(angular, slid), vel))
    vel = axpy(1.0, cross(angular, to_world(frame, vec_at(chain.racket, CENTRE))), vel)
    return racket_on(chain, frame), vel, angular


@kernel
def quaternion_of(pose: RacketPose) -> tuple[float, float, float, float]:
    """Return the racket frame's orientation (w, x, y, z), w >= 0; near (1, 0, 0, 0) at home.

    Shepperd 1978: the largest of the four components first, so that no small number divides.
    """
    (m00, m10, m20), (m01, m11, m21), (m02, m12, m22) = pose.normal, pose.side, pose.up
    trace = m00 + m11 + m22
    if trace >= max(m00, m11, m22):
        r = math.sqrt(1.0 + trace)
        s = 0.5 / r
        w, x, y, z = 0.5 * r, (m21 - m12) * s, (m02 - m20) * s, (m10 - m01) * s
    elif m00 >= max(m11, m22):
        r = math.sqrt(1.0 + m00 - m11 - m22)
        s = 0.5 / r
        w, x, y, z = (m21 - m12) * s, 0.5 * r, (m10 + m01) * s, (m20 + m02) * s
    elif m11 >= m22:
        r = math.sqrt(1.0 - m00 + m11 - m22)
        s = 0.5 / r
        w, x, y, z = (m02 - m20) * s, (m10 + m01) * s, 0.5 * r, (m21 + m12) * s
    else:
        r = math.sqrt(1.0 - m00 - m11 + m22)
        s = 0.5 / r
        w, x, y, z = (m10 - m01) * s, (m20 + m02) * s, (m21 + m12) * s, 0.5 * r
    if w < 0.0:
        return -w, -x, -y, -z
    return w, x, y, z


@kernel
def point_velocity(centre: Vec, vel: Vec, angular: Vec, point: Vec) -> Vec:
    """Return the velocity V_R + W_R x (p - p_R) of a point of the racket [m/s]."""
    arm = (point[0] - centre[0], point[1] - centre[1], point[2] - centre[2])
    turn = cross(angular, arm)
    return (vel[0] + turn[0], vel[1] + turn[1], vel[2] + turn[2])


@kernel
def speed_bound(chain: Chain, trajectory: Array, step: float) -> float:
    """Return an upper bound of the speed [m/s] of all points of the robot along ``trajectory`` (n, 7)."""
    bound = 0.0
    for k in range(trajectory.shape[0] - 1):
        distance = 0.0
        for joint in range(JOINTS):
            distance += abs(trajectory[k + 1, joint] - trajectory[k, joint]) * chain.joints[joint, REACH]
        bound = max(bound, distance / step)
    return bound

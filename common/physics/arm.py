"""Kinematics of the robot: poses of racket and links from its seven joints (the lengths of ``common/env/robot.xml``).

The ball flies outside MuJoCo, so its kernels need the robot's pose at any moment inside a MuJoCo step (ADR-0005).
Joint positions are interpolated linearly between steps, as MuJoCo's semi-implicit step moves them. This file
evaluates the chain of two rails, yaw, three pitching joints and roll. The result is exact, rigid at every moment,
and about 30 times cheaper than a recording of MuJoCo's own frames. A test compares it with ``mj_forward``.

Angles: a = pitch, b = pitch + elbow, c = pitch + elbow + wrist, measured from the vertical towards the
opponent. In the racket's frame x is the face's normal (towards the opponent at home), and z points to the handle.
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from common.jit import kernel
from common.physics.vec import Vec, axpy, cross, scale

Array = npt.NDArray[np.float64]
Joints = tuple[float, float, float, float, float, float, float]

RAIL_HOME_X = -1.45  # [m] x of the beam at rail_x = 0
SHOULDER_Z = 0.33  # [m] height of the pitch axis over the table top
UPPER_ARM = 0.22  # [m] pitch axis to elbow axis
FOREARM = 0.20  # [m] elbow axis to wrist axis
RACKET_REACH = 0.14  # [m] wrist axis to the racket's centre
RACKET_RADIUS = 0.076  # [m]
RACKET_HALF_THICKNESS = 0.0065  # [m]
HANDLE_LENGTH = RACKET_REACH - RACKET_RADIUS  # [m] wrist axis to the blade's rim

UPPER_ARM_RADIUS = 0.035  # [m] radii of the capsules that a ball can hit
FOREARM_RADIUS = 0.030
WRIST_RADIUS = 0.025
COLUMN_RADIUS = 0.045
BEAM_RADIUS = 0.050
BEAM_Z = 0.10
BEAM_HALF_LENGTH = 1.1

REACH = (
    UPPER_ARM + FOREARM + RACKET_REACH + RACKET_RADIUS + 0.002
)  # [m] shoulder to the rim, with its thickness
"""Largest distance of a point of arm or racket from the pitch axis."""


class RacketPose(NamedTuple):
    """The racket at one moment in the world frame: its centre and the three axes of its frame."""

    centre: Vec
    normal: Vec  # x axis: the face's normal
    side: Vec  # y axis
    up: Vec  # z axis: towards the handle


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


@kernel
def shoulder(q: Joints) -> Vec:
    """Return the point where the yaw and pitch axes meet [m]."""
    return (RAIL_HOME_X + q[0], q[1], SHOULDER_Z)


@kernel
def _along(cos_yaw: float, sin_yaw: float, angle: float) -> Vec:
    """Return the unit vector of a link that leans ``angle`` from the vertical."""
    s = math.sin(angle)
    return (cos_yaw * s, sin_yaw * s, math.cos(angle))


@kernel
def links(q: Joints) -> tuple[Vec, Vec, Vec, Vec, Vec]:
    """Return shoulder, elbow, wrist, the handle's end at the blade, and the racket's centre [m]."""
    cos_yaw, sin_yaw = math.cos(q[2]), math.sin(q[2])
    p_shoulder = shoulder(q)
    elbow = axpy(UPPER_ARM, _along(cos_yaw, sin_yaw, q[3]), p_shoulder)
    wrist = axpy(FOREARM, _along(cos_yaw, sin_yaw, q[3] + q[4]), elbow)
    hand = _along(cos_yaw, sin_yaw, q[3] + q[4] + q[5])
    return p_shoulder, elbow, wrist, axpy(HANDLE_LENGTH, hand, wrist), axpy(RACKET_REACH, hand, wrist)


@kernel
def racket_pose(q: Joints) -> RacketPose:
    """Return the racket's centre and axes: R = Rz(yaw) Ry(c - pi) Rz(-roll)."""
    cos_yaw, sin_yaw = math.cos(q[2]), math.sin(q[2])
    cos_roll, sin_roll = math.cos(q[6]), math.sin(q[6])
    c = q[3] + q[4] + q[5]
    hand = _along(cos_yaw, sin_yaw, c)
    p = axpy(UPPER_ARM, _along(cos_yaw, sin_yaw, q[3]), shoulder(q))
    p = axpy(FOREARM, _along(cos_yaw, sin_yaw, q[3] + q[4]), p)
    centre = axpy(RACKET_REACH, hand, p)
    # Columns of Rz(yaw) Ry(c - pi): forward, left, up. Then a turn by -roll about up.
    cos_c, sin_c = math.cos(c), math.sin(c)
    forward = (-cos_yaw * cos_c, -sin_yaw * cos_c, sin_c)
    left = (-sin_yaw, cos_yaw, 0.0)
    normal = axpy(-sin_roll, left, scale(cos_roll, forward))
    side = axpy(sin_roll, forward, scale(cos_roll, left))
    return RacketPose(centre, normal, side, scale(-1.0, hand))


@kernel
def racket_motion(q: Joints, qd: Joints) -> tuple[Vec, Vec]:
    """Return the racket centre's velocity [m/s] and the racket's angular velocity [rad/s], world frame."""
    cos_yaw, sin_yaw = math.cos(q[2]), math.sin(q[2])
    a, b, c = q[3], q[3] + q[4], q[3] + q[4] + q[5]
    a_rate, b_rate, c_rate = qd[3], qd[3] + qd[4], qd[3] + qd[4] + qd[5]
    sin_a, cos_a, sin_b, cos_b = math.sin(a), math.cos(a), math.sin(b), math.cos(b)
    sin_c, cos_c = math.sin(c), math.cos(c)
    # In the arm's plane: radius from the yaw axis, its rate and the rate of the height.
    radius = UPPER_ARM * sin_a + FOREARM * sin_b + RACKET_REACH * sin_c
    radius_rate = UPPER_ARM * cos_a * a_rate + FOREARM * cos_b * b_rate + RACKET_REACH * cos_c * c_rate
    height_rate = -(UPPER_ARM * sin_a * a_rate + FOREARM * sin_b * b_rate + RACKET_REACH * sin_c * c_rate)
    swing = radius * qd[2]
    vel = (
        qd[0] + radius_rate * cos_yaw - swing * sin_yaw,
        qd[1] + radius_rate * sin_yaw + swing * cos_yaw,
        height_rate,
    )
    angular = (
        -sin_yaw * c_rate + qd[6] * cos_yaw * sin_c,
        cos_yaw * c_rate + qd[6] * sin_yaw * sin_c,
        qd[2] + qd[6] * cos_c,
    )
    return vel, angular


@kernel
def racket_quaternion(q: Joints) -> tuple[float, float, float, float]:
    """Return the racket frame's orientation (w, x, y, z), w >= 0; near (1, 0, 0, 0) at home."""
    half_yaw, half_c, half_roll = 0.5 * q[2], 0.5 * (q[3] + q[4] + q[5] - math.pi), -0.5 * q[6]
    cz, sz = math.cos(half_yaw), math.sin(half_yaw)
    cy, sy = math.cos(half_c), math.sin(half_c)
    cr, sr = math.cos(half_roll), math.sin(half_roll)
    # (cz + sz k)(cy + sy j)(cr + sr k)
    w0, x0, y0, z0 = cz * cy, -sz * sy, cz * sy, sz * cy
    w, x, y, z = w0 * cr - z0 * sr, x0 * cr + y0 * sr, y0 * cr - x0 * sr, z0 * cr + w0 * sr
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
def speed_bound(trajectory: Array, step: float) -> float:
    """Return an upper bound of the speed [m/s] of all points of the robot along ``trajectory`` (n, 7)."""
    bound = 0.0
    for k in range(trajectory.shape[0] - 1):
        a, b = trajectory[k], trajectory[k + 1]
        distance = abs(b[0] - a[0]) + abs(b[1] - a[1]) + (abs(b[2] - a[2]) + abs(b[3] - a[3])) * REACH
        distance += abs(b[4] - a[4]) * (REACH - UPPER_ARM) + abs(b[5] - a[5]) * (RACKET_REACH + RACKET_RADIUS)
        distance += abs(b[6] - a[6]) * RACKET_RADIUS
        bound = max(bound, distance / step)
    return bound

"""The robot as gradients pass through it: kinematics and drives, in torch.

A policy without memory can still remember: what its arm did a moment ago shows in where it is now. To learn that, it
must be told how what it does now changes what it will see, and that is known: the drives are springs and dampers with
a largest force, the rest is the chain of ``common/physics/arm.py``. The mass matrix is that at home; gravity and
latency are left out. Only differences to what really happened are taken from here (``through_arm.py``): of what another
target changes in a control step, 6 % of the square at most is missing (a test has it).
"""

import math

import torch
from torch import Tensor

from common.env.robot import JOINTS, RobotBatch, RobotPreset, inertia_at_home
from common.physics.arm import FOREARM, RACKET_REACH, RAIL_HOME_X, SHOULDER_Z, UPPER_ARM
from common.rally.observation import OBSERVATION, offsets

DOF = len(JOINTS)
SEEN = offsets(OBSERVATION)["racket_vel"].stop  # of an observation's numbers: joints and racket come first


class Arm:
    """N robots' joints, one control step after the other.

    Args:
        preset: Whose drives.
        control_rate_hz: Control steps a second.
    """

    def __init__(self, preset: RobotPreset = "rails", control_rate_hz: float = 50.0) -> None:
        robot = RobotBatch(1, preset, control_rate_hz)
        rows: list[Tensor] = [torch.tensor(row, dtype=torch.float32) for row in robot.drives]
        _, self._stiffness, self._damping, self._joint_damping, self._half_range = rows
        self._middle = torch.tensor(robot.middle, dtype=torch.float32)
        self._largest = torch.tensor(robot.torque_limit, dtype=torch.float32)
        self._substeps, self._h = robot.substeps, robot.step_s
        inertia = torch.tensor(inertia_at_home(robot.model), dtype=torch.float32)
        self._mobility = torch.linalg.inv(inertia + self._h * torch.diag(self._joint_damping))
        self._drag = self._h * self._damping * self._mobility.diag()

    def step(self, pos: Tensor, vel: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Return joint positions and velocities (..., 7) a control step later.

        Implicit in the velocity, as MuJoCo's ``implicitfast``: exactly for the joints' own damping; for a drive's,
        which ends at its largest force, as if the other joints had none.

        Args:
            pos: (..., 7) [m, rad].
            vel: (..., 7) [m/s, rad/s].
            action: (..., 7) [half-range], clipped to [-1, 1].
        """
        target = self._middle + self._half_range * action.clamp(-1.0, 1.0)
        with torch.autocast("cpu", enabled=False):  # a product in bfloat16 would lose what it is about
            for _ in range(self._substeps):
                asked = self._stiffness * (target - pos) - self._damping * vel
                force = asked.clamp(-self._largest, self._largest) - self._joint_damping * vel
                drag = 1.0 + self._drag * (asked.abs() < self._largest)
                vel = vel + self._h * (force @ self._mobility) / drag
                pos = pos + self._h * vel
        return pos, vel


def seen_of(pos: Tensor, vel: Tensor) -> Tensor:
    """Return what an observation says of a robot (..., 24): joints, then the racket's place, turn and velocity.

    The same as ``racket_pose``, ``racket_quaternion`` and ``racket_motion`` of ``common/physics/arm.py``.
    """
    rail_x, rail_y, yaw, a, elbow, wrist, roll = pos.unbind(-1)
    rail_x_rate, rail_y_rate, yaw_rate, a_rate, elbow_rate, wrist_rate, _ = vel.unbind(-1)
    b, b_rate = a + elbow, a_rate + elbow_rate
    c, c_rate = b + wrist, b_rate + wrist_rate
    sin_a, cos_a, sin_b, cos_b, sin_c, cos_c = a.sin(), a.cos(), b.sin(), b.cos(), c.sin(), c.cos()
    radius = UPPER_ARM * sin_a + FOREARM * sin_b + RACKET_REACH * sin_c
    height = SHOULDER_Z + UPPER_ARM * cos_a + FOREARM * cos_b + RACKET_REACH * cos_c
    radius_rate = UPPER_ARM * cos_a * a_rate + FOREARM * cos_b * b_rate + RACKET_REACH * cos_c * c_rate
    height_rate = -(UPPER_ARM * sin_a * a_rate + FOREARM * sin_b * b_rate + RACKET_REACH * sin_c * c_rate)
    cos_yaw, sin_yaw = yaw.cos(), yaw.sin()
    place = (RAIL_HOME_X + rail_x + radius * cos_yaw, rail_y + radius * sin_yaw, height)
    swing = radius * yaw_rate
    velocity = (
        rail_x_rate + radius_rate * cos_yaw - swing * sin_yaw,
        rail_y_rate + radius_rate * sin_yaw + swing * cos_yaw,
        height_rate,
    )
    # Rz(yaw) Ry(c - pi) Rz(-roll)
    half_c, half_sum, half_difference = 0.5 * (c - math.pi), 0.5 * (yaw - roll), 0.5 * (yaw + roll)
    turn = torch.stack(
        (
            half_c.cos() * half_sum.cos(),
            -half_c.sin() * half_difference.sin(),
            half_c.sin() * half_difference.cos(),
            half_c.cos() * half_sum.sin(),
        ),
        -1,
    )
    turn = torch.where(turn[..., :1] < 0.0, -turn, turn)
    return torch.cat((pos, vel, torch.stack(place, -1), turn, torch.stack(velocity, -1)), -1)

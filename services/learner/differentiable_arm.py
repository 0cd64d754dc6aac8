"""The robot in torch, so that gradients pass through it: kinematics and drives.

A policy without memory can remember in its arm: earlier actions show in the arm's present position. To train that, the
learner must know how actions change later observations. The drives are springs and dampers with a largest force. The
kinematics are the chain of ``common/physics/arm.py``. The mass matrix is that of the home pose; gravity and latency are
left out. Only differences from the recorded motion are computed with this model (``bptt.py``). Of the change that
another target makes in a control step, it misses at most 6 % of the square (a test checks it).
"""

import math

import torch
from torch import Tensor

from common.env.robot import JOINTS, RobotBatch, inertia_at_home
from common.physics.arm import FOREARM, RACKET_REACH, RAIL_HOME_X, SHOULDER_Z, UPPER_ARM
from common.task.config import RobotName
from common.task.observation import OBSERVATION, offsets

DOF = len(JOINTS)
ARM_OBS = offsets(OBSERVATION)["racket_vel"].stop  # an observation's first numbers: joints and racket


class ArmModel:
    """The joints of N robots, computed from one control step to the next.

    Args:
        robot: Its name, which decides its drives.
        control_rate_hz: Control steps per second.
    """

    def __init__(self, robot: RobotName = "rails", control_rate_hz: float = 50.0) -> None:
        simulated = RobotBatch(1, robot, control_rate_hz)
        rows: list[Tensor] = [torch.tensor(row, dtype=torch.float32) for row in simulated.drives]
        _, self._stiffness, self._damping, self._joint_damping, self._half_range = rows
        self._middle = torch.tensor(simulated.middle, dtype=torch.float32)
        self._largest = torch.tensor(simulated.torque_limit, dtype=torch.float32)
        self._substeps, self._h = simulated.substeps, simulated.step_s
        inertia = torch.tensor(inertia_at_home(simulated.model), dtype=torch.float32)
        self._mobility = torch.linalg.inv(inertia + self._h * torch.diag(self._joint_damping))
        self._drag = self._h * self._damping * self._mobility.diag()

    def step(self, pos: Tensor, vel: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Return joint positions and velocities (..., 7) one control step later.

        Implicit in the velocity, as MuJoCo's ``implicitfast``: exact for the joints' own damping. A drive's
        damping ends at its largest force; it is computed as if the other joints had no drives.

        Args:
            pos: (..., 7) [m, rad].
            vel: (..., 7) [m/s, rad/s].
            action: (..., 7) [half-range], clipped to [-1, 1].
        """
        target = self._middle + self._half_range * action.clamp(-1.0, 1.0)
        with torch.autocast("cpu", enabled=False):  # a product in bfloat16 would lose the difference
            for _ in range(self._substeps):
                demand = self._stiffness * (target - pos) - self._damping * vel
                force = demand.clamp(-self._largest, self._largest) - self._joint_damping * vel
                drag = 1.0 + self._drag * (demand.abs() < self._largest)
                vel = vel + self._h * (force @ self._mobility) / drag
                pos = pos + self._h * vel
        return pos, vel


def robot_observation(pos: Tensor, vel: Tensor) -> Tensor:
    """Return the robot's part of an observation (..., 24): joints; the racket's position, orientation and velocity.

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

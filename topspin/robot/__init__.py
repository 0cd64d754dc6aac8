"""A trained policy on a robot: numpy, numba and ONNX Runtime, without torch, MuJoCo or the rest of Topspin.

`topspin export` packs this package as the wheel ``topspin-robot``, there named ``topspin_robot``:

    controller = topspin_robot.load(folder)     reads, compiles and warms up
    controller.begin(target)                    a new ball, and where to return it
    controller.see(moment, position)            a camera's detection of the ball
    controller.step(now, joint_pos, joint_vel)  joint targets, at the contract's control rate
"""

from common.rally.observer import BallSample
from topspin.robot.contract import ExportError, RobotContract
from topspin.robot.controller import Command, Controller, load
from topspin.robot.faults import Fault

__all__ = ["BallSample", "Command", "Controller", "ExportError", "Fault", "RobotContract", "load"]

"""`python -m topspin_robot.ros2 FOLDER`: an exported policy as a ROS 2 node.

| topic | message | what |
|---|---|---|
| `ball` | geometry_msgs/PointStamped | a camera's detection of the ball, stamped when the picture was taken |
| `joint_states` | sensor_msgs/JointState | positions and velocities of the joints, found by their names |
| `new_ball` | geometry_msgs/PointStamped | begins a ball: x and y of its target on the opponent's court |
| `joint_trajectory` | trajectory_msgs/JointTrajectory | out: one point, the joint targets |

``RobotNode`` takes and makes messages without knowing ROS: everything that can go wrong is in it, and its tests run
without ROS. ``main`` connects it to ``rclpy``.
"""

import argparse
import logging
import math
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any, Final, NamedTuple

import numpy as np

from common.errors import ReportedError
from topspin.robot.contract import RobotContract
from topspin.robot.controller import Array, Controller, load

log = logging.getLogger(__name__)

BALL, JOINTS, NEW_BALL, TARGETS = "ball", "joint_states", "new_ball", "joint_trajectory"
ROS_ARGS: Final = "--ros-args"
NOT_A_NUMBER: Final = math.nan  # a joint that is not known: the controller counts it and holds over


class Messages(NamedTuple):
    """The ROS 2 message types that the node makes: classes with the fields of these names."""

    joint_trajectory: Callable[..., Any]  # trajectory_msgs/JointTrajectory
    point: Callable[..., Any]  # trajectory_msgs/JointTrajectoryPoint
    duration: Callable[..., Any]  # builtin_interfaces/Duration
    header: Callable[..., Any]  # std_msgs/Header
    time: Callable[..., Any]  # builtin_interfaces/Time


def time_to_reach(contract: RobotContract, positions: Array, joint_pos: Array) -> float:
    """Return the time [s] in which the targets can be reached: no joint over its speed limit, at least a period."""
    return max(contract.period, float(np.max(np.abs(positions - joint_pos) / contract.of_joints("speed"))))


class RobotNode:
    """Turns messages of ball and joints into joint trajectories.

    Args:
        controller: Of the policy.
        messages: The message types.
        publish: Sends a JointTrajectory.
        frame: ``frame_id`` of the world frame; a message of another frame is refused and counted.
        joint_names: The robot's own names of the joints, in the contract's order; empty: the contract's names.
    """

    def __init__(
        self,
        controller: Controller,
        messages: Messages,
        publish: Callable[[Any], None],
        frame: str = "table",
        joint_names: Sequence[str] = (),
    ) -> None:
        wanted = controller.contract.joint_names
        if joint_names and len(joint_names) != len(wanted):
            raise ReportedError(
                f"{len(joint_names)} joint names; allowed: {len(wanted)}, for {', '.join(wanted)}"
            )
        self.refused: Counter[str] = Counter()  # messages that were not used, by topic
        self._controller, self._messages, self._publish = controller, messages, publish
        self._frame, self._names = frame, list(joint_names or wanted)
        self._origin: int | None = None
        self._joints: tuple[list[float], list[float]] | None = None
        self._steps_since_joints = 0

    def on_ball(self, message: Any) -> None:
        """Take a PointStamped: a detection of the ball."""
        if self._is_in_frame(BALL, message):
            point = message.point
            self._controller.see(self._seconds(message.header.stamp), (point.x, point.y, point.z))

    def on_new_ball(self, message: Any) -> None:
        """Take a PointStamped: a new ball, and where to return it."""
        if self._is_in_frame(NEW_BALL, message):
            try:
                self._controller.begin((message.point.x, message.point.y))
            except ValueError as error:
                self._refuse(NEW_BALL, str(error))

    def on_joints(self, message: Any) -> None:
        """Take a JointState. Joints that it lacks, or that have no velocity, count as bad measurements."""
        place = {name: k for k, name in enumerate(message.name)}

        def of(values: Sequence[float]) -> list[float]:
            found = [place.get(name, len(values)) for name in self._names]
            return [float(values[k]) if k < len(values) else NOT_A_NUMBER for k in found]

        self._joints = of(message.position), of(message.velocity)
        self._steps_since_joints = 0

    def on_timer(self, stamp: Any) -> None:
        """Do a control step at a Time: publish a trajectory if there are new targets.

        A second step without a new JointState counts as bad joints, so that the robot stops if they stay away.
        """
        if self._joints is None:
            return
        joint_pos, joint_vel = self._joints
        self._steps_since_joints += 1
        if self._steps_since_joints > 2:
            joint_pos = joint_vel = [NOT_A_NUMBER] * len(self._names)
        try:
            command = self._controller.step(self._seconds(stamp), joint_pos, joint_vel)
        except ValueError as error:
            self._refuse(JOINTS, str(error))
            return
        if command.is_new:
            self._publish(self._trajectory(command.positions, np.array(joint_pos)))

    def _trajectory(self, positions: Array, joint_pos: Array) -> Any:
        """Return a JointTrajectory whose one point is to be reached as fast as the joints' speed limits allow.

        Its stamp is 0: it begins when it arrives.
        """
        make = self._messages
        here = np.where(np.isfinite(joint_pos), joint_pos, positions)
        whole, rest = divmod(round(1e9 * time_to_reach(self._controller.contract, positions, here)), 10**9)
        point = make.point(
            positions=positions.tolist(),
            velocities=[],
            accelerations=[],
            effort=[],
            time_from_start=make.duration(sec=whole, nanosec=rest),
        )
        header = make.header(stamp=make.time(sec=0, nanosec=0), frame_id="")
        return make.joint_trajectory(header=header, joint_names=self._names, points=[point])

    def _is_in_frame(self, topic: str, message: Any) -> bool:
        found = message.header.frame_id
        if found != self._frame:
            self._refuse(topic, f"frame_id {found!r}; allowed: {self._frame!r}")
        return bool(found == self._frame)

    def _refuse(self, topic: str, why: str) -> None:
        if not self.refused[topic]:
            log.warning("message refused topic=%s: %s (later ones are only counted)", topic, why)
        self.refused[topic] += 1

    def _seconds(self, stamp: Any) -> float:
        """Return a Time since the whole second of the first one [s]: seconds since 1970 leave only 0.2 us."""
        if self._origin is None:
            self._origin = int(stamp.sec)
        return float(stamp.sec - self._origin) + 1e-9 * float(stamp.nanosec)


def main(argv: Sequence[str]) -> int:
    """Run the node until ROS ends it; return the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m topspin_robot.ros2",
        description="Play with an exported policy as a ROS 2 node: detections of the ball and joint states in, joint "
        "trajectories out.",
    )
    parser.add_argument("folder", help="folder of `topspin export`")
    parser.add_argument(
        "--frame", default="table", help="frame_id of the world frame (default: table); others are refused"
    )
    parser.add_argument(
        "--joint-names",
        default="",
        metavar="A,B,...",
        help="the robot's own names of the joints, in our order",
    )
    words = list(argv)
    # What follows is for ROS: rclpy reads it itself, for example new names of the topics
    arguments = parser.parse_args(words[: words.index(ROS_ARGS)] if ROS_ARGS in words else words)
    names = [name for name in arguments.joint_names.split(",") if name]
    try:
        spin(load(arguments.folder), arguments.frame, names)
    except ReportedError as error:
        sys.stderr.write(f"{parser.prog}: {error}\n")
        return 1
    return 0


def spin(controller: Controller, frame: str, names: Sequence[str]) -> None:
    """Run the node until a signal ends it. Raises ReportedError without ROS 2."""
    # rclpy is no package of an index: it comes with ROS 2
    try:
        import rclpy  # noqa: PLC0415
        from builtin_interfaces.msg import Duration, Time  # noqa: PLC0415
        from geometry_msgs.msg import PointStamped  # noqa: PLC0415
        from rclpy.executors import ExternalShutdownException  # noqa: PLC0415
        from sensor_msgs.msg import JointState  # noqa: PLC0415
        from std_msgs.msg import Header  # noqa: PLC0415
        from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint  # noqa: PLC0415
    except ImportError as error:
        raise ReportedError(f"no {error.name}: source the setup file of a ROS 2 installation first") from None
    rclpy.init()
    ros = rclpy.create_node("topspin_robot")
    publisher = ros.create_publisher(JointTrajectory, TARGETS, 1)
    messages = Messages(JointTrajectory, JointTrajectoryPoint, Duration, Header, Time)
    node = RobotNode(controller, messages, publisher.publish, frame, names)
    ros.create_subscription(PointStamped, BALL, node.on_ball, 50)
    ros.create_subscription(PointStamped, NEW_BALL, node.on_new_ball, 10)
    ros.create_subscription(JointState, JOINTS, node.on_joints, 1)
    ros.create_timer(controller.contract.period, lambda: node.on_timer(ros.get_clock().now().to_msg()))
    # Ctrl-C, or the launch system's signal: the usual end of a node, and no fault
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(ros)
    ros.destroy_node()
    rclpy.try_shutdown()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

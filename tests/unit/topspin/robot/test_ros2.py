"""The ROS 2 node without ROS: its messages are written and read as ROS 2 does, by its own definitions."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from common.errors import ReportedError
from tests.unit.topspin.export.exports import export, small_policy
from topspin.robot.contract import POLICY_FILE
from topspin.robot.controller import MAX_HELD, Controller
from topspin.robot.faults import Fault
from topspin.robot.made_up_ball import detections
from topspin.robot.network import Network
from topspin.robot.ros2 import Messages, RobotNode, main, spin

STORE = get_typestore(Stores.ROS2_HUMBLE)
TYPES = {
    name: STORE.types[f"{package}/msg/{name}"]
    for package, names in {
        "builtin_interfaces": ("Duration", "Time"),
        "geometry_msgs": ("Point", "PointStamped"),
        "sensor_msgs": ("JointState",),
        "std_msgs": ("Header",),
        "trajectory_msgs": ("JointTrajectory", "JointTrajectoryPoint"),
    }.items()
    for name in names
}
EPOCH = 1_790_000_000  # [s] ROS stamps are since 1970


def point_message(**fields):
    """Return a trajectory point: rosbags wants arrays where rclpy takes lists."""
    arrays = {
        name: np.array(value, np.float64) if isinstance(value, list) else value
        for name, value in fields.items()
    }
    return TYPES["JointTrajectoryPoint"](**arrays)


MESSAGES = Messages(
    TYPES["JointTrajectory"], point_message, TYPES["Duration"], TYPES["Header"], TYPES["Time"]
)


@pytest.fixture(scope="module")
def parts(tmp_path_factory):
    """Contract and network of an exported policy."""
    out = tmp_path_factory.mktemp("ros") / "out"
    contract, _ = export(small_policy(), out, "small")
    return contract, Network(out / POLICY_FILE, contract.size)


@pytest.fixture
def controller(parts):
    return Controller(*parts)


def stamp(seconds):
    whole, rest = divmod(round(1e9 * seconds), 10**9)
    return TYPES["Time"](EPOCH + whole, rest)


def over_the_wire(message):
    """Return a message as its receiver gets it: serialized as ROS 2 does (CDR), and read again."""
    kind = message.__msgtype__
    return STORE.deserialize_cdr(STORE.serialize_cdr(message, kind), kind)


def point(seconds, x, y, z, frame="table"):
    header = TYPES["Header"](stamp(seconds), frame)
    return over_the_wire(TYPES["PointStamped"](header, TYPES["Point"](x, y, z)))


def joints(names, pos, vel):
    header = TYPES["Header"](stamp(0.0), "")
    state = TYPES["JointState"](header, list(names), np.array(pos), np.array(vel), np.zeros(0))
    return over_the_wire(state)


def play_ball(node, controller, start, steps=10, velocities=True):
    """Play a made-up ball: a new ball, joints in another order than the contract's, detections, and timers."""
    names, home = controller.contract.joint_names, controller.contract.of_joints("home")
    state = joints(names[::-1], home[::-1], np.zeros(7 if velocities else 0))
    pictures = list(detections(0.02 * steps))
    node.on_new_ball(point(start, 0.9, -0.2, 0.0))
    for step in range(steps):
        while pictures and pictures[0][0] <= 0.02 * step:
            moment, pos = pictures.pop(0)
            node.on_ball(point(start + moment, *pos))
        node.on_joints(state)
        node.on_timer(stamp(start + 0.02 * step))


def test_the_node_sends_the_controllers_targets_as_ros_2_joint_trajectories(controller, parts):
    sent = []
    play_ball(RobotNode(controller, MESSAGES, lambda m: sent.append(over_the_wire(m))), controller, 10.0)
    home, speed = controller.contract.of_joints("home"), controller.contract.of_joints("speed")

    direct = play_directly(Controller(*parts))
    assert len(sent) == 10
    for message, positions in zip(sent, direct, strict=True):
        (only,) = message.points
        assert message.joint_names == controller.contract.joint_names
        np.testing.assert_allclose(only.positions, positions, atol=1e-5)
        seconds = only.time_from_start.sec + 1e-9 * only.time_from_start.nanosec
        assert seconds >= 0.02 - 1e-9
        assert (np.abs(only.positions - home) <= speed * (seconds + 1e-8)).all()
    assert (
        max(m.points[0].time_from_start.nanosec for m in sent) > 20_000_000
    )  # a target farther than a period


def play_directly(controller):
    """Return the targets of the same ball, given to the controller itself."""
    home = controller.contract.of_joints("home")
    pictures, found = list(detections(0.2)), []
    controller.begin((0.9, -0.2))
    for step in range(10):
        while pictures and pictures[0][0] <= 0.02 * step:
            moment, pos = pictures.pop(0)
            controller.see(50.0 + moment, pos)
        found.append(controller.step(50.0 + 0.02 * step, home, np.zeros(7)).positions)
    return found


def test_joint_states_that_stay_away_stop_the_robot(controller):
    sent = []
    node = RobotNode(controller, MESSAGES, sent.append)
    play_ball(node, controller, 400.0)
    sent.clear()
    for step in range(10):
        node.on_ball(point(400.2 + 0.02 * step, 0.1, 0.1, 0.2))
        node.on_timer(stamp(400.2 + 0.02 * step))

    assert len(sent) == 1 + MAX_HELD
    assert controller.faults == {Fault.JOINTS_NOT_FINITE: 9}


def test_messages_of_another_frame_are_refused_and_counted(controller):
    sent = []
    node = RobotNode(controller, MESSAGES, sent.append, frame="court")
    play_ball(node, controller, 100.0)

    assert sent == []
    assert node.refused == {"new_ball": 1, "ball": 33}


def test_joints_without_velocities_are_refused_by_name(controller):
    sent = []
    node = RobotNode(controller, MESSAGES, sent.append)
    play_ball(node, controller, 200.0, velocities=False)

    assert sent == []
    assert node.refused == {"joint_states": 10}
    assert "joint_vel[0] is nan" in controller.last_fault


def test_a_target_that_is_no_number_is_refused(controller):
    node = RobotNode(controller, MESSAGES, lambda message: None)
    node.on_new_ball(point(0.0, float("nan"), 0.0, 0.0))

    assert node.refused == {"new_ball": 1}


def test_a_robot_with_its_own_names_of_the_joints(controller):
    names, sent = [f"axis_{k}" for k in range(7)], []
    node = RobotNode(controller, MESSAGES, sent.append, joint_names=names)
    node.on_new_ball(point(300.0, 0.9, -0.2, 0.0))
    node.on_ball(point(300.0, 1.3, 0.1, 0.3))
    node.on_joints(joints(["other", *names], [9.0, *controller.contract.of_joints("home")], np.zeros(8)))
    node.on_timer(stamp(300.0))

    assert [message.joint_names for message in sent] == [names]
    with pytest.raises(ReportedError, match="1 joint names; allowed: 7, for rail_x"):
        RobotNode(controller, MESSAGES, sent.append, joint_names=["one"])


class ShutDownError(Exception):
    """What rclpy's executor raises when a signal has ended its context."""


@pytest.mark.parametrize("end", [KeyboardInterrupt, ShutDownError])
def test_a_signal_ends_the_node_without_a_traceback(controller, monkeypatch, end):
    """rclpy itself is not here: what it is asked for is."""
    closed = []

    def spinning(_node):
        raise end

    node = SimpleNamespace(
        create_publisher=lambda *_: SimpleNamespace(publish=None),
        create_subscription=lambda *_: None,
        create_timer=lambda *_: None,
        destroy_node=lambda: closed.append("node"),
    )
    rclpy = SimpleNamespace(
        init=lambda: None,
        create_node=lambda _: node,
        spin=spinning,
        try_shutdown=lambda: closed.append("context"),
    )
    monkeypatch.setitem(sys.modules, "rclpy", rclpy)
    monkeypatch.setitem(
        sys.modules, "rclpy.executors", SimpleNamespace(ExternalShutdownException=ShutDownError)
    )
    for module in ("builtin_interfaces", "geometry_msgs", "sensor_msgs", "std_msgs", "trajectory_msgs"):
        types = SimpleNamespace(**TYPES)
        monkeypatch.setitem(sys.modules, module, SimpleNamespace(msg=types))
        monkeypatch.setitem(sys.modules, f"{module}.msg", types)

    spin(controller, "table", [])

    assert closed == ["node", "context"]


def test_words_for_ros_are_left_to_ros(tmp_path, capsys):
    assert main([str(tmp_path / "nowhere"), "--ros-args", "-r", "ball:=/camera/ball"]) == 1

    assert "nowhere" in capsys.readouterr().err  # and no unknown argument

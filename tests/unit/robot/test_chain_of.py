"""The kernels' kinematics against MuJoCo's, for random poses and motions of every robot."""

import mujoco
import numpy as np
import pytest

from common.physics import chain as kinematics
from common.physics import touch
from common.robot.chain_of import capsule_names, chain_of
from common.robot.description import RobotError, describe, robot_names
from common.robot.model import load_model

EXACT = {"rtol": 0, "atol": 1e-12}  # the same rigid chain, rounded in another order
ROBOTS = robot_names()


class Robot:
    """A robot's model, chain, and random poses within its stops."""

    def __init__(self, name: str) -> None:
        self.name, self.model, self.chain = name, load_model(name), chain_of(name)
        self.low, self.high = np.array(self.model.jnt_range).T
        self.speed = np.array([joint.speed for joint in describe(name).joint])

    def poses(self, count: int, seed: int = 0) -> np.ndarray:
        return np.random.default_rng(seed).uniform(self.low, self.high, (count, 7))

    def rates(self, count: int, seed: int = 1) -> np.ndarray:
        return np.random.default_rng(seed).uniform(-1, 1, (count, 7)) * self.speed

    def at(self, q: np.ndarray, qd: np.ndarray | None = None) -> mujoco.MjData:
        data = mujoco.MjData(self.model)
        data.qpos[:] = q
        data.qvel[:] = 0.0 if qd is None else qd
        mujoco.mj_forward(self.model, data)
        return data


@pytest.fixture(params=ROBOTS)
def robot(request) -> Robot:
    return Robot(request.param)


def test_the_robots_that_ship():
    assert ROBOTS == ["arm", "pro", "rails", "usst"]


def test_the_rackets_centre_and_axes_agree_with_mujoco(robot):
    for q in robot.poses(100):
        site = robot.at(q).site("racket")
        pose = kinematics.racket_pose(robot.chain, tuple(q))

        np.testing.assert_allclose(pose.centre, site.xpos, **EXACT)
        np.testing.assert_allclose(
            np.column_stack([pose.normal, pose.side, pose.up]).ravel(), site.xmat, **EXACT
        )


def test_the_quaternion_has_the_rackets_axes_and_w_is_not_negative(robot):
    for q in robot.poses(100):
        pose = kinematics.racket_pose(robot.chain, tuple(q))
        matrix, quaternion = np.empty(9), np.array(kinematics.quaternion_of(pose))
        mujoco.mju_quat2Mat(matrix, quaternion)

        assert quaternion[0] >= 0.0
        np.testing.assert_allclose(np.linalg.norm(quaternion), 1.0, **EXACT)
        np.testing.assert_allclose(
            matrix.reshape(3, 3), np.column_stack([pose.normal, pose.side, pose.up]), **EXACT
        )


@pytest.mark.parametrize("turn", [(1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1), (0, 0.6, 0.8, 0)])
def test_the_quaternion_of_half_turns(turn):
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, np.array(turn, float))
    columns = [tuple(column) for column in matrix.reshape(3, 3).T]
    found = kinematics.quaternion_of(kinematics.RacketPose((0.0, 0.0, 0.0), *columns, 0.08, 0.006))

    assert abs(np.dot(found, turn)) == pytest.approx(1.0)


def test_the_rackets_velocities_agree_with_mujoco(robot):
    for q, qd in zip(robot.poses(100), robot.rates(100), strict=True):
        twist = np.empty(6)
        site = robot.model.site("racket").id
        data = robot.at(q, qd)
        mujoco.mj_objectVelocity(robot.model, data, mujoco.mjtObj.mjOBJ_SITE, site, twist, 0)
        velocity, angular = kinematics.racket_motion(robot.chain, tuple(q), tuple(qd))

        np.testing.assert_allclose(angular, twist[:3], rtol=0, atol=1e-11)
        np.testing.assert_allclose(velocity, twist[3:], rtol=0, atol=1e-11)


def test_the_gap_to_the_body_is_that_to_the_nearest_of_mujocos_capsules(robot):
    rng = np.random.default_rng(2)
    for q in robot.poses(100):
        data = robot.at(q)
        ball = data.site("racket").xpos + rng.uniform(-0.6, 0.6, 3)
        gaps = []
        for name in capsule_names(robot.name):
            axis = data.geom(name).xmat.reshape(3, 3)[:, 2]
            radius, half = robot.model.geom(name).size[:2]
            along = np.clip((ball - data.geom(name).xpos) @ axis, -half, half)
            gaps.append(np.linalg.norm(ball - data.geom(name).xpos - along * axis) - radius - 0.02)
        gap, normal = touch.body_gap(tuple(ball), robot.chain, tuple(q))

        assert gap == pytest.approx(min(gaps), abs=1e-12)
        assert np.linalg.norm(normal) == pytest.approx(1.0)


def test_the_racket_of_the_ball_is_that_of_mujoco(robot):
    pose = kinematics.racket_pose(robot.chain, (0.0,) * 7)
    radius, half_thickness = robot.model.geom("racket").size[:2]

    assert (pose.radius, pose.half_thickness) == (radius, half_thickness)
    assert (radius, half_thickness) == (0.076, 0.0065)


def test_the_bound_of_the_gap_is_not_larger_than_any_gap(robot):
    rng = np.random.default_rng(3)
    tightest = np.inf
    for q in robot.poses(500):
        ball = tuple(rng.uniform([-3.0, -2.0, -0.7], [0.5, 2.0, 1.5]))
        bound = touch.robot_gap_bound(ball, robot.chain, tuple(q))
        racket, _ = touch.racket_gap(ball, kinematics.racket_pose(robot.chain, tuple(q)))
        gap = min(racket, touch.body_gap(ball, robot.chain, tuple(q))[0])
        tightest = min(tightest, gap - bound)

        assert bound <= gap + 1e-12
    assert tightest < 0.25  # a bound that is never near is of no use


def robot_points(robot: Robot, q: kinematics.Joints) -> np.ndarray:
    """Return points of arm and racket: the ends of its parts, the rim of the blade and of its face."""
    pose = kinematics.racket_pose(robot.chain, q)
    angles = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    rim = np.cos(angles)[:, None] * np.array(pose.side) + np.sin(angles)[:, None] * np.array(pose.up)
    blade = np.array(pose.centre) + 0.076 * rim
    face = blade + 0.0065 * np.array(pose.normal)
    data = robot.at(np.array(q))
    ends = []
    for name in capsule_names(robot.name):
        geom = data.geom(name)
        reach = robot.model.geom(name).size[1] * geom.xmat.reshape(3, 3)[:, 2]
        ends += [geom.xpos - reach, geom.xpos + reach]
    return np.concatenate([np.array(ends), blade, face])


def test_no_point_of_the_robot_moves_faster_than_the_bound(robot):
    step = 0.004
    nearest = 0.0
    for q, qd in zip(robot.poses(150), robot.rates(150), strict=True):
        path = np.stack([q, q + step * qd])
        bound = kinematics.speed_bound(robot.chain, path, step)
        before, after = (
            robot_points(robot, kinematics.joints_at(path, t, step)) for t in (0.4 * step, 0.4 * step + 1e-7)
        )
        fastest = np.linalg.norm(after - before, axis=1).max() / 1e-7
        nearest = max(nearest, fastest / bound)

        assert fastest <= bound * (1 + 1e-6)
    assert nearest > 0.5


@pytest.mark.parametrize("joint", range(7))
def test_the_speed_bound_counts_every_joint(robot, joint):
    """A joint alone, in the pose that stretches the arm: the bound is not below the racket's fastest point."""
    step = 0.004
    for q in robot.poses(60, seed=joint):
        qd = np.zeros(7)
        qd[joint] = robot.speed[joint]
        path = np.stack([q, q + step * qd])
        before, after = (robot_points(robot, kinematics.joints_at(path, t, step)) for t in (0.0, 1e-7))
        fastest = np.linalg.norm(after - before, axis=1).max() / 1e-7

        assert fastest <= kinematics.speed_bound(robot.chain, path, step) * (1 + 1e-6)
        assert kinematics.speed_bound(robot.chain, path, step) > 0.0


def test_between_its_time_steps_the_robot_moves_uniformly_at_its_joint_rates():
    path = Robot("rails").poses(3)
    step = 0.004
    for moment in (0.001, 0.0055):
        early, late = (np.array(kinematics.joints_at(path, moment + d, step)) for d in (-1e-6, 1e-6))

        np.testing.assert_allclose(
            (late - early) / 2e-6, kinematics.joint_rates_at(path, moment, step), rtol=1e-6
        )


def test_the_velocity_of_a_point_is_that_of_the_rigid_racket(robot):
    q, qd = robot.poses(1)[0], robot.rates(1)[0]
    pose, velocity, angular = kinematics.racket_state(robot.chain, tuple(q), tuple(qd))
    point = np.array(pose.centre) + 0.05 * np.array(pose.side) - 0.03 * np.array(pose.up)
    later = kinematics.racket_pose(robot.chain, tuple(q + 1e-7 * qd))
    moved = np.array(later.centre) + 0.05 * np.array(later.side) - 0.03 * np.array(later.up)

    expected = (moved - point) / 1e-7
    np.testing.assert_allclose(
        kinematics.point_velocity(pose.centre, velocity, angular, tuple(point)), expected, atol=1e-4
    )


def test_a_robot_that_is_not_there_is_refused_with_those_that_are():
    with pytest.raises(RobotError, match=r"robot 'rail'; allowed: arm, pro, rails, usst"):
        chain_of("rail")

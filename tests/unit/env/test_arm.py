"""The kernels' kinematics against MuJoCo's, for random poses and motions of the robot."""

import mujoco
import numpy as np
import pytest

from common.env.robot import RACKET_BODY, load_model
from common.physics import arm, touch
from common.physics.constants import TABLE_HALF_LENGTH, TABLE_HALF_WIDTH, TABLE_THICKNESS

MODEL = load_model()
RANGES = np.array(MODEL.jnt_range)
EXACT = {"rtol": 0, "atol": 1e-12}  # the same rigid chain, rounded in another order


def poses(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(RANGES[:, 0], RANGES[:, 1], (count, 7))


def rates(count: int, seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, (count, 7)) * [3, 3, 15, 15, 15, 15, 15]


def mujoco_at(q: np.ndarray, qd: np.ndarray | None = None) -> mujoco.MjData:
    data = mujoco.MjData(MODEL)
    data.qpos[:] = q
    data.qvel[:] = 0.0 if qd is None else qd
    mujoco.mj_forward(MODEL, data)
    return data


def test_the_rackets_centre_and_axes_agree_with_mujoco():
    for q in poses(200):
        site = mujoco_at(q).site(RACKET_BODY)
        pose = arm.racket_pose(tuple(q))

        np.testing.assert_allclose(pose.centre, site.xpos, **EXACT)
        np.testing.assert_allclose(
            np.column_stack([pose.normal, pose.side, pose.up]).ravel(), site.xmat, **EXACT
        )


def test_the_quaternion_has_the_rackets_axes_and_w_is_not_negative():
    for q in poses(200):
        matrix, quaternion = np.empty(9), np.array(arm.racket_quaternion(tuple(q)))
        mujoco.mju_quat2Mat(matrix, quaternion)
        pose = arm.racket_pose(tuple(q))

        assert quaternion[0] >= 0.0
        np.testing.assert_allclose(np.linalg.norm(quaternion), 1.0, **EXACT)
        np.testing.assert_allclose(matrix.reshape(3, 3), np.column_stack(pose[1:]), **EXACT)


def test_the_rackets_velocities_agree_with_mujoco():
    for q, qd in zip(poses(200), rates(200), strict=True):
        twist = np.empty(6)
        body = MODEL.body(RACKET_BODY).id
        mujoco.mj_objectVelocity(MODEL, mujoco_at(q, qd), mujoco.mjtObj.mjOBJ_BODY, body, twist, 0)
        velocity, angular = arm.racket_motion(tuple(q), tuple(qd))

        np.testing.assert_allclose(angular, twist[:3], rtol=0, atol=1e-11)
        np.testing.assert_allclose(velocity, twist[3:], rtol=0, atol=1e-11)


def test_the_ends_of_the_links_agree_with_mujoco():
    for q in poses(100):
        data = mujoco_at(q)
        shoulder, elbow, wrist, handle, centre = arm.links(tuple(q))

        np.testing.assert_allclose(shoulder, data.body("upper_arm").xpos, **EXACT)
        np.testing.assert_allclose(elbow, data.body("forearm").xpos, **EXACT)
        np.testing.assert_allclose(wrist, data.body("wrist").xpos, **EXACT)
        np.testing.assert_allclose(centre, data.body(RACKET_BODY).xpos, **EXACT)
        assert np.linalg.norm(np.subtract(centre, handle)) == pytest.approx(arm.RACKET_RADIUS)


@pytest.mark.parametrize(
    ("geom", "radius"),
    [
        ("upper_arm", arm.UPPER_ARM_RADIUS),
        ("forearm", arm.FOREARM_RADIUS),
        ("wrist", arm.WRIST_RADIUS),
        ("column", arm.COLUMN_RADIUS),
        ("racket", arm.RACKET_RADIUS),
    ],
)
def test_the_radii_agree_with_the_model(geom, radius):
    assert MODEL.geom(geom).size[0] == radius


def test_blade_and_beam_agree_with_the_model():
    beam = MODEL.geom("beam")

    assert MODEL.geom("racket").size[1] == arm.RACKET_HALF_THICKNESS
    assert beam.size[0] == arm.BEAM_RADIUS
    assert beam.size[1] == arm.BEAM_HALF_LENGTH
    np.testing.assert_allclose(MODEL.body("beam").pos, [arm.RAIL_HOME_X, 0.0, arm.BEAM_Z])


def test_the_simulators_table_agrees_with_the_balls_table():
    table = MODEL.geom("table")

    np.testing.assert_allclose(2 * table.size, [2 * TABLE_HALF_LENGTH, 2 * TABLE_HALF_WIDTH, TABLE_THICKNESS])
    assert table.pos[2] == -table.size[2]  # its top is at height 0


def test_the_gap_to_a_link_is_not_larger_than_by_mujocos_geoms():
    """The gap to upper arm and forearm, against the distance to the capsules of MuJoCo's model."""
    rng = np.random.default_rng(2)
    for q in poses(50):
        data = mujoco_at(q)
        _, elbow, wrist, _, centre = arm.links(tuple(q))
        ball = np.array(elbow) + rng.uniform(-0.15, 0.15, 3)
        names = ("upper_arm", "forearm")
        # a capsule's axis is its geom's z axis: distance of the ball's centre from this segment
        gaps = []
        for name in names:
            axis = data.geom(name).xmat.reshape(3, 3)[:, 2]
            radius, half = MODEL.geom(name).size[:2]
            along = np.clip((ball - data.geom(name).xpos) @ axis, -half, half)
            gaps.append(np.linalg.norm(ball - data.geom(name).xpos - along * axis) - radius - 0.02)
        gap, _ = touch.body_gap(tuple(ball), tuple(q))

        # another part may be nearer: wrist, column or beam
        assert gap <= min(gaps) + 1e-12
        assert touch.robot_gap_bound(tuple(ball), tuple(q)) <= gap + 1e-12
        assert np.linalg.norm(np.subtract(centre, wrist)) == pytest.approx(arm.RACKET_REACH)


def test_no_point_of_the_robot_moves_faster_than_the_bound():
    step = 0.004
    for q, qd in zip(poses(300), rates(300), strict=True):
        path = np.stack([q, q + step * qd])
        bound = arm.speed_bound(path, step)
        before, after = (robot_points(arm.joints_at(path, t, step)) for t in (0.4 * step, 0.4 * step + 1e-7))
        fastest = np.linalg.norm(after - before, axis=1).max() / 1e-7

        assert fastest <= bound * (1 + 1e-6)


def robot_points(q: arm.Joints) -> np.ndarray:
    """Return points of arm and racket: joints, the rim of the blade and of its face."""
    pose = arm.racket_pose(q)
    angles = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    rim = np.cos(angles)[:, None] * np.array(pose.side) + np.sin(angles)[:, None] * np.array(pose.up)
    blade = np.array(pose.centre) + arm.RACKET_RADIUS * rim
    face = blade + arm.RACKET_HALF_THICKNESS * np.array(pose.normal)
    return np.concatenate([np.array(arm.links(q)), blade, face])


def test_between_its_time_steps_the_robot_moves_uniformly_at_its_joint_rates():
    path = poses(3)
    step = 0.004
    for moment in (0.001, 0.0055):
        early, late = (np.array(arm.joints_at(path, moment + d, step)) for d in (-1e-6, 1e-6))

        np.testing.assert_allclose((late - early) / 2e-6, arm.joint_rates_at(path, moment, step), rtol=1e-6)


def test_the_velocity_of_a_point_is_that_of_the_rigid_racket():
    q, qd = poses(1)[0], rates(1)[0]
    pose = arm.racket_pose(tuple(q))
    velocity, angular = arm.racket_motion(tuple(q), tuple(qd))
    point = np.array(pose.centre) + 0.05 * np.array(pose.side) - 0.03 * np.array(pose.up)
    later = arm.racket_pose(tuple(q + 1e-7 * qd))
    moved = np.array(later.centre) + 0.05 * np.array(later.side) - 0.03 * np.array(later.up)

    expected = (moved - point) / 1e-7
    np.testing.assert_allclose(
        arm.point_velocity(pose.centre, velocity, angular, tuple(point)), expected, atol=1e-4
    )

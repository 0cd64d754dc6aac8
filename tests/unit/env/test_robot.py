"""The MuJoCo robot: its time step is converged, its speeds and limits are as stated, and the ball pushes it."""

import logging

import mujoco
import numpy as np
import pytest

from common.env.robot import MAX_ACTION_LATENCY, MUJOCO_STEP, RobotBatch, home_action
from common.physics.chain import quaternion_of, racket_motion, racket_pose
from common.robot.chain_of import chain_of
from common.robot.description import describe, robot_names
from common.robot.model import load_model
from common.task.randomization import PROFILES

CHAIN = chain_of("rails")

FINE_STEP = 0.00025  # [s] a sixteenth of the robot's
HOME = home_action().astype(np.float64)
STILL = np.zeros((1, 7))
ONE = np.zeros(1, np.int64)


def make_strokes(count: int = 64, steps: int = 20, seed: int = 0) -> np.ndarray:
    """Return smooth full strokes as of a policy: (steps, count, 7) actions at 50 Hz.

    In 0.2 s each joint moves back by up to a third of its range, then in 0.2 s forward as far beyond home, on
    minimum-jerk curves. The racket reaches 4 m/s.
    """
    rng = np.random.default_rng(seed)
    back, front = HOME + 0.35 * rng.uniform(-1, 1, (2, count, 7)) * [1, 1, 0.4, 0.4, 0.4, 0.5, 0.4]
    s = np.arange(1, steps // 2 + 1)[:, None, None] / (steps // 2)
    blend = s**3 * (10 - 15 * s + 6 * s * s)
    return np.concatenate([HOME + (back - HOME) * blend, back + (front - back) * blend])


def racket_errors(actions: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Return distance [m] and angle [rad] between the rackets with ``step`` and FINE_STEP, at every control step."""
    coarse, fine = (RobotBatch(actions.shape[1], step=h) for h in (step, FINE_STEP))
    distances, turns = [], []
    for action in actions:
        coarse.step(action)
        fine.step(action)
        for a, b in zip(coarse.joint_pos, fine.joint_pos, strict=True):
            distances.append(
                np.linalg.norm(
                    np.subtract(racket_pose(CHAIN, tuple(a)).centre, racket_pose(CHAIN, tuple(b)).centre)
                )
            )
            cosine = np.dot(
                quaternion_of(racket_pose(CHAIN, tuple(a))), quaternion_of(racket_pose(CHAIN, tuple(b)))
            )
            turns.append(2.0 * np.arccos(np.clip(abs(cosine), 0.0, 1.0)))
    return np.array(distances), np.array(turns)


def racket_speed(robot: RobotBatch) -> float:
    return float(
        np.linalg.norm(racket_motion(CHAIN, tuple(robot.joint_pos[0]), tuple(robot.joint_vel[0]))[0])
    )


def drive(robot: RobotBatch, action: np.ndarray, steps: int) -> tuple[np.ndarray, float]:
    """Return the largest speed of each joint and of the racket under a constant action."""
    joints, racket = np.zeros(7), 0.0
    for _ in range(steps):
        robot.step(action[None])
        joints = np.maximum(joints, np.abs(robot.joint_vel[0]))
        racket = max(racket, racket_speed(robot))
    return joints, racket


def test_the_time_step_is_converged_over_full_strokes():
    """4 ms against 0.25 ms: racket mean 1.4 mm and 4 mrad, at most 5.1 mm and 27 mrad (measured).

    The ball's diameter is 40 mm and the measurement noise is 3 mm. The error is the same in training and evaluation, so
    a policy can't observe it. Targets that jump by half a range, so that every drive saturates, have a mean error of
    5 mm.
    """
    distances, turns = racket_errors(make_strokes(), MUJOCO_STEP)

    assert distances.mean() < 0.002
    assert distances.max() < 0.007
    assert turns.mean() < 0.006
    assert turns.max() < 0.035


def test_the_error_of_the_time_step_falls_in_proportion_to_it():
    strokes = make_strokes(count=16)
    whole, half = (racket_errors(strokes, step)[0].mean() for step in (0.004, 0.002))

    # first order, against a reference of h/16: (4 - 0.25)/(2 - 0.25) = 2.1
    assert whole / half == pytest.approx(2.1, abs=0.5)


def test_the_racket_reaches_8_to_9_m_per_s():
    robot = RobotBatch(1)
    drive(robot, np.array([-1, 0, 0, -0.6, -0.35, -0.4, 0]), steps=60)
    _, racket = drive(robot, np.array([1, 0, 0, 0.9, 0.7, 0.9, 0]), steps=25)

    assert racket > 8.0


def test_the_racket_of_pro_reaches_20_m_per_s():
    """The class of the best real system. Measured: 21 m/s in this stroke, with all contacts on."""
    robot = RobotBatch(1, "pro")
    drive(robot, np.array([-1, 0.2, 0.37, -0.41, -0.76, -0.68, -0.71]), steps=40)
    largest = 0.0
    for _ in range(20):
        robot.step(np.array([[1, 0.66, 0.56, 0.82, 0.76, 0.74, -0.76]]))
        largest = max(largest, racket_speed(robot))

    assert 20.0 < largest < 25.0


def test_the_robot_moves_70_cm_sideways_in_0_4_s():
    robot = RobotBatch(1)
    aside = HOME.copy()
    aside[1] = 0.9
    drive(robot, aside, steps=20)

    assert abs(robot.joint_pos[0, 1]) > 0.70


def test_joints_overshoot_their_ranges_by_little_under_the_widest_targets():
    """MuJoCo's joint limits are springs. A joint whose target jumps from end to end overshoots its stop.

    Measured: 4 mm, and 0.19 rad of the pitch, which carries the whole arm at 13 rad/s.
    """
    overshoot = np.array([0.01, 0.01, 0.35, 0.35, 0.35, 0.35, 0.35])
    rng = np.random.default_rng(0)
    robot = RobotBatch(64)
    low, high = np.array(robot.model.jnt_range).T
    for _ in range(15):
        action = rng.choice([-1.0, 1.0], (64, 7))
        for _ in range(10):
            robot.step(action)

            assert np.all(robot.joint_pos > low - overshoot)
            assert np.all(robot.joint_pos < high + overshoot)


def uniform_targets(steps: int = 90, count: int = 64, seed: int = 0) -> np.ndarray:
    """Return targets anywhere in the ranges that jump every 60 ms: all joints at once, far beyond any policy."""
    return np.repeat(np.random.default_rng(seed).uniform(-1, 1, (steps // 3, count, 7)), 3, axis=0)


@pytest.mark.parametrize(
    ("name", "limits"),
    [
        ("rails", [3.1, 3.3, 15.0, 15.0, 15.0, 15.0, 15.0]),
        # published: rails [m/s]; yaw and pitch, then the last three joints [rad/s]
        ("usst", [2.0, 2.0, 11.64, 11.64, 5.86, 5.86, 5.86]),
        ("pro", [5.0, 5.0, 30.0, 30.0, 40.0, 40.0, 40.0]),
        ("arm", [10.0, 10.0, 12.0, 15.0, 18.0, 18.0, 18.0]),
    ],
)
def test_joints_in_coupled_motion_hold_their_speed_limits(name, limits):
    """All joints at once, targets that jump: nothing but the drives holds the limits. Contacts are off.

    Measured: at most 0.95, 1.16, 0.98 and 1.08 of the limit. The elbow of usst is the worst: its limit is low, and the
    pitch, which carries it, has twice its torque and twice its speed.
    """
    robot = RobotBatch(64, name)
    robot.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT.value
    robot = RobotBatch(64, name, model=robot.model)
    largest = np.zeros(7)
    for action in uniform_targets():
        motion = robot.step(action)
        before = np.concatenate([motion.start_pos[:, None], motion.joint_pos[:, :-1]], axis=1)
        speed = np.abs(motion.joint_pos - before) / robot.step_s
        largest = np.maximum(largest, speed.max(axis=(0, 1)))

    np.testing.assert_array_equal([joint.speed for joint in describe(name).joint], limits)
    assert np.all(largest <= np.array(limits) * (1.2 if name == "usst" else 1.1))
    assert largest.max() > 0.7 * min(limits)


@pytest.mark.parametrize("name", robot_names())
def test_a_link_that_strikes_the_robot_is_stopped_and_felt(name):
    """Targets anywhere drive arm and racket into base, beam and column: the covers hold, and F_c has the force."""
    robot = RobotBatch(64, name)
    deepest, felt, struck = 0.0, 0.0, 0.0
    targets = uniform_targets(seed=3)
    if name == "arm":  # only where elbow and wrist fold
        targets[:, :, [3, 5]] = 1.0
    for action in targets:
        motion = robot.step(action)
        own = robot.sensors.own
        deepest = max(deepest, -own[..., 3].min())
        force = np.linalg.norm(own[..., :3], axis=-1)
        felt = max(felt, force.max())
        struck = max(struck, motion.contact.max())

        # the touch sensors, which are paid, measure at least what the covers do
        assert np.all(motion.contact >= force - 1e-6)

    assert felt > 50.0
    assert struck >= felt
    assert deepest < (0.080 if name == "pro" else 0.030)


def test_usst_is_rails_with_the_published_speed_limits():
    ours, theirs = load_model("rails"), load_model("usst")

    np.testing.assert_array_equal(theirs.body_mass, ours.body_mass)
    np.testing.assert_array_equal(theirs.jnt_range, ours.jnt_range)
    np.testing.assert_array_equal(theirs.actuator_forcerange, ours.actuator_forcerange)


def test_the_stops_are_beyond_the_targets_of_every_robot():
    for name in robot_names():
        stops, joints = load_model(name).jnt_range, describe(name).joint
        for (low, high), joint in zip(stops, joints, strict=True):
            assert low < joint.range[0] < joint.range[1] < high


def test_forces_stay_within_the_actuators_limits():
    robot = RobotBatch(4)
    motion = robot.step(np.ones((4, 7)))

    assert np.all(np.abs(motion.torque) <= robot.torque_limit * (1 + 1e-12))


@pytest.mark.parametrize("control_rate_hz", [50, 200])
def test_the_racket_receives_an_impulse_within_one_control_step(control_rate_hz):
    """Two robots without drives and joint damping, one with the impulse: M dv = J^T impulse."""
    impulse = np.array([[-0.03, 0.01, 0.02, 1e-4, -5e-4, 2e-4]])
    pushed, free = (RobotBatch(1, control_rate_hz=control_rate_hz) for _ in range(2))
    for robot in (pushed, free):
        robot.set_gains(ONE, np.zeros((1, 3, 7)), np.zeros(1))
    inertia, data = np.empty((7, 7)), pushed.batch.get_data(0)
    linear, angular = np.empty((3, 7)), np.empty((3, 7))
    mujoco.mj_forward(pushed.model, data)
    mujoco.mj_fullM(pushed.model, data, inertia)
    mujoco.mj_jacBody(pushed.model, data, linear, angular, pushed.model.body("racket").id)
    momentum = linear.T @ impulse[0, :3] + angular.T @ impulse[0, 3:]
    pushed.push_racket(impulse)
    for robot in (pushed, free):
        robot.step(HOME[None])
    dv = pushed.joint_vel[0] - free.joint_vel[0]

    # the arm falls and turns a little during the step: at 50 Hz M and J change by a few percent
    scale = np.abs(momentum).max()
    np.testing.assert_allclose(
        inertia @ dv, momentum, rtol=0, atol=scale * (0.06 if control_rate_hz == 50 else 0.01)
    )


def test_an_impulse_acts_only_in_the_next_control_step():
    impulse = np.array([[-0.03, 0.0, 0.01, 0.0, 0.0, 0.0]])
    robot = RobotBatch(1)
    wrench = robot.batch.bind("xfrc_applied")[0, robot.model.body("racket").id]
    robot.push_racket(impulse)
    force = wrench.copy()
    robot.step(HOME[None])
    robot.push_racket(np.zeros((1, 6)))

    np.testing.assert_allclose(force * robot.substeps * robot.step_s, impulse[0])
    np.testing.assert_array_equal(wrench, 0.0)


def test_the_home_action_holds_the_home_pose():
    robot = RobotBatch(1)
    drive(robot, HOME, steps=50)

    # gravity: the wrist sags by its torque divided by 80 Nm/rad
    np.testing.assert_allclose(robot.joint_pos[0], robot.home, atol=0.02)


def test_a_drive_with_a_higher_gain_is_closer_to_its_target():
    stiff, soft = RobotBatch(1), RobotBatch(1)
    soft.set_gains(ONE, np.array([[[0.5] * 7, [1.0] * 7, [1.0] * 7]]), np.zeros(1))
    action = HOME + 0.05
    for robot in (stiff, soft):
        robot.step(action[None])
    goal = stiff.middle + stiff.half_range * action

    assert np.all(np.abs(stiff.joint_pos[0] - goal) < np.abs(soft.joint_pos[0] - goal))


@pytest.mark.parametrize("control_rate_hz", [50, 200])
def test_an_action_acts_one_latency_late(control_rate_hz):
    """Also where the latency is longer than the control period, as at 200 Hz."""
    prompt, late = (RobotBatch(1, control_rate_hz=control_rate_hz) for _ in range(2))
    late.set_gains(ONE, np.ones((1, 3, 7)), np.array([0.020]))
    delay = round(0.020 * control_rate_hz)
    home = np.tile(late.home_action, (delay, 1, 1))
    actions = late.home_action + 0.1 * np.random.default_rng(0).standard_normal((12, 1, 7))
    for given, acting in zip(actions, np.concatenate([home, actions]), strict=False):
        late.step(given)
        prompt.step(acting)

    np.testing.assert_array_equal(late.joint_pos, prompt.joint_pos)


def test_targets_are_kept_as_long_as_the_longest_action_latency():
    assert max(profile.action_latency[1] for profile in PROFILES.values()) <= MAX_ACTION_LATENCY


@pytest.mark.parametrize("broken", [np.nan, 1e12])
def test_a_robot_whose_simulation_mujoco_resets_goes_home(broken, caplog, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes a log file of its warnings
    robot = RobotBatch(3)
    robot.step(np.tile(HOME, (3, 1)))
    robot.joint_vel[1, 2] = broken
    with caplog.at_level(logging.WARNING):
        motion = robot.step(np.tile(HOME, (3, 1)))

    np.testing.assert_array_equal(robot.faulty, [1])
    np.testing.assert_array_equal(robot.joint_pos[1], robot.home)
    np.testing.assert_array_equal(motion.joint_pos[1], np.tile(robot.home, (5, 1)))
    assert np.isfinite(motion.torque).all()
    assert "robots sent home after a simulation fault count=1 first=1" in caplog.text
    assert robot.step(np.tile(HOME, (3, 1))).joint_pos.shape == (3, 5, 7)
    assert robot.faulty.size == 0


def test_a_control_period_that_is_not_a_multiple_of_the_step_is_refused():
    with pytest.raises(
        ValueError, match=r"control period 0.02 s is not a multiple of the MuJoCo step 0.003 s"
    ):
        RobotBatch(1, step=0.003)

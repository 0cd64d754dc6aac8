"""The robot in torch against the simulated one: kinematics nearly exactly, drives within the model's error."""

import numpy as np
import torch

from common.env.robot import RobotBatch
from common.physics.arm import racket_motion, racket_pose, racket_quaternion
from services.learner.differentiable_arm import ArmModel, robot_observation


def poses(count, seed=0):
    """Return joint positions about home and velocities (count, 7)."""
    rng = np.random.default_rng(seed)
    home = np.array([0.0, 0.0, 0.0, 1.0, 1.0, 1.1, 0.0])
    return home + rng.uniform(-0.8, 0.8, (count, 7)), rng.uniform(-3.0, 3.0, (count, 7))


def test_the_robots_observation_is_the_one_that_play_writes():
    pos, vel = poses(200)
    expected = np.array(
        [
            [
                *q,
                *qd,
                *racket_pose(tuple(q)).centre,
                *racket_quaternion(tuple(q)),
                *racket_motion(tuple(q), tuple(qd))[0],
            ]
            for q, qd in zip(pos, vel, strict=True)
        ]
    )

    seen = robot_observation(torch.from_numpy(pos), torch.from_numpy(vel)).numpy()

    assert (expected[:, 17] > 0).all()
    np.testing.assert_allclose(seen, expected, atol=1e-9)


def test_other_targets_change_the_joints_as_they_do_in_mujoco():
    """The model explains nearly all of the change that another target makes in a control step, joint by joint."""
    rng = np.random.default_rng(1)
    count = 300
    offset, actions = rng.uniform(-0.3, 0.3, (count, 7)), rng.uniform(-0.5, 0.5, (count, 7))
    nudges = rng.uniform(-0.2, 0.2, (count, 7))
    ends, starts = [], None
    for nudge in (0.0 * nudges, nudges):
        robots = RobotBatch(count)
        robots.go_home(np.arange(count), offset)
        robots.step(robots.home_action + actions)  # they move
        starts = np.concatenate((robots.joint_pos, robots.joint_vel), axis=1)
        robots.step(np.clip(robots.home_action - 0.5 * actions + nudge, -1.0, 1.0))
        ends.append(np.concatenate((robots.joint_pos, robots.joint_vel), axis=1))
    start = torch.from_numpy(starts).float()
    arm, home = ArmModel(), RobotBatch(1).home_action
    by_drives = [
        torch.cat(
            arm.step(start[:, :7], start[:, 7:], torch.from_numpy(home - 0.5 * actions + nudge).float()), 1
        )
        for nudge in (0.0 * nudges, nudges)
    ]

    measured, predicted = ends[1] - ends[0], (by_drives[1] - by_drives[0]).numpy()
    left = ((measured - predicted) ** 2).sum(axis=0) / (measured**2).sum(axis=0)
    assert (left < 0.06).all(), left


def test_a_drive_at_its_largest_force_passes_no_gradient():
    pos, vel = (torch.zeros(1, 7), torch.zeros(1, 7))
    action = torch.full((1, 7), 0.9, requires_grad=True)  # far away

    moved, _ = ArmModel().step(pos, vel, action)
    moved.sum().backward()

    assert (moved.abs() > 1e-4).all()
    assert action.grad is not None
    assert (action.grad == 0).all()

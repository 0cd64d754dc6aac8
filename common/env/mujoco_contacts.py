"""``collision: original``: balls bounce by MuJoCo's own contacts, for comparison with the paper's Policy 3 (ADR-0027).

Rules, reward, the air, and the randomization of camera and drives are the same as with our contacts. Restitution and
friction are MuJoCo's and do not vary between rallies. ``mujoco_ball`` has the model.

A touch is the first substep in which MuJoCo reports a contact with an obstacle that the ball did not touch before.
MuJoCo's contacts are springs. A contact lasts several substeps, and the ball sinks into the racket by up to 0.45 mm per
m/s. Half the racket's thickness and the ball's radius are together 26.5 mm, so no ball passes below 50 m/s.
"""

from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from common.env.mujoco_ball import (
    BALL_POS,
    BALL_QUAT,
    BALL_SPIN,
    BALL_VEL,
    RobotAndBall,
    obstacles,
    to_world,
)
from common.env.robot import RobotBatch
from common.jit import kernel
from common.physics import touch
from common.physics.chain import joint_rates_at, joints_at, point_velocity, racket_state
from common.physics.constants import BALL_RADIUS
from common.physics.fly import Segment
from common.physics.vec import axpy
from common.rally.finish import apply_touch, finish_step
from common.rally.hit import FRESH, write_contact
from common.rally.sensing import advance_clock, record_detections
from common.rally.state import FlightResult, Rallies, RobotMotion, Rules, Step
from common.rally.step import MAX_SPEED_REWARDED, copy_path
from common.task.randomization import RandomizationProfile
from common.task.states import State

Array = npt.NDArray[np.float64]
Rows = npt.NDArray[np.int64]

FREE_SUBSTEPS: Final = 4  # a contact that opens for up to 2 ms is still the same contact

_TAU_1, _TAU_2, _TAU_3 = int(State.TAU_1), int(State.TAU_2), int(State.TAU_3)
_TAU_23 = int(State.TAU_23)
_RACKET, _TABLE, _OUT = int(touch.RACKET), int(touch.ROBOT_COURT), int(touch.OUT)


class BallRecords(NamedTuple):
    """MuJoCo's records of one control step, and what is known of the obstacles."""

    qpos: Array  # (B, n, 14)
    qvel: Array  # (B, n, 13)
    found: Array  # (B, n, obstacles) contacts with each of ``obstacles`` at the start of each substep
    free: Rows  # (B, obstacles) substeps since the last contact with each; written
    touches: Rows  # (obstacles,) ``touch.Touch`` of each
    senses: Rows  # (links, 2) touch sensors that also measure the ball, and on which obstacle


@kernel
def _follow(
    rallies: Rallies,
    b: int,
    records: BallRecords,
    motion: RobotMotion,
    rules: Rules,
    profile: RandomizationProfile,
    path: Array,
) -> FlightResult:
    """Follow ball b through MuJoCo's records of one control step, and apply each touch.

    Args:
        rallies: Row b is written.
        b: Row.
        records: Row b of ``free`` is written.
        motion: The robots' motion.
        rules: The rules.
        profile: Noise and rate of the camera.
        path: Robot b's joint positions (n + 1, 7).
    """
    qpos, qvel, found, free = records.qpos[b], records.qvel[b], records.found[b], records.free[b]
    touches = records.touches
    ball = rallies.ball[b]
    pos, vel, spin = (ball[0], ball[1], ball[2]), (ball[3], ball[4], ball[5]), (ball[6], ball[7], ball[8])
    state, outcome = rallies.state[b], 0
    bounced, hit, landed = False, False, False
    racket_speed = 0.0
    per_grid_step = qpos.shape[0] // rules.grid_steps
    has_camera, keeps_hits = rallies.camera_state.shape[0] > 0, rallies.hit.shape[0] > 0
    if keeps_hits:
        rallies.hit[b, FRESH] = 0.0
    for k in range(qpos.shape[0]):
        for obstacle in range(found.shape[1]):
            is_new = found[k, obstacle] > 0.0 and free[obstacle] > FREE_SUBSTEPS
            free[obstacle] = 0 if found[k, obstacle] > 0.0 else free[obstacle] + 1
            if not is_new or outcome != 0:
                continue
            what = touches[obstacle]
            if what == _TABLE:
                what = touch.table_touch(pos)
            elif what == _RACKET and state != _TAU_2:
                moment = k * motion.step
                joints = joints_at(path, moment, motion.step)
                rates = joint_rates_at(path, moment, motion.step)
                pose, racket_vel, racket_spin = racket_state(rules.chain, joints, rates)
                contact = axpy(-BALL_RADIUS, touch.racket_gap(pos, pose)[1], pos)
                surface_vel = point_velocity(pose.centre, racket_vel, racket_spin, contact)
                racket_speed = min(max(surface_vel[0], 0.0), MAX_SPEED_REWARDED)
                if keeps_hits and rules.transitions[state, _RACKET] == _TAU_2:
                    write_contact(rallies.hit[b], pos, joints, rates)
            state, outcome = apply_touch(rallies, b, state, what, pos, rules)
        if outcome == 0:
            p, v, w = qpos[k, BALL_POS:], qvel[k, BALL_VEL:], qvel[k, BALL_SPIN:]
            p0, v0 = pos, vel
            pos, vel = (p[0], p[1], p[2]), (v[0], v[1], v[2])
            if has_camera:
                record_detections(
                    rallies,
                    b,
                    profile,
                    (k % per_grid_step) * motion.step,
                    Segment(p0, v0, pos, vel, motion.step),
                )
            spin = to_world(qpos[k, BALL_QUAT:], (w[0], w[1], w[2]))
            if abs(pos[0]) > touch.PLAY_X or abs(pos[1]) > touch.PLAY_Y:
                state, outcome = apply_touch(rallies, b, state, _OUT, pos, rules)
            if state in (_TAU_2, _TAU_23) and pos[0] > BALL_RADIUS:
                rallies.over[b] = True
        bounced, hit, landed = bounced or state == _TAU_1, hit or state == _TAU_2, landed or state == _TAU_3
        if outcome != 0 or (k + 1) % per_grid_step == 0:
            advance_clock(rallies, b, pos, vel, state)
        if outcome != 0:
            break
    return FlightResult(pos, vel, spin, state, outcome, bounced, hit, landed, racket_speed)


@kernel
def _play_records(
    rallies: Rallies,
    motion: RobotMotion,
    records: BallRecords,
    actions: Array,
    rules: Rules,
    profile: RandomizationProfile,
    step: Step,
) -> None:
    """Play every ball for one control step from MuJoCo's records."""
    path = np.empty((motion.joint_pos.shape[1] + 1, 7))
    for b in range(rallies.state.shape[0]):
        copy_path(motion, b, path)
        found, senses = records.found[b], records.senses
        for k in range(found.shape[0]):
            for row in range(senses.shape[0]):
                if found[k, senses[row, 1]] > 0.0:
                    motion.contact[b, k, senses[row, 0]] = 0.0
        result = _follow(rallies, b, records, motion, rules, profile, path)
        finish_step(rallies, b, result, motion, actions, rules, profile, path, step)


class MujocoContacts:
    """The ball bounces by MuJoCo's own contacts."""

    def __init__(self, robot: RobotAndBall) -> None:
        self.robot: RobotBatch = robot
        self._simulation = robot
        found, links = obstacles(robot.name), robot.description.links
        self._touches = np.array([int(obstacle.touch) for obstacle in found])
        # Touch sensors of links that also measure the ball: (sensor, obstacle). The penalty F_c does not count the ball
        geoms = [obstacle.geom for obstacle in found]
        self._senses = np.array([[k, geoms.index(link)] for k, link in enumerate(links)])
        self._free = np.zeros((robot.count, len(found)), np.int64)

    def launch(self, rallies: Rallies, rows: Rows) -> None:
        """Put the rallies' balls into the simulation."""
        self._simulation.place(rows, rallies.ball[rows])
        self._simulation.parameters[rows] = rallies.parameters[rows, :2]
        self._free[rows] = FREE_SUBSTEPS + 1

    def step(
        self,
        rallies: Rallies,
        actions: Array,
        rules: Rules,
        profile: RandomizationProfile,
        step: Step,
    ) -> None:
        """Play one control step. In MuJoCo the ball itself pushes the racket."""
        motion = self._simulation.step(actions)
        played = self._simulation.records
        robot_motion = self.motion = motion._replace(
            joint_pos=played["qpos"][:, :, :7], contact=motion.contact
        )
        found = played["sensordata"][:, :, -len(self._touches) :]
        records = BallRecords(played["qpos"], played["qvel"], found, self._free, self._touches, self._senses)
        _play_records(rallies, robot_motion, records, actions, rules, profile, step)

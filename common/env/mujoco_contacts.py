"""``collision: original``: balls bounce by MuJoCo's own contacts, for comparison with the paper's Policy 3 (ADR-0027).

Rules, reward, the air, and the randomization of camera and drives are the same as with our contacts. Restitution and
friction are MuJoCo's and do not vary between rallies. ``mujoco_ball`` has the model.

A touch is the first substep in which MuJoCo reports a contact with an obstacle that the ball did not touch before.
MuJoCo's contacts are springs. A contact lasts several substeps, and the ball sinks into the racket by up to 0.45 mm per
m/s. Half the racket's thickness and the ball's radius are together 26.5 mm, so no ball passes below 50 m/s.
"""

from typing import Final

import numpy as np
import numpy.typing as npt

from common.env.mujoco_ball import (
    BALL_POS,
    BALL_QUAT,
    BALL_SPIN,
    BALL_VEL,
    OBSTACLES,
    RobotAndBall,
    to_world,
)
from common.env.robot import RobotBatch
from common.jit import kernel
from common.physics import touch
from common.physics.arm import joint_rates_at, joints_at, point_velocity, racket_motion, racket_pose
from common.physics.constants import BALL_RADIUS, GRID_STEP
from common.physics.fly import Segment
from common.physics.vec import axpy
from common.rally.finish import apply_touch, finish_step
from common.rally.hit_correction import BOUNCE, FRESH, write_contact, write_departure
from common.rally.sensing import advance_clock, record_detections
from common.rally.state import FlightResult, Rallies, RobotMotion, Rules, Step
from common.rally.step import MAX_SPEED_REWARDED, copy_path
from common.task.randomization import RandomizationProfile
from common.task.states import State

Array = npt.NDArray[np.float64]
Rows = npt.NDArray[np.int64]

FREE_SUBSTEPS: Final = 4  # a contact that opens for up to 2 ms is still the same contact
# Touch sensors of the robot that also measure the ball, as (sensor, obstacle). The penalty F_c does not count the ball
_SENSES_BALL: Final = ((0, 4), (1, 5), (2, 6), (3, 0), (3, 7))
_RACKET_ROW: Final = 0  # of OBSTACLES
_TOUCHES: Final = tuple(int(what) for _, what, _ in OBSTACLES)
_ROBOT_SENSORS: Final = 4

_TAU_1, _TAU_2, _TAU_3 = int(State.TAU_1), int(State.TAU_2), int(State.TAU_3)
_TAU_23 = int(State.TAU_23)
_RACKET, _TABLE, _OUT = int(touch.RACKET), int(touch.ROBOT_COURT), int(touch.OUT)


@kernel
def _follow(
    rallies: Rallies,
    b: int,
    qpos: Array,
    qvel: Array,
    found: Array,
    free: Rows,
    motion: RobotMotion,
    rules: Rules,
    profile: RandomizationProfile,
    path: Array,
) -> FlightResult:
    """Follow ball b through MuJoCo's records of one control step, and apply each touch.

    Args:
        rallies: Row b is written.
        b: Row.
        qpos: Recorded positions (n, 14).
        qvel: Recorded velocities (n, 13).
        found: Contacts with each of OBSTACLES at the start of each substep (n, obstacles).
        free: Substeps since the last contact with each obstacle; written.
        motion: The robots' motion.
        rules: The rules.
        profile: Noise and rate of the camera.
        path: Robot b's joint positions (n + 1, 7).
    """
    ball = rallies.ball[b]
    pos, vel, spin = (ball[0], ball[1], ball[2]), (ball[3], ball[4], ball[5]), (ball[6], ball[7], ball[8])
    state, outcome = rallies.state[b], 0
    bounced, hit, landed = False, False, False
    racket_speed = 0.0
    # Whether the ball is in contact with the racket. A hit that lasts longer than its control step is not corrected
    is_pressed = False
    per_grid_step = qpos.shape[0] // rules.grid_steps
    has_camera, keeps_hits = rallies.camera_state.shape[0] > 0, rallies.hit.shape[0] > 0
    if keeps_hits:
        rallies.hit[b, FRESH] = 0.0
    for k in range(qpos.shape[0]):
        since_launch = rallies.clock[b] * GRID_STEP + (k % per_grid_step) * motion.step
        for obstacle in range(found.shape[1]):
            is_new = found[k, obstacle] > 0.0 and free[obstacle] > FREE_SUBSTEPS
            free[obstacle] = 0 if found[k, obstacle] > 0.0 else free[obstacle] + 1
            if not is_new or outcome != 0:
                continue
            what = _TOUCHES[obstacle]
            if what == _TABLE:
                what = touch.table_touch(pos)
            elif what == _RACKET and state != _TAU_2:
                moment = k * motion.step
                joints = joints_at(path, moment, motion.step)
                pose = racket_pose(joints)
                rates = joint_rates_at(path, moment, motion.step)
                racket_vel, racket_spin = racket_motion(joints, rates)
                contact = axpy(-BALL_RADIUS, touch.racket_gap(pos, pose)[1], pos)
                surface_vel = point_velocity(pose.centre, racket_vel, racket_spin, contact)
                racket_speed = min(max(surface_vel[0], 0.0), MAX_SPEED_REWARDED)
                if keeps_hits and rules.transitions[state, _RACKET] == _TAU_2:
                    now = rallies.clock[b] // rules.grid_steps
                    write_contact(rallies.hit[b], pos, vel, spin, joints, rates, moment, now, since_launch)
                    is_pressed = True
            state, outcome = apply_touch(rallies, b, state, what, pos, rules)
            if keeps_hits and state == _TAU_1:
                rallies.hit[b, BOUNCE] = since_launch
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
            if is_pressed and free[_RACKET_ROW] > 0:
                write_departure(rallies.hit[b], pos, vel, spin)
                is_pressed = False
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
    qpos: Array,
    qvel: Array,
    found: Array,
    free: Rows,
    actions: Array,
    rules: Rules,
    profile: RandomizationProfile,
    step: Step,
) -> None:
    """Play every ball for one control step from MuJoCo's records."""
    path = np.empty((motion.joint_pos.shape[1] + 1, 7))
    for b in range(rallies.state.shape[0]):
        copy_path(motion, b, path)
        for k in range(found.shape[1]):
            for sensor, obstacle in _SENSES_BALL:
                if found[b, k, obstacle] > 0.0:
                    motion.contact[b, k, sensor] = 0.0
        result = _follow(rallies, b, qpos[b], qvel[b], found[b], free[b], motion, rules, profile, path)
        finish_step(rallies, b, result, motion, actions, rules, profile, path, step)


class MujocoContacts:
    """The ball bounces by MuJoCo's own contacts."""

    def __init__(self, robot: RobotAndBall) -> None:
        self.robot: RobotBatch = robot
        self._simulation = robot
        self._free = np.zeros((robot.count, len(OBSTACLES)), np.int64)

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
        records = self._simulation.records
        robot_motion = self.motion = motion._replace(
            joint_pos=records["qpos"][:, :, :7], contact=records["sensordata"][:, :, :_ROBOT_SENSORS]
        )
        found = records["sensordata"][:, :, _ROBOT_SENSORS:]
        _play_records(
            rallies,
            robot_motion,
            records["qpos"],
            records["qvel"],
            found,
            self._free,
            actions,
            rules,
            profile,
            step,
        )

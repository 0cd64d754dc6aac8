"""One control step of many rallies: flight and touches. ``finish`` then pays the step and measures the ball.

One function plays one ball on its own row, and the batch is a loop. Nothing depends on the batch's size or order, so a
batch equals its rallies played one by one, bit for bit. Only with ``expected_spin`` learnt does a row's rally depend on
the one before: the flight filter keeps what it has learnt about the opponent's spin (ADR-0030).
"""

from typing import Final

import numpy as np
import numpy.typing as npt

from common.jit import inlined, kernel
from common.perception.camera import DETECTION_BUFFER, begin_detections
from common.physics.chain import joint_rates_at, joints_at, point_velocity, racket_state, speed_bound
from common.physics.constants import BALL_MASS, BALL_RADIUS, GRID_STEP
from common.physics.fly import RobotPath, Segment, fly_step
from common.physics.racket_bounce import racket_bounce
from common.physics.table_bounce import table_bounce
from common.physics.touch import NONE, OPPONENT_COURT, RACKET, ROBOT_COURT
from common.physics.vec import Vec, axpy, cross, dot, scale, sub
from common.rally.finish import apply_touch, finish_step
from common.rally.hit import FRESH, write_contact
from common.rally.sensing import advance_clock, record_detections, update_perception
from common.rally.state import RING, Array, FlightResult, Integers, Rallies, RobotMotion, Rules, Step
from common.task.launch import DRAG_FACTOR, KIND, LIFT_FACTOR
from common.task.launch_presets import SERVE
from common.task.randomization import (
    RallyParameter,
    RandomizationProfile,
    air_of,
    draw_parameters,
    rubber_of,
)
from common.task.states import State

MAX_SPEED_REWARDED: Final = 10.0  # [m/s]
_TOUCHES_A_STEP: Final = 8  # a ball that touches more often within 5 ms is squeezed between two obstacles

_TAU_0, _TAU_1, _TAU_2, _TAU_23, _TAU_3, _TAU_S = (
    int(s) for s in (State.TAU_0, State.TAU_1, State.TAU_2, State.TAU_23, State.TAU_3, State.TAU_S)
)


@kernel
def launch_rally(rallies: Rallies, b: int, launch: Array, seed: int, profile: RandomizationProfile) -> None:
    """Put a new rally on row b.

    Args:
        rallies: Row b is written.
        b: Row.
        launch: (12,) position, velocity, spin, drag factor, lift factor, kind: the columns of ``task.launch``.
        seed: Seed of the rally. Its parameters, target and noise follow from it.
        profile: Ranges of the parameters.
    """
    for k in range(9):
        rallies.ball[b, k] = launch[k]
    state = _TAU_S if launch[KIND] == SERVE else _TAU_0
    rallies.state[b] = state
    rallies.seed[b] = seed
    draw_parameters(
        seed, launch[DRAG_FACTOR], launch[LIFT_FACTOR], launch[KIND], profile, rallies.parameters[b]
    )
    rallies.clock[b] = 0
    rallies.caught[b] = False
    rallies.over[b] = False
    rallies.landing_bonus_paid[b] = False
    rallies.landing[b, 0], rallies.landing[b, 1] = np.nan, np.nan
    rallies.landing_error[b] = np.nan
    rallies.head[b] = 0
    for row in range(RING):
        for k in range(6):
            rallies.true_sample_ring[b, row, k] = launch[k]
        rallies.true_sample_ring[b, row, 6] = float(state // 2)
    if rallies.camera_state.shape[0] > 0:
        start = (launch[0], launch[1], launch[2])
        begin_detections(rallies.camera_state[b, :DETECTION_BUFFER], seed, start, profile)
    update_perception(rallies, b, 0, profile)
    for k in range(rallies.measurement_history.shape[1]):
        for j in range(6):
            rallies.measurement_history[b, k, j] = rallies.measurement[b, j]


@kernel
def snap_to_recorded_track(path: Array, step: int, state: int, pos: Vec, vel: Vec) -> tuple[Vec, Vec]:
    """Return position and velocity of a ball that a recorded track drives, after ``step`` grid steps.

    Between two rows physics moves the ball for 5 ms, so touches are found as always. A row then puts the ball back on
    its track, a tenth of a millimetre away. The bounce and its effect on the spin are therefore those of physics, up
    to a grid step before or after the track's bounce. While track and physics disagree on whether the ball has
    bounced, the ball is left alone.

    Args:
        path: Samples on the grid from the launch on: position, velocity, and ``SERVED`` before a serve's first bounce,
            0 before the bounce on the robot's court and 1 after it; ``NO_SAMPLE`` after the track's end (n, 7).
        step: Grid steps since the launch.
        state: Trajectory state now.
        pos: Position by physics [m].
        vel: Velocity by physics [m/s].
    """
    if step >= path.shape[0] or _TAU_2 <= state < _TAU_S:
        return pos, vel
    row = path[step]
    if row[6] != float(state // 2):
        return pos, vel
    return (row[0], row[1], row[2]), (row[3], row[4], row[5])


@kernel
def copy_path(motion: RobotMotion, b: int, path: Array) -> None:
    """Write robot b's joint positions before the control step and after each substep into ``path`` (n + 1, 7)."""
    for j in range(7):
        path[0, j] = motion.start_pos[b, j]
        for k in range(motion.joint_pos.shape[1]):
            path[k + 1, j] = motion.joint_pos[b, k, j]


@kernel
def _hit_ball(
    rallies: Rallies,
    b: int,
    ball: tuple[Vec, Vec, Vec],
    normal: Vec,
    robot: RobotPath,
    moment: float,
    is_kept: bool,
    rules: Rules,
    step: Step,
) -> tuple[Vec, Vec, float, bool]:
    """Let the racket hit ball b.

    Args:
        rallies: Row b is written where the contact is kept.
        b: Row.
        ball: Position, velocity and spin just before.
        normal: Unit normal of the racket's face, towards the ball.
        robot: Its motion in this control step.
        moment: Time of the contact since the control step's start [s].
        is_kept: Whether the contact is kept.
        rules: The rules.
        step: The impulse on the racket is added.

    Returns:
        Velocity and spin just after, the racket's forward speed [m/s], and whether there was a contact. There is none
        if ball and racket are already separating.
    """
    pos, vel, spin = ball
    joints = joints_at(robot.joints, moment, robot.step)
    rates = joint_rates_at(robot.joints, moment, robot.step)
    pose, racket_vel, racket_spin = racket_state(rules.chain, joints, rates)
    centre = pose.centre
    contact = axpy(-BALL_RADIUS, normal, pos)
    surface_vel = point_velocity(centre, racket_vel, racket_spin, contact)
    if dot(sub(vel, surface_vel), normal) >= 0.0:
        return vel, spin, 0.0, False
    if is_kept:
        write_contact(rallies.hit[b], pos, joints, rates)
    before = vel
    vel, spin = racket_bounce(vel, spin, normal, surface_vel, rubber_of(rallies.parameters[b]))
    impulse = scale(BALL_MASS, sub(before, vel))
    turn = cross(sub(contact, centre), impulse)
    for k in range(3):
        step.impulse[b, k] += impulse[k]
        step.impulse[b, 3 + k] += turn[k]
    return vel, spin, min(max(surface_vel[0], 0.0), MAX_SPEED_REWARDED), True


@inlined
def _fly_one(
    rallies: Rallies, b: int, robot: RobotPath, rules: Rules, profile: RandomizationProfile, step: Step
) -> FlightResult:
    """Fly ball b through one control step, with every touch."""
    ball, parameters = rallies.ball[b], rallies.parameters[b]
    air = air_of(parameters, rules.flight_model)
    pos, vel, spin = (ball[0], ball[1], ball[2]), (ball[3], ball[4], ball[5]), (ball[6], ball[7], ball[8])
    state = rallies.state[b]
    has_camera, keeps_hits = rallies.camera_state.shape[0] > 0, rallies.hit.shape[0] > 0
    is_driven = rallies.true_sample_ring.shape[1] > RING
    if keeps_hits:
        rallies.hit[b, FRESH] = 0.0
    outcome = 0
    bounced, hit, landed = False, False, False
    racket_speed = 0.0
    for k in range(6):
        step.impulse[b, k] = 0.0

    for grid_step in range(rules.grid_steps):
        rest = GRID_STEP
        for _ in range(_TOUCHES_A_STEP):
            start = grid_step * GRID_STEP + (GRID_STEP - rest)
            p0, v0 = pos, vel
            pos, vel, flown, what, normal = fly_step(pos, vel, spin, rest, air, robot, start)
            if has_camera:
                record_detections(rallies, b, profile, GRID_STEP - rest, Segment(p0, v0, pos, vel, flown))
            rest -= flown
            if state in (_TAU_2, _TAU_23) and pos[0] > BALL_RADIUS:
                rallies.over[b] = True
            if what == NONE:
                break
            if what in (ROBOT_COURT, OPPONENT_COURT):
                vel, spin = table_bounce(
                    vel,
                    spin,
                    normal,
                    parameters[RallyParameter.TABLE_RESTITUTION0],
                    parameters[RallyParameter.TABLE_FRICTION],
                )
            elif what == RACKET:
                is_kept = keeps_hits and rules.transitions[state, RACKET] == _TAU_2
                moment = start + flown
                vel, spin, speed, has_contact = _hit_ball(
                    rallies, b, (pos, vel, spin), normal, robot, moment, is_kept, rules, step
                )
                if not has_contact:
                    continue
                racket_speed = speed
            state, outcome = apply_touch(rallies, b, state, what, pos, rules)
            bounced, hit, landed = (
                bounced or state == _TAU_1,
                hit or state == _TAU_2,
                landed or state == _TAU_3,
            )
            if outcome != 0:
                break
        if is_driven and outcome == 0:
            path = rallies.true_sample_ring[b, RING:]
            pos, vel = snap_to_recorded_track(path, rallies.clock[b] + 1, state, pos, vel)
        advance_clock(rallies, b, pos, vel, state)
        if outcome != 0:
            break
    return FlightResult(pos, vel, spin, state, outcome, bounced, hit, landed, racket_speed)


@kernel
def play_step(
    rallies: Rallies,
    motion: RobotMotion,
    actions: Array,
    rules: Rules,
    profile: RandomizationProfile,
    step: Step,
) -> None:
    """Play every rally for one control step. ``rallies`` and ``step`` are written in place."""
    path = np.empty((motion.joint_pos.shape[1] + 1, 7))
    for b in range(rallies.state.shape[0]):
        copy_path(motion, b, path)
        robot = RobotPath(path, motion.step, speed_bound(rules.chain, path, motion.step), rules.chain)
        result = _fly_one(rallies, b, robot, rules, profile, step)
        finish_step(rallies, b, result, motion, actions, rules, profile, path, step)


@kernel
def launch_rallies(
    rallies: Rallies,
    rows: Integers,
    launches: Array,
    seeds: npt.NDArray[np.uint64],
    profile: RandomizationProfile,
) -> None:
    """Put rallies ``launches`` (n, 12) with ``seeds`` (n,) on ``rows`` (n,)."""
    for k in range(rows.shape[0]):
        launch_rally(rallies, rows[k], launches[k], seeds[k], profile)

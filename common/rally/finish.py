"""The end of a control step: what a touch leads to, the reward, the outcome, and the new measurement."""

from typing import Final

import numpy as np

from common.jit import inlined, kernel
from common.physics.chain import joints_at, racket_pose
from common.physics.constants import BALL_RADIUS, GRID_STEP
from common.physics.fly import RobotPath, fly_step
from common.physics.touch import NONE
from common.physics.vec import Vec, norm, sub
from common.rally.sensing import update_perception
from common.rally.state import Array, FlightResult, Rallies, RobotMotion, Rules, Step
from common.task.landing_point import LONGEST_RETURN, landing_point
from common.task.randomization import RallyParameter, RandomizationProfile, air_of
from common.task.states import OUTCOME_OFFSET, Outcome, State

CONTACT_FORCE_SCALE: Final = 50.0  # [N] F_c at which a body's collision penalty saturates
FARTHEST: Final = 1.0e3  # [m] a rally whose ball is farther away ends: the simulation has failed

_TAU_0, _TAU_1, _TAU_2, _TAU_23, _TAU_3, _TAU_30, _TAU_S = (
    int(s)
    for s in (
        *(State.TAU_0, State.TAU_1, State.TAU_2, State.TAU_23, State.TAU_3, State.TAU_30),
        State.TAU_S,
    )
)
_RETURNED, _TIME_OUT = int(Outcome.RETURNED), int(Outcome.TIME_OUT)
# Columns of the reward table and of its terms (reward.FEATURES, reward.TERMS)
_CONSTANT, _REACH, _SPEED, _AIM, _LANDING = range(5)
_APPROACH_TERM, _BOUNCE_TERM, _CONTACT_TERM, _AIM_TERM, _LANDING_TERM = range(5)
_TORQUE_TERM, _JITTER_TERM, _COLLISION_TERM = range(5, 8)
_TERMS: Final = 8


@kernel
def apply_touch(rallies: Rallies, b: int, state: int, what: int, pos: Vec, rules: Rules) -> tuple[int, int]:
    """Return the state and the outcome after a touch (outcome 0: the rally continues), and record catch and landing.

    Args:
        rallies: Row b is written.
        b: Row.
        state: State before the touch.
        what: ``touch.Touch``.
        pos: Ball's position at the touch [m].
        rules: The rules.
    """
    following = rules.transitions[state, what]
    if following >= OUTCOME_OFFSET:
        return state, following - OUTCOME_OFFSET
    if following == _TAU_2:
        rallies.caught[b] = True
    elif following == _TAU_3:
        rallies.over[b] = True
        rallies.landing[b, 0], rallies.landing[b, 1] = pos[0], pos[1]
        dx = pos[0] - rallies.parameters[b, RallyParameter.TARGET_X]
        dy = pos[1] - rallies.parameters[b, RallyParameter.TARGET_Y]
        rallies.landing_error[b] = np.sqrt(dx * dx + dy * dy)
        if rallies.rounds_left[b] <= 1:
            return following, _RETURNED
    return following, 0


@kernel
def _near(distance: float) -> float:
    """Return the reward's closeness 1/(1 + d^2)^2 (the paper's g and aim)."""
    return 1.0 / ((1.0 + distance * distance) * (1.0 + distance * distance))


@kernel
def simulate_to_landing(
    rallies: Rallies, b: int, result: FlightResult, rules: Rules, no_robot: RobotPath
) -> tuple[FlightResult, float]:
    """Fly a ball that was hit to the rally's end at once, as if there were no robot.

    After the hit the robot can change the landing only by a second touch. So a training rally may end here. Then all
    its frames are from the time before the contact, and the landing is paid right after it (ADR-0015).

    Returns:
        The ball at the rally's end, and the sum of the reward's feature ``aim`` over the control steps until then.
    """
    parameters = rallies.parameters[b]
    air = air_of(parameters, rules.flight_model)
    pos, vel, spin, state, outcome, _, _, landed, _ = result
    target = (parameters[RallyParameter.TARGET_X], parameters[RallyParameter.TARGET_Y], BALL_RADIUS)
    aim, steps = 0.0, 0
    while outcome == 0:
        pos, vel, _, what, _ = fly_step(pos, vel, spin, GRID_STEP, air, no_robot, 0.0)
        if pos[0] > BALL_RADIUS:
            rallies.over[b] = True
        if what != NONE:
            state, outcome = apply_touch(rallies, b, state, what, pos, rules)
            landed = landed or state == _TAU_3
        steps += 1
        if outcome == 0 and steps % rules.grid_steps == 0:
            aim += _near(norm(sub(pos, target)))
        if steps * GRID_STEP >= LONGEST_RETURN:
            outcome = _TIME_OUT
    return FlightResult(pos, vel, spin, state, outcome, False, False, landed, 0.0), aim


@inlined
def _landing_bonus(rallies: Rallies, b: int, result: FlightResult, rules: Rules) -> float:
    """Return the bonus for the predicted landing point of a ball that was just hit, once a rally (ADR-0016)."""
    is_due = rules.landing_bonus > 0.0 and result.state == _TAU_23 and result.outcome == 0
    if not is_due or rallies.landing_bonus_paid[b]:
        return 0.0
    rallies.landing_bonus_paid[b] = True
    parameters = rallies.parameters[b]
    x, y, over_net = landing_point(
        result.pos, result.vel, result.spin, air_of(parameters, rules.flight_model)
    )
    target_x, target_y = parameters[RallyParameter.TARGET_X], parameters[RallyParameter.TARGET_Y]
    off2 = ((x - target_x) ** 2 + (y - target_y) ** 2) / rules.landing_bonus_scale**2
    bonus: float = (1.0 if over_net > 0.0 else 0.5) * rules.landing_bonus / (1.0 + off2)
    return bonus


@inlined
def pay(
    rallies: Rallies,
    b: int,
    result: FlightResult,
    later_aim: float,
    bonus: float,
    motion: RobotMotion,
    path: Array,
    actions: Array,
    rules: Rules,
    step: Step,
) -> None:
    """Write reward and terms of ball b's control step.

    Every instant (tau_1, tau_2, tau_3) of the step is paid its row of R. A step without an instant is paid the row of
    the continuing state.

    Args:
        rallies: Row b; its last action is written.
        b: Row.
        result: The ball after the step, and what it touched.
        later_aim: Sum of the feature ``aim`` over a flight that was simulated to its landing.
        bonus: For the predicted landing point.
        motion: Of the robots.
        path: Robot b's joint positions (n + 1, 7).
        actions: (B, 7).
        rules: The rules.
        step: Row b is written.
    """
    pos, _, _, state, _, bounced, hit, landed, racket_speed = result
    substeps = motion.joint_pos.shape[1]
    parameters = rallies.parameters[b]
    target = (parameters[RallyParameter.TARGET_X], parameters[RallyParameter.TARGET_Y], BALL_RADIUS)
    joints = joints_at(path, substeps * motion.step, motion.step)
    rows, terms = rules.rewards, step.terms[b]
    for k in range(_TERMS):
        terms[k] = 0.0
    if bounced:
        terms[_BOUNCE_TERM] = rows[_TAU_1, _CONSTANT]
    if hit:
        terms[_CONTACT_TERM] = rows[_TAU_2, _CONSTANT] + rows[_TAU_2, _SPEED] * racket_speed
    if landed:
        miss = rallies.landing_error[b] / rules.landing_scale
        terms[_LANDING_TERM] = rows[_TAU_3, _CONSTANT] + rows[_TAU_3, _LANDING] / (
            (1.0 + miss * miss) * (1.0 + miss * miss)
        )
    if not (bounced or hit or landed or state in (_TAU_0, _TAU_S)):
        reach = _near(norm(sub(pos, racket_pose(rules.chain, joints).centre)))
        terms[_APPROACH_TERM] = rules.rate_scale * rows[state, _REACH] * reach
        terms[_AIM_TERM] = rules.rate_scale * rows[state, _AIM] * _near(norm(sub(pos, target)))
    terms[_AIM_TERM] += rules.rate_scale * rows[_TAU_23, _AIM] * later_aim + bonus
    torque, jitter, collision = 0.0, 0.0, 0.0
    for j in range(7):
        change = actions[b, j] - rallies.last_action[b, j]
        jitter += change * change
        rallies.last_action[b, j] = actions[b, j]
        for k in range(substeps):
            torque += abs(motion.torque[b, k, j]) / rules.torque_limit[j]
    for body in range(motion.contact.shape[2]):
        for k in range(substeps):
            collision += min(motion.contact[b, k, body] / CONTACT_FORCE_SCALE, 1.0)
    terms[_TORQUE_TERM] = -rules.torque_weight * rules.rate_scale * torque / substeps
    terms[_JITTER_TERM] = -rules.jitter_weight * jitter
    terms[_COLLISION_TERM] = -rules.collision_weight * rules.rate_scale * collision / substeps
    total = 0.0
    for k in range(_TERMS):
        total += terms[k]
    step.reward[b] = total


@inlined
def end_rally(rallies: Rallies, b: int, result: FlightResult, rules: Rules) -> tuple[int, int]:
    """Return state and outcome after the control step. An instant lasts one step. The time limit may end the rally."""
    state, outcome = result.state, result.outcome
    if state % 2 == 0:
        state += 1
    is_over_time = rallies.clock[b] * GRID_STEP >= rules.time_limit - 1e-9
    if outcome == 0 and (is_over_time or not norm(result.pos) < FARTHEST):
        outcome = _RETURNED if state == _TAU_30 else _TIME_OUT  # after a legal landing nothing is cut
    return state, outcome


@inlined
def write_back(rallies: Rallies, b: int, result: FlightResult, state: int, outcome: int, step: Step) -> None:
    """Write ball b's state and outcome into its row."""
    ball = rallies.ball[b]
    step.outcome[b] = outcome
    rallies.state[b] = state
    for k in range(3):
        ball[k], ball[3 + k], ball[6 + k] = result.pos[k], result.vel[k], result.spin[k]


@inlined
def finish_step(
    rallies: Rallies,
    b: int,
    result: FlightResult,
    motion: RobotMotion,
    actions: Array,
    rules: Rules,
    profile: RandomizationProfile,
    path: Array,
    step: Step,
) -> None:
    """Pay ball b's control step, decide whether its rally ends, write it back, and measure the ball."""
    bonus = _landing_bonus(rallies, b, result, rules)
    later_aim = 0.0
    if rallies.ends_at_hit[b] and result.state == _TAU_23 and result.outcome == 0:
        no_robot = RobotPath(path[:0], 1.0, 0.0, rules.chain)
        result, later_aim = simulate_to_landing(rallies, b, result, rules, no_robot)
    pay(rallies, b, result, later_aim, bonus, motion, path, actions, rules, step)
    state, outcome = end_rally(rallies, b, result, rules)
    write_back(rallies, b, result, state, outcome, step)
    update_perception(rallies, b, rallies.clock[b] // rules.grid_steps, profile)

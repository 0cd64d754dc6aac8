"""Hit correction: how the last actions should have differed, computed from a hit.

A reward says how good a stroke was. A simulation can also compute what was wrong with it. Contact, flight and drives
are smooth and known, so the hit's result r depends on a small change d of the last actions a as

    r(a + d) = r(a) + L d,       L = dr/d(racket's path) . d(racket's path)/d(a)

and the least change that gives the wanted result is d = L' (L L' + lambda)^-1 (wanted - r): one damped Gauss-Newton
step (Levenberg 1944) per hit. The learner pulls the policy's mean there (``policy.losses``): iterative learning
control (Arimoto 1984) with a network as its memory. The gradient of the same reward through the same physics (as in
SHAC, Xu et al. 2022) is large where the stroke is sensitive; this step is not. Its mean over a dataset has five times
the signal to noise (ADR-0022).

The landing follows from the ball that left the racket, under either kind of contacts. Only L uses our own contact law.
So a hit under MuJoCo's contacts (``mujoco_contacts``) is corrected by its own miss, in the direction of our law.

A hit should land the ball on its target, clear the net by a margin, meet the racket's centre, and come not too soon
after the bounce (ADR-0023).
"""

import math
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from common.jit import kernel
from common.perception.cholesky import factor, substitute
from common.physics.chain import Chain, Joints, RacketPose, point_velocity, racket_state
from common.physics.constants import BALL_RADIUS, TABLE_HALF_LENGTH, TABLE_HALF_WIDTH, Rubber
from common.physics.flight import Air
from common.physics.racket_bounce import racket_bounce
from common.physics.touch import racket_gap
from common.physics.vec import Vec, axpy, dot, sub, vec_at
from common.task.landing_point import SHORT_OF_NET, landing_and_clearance
from common.task.randomization import RallyParameter, air_of, rubber_of

Array = npt.NDArray[np.float64]
Limits = npt.NDArray[np.int8]
Losses = npt.NDArray[np.float32]
Goals = tuple[float, float, float, float, float, float]

BACK: Final = 12  # control steps that a correction looks back: 0.24 s at 50 Hz, twice the slowest drive's lag
# Goals: landing x, y; place on the racket (2); height over the net, if too low; time of the contact, if too soon
_LANDING, _PLACE, _OVER, _LATER = 0, 2, 4, 5
GOALS: Final = 6

# Columns of a hit's row: ball and joints at the contact, and the time of the contact in its control step [s]
BALL_POS, BALL_VEL, BALL_SPIN, JOINT_POS, JOINT_VEL, MOMENT = 0, 3, 6, 9, 16, 23
STEP = 24  # number of that control step in the rally, from 0
FRESH = 25  # 1: contact and departure were in the newest control step
BOUNCE, CONTACT = 26, 27  # times of the bounce on the robot's court and of the contact [s since launch]
LEFT_POS, LEFT_VEL, LEFT_SPIN = 28, 31, 34  # the ball as it left the racket
HIT: Final = 37

# Rows of the drives' table (5, 7)
INERTIA, STIFFNESS, DAMPING, HALF_RANGE, BACK_EMF = range(5)
# What limits a drive in a substep
FREE, CURRENT, VOLTAGE = range(3)

MARGIN: Final = 0.16  # [m] by which the ball should clear the net
# [m] targets nearer to the table's edge are moved inside, so that a small miss still returns
EDGE: Final = 0.30
NEAREST: Final = 0.40  # [m] from the net: the nearest target
# [m] largest landing error that is corrected in full: beyond it the linear model gives only the direction
LARGEST_MISS: Final = 0.5
LARGEST_SHORTFALL: Final = 0.25  # [m] largest correction of the height over the net
PLACE_WEIGHT: Final = 5.0  # [-] 1 cm off the racket's centre weighs as much as 5 cm off the target
SOONEST: Final = 0.100  # [s] after the bounce: then the bounce has been measured and shows the spin
# [m/s] speed of a typical ball: a contact 10 ms too soon weighs as much as 3 cm off the target
PACE: Final = 3.0
LEVENBERG: Final = 1.0  # [m^2] lambda; L L' is about 25 m^2 per (unit of action)^2
# [half-range] a correction of this size is halved: larger ones leave the range of the linear model
TRUST: Final = 0.1
_SLOWEST_CLOSING: Final = -0.5  # [m/s] a slower contact would be shifted too far in time
_POS_STEP, _VEL_STEP = 1e-4, 1e-3  # of the finite differences [m, rad], [m/s, rad/s]
_INSANE: Final = 1e6  # larger results give no correction


class DriveHistory(NamedTuple):
    """What one robot's drives did before a contact."""

    # (BACK, n, 7) what limited a drive, by control step (a ring) and substep
    limits: Limits
    losses: Losses  # (BACK, n, 7) slope of a joint's losses and its speed, at the same times
    newest: int  # the ring's row of the contact's control step
    steps: int  # control steps that the rally or the ring reaches back, including the contact's
    late: int  # action latency [substeps]
    drives: Array  # (5, 7) inertia, k_p, k_v, half-range of the targets, slope of force and speed at the voltage limit
    h: float  # MuJoCo's time step [s]


class DriveHistories(NamedTuple):
    """What the drives of B robots did: ``DriveHistory`` for all of them."""

    limits: Limits  # (B, BACK, n, 7)
    losses: Losses  # (B, BACK, n, 7)
    newest: int  # the rings' row of the newest control step
    drives: Array  # (5, 7)
    h: float  # MuJoCo's time step [s]


@kernel
def write_contact(
    hit: Array,
    pos: Vec,
    vel: Vec,
    spin: Vec,
    joints: Joints,
    rates: Joints,
    moment: float,
    step: int,
    contact: float,
) -> None:
    """Write ball and joints at a contact into a hit's row (HIT,). The row becomes fresh when the ball has left."""
    for k in range(3):
        hit[BALL_POS + k], hit[BALL_VEL + k], hit[BALL_SPIN + k] = pos[k], vel[k], spin[k]
    for j in range(7):
        hit[JOINT_POS + j], hit[JOINT_VEL + j] = joints[j], rates[j]
    hit[MOMENT], hit[STEP], hit[FRESH], hit[CONTACT] = moment, step, 0.0, contact


@kernel
def write_departure(hit: Array, pos: Vec, vel: Vec, spin: Vec) -> None:
    """Write the ball as it left the racket into its hit's row."""
    for k in range(3):
        hit[LEFT_POS + k], hit[LEFT_VEL + k], hit[LEFT_SPIN + k] = pos[k], vel[k], spin[k]
    hit[FRESH] = 1.0


@kernel
def _approach(chain: Chain, q: Joints, qd: Joints, pos: Vec) -> tuple[float, Vec, Vec, RacketPose]:
    """Return gap [m] and normal between racket and ball, the contact point's velocity [m/s], and the racket's pose."""
    pose, racket_vel, racket_spin = racket_state(chain, q, qd)
    gap, normal = racket_gap(pos, pose)
    surface_vel = point_velocity(pose.centre, racket_vel, racket_spin, axpy(-BALL_RADIUS, normal, pos))
    return gap, normal, surface_vel, pose


@kernel
def hit_result(
    chain: Chain, q: Joints, qd: Joints, pos: Vec, vel: Vec, spin: Vec, rubber: Rubber, air: Air
) -> Goals:
    """Return the result of a hit: ``GOALS`` numbers.

    The racket may be a little away from the ball or inside it. The contact is shifted to the time at which they meet.

    Args:
        chain: Of the robot.
        q: Joint positions near the contact [m, rad].
        qd: Joint velocities [m/s, rad/s].
        pos: Position of the ball then [m].
        vel: Velocity before the contact [m/s].
        spin: Spin before the contact [rad/s].
        rubber: Of the racket.
        air: Of the rally.

    Returns:
        Landing x, y [m]; offset from the racket's centre along its side and handle, times ``PLACE_WEIGHT`` [m]; height
        over the net [m]; delay of the contact, times ``PACE`` [m].
    """
    gap, normal, surface_vel, _ = _approach(chain, q, qd, pos)
    later = -gap / min(dot(sub(vel, surface_vel), normal), _SLOWEST_CLOSING)
    pos = axpy(later, vel, pos)
    q = (
        q[0] + later * qd[0],
        q[1] + later * qd[1],
        q[2] + later * qd[2],
        q[3] + later * qd[3],
        q[4] + later * qd[4],
        q[5] + later * qd[5],
        q[6] + later * qd[6],
    )
    _, normal, surface_vel, pose = _approach(chain, q, qd, pos)
    offset = sub(pos, pose.centre)
    vel, spin = racket_bounce(vel, spin, normal, surface_vel, rubber)
    x, y, over_net = landing_and_clearance(pos, vel, spin, air)
    side, up = PLACE_WEIGHT * dot(offset, pose.side), PLACE_WEIGHT * dot(offset, pose.up)
    return x, y, side, up, over_net, PACE * later


@kernel
def _moved(q: Joints, joint: int, by: float) -> Joints:
    """Return ``q`` with one number changed."""
    return (
        q[0] + (by if joint == 0 else 0.0),
        q[1] + (by if joint == 1 else 0.0),
        q[2] + (by if joint == 2 else 0.0),
        q[3] + (by if joint == 3 else 0.0),
        q[4] + (by if joint == 4 else 0.0),
        q[5] + (by if joint == 5 else 0.0),
        q[6] + (by if joint == 6 else 0.0),
    )


@kernel
def _joints(hit: Array, at: int) -> Joints:
    return (hit[at], hit[at + 1], hit[at + 2], hit[at + 3], hit[at + 4], hit[at + 5], hit[at + 6])


@kernel
def hit_sensitivity(
    chain: Chain, hit: Array, rubber: Rubber, air: Air, by_pos: Array, by_vel: Array
) -> Goals:
    """Write how a hit's result depends on the joints at the contact, and return the result by our contact law.

    Args:
        chain: Of the robot.
        hit: (HIT,).
        rubber: Of the racket.
        air: Of the rally.
        by_pos: (GOALS, 7) d result / d joint position; written.
        by_vel: (GOALS, 7) d result / d joint velocity; written.
    """
    pos, vel, spin = vec_at(hit, BALL_POS), vec_at(hit, BALL_VEL), vec_at(hit, BALL_SPIN)
    q, qd = _joints(hit, JOINT_POS), _joints(hit, JOINT_VEL)
    result = hit_result(chain, q, qd, pos, vel, spin, rubber, air)
    for joint in range(7):
        moved = hit_result(chain, _moved(q, joint, _POS_STEP), qd, pos, vel, spin, rubber, air)
        faster = hit_result(chain, q, _moved(qd, joint, _VEL_STEP), pos, vel, spin, rubber, air)
        for goal in range(GOALS):
            by_pos[goal, joint] = (moved[goal] - result[goal]) / _POS_STEP
            by_vel[goal, joint] = (faster[goal] - result[goal]) / _VEL_STEP
    return result


@kernel
def back_through_drives(
    by_pos: Array, by_vel: Array, moment: float, history: DriveHistory, out: Array
) -> None:
    """Write d result / d action for the control step of a contact and the control steps before it.

    Each joint is a drive of its own: inertia v' = k_p (target - q) - (k_v + d) v, where d is the slope of its losses,
    in the steps of MuJoCo's implicit integrator. The force of a drive at a limit does not depend on its target: at the
    limit of the current it is constant, at that of the voltage it falls with the speed. The adjoint recursion runs back
    from the contact.

    Args:
        by_pos: (7,) d result / d joint position at the contact.
        by_vel: (7,) d result / d joint velocity.
        moment: Time of the contact since the start of its control step [s].
        history: Of the robot's drives.
        out: (BACK, 7) by control step, the contact's first; written.
    """
    limits, losses, newest, steps, late, drives, h = history
    substeps = limits.shape[1]
    row = min(int(moment / h), substeps - 1)
    for j in range(7):
        inertia, stiffness, damping = drives[INERTIA, j], drives[STIFFNESS, j], drives[DAMPING, j]
        for k in range(out.shape[0]):
            out[k, j] = 0.0
        # Positions between substeps are linear: q(moment) = q_row + (moment - row h) v_{row + 1}
        on_q, on_v = by_pos[j], by_vel[j] + (moment - row * h) * by_pos[j]
        for k in range(steps):
            for s in range(row if k == 0 else substeps - 1, -1, -1):
                if k > 0 or s < row:
                    on_v += h * on_q  # q+ = q + h v+
                at = (newest - k) % limits.shape[0]
                slowed = inertia + h * losses[at, s, j]
                if limits[at, s, j] != FREE:
                    on_v *= inertia / (
                        slowed + (h * drives[BACK_EMF, j] if limits[at, s, j] == VOLTAGE else 0.0)
                    )
                    continue
                driven = slowed + h * damping
                pull = h * stiffness / driven * on_v
                age = k + (late - s + substeps - 1) // substeps if s < late else k
                if age < steps:  # an earlier target belongs to the previous rally
                    out[age, j] += pull * drives[HALF_RANGE, j]
                on_v *= inertia / driven
                on_q -= pull


@kernel
def least_change(sensitivity: Array, wanted: Array, out: Array) -> bool:
    """Write d = L' (L L' + lambda)^-1 wanted, and return whether it is finite.

    Args:
        sensitivity: L (GOALS, BACK, 7); rows of zeros for goals that are already met.
        wanted: By how much the result should change (GOALS,).
        out: d (BACK, 7), scaled down where it is large; written.
    """
    steps, joints = out.shape
    gram = np.empty((GOALS, GOALS))
    for i in range(GOALS):
        for j in range(GOALS):
            total = LEVENBERG if i == j else 0.0
            for k in range(steps):
                for c in range(joints):
                    total += sensitivity[i, k, c] * sensitivity[j, k, c]
            if not abs(total) < _INSANE * _INSANE:
                return False
            gram[i, j] = total
        if not abs(wanted[i]) < _INSANE:
            return False
    lower, weights = np.empty((GOALS, GOALS)), np.empty(GOALS)
    factor(gram, lower)
    substitute(lower, wanted, weights)
    square = 0.0
    for k in range(steps):
        for c in range(joints):
            change = 0.0
            for i in range(GOALS):
                change += sensitivity[i, k, c] * weights[i]
            out[k, c] = change
            square += change * change
    # As in robust regression (Cauchy's influence function): a hit that is far off counts less. Without this, a policy
    # that does not return balls yet loses its catches faster than PPO can restore them.
    for k in range(steps):
        for c in range(joints):
            out[k, c] /= 1.0 + square / (TRUST * TRUST)
    return math.isfinite(square)


@kernel
def correction(
    chain: Chain, hit: Array, parameters: Array, model: int, history: DriveHistory, out: Array
) -> bool:
    """Write the least change of the last actions that gives the wanted hit in the linear model.

    Args:
        chain: Of the robot.
        hit: (HIT,) ball and joints at the contact, and the ball as it left.
        parameters: ``randomization.RallyParameter`` of the rally (15,).
        model: ``flight.SIMPLE`` or ``flight.FULL``.
        history: Of the robot's drives.
        out: (BACK, 7) [half-range] by control step, the contact's first; written.

    Returns:
        Whether there is a correction. There is none where a number is not finite or unreasonably large.
    """
    air = air_of(parameters, model)
    by_pos, by_vel = np.empty((GOALS, 7)), np.empty((GOALS, 7))
    result = hit_sensitivity(chain, hit, rubber_of(parameters), air, by_pos, by_vel)
    sensitivity = np.empty((GOALS, out.shape[0], 7))
    for goal in range(GOALS):
        back_through_drives(by_pos[goal], by_vel[goal], hit[MOMENT], history, sensitivity[goal])
    wanted = np.empty(GOALS)
    target_x = min(max(parameters[RallyParameter.TARGET_X], NEAREST), TABLE_HALF_LENGTH - EDGE)
    target_y = min(max(parameters[RallyParameter.TARGET_Y], EDGE - TABLE_HALF_WIDTH), TABLE_HALF_WIDTH - EDGE)
    x, y, over_net = landing_and_clearance(
        vec_at(hit, LEFT_POS), vec_at(hit, LEFT_VEL), vec_at(hit, LEFT_SPIN), air
    )
    miss_x, miss_y = target_x - x, target_y - y
    miss = math.sqrt(miss_x * miss_x + miss_y * miss_y)
    if miss > LARGEST_MISS:
        miss_x *= LARGEST_MISS / miss
        miss_y *= LARGEST_MISS / miss
    wanted[_LANDING], wanted[_LANDING + 1] = miss_x, miss_y
    wanted[_PLACE], wanted[_PLACE + 1] = -result[_PLACE], -result[_PLACE + 1]
    wanted[_OVER] = min(MARGIN - over_net, LARGEST_SHORTFALL)
    if not SHORT_OF_NET < over_net < MARGIN:
        wanted[_OVER], sensitivity[_OVER] = 0.0, 0.0
    wanted[_LATER] = PACE * (SOONEST - (hit[CONTACT] - hit[BOUNCE]))
    if wanted[_LATER] <= 0.0:
        wanted[_LATER], sensitivity[_LATER] = 0.0, 0.0
    return least_change(sensitivity, wanted, out)


@kernel
def corrections(
    chain: Chain,
    hits: Array,
    parameters: Array,
    model: int,
    histories: DriveHistories,
    out: Array,
    steps: npt.NDArray[np.int64],
) -> None:
    """Correct every fresh hit of B robots.

    Args:
        chain: Of the robots.
        hits: (B, HIT).
        parameters: ``randomization.RallyParameter`` of the rallies (B, 15).
        model: ``flight.SIMPLE`` or ``flight.FULL``.
        histories: Of the robots' drives.
        out: (B, BACK, 7); rows of fresh hits are written.
        steps: (B,) how many control steps back a correction reaches; 0: there is none; written.
    """
    limits, losses, newest, drives, h = histories
    for b in range(hits.shape[0]):
        steps[b] = 0
        if hits[b, FRESH] == 0.0:
            continue
        reach = min(int(hits[b, STEP]) + 1, BACK)
        late = int(parameters[b, RallyParameter.ACTION_LATENCY] / h + 0.5)
        history = DriveHistory(limits[b], losses[b], newest, reach, late, drives, h)
        if correction(chain, hits[b], parameters[b], model, history, out[b]):
            steps[b] = reach

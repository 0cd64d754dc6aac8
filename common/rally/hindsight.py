"""How the last actions should have been: what a hit teaches besides its reward.

A reward says how good a stroke was; in simulation we can also say what was wrong with it. Contact, flight and drives
are smooth and known, so near what happened the hit's result r depends on the last actions a as

    r(a + d) = r(a) + L d,       L = dr/d(racket's path) . d(racket's path)/d(a)

and the least change that would have led to what was wanted is d = L' (L L' + lambda)^-1 (wanted - r): a damped
Gauss-Newton step (Levenberg 1944), one a hit. The learner draws the policy's mean there (``ppo.correction_loss``):
iterative learning control (Arimoto 1984) with a network as its memory. Against the gradient of the same reward through
the same physics (as in SHAC, Xu et al. 2022) such a step doesn't shout where the stroke is sensitive: the mean over a
dataset has five times the signal to noise.

Where the ball went is known from how it left, whoever let it bounce; only L is our own law's. So the simulator's own
contacts (``original_collision``) are corrected by what they did, along the way that our racket would have it.

Wanted of a hit: that the ball comes down on its target, clears the net by a margin, meets the racket's centre, and not
so soon after the bounce that it might as well have been before it.
"""

import math

import numpy as np
import numpy.typing as npt

from common.jit import kernel
from common.physics.arm import Joints, point_velocity, racket_motion, racket_pose
from common.physics.constants import BALL_RADIUS, NET_HEIGHT, TABLE_HALF_LENGTH, TABLE_HALF_WIDTH
from common.physics.flight import flight_step
from common.physics.racket_bounce import racket_bounce
from common.physics.touch import racket_gap
from common.physics.vec import Vec, axpy, dot, sub, vec_at
from common.rally.cholesky import factor, substitute
from common.rally.heading import LONGEST_RETURN, NOT_THAT_FAR

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

BACK = 12  # control steps that a correction looks back over: 0.24 s at 50 Hz, twice the slowest drive's lag
# Goals: landing x, y; place on the racket (2); height over the net, where it lacks; time of the contact, where too soon
_LANDING, _PLACE, _OVER, _LATER = 0, 2, 4, 5
GOALS = 6

# Columns of a hit's row: the ball as it met the racket, the joints then, and when in its control step that was [s]
BALL_POS, BALL_VEL, BALL_SPIN, JOINT_POS, JOINT_VEL, MOMENT = 0, 3, 6, 9, 16, 23
STEP = 24  # number of that control step in the rally, from 0
FRESH = 25  # 1: contact and leaving were in the newest control step
BOUNCE, CONTACT = 26, 27  # when the ball met the robot's court, and the racket, since launch [s]
LEFT_POS, LEFT_VEL, LEFT_SPIN = 28, 31, 34  # the ball as it left the racket
HIT = 37

# Rows of the drives' table (5, 7)
INERTIA, STIFFNESS, DAMPING, JOINT_DAMPING, HALF_RANGE = range(5)

MARGIN = 0.16  # [m] that the ball should clear the net by
EDGE = 0.30  # [m] a target nearer to the table's edge than this is aimed at from inside: what misses a little returns
NEAREST = 0.40  # [m] from the net on that balls are aimed to
LARGEST_MISS = 0.5  # [m] of landing errors as corrected: farther off the linear model says the direction only
LARGEST_SHORTFALL = 0.25  # [m] of the height over the net
PLACE_WEIGHT = 5.0  # [-] 1 cm off the racket's centre weighs as much as 5 cm off the target
SOONEST = 0.100  # [s] after the bounce: by then it has been seen, and tells of the spin; who hits much earlier volleys
PACE = 3.0  # [m/s] a ball's, about: a contact that is 10 ms too soon weighs as much as 3 cm off the target
LEVENBERG = 1.0  # [m^2] lambda; L L' is some 25 m^2 per (unit of action)^2
TRUST = 0.1  # [half-range] size of a whole correction at which it counts half: a larger one leaves the linear model
_FLIGHT_STEP = 0.010  # [s]
_DEEPEST = -0.7  # [m] below the table a ball that fell short isn't followed
_SLOWEST_CLOSING = -0.5  # [m/s] slower contacts would be shifted too far in time
_POS_STEP, _VEL_STEP = 1e-4, 1e-3  # of the differences [m, rad], [m/s, rad/s]
_INSANE = 1e6  # results beyond this are no basis for a correction


@kernel
def note_hit(
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
    """Write ball and joints at a contact into a hit's row (HIT,); it is fresh once the ball has left."""
    for k in range(3):
        hit[BALL_POS + k], hit[BALL_VEL + k], hit[BALL_SPIN + k] = pos[k], vel[k], spin[k]
    for j in range(7):
        hit[JOINT_POS + j], hit[JOINT_VEL + j] = joints[j], rates[j]
    hit[MOMENT], hit[STEP], hit[FRESH], hit[CONTACT] = moment, step, 0.0, contact


@kernel
def note_leaving(hit: Array, pos: Vec, vel: Vec, spin: Vec) -> None:
    """Write the ball as it left the racket into the row of its hit."""
    for k in range(3):
        hit[LEFT_POS + k], hit[LEFT_VEL + k], hit[LEFT_SPIN + k] = pos[k], vel[k], spin[k]
    hit[FRESH] = 1.0


@kernel
def flies_to(pos: Vec, vel: Vec, spin: Vec, condition: Array, model: int) -> tuple[float, float, float]:
    """Return where a ball comes down to the table's height, x and y [m], and by how much it clears the net [m].

    Unlike in ``heading.heading`` a ball that comes down before the net is followed on below the table: by how much it
    lacks height is known then.
    """
    over_net = NOT_THAT_FAR
    x, y, is_down = pos[0], pos[1], False
    for _ in range(math.ceil(LONGEST_RETURN / _FLIGHT_STEP)):
        before = pos
        pos, vel = flight_step(pos, vel, spin, _FLIGHT_STEP, condition[0], condition[1], model)
        if before[0] < 0.0 <= pos[0]:
            share = -before[0] / (pos[0] - before[0])
            over_net = before[2] + share * (pos[2] - before[2]) - NET_HEIGHT - BALL_RADIUS
            if is_down:
                break
        if not is_down and pos[2] < BALL_RADIUS and vel[2] < 0.0:
            share = (before[2] - BALL_RADIUS) / (before[2] - pos[2]) if before[2] > BALL_RADIUS else 0.0
            x, y = before[0] + share * (pos[0] - before[0]), before[1] + share * (pos[1] - before[1])
            is_down = True
            if x > 0.0:
                break
        if pos[2] < _DEEPEST:
            break
    return x, y, over_net


@kernel
def _meeting(q: Joints, qd: Joints, pos: Vec) -> tuple[float, Vec, Vec]:
    """Return gap [m] and normal between racket and ball, and the racket's velocity where they meet [m/s]."""
    pose = racket_pose(q)
    gap, normal = racket_gap(pos, pose)
    racket_vel, racket_spin = racket_motion(q, qd)
    surface_vel = point_velocity(pose.centre, racket_vel, racket_spin, axpy(-BALL_RADIUS, normal, pos))
    return gap, normal, surface_vel


@kernel
def hit_result(
    q: Joints, qd: Joints, pos: Vec, vel: Vec, spin: Vec, condition: Array, model: int
) -> tuple[float, float, float, float, float, float]:
    """Return what a hit comes to: ``GOALS``.

    The racket may stand a little off the ball (or in it): the contact is shifted to the moment at which they meet.

    Args:
        q: Joint positions at about the contact [m, rad].
        qd: Joint velocities [m/s, rad/s].
        pos: Ball then [m].
        vel: Its velocity before the contact [m/s].
        spin: [rad/s].
        condition: The rally's ``noise.Condition`` (14,).
        model: ``flight.SIMPLE`` or ``flight.FULL``.

    Returns:
        Landing x, y [m]; offset from the racket's centre along its side and handle, times ``PLACE_WEIGHT`` [m]; height
        over the net [m]; by how much later the contact is, times ``PACE`` [m].
    """
    gap, normal, surface_vel = _meeting(q, qd, pos)
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
    _, normal, surface_vel = _meeting(q, qd, pos)
    pose = racket_pose(q)
    offset = sub(pos, pose.centre)
    vel, spin = racket_bounce(
        vel, spin, normal, surface_vel, condition[4], condition[5], condition[6], condition[7], np.inf
    )
    x, y, over_net = flies_to(pos, vel, spin, condition, model)
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
    hit: Array, condition: Array, model: int, by_pos: Array, by_vel: Array
) -> tuple[float, float, float, float, float, float]:
    """Write how a hit's result depends on the joints at the contact, and return the result as our racket has it.

    Args:
        hit: (HIT,).
        condition: (14,).
        model: ``flight.SIMPLE`` or ``flight.FULL``.
        by_pos: (GOALS, 7) d result / d joint position; written.
        by_vel: (GOALS, 7) d result / d joint velocity; written.
    """
    pos, vel, spin = vec_at(hit, BALL_POS), vec_at(hit, BALL_VEL), vec_at(hit, BALL_SPIN)
    q, qd = _joints(hit, JOINT_POS), _joints(hit, JOINT_VEL)
    result = hit_result(q, qd, pos, vel, spin, condition, model)
    for joint in range(7):
        moved = hit_result(_moved(q, joint, _POS_STEP), qd, pos, vel, spin, condition, model)
        faster = hit_result(q, _moved(qd, joint, _VEL_STEP), pos, vel, spin, condition, model)
        for goal in range(GOALS):
            by_pos[goal, joint] = (moved[goal] - result[goal]) / _POS_STEP
            by_vel[goal, joint] = (faster[goal] - result[goal]) / _VEL_STEP
    return result


@kernel
def back_through_drives(
    by_pos: Array,
    by_vel: Array,
    moment: float,
    limited: Flags,
    newest: int,
    steps: int,
    late: int,
    drives: Array,
    h: float,
    out: Array,
) -> None:
    """Write d result / d action for the control step of a contact and those before it.

    Each joint on its own: inertia v' = k_p (target - q) - (k_v + d) v, stepped as MuJoCo's implicit integrator does;
    where its force was at the limit it didn't feel the target. The adjoint recursion runs back from the contact.

    Args:
        by_pos: (7,) d result / d joint position at the contact.
        by_vel: (7,) d result / d joint velocity.
        moment: Of the contact, since its control step began [s].
        limited: (BACK, n, 7) whether a drive was at its limit, by control step (a ring) and substep.
        newest: The ring's row of the contact's control step.
        steps: How many control steps back the rally (or the ring) reaches, that one included.
        late: Action latency [substeps], from the beginning of an action's control step on.
        drives: (5, 7) inertia, k_p, k_v, joint damping, half-range of the targets.
        h: MuJoCo's time step [s].
        out: (BACK, 7) by control step, the contact's first; written.
    """
    substeps = limited.shape[1]
    row = min(int(moment / h), substeps - 1)
    for j in range(7):
        inertia, stiffness, damping = drives[INERTIA, j], drives[STIFFNESS, j], drives[DAMPING, j]
        slowed, driven = (
            inertia + h * drives[JOINT_DAMPING, j],
            inertia + h * (drives[JOINT_DAMPING, j] + damping),
        )
        for k in range(out.shape[0]):
            out[k, j] = 0.0
        # Positions between substeps are linear: q(moment) = q_row + (moment - row h) v_{row + 1}
        on_q, on_v = by_pos[j], by_vel[j] + (moment - row * h) * by_pos[j]
        for k in range(steps):
            for s in range(row if k == 0 else substeps - 1, -1, -1):
                if k > 0 or s < row:
                    on_v += h * on_q  # q+ = q + h v+
                if limited[(newest - k) % limited.shape[0], s, j]:
                    on_v *= inertia / slowed
                    continue
                pull = h * stiffness / driven * on_v
                age = k + (late - s + substeps - 1) // substeps if s < late else k
                if age < steps:  # what was told before belongs to another rally
                    out[age, j] += pull * drives[HALF_RANGE, j]
                on_v *= inertia / driven
                on_q -= pull


@kernel
def least_change(sensitivity: Array, wanted: Array, out: Array) -> bool:
    """Write d = L' (L L' + lambda)^-1 wanted; return whether it is any good.

    Args:
        sensitivity: L (GOALS, BACK, 7); rows of zeros: goals that are met already.
        wanted: By how much the result should change (GOALS,).
        out: d (BACK, 7), a large one scaled down; written.
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
    # As in robust regression (Cauchy's influence): the farther off, the less a hit knows about the way. Without it
    # a policy that doesn't return anything yet is torn from catching before PPO can hold it.
    for k in range(steps):
        for c in range(joints):
            out[k, c] /= 1.0 + square / (TRUST * TRUST)
    return math.isfinite(square)


@kernel
def correction(
    hit: Array,
    condition: Array,
    model: int,
    limited: Flags,
    newest: int,
    steps: int,
    late: int,
    drives: Array,
    h: float,
    out: Array,
) -> bool:
    """Write the least change of the last actions that would have taken a hit where it should go, linearised.

    Args:
        hit: (HIT,) ball and joints at the contact, and the ball as it left.
        condition: (14,).
        model: ``flight.SIMPLE`` or ``flight.FULL``.
        limited: See ``back_through_drives``, as the next four.
        newest: The ring's row of the contact's control step.
        steps: Control steps to look back over.
        late: Action latency [substeps].
        drives: (5, 7).
        h: MuJoCo's time step [s].
        out: (BACK, 7) [half-range] by control step, the contact's first; written.

    Returns:
        Whether there is a correction: not where a result isn't finite or beyond reason.
    """
    by_pos, by_vel = np.empty((GOALS, 7)), np.empty((GOALS, 7))
    result = hit_sensitivity(hit, condition, model, by_pos, by_vel)
    sensitivity = np.empty((GOALS, out.shape[0], 7))
    for goal in range(GOALS):
        back_through_drives(
            by_pos[goal],
            by_vel[goal],
            hit[MOMENT],
            limited,
            newest,
            steps,
            late,
            drives,
            h,
            sensitivity[goal],
        )
    wanted = np.empty(GOALS)
    target_x = min(max(condition[8], NEAREST), TABLE_HALF_LENGTH - EDGE)
    target_y = min(max(condition[9], EDGE - TABLE_HALF_WIDTH), TABLE_HALF_WIDTH - EDGE)
    x, y, over_net = flies_to(
        vec_at(hit, LEFT_POS), vec_at(hit, LEFT_VEL), vec_at(hit, LEFT_SPIN), condition, model
    )
    miss_x, miss_y = target_x - x, target_y - y
    miss = math.sqrt(miss_x * miss_x + miss_y * miss_y)
    if miss > LARGEST_MISS:
        miss_x *= LARGEST_MISS / miss
        miss_y *= LARGEST_MISS / miss
    wanted[_LANDING], wanted[_LANDING + 1] = miss_x, miss_y
    wanted[_PLACE], wanted[_PLACE + 1] = -result[_PLACE], -result[_PLACE + 1]
    wanted[_OVER] = min(MARGIN - over_net, LARGEST_SHORTFALL)
    if not NOT_THAT_FAR < over_net < MARGIN:
        wanted[_OVER], sensitivity[_OVER] = 0.0, 0.0
    wanted[_LATER] = PACE * (SOONEST - (hit[CONTACT] - hit[BOUNCE]))
    if wanted[_LATER] <= 0.0:
        wanted[_LATER], sensitivity[_LATER] = 0.0, 0.0
    return least_change(sensitivity, wanted, out)


@kernel
def corrections(
    hits: Array,
    conditions: Array,
    model: int,
    limited: Flags,
    newest: int,
    drives: Array,
    h: float,
    out: Array,
    steps: npt.NDArray[np.int64],
) -> None:
    """Correct every fresh hit of B robots.

    Args:
        hits: (B, HIT).
        conditions: ``noise.Condition`` of the rallies (B, 14).
        model: ``flight.SIMPLE`` or ``flight.FULL``.
        limited: (B, BACK, n, 7) whether a drive was at its limit, by control step (a ring) and substep.
        newest: The ring's row of the newest control step.
        drives: (5, 7).
        h: MuJoCo's time step [s].
        out: (B, BACK, 7); rows of fresh hits are written.
        steps: (B,) how many control steps back a correction reaches; 0 where there is none; written.
    """
    for b in range(hits.shape[0]):
        steps[b] = 0
        if hits[b, FRESH] == 0.0:
            continue
        reach = min(int(hits[b, STEP]) + 1, BACK)
        late = int(conditions[b, 11] / h + 0.5)
        if correction(hits[b], conditions[b], model, limited[b], newest, reach, late, drives, h, out[b]):
            steps[b] = reach

"""One control step of many rallies: flight, touches, states, reward and what the camera saw.

Each ball is played by one readable function on its own row; the batch is a loop. Nothing here depends on the
batch's size or order, so a batch equals its rallies played one by one, bit for bit. One thing goes from a row's rally
to its next, if it is asked for (``spin_expected`` learnt): what was learnt of how the other side spins.
"""

from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from common.jit import kernel
from common.physics.arm import (
    joint_rates_at,
    joints_at,
    point_velocity,
    racket_motion,
    racket_pose,
    racket_quaternion,
    speed_bound,
)
from common.physics.constants import BALL_MASS, BALL_RADIUS, GRID_STEP
from common.physics.fly import fly_step
from common.physics.racket_bounce import racket_bounce
from common.physics.table_bounce import table_bounce
from common.physics.touch import NONE, OPPONENT_COURT, RACKET, ROBOT_COURT
from common.physics.vec import Vec, axpy, cross, dot, norm, scale, sub
from common.rally.camera import FILM, READ, TAKEN, begin_film, film_flight, shot_row
from common.rally.draws import Stream, normal_pair, uniform
from common.rally.estimator import ESTIMATE, begin_estimate, estimate_at, is_guess, take_shot
from common.rally.heading import LONGEST_RETURN, heading
from common.rally.hindsight import BOUNCE, FRESH, HIT, note_hit, note_leaving
from common.rally.noise import CONDITIONS, MAX_LATENCY_STEPS, NoiseProfile, draw_conditions
from common.rally.observation import ObservationConfig
from common.rally.prediction import PREDICTED, PRESENT, SPIN, begin_track, follow, new_tracks, predict
from common.rally.trajectory import OUTCOME_OFFSET, Outcome, State

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

RING = MAX_LATENCY_STEPS + 1  # camera samples kept: one a grid step
SAMPLE = 7  # numbers in a camera sample: position, velocity, trajectory state 0..3
CONTACT_FORCE_SCALE = 50.0  # [N] F_c at which a body's collision penalty saturates
MAX_SPEED_REWARDED = 10.0  # [m/s]
FARTHEST = 1.0e3  # [m] a ball beyond this is a bug, not a rally
_TAKEN = SAMPLE  # column of ``Rallies.seen``
NO_SAMPLE = -1.0  # state of a sample that is none: a path ends before it
NO_TRACKS: Final = new_tracks(0)
_TOUCHES_A_STEP = 8  # a ball that touches more often inside 5 ms is squeezed between two things: let it be

_TAU_0, _TAU_01, _TAU_1, _TAU_12, _TAU_2, _TAU_23, _TAU_3, _TAU_30 = (int(s) for s in State)
_RETURNED, _TIME_OUT = int(Outcome.RETURNED), int(Outcome.TIME_OUT)
_CAMERA = int(Stream.CAMERA)


class Told(NamedTuple):
    """What an observation says of the ball and of the truth: ``ObservationConfig`` for kernels."""

    is_filtered: bool  # the ball stands where it is now, else where it was sampled
    spin: int  # of ``_SPINS``
    is_predicted: bool  # where it is now and how it will come to be met follow
    has_age: bool  # how old its sample is follows
    is_privileged: bool  # the critic's truth follows


_SPINS = ("hidden", "estimated", "true")
_SPIN_HIDDEN, _SPIN_TRUE = _SPINS.index("hidden"), _SPINS.index("true")


def told_by(options: ObservationConfig) -> Told:
    """Return what policy and critic are told."""
    return Told(
        is_filtered=options.ball == "filtered",
        spin=_SPINS.index(options.spin),
        is_predicted=options.prediction,
        has_age=options.age,
        is_privileged=options.critic == "privileged",
    )


class Rallies(NamedTuple):
    """The state of B rallies, one row each; the kernels write it in place."""

    ball: Array  # (B, 9) position [m], velocity [m/s], spin [rad/s]
    state: Integers  # (B,) State
    seed: npt.NDArray[np.uint64]  # (B,)
    condition: Array  # (B, 14) noise.Condition
    clock: Integers  # (B,) grid steps since launch
    rounds_left: Integers  # (B,) rallies left in this episode, the one in play included
    aimed: npt.NDArray[np.bool_]  # (B,) the bonus for where the hit ball is heading has been paid
    foreseen: npt.NDArray[np.bool_]  # (B,) once hit, it is flown to its end at once, robot apart
    caught: npt.NDArray[np.bool_]  # (B,) the racket touched the ball legally
    over: npt.NDArray[np.bool_]  # (B,) and it crossed the net after that
    landing: Array  # (B, 2) [m] where the ball landed; nan before a legal landing
    landing_error: Array  # (B,) [m] planar distance of that to the target
    # (B, RING + n, 7) true samples on the grid: a ring of those that were, newest at ``head``, and a path of those to
    # come, from the launch on, to which a ball keeps until it is hit. Not an array of its own: see ``eyes``
    camera: Array
    head: Integers  # (B,)
    # (B, 8) the sample that the robot goes by: late, noisy, sometimes held; and when it was taken [s since launch]
    seen: Array
    earlier: Array  # (B, history, 6) what it went by one, two ... control steps ago
    # (B, FILM + ESTIMATE) the simulated camera's film and what the estimator makes of it; no rows: perception is cheap.
    # One array, not several: with four, every step of every rally took twice as long, camera or not
    eyes: Array
    track: Array  # (B, TRACK) what the samples tell of the flight; no rows: nobody asks
    hit: Array  # (B, HIT) the last legal contact: ball before and after, joints; no rows: nobody asks
    last_action: Array  # (B, 7)


class Motion(NamedTuple):
    """What the robot did in one control step: MuJoCo's records of n substeps."""

    start_pos: Array  # (B, 7) joint positions before the step
    joint_pos: Array  # (B, n, 7)
    torque: Array  # (B, n, 7) actuator forces [N, Nm]
    contact: Array  # (B, n, bodies) touch sensors [N]
    step: float  # [s] MuJoCo's time step


class Rules(NamedTuple):
    """Everything constant that a step needs."""

    transitions: Integers  # trajectory.transition_table()
    rewards: Array  # (8, 5) reward.reward_table()[stage - 1]
    landing_scale: float  # [m]
    heading: float  # weight of the bonus for where a hit ball is heading; 0 in stages that don't aim
    heading_scale: float  # [m]
    rate_scale: float  # reference rate / control rate: continuous rows, torque and collision are rates (jitter is not)
    torque_weight: float
    torque_limit: Array  # (7,) [N, Nm]
    jitter_weight: float
    collision_weight: float
    grid_steps: int  # a control step
    time_limit: float  # [s] a rally
    flight_model: int


class Step(NamedTuple):
    """What one control step came to, one row a rally; the kernels write it in place."""

    reward: Array  # (B,)
    terms: Array  # (B, 8) reward.TERMS
    outcome: Integers  # (B,) trajectory.Outcome
    impulse: Array  # (B, 6) [N s, N m s] impulse of the ball on the racket, and its moment about the centre


class Flown(NamedTuple):
    """Where a ball came to in one control step, and what it met on its way."""

    pos: Vec
    vel: Vec
    spin: Vec
    state: int
    outcome: int  # trajectory.Outcome; 0: goes on
    bounced: bool  # tau_1 was met
    hit: bool  # tau_2 was met
    landed: bool  # tau_3 was met
    racket_speed: float  # [m/s] v of the reward, where hit


def allocate(
    count: int,
    history: int = 0,
    full: bool = False,
    tracks: Array = NO_TRACKS,
    reviewed: bool = False,
    path_rows: int = 0,
) -> tuple[Rallies, Step]:
    """Return zeroed rows for ``count`` rallies.

    Args:
        count: B.
        history: How many earlier samples are remembered.
        full: Whether the ball is perceived by camera and estimator; else by its true state, late and noisy.
        tracks: ``prediction.new_tracks``, where flights are followed: ball filtered, spin estimated, meeting predicted.
        reviewed: Whether contacts are kept, for ``hindsight``.
        path_rows: Samples of a path that balls keep to until they are hit; 0: they fly as physics has it.
    """
    rallies = Rallies(
        ball=np.zeros((count, 9)),
        state=np.zeros(count, np.int64),
        seed=np.zeros(count, np.uint64),
        condition=np.zeros((count, CONDITIONS)),
        clock=np.zeros(count, np.int64),
        rounds_left=np.ones(count, np.int64),
        aimed=np.zeros(count, np.bool_),
        foreseen=np.zeros(count, np.bool_),
        caught=np.zeros(count, np.bool_),
        over=np.zeros(count, np.bool_),
        landing=np.full((count, 2), np.nan),
        landing_error=np.full(count, np.nan),
        camera=np.zeros((count, RING + path_rows, SAMPLE)),
        head=np.zeros(count, np.int64),
        seen=np.zeros((count, SAMPLE + 1)),
        earlier=np.zeros((count, history, 6)),
        eyes=np.zeros((count if full else 0, FILM + ESTIMATE)),
        track=tracks,
        hit=np.zeros((count if reviewed else 0, HIT)),
        last_action=np.zeros((count, 7)),
    )
    step = Step(np.zeros(count), np.zeros((count, 8)), np.zeros(count, np.int64), np.zeros((count, 6)))
    return rallies, step


@kernel
def _sample(rallies: Rallies, b: int, step: int, noise: NoiseProfile) -> None:
    """Show the true sample of a latency ago with noise; if lost, the last one."""
    seed = rallies.seed[b]
    moment = rallies.clock[b] * GRID_STEP
    condition = rallies.condition[b]
    in_burst = condition[12] <= moment < condition[13]
    if step > 0 and (in_burst or uniform(seed, _CAMERA, 8 * step) < noise.loss):
        return
    row = (rallies.head[b] + RING - int(condition[10])) % RING
    seen = rallies.seen[b]
    seen[_TAKEN] = max(moment - condition[10] * GRID_STEP, 0.0)
    sample = rallies.camera[b, row]
    if noise.position_noise == 0.0 and noise.velocity_noise == 0.0:
        for k in range(6):
            seen[k] = sample[k]
    else:
        a0, a1 = normal_pair(seed, _CAMERA, 4 * step + 1)
        a2, a3 = normal_pair(seed, _CAMERA, 4 * step + 2)
        a4, a5 = normal_pair(seed, _CAMERA, 4 * step + 3)
        seen[0] = sample[0] + noise.position_noise * a0
        seen[1] = sample[1] + noise.position_noise * a1
        seen[2] = sample[2] + noise.position_noise * a2
        seen[3] = sample[3] + noise.velocity_noise * a3
        seen[4] = sample[4] + noise.velocity_noise * a4
        seen[5] = sample[5] + noise.velocity_noise * a5
    seen[6] = sample[6]


@kernel
def _estimate(rallies: Rallies, b: int, noise: NoiseProfile) -> None:
    """Let the estimator take the shots that have arrived, and show its estimate for the usual latency ago.

    The usual latency is the mean over rallies: what a policy expects of its samples' age, whoever perceives. The
    camera's own, this rally's, is known, because it stamps its shots.
    """
    now = rallies.clock[b] * GRID_STEP
    latency = rallies.condition[b, 10] * GRID_STEP
    film, row = rallies.eyes[b, :FILM], rallies.eyes[b, FILM:]
    while film[READ] < film[TAKEN]:
        shot = shot_row(film, int(film[READ]))
        pos = (shot[1], shot[2], shot[3])
        if film[READ] == 0.0:  # the launch itself is in view
            begin_estimate(row, shot[0], pos, noise.camera_noise)
            shot[4] = 1.0
        elif shot[0] + latency > now + 1e-9:
            break
        elif take_shot(row, shot[0], pos, noise.camera_noise):
            shot[4] = 1.0
        film[READ] += 1.0
    usual = 0.5 * (noise.observation_latency[0] + noise.observation_latency[1])
    seen = rallies.seen[b]
    seen[_TAKEN] = max(now - usual, 0.0)
    pos, vel, state = estimate_at(row, seen[_TAKEN])
    for k in range(3):
        seen[k], seen[3 + k] = pos[k], vel[k]
    seen[6] = state


@kernel
def follow_flight(
    track: Array,
    seen: Array,
    moment: float,
    now: float,
    is_first: bool,
    guessed: bool,
    position_noise: float,
    velocity_noise: float,
) -> None:
    """Let a track (``prediction.TRACK``,) follow the sample that the robot goes by ``now``.

    Args:
        track: Written.
        seen: Position [m], velocity [m/s], trajectory state 0..3.
        moment: When it was taken [s].
        now: [s].
        is_first: Whether the flight begins with it.
        guessed: Whether it is but an estimator's guess (``estimator.is_guess``): then the flight begins anew with it.
        position_noise: Its sigma a axis [m].
        velocity_noise: [m/s].
    """
    if is_first or (guessed and seen[6] == 0.0):
        begin_track(track, seen, moment, position_noise, velocity_noise)
        predict(track, now)
    elif seen[6] <= 1.0:
        follow(track, seen, moment, seen[6] == 1.0, position_noise, velocity_noise)
        predict(track, now)
    else:  # it was hit: what was followed is over
        for k in range(6):
            track[PRESENT + k] = seen[k]


@kernel
def _look(rallies: Rallies, b: int, step: int, noise: NoiseProfile) -> None:
    """Update what the robot sees of ball b, and what it remembers."""
    earlier = rallies.earlier[b]
    for k in range(earlier.shape[0] - 1, -1, -1):
        for j in range(6):
            earlier[k, j] = earlier[k - 1, j] if k > 0 else rallies.seen[b, j]
    seen = rallies.seen[b]
    if rallies.eyes.shape[0] > 0:
        _estimate(rallies, b, noise)
    else:
        _sample(rallies, b, step, noise)
    if rallies.track.shape[0] > 0:
        guessed = rallies.eyes.shape[0] > 0 and is_guess(rallies.eyes[b, FILM:])
        follow_flight(
            rallies.track[b],
            seen,
            seen[_TAKEN],
            rallies.clock[b] * GRID_STEP,
            step == 0,
            guessed,
            noise.position_noise,
            noise.velocity_noise,
        )


@kernel
def launch_rally(rallies: Rallies, b: int, record: Array, seed: int, noise: NoiseProfile) -> None:
    """Put a rally on row b.

    Args:
        rallies: Rows to write.
        b: Row.
        record: Position, velocity, spin, drag factor, lift factor (11,), as generated.
        seed: The rally's seed: conditions, target and camera noise follow from it.
        noise: Profile to draw conditions from.
    """
    for k in range(9):
        rallies.ball[b, k] = record[k]
    rallies.state[b] = _TAU_0
    rallies.seed[b] = seed
    draw_conditions(seed, record[9], record[10], noise, rallies.condition[b])
    rallies.clock[b] = 0
    rallies.caught[b] = False
    rallies.over[b] = False
    rallies.aimed[b] = False
    rallies.landing[b, 0], rallies.landing[b, 1] = np.nan, np.nan
    rallies.landing_error[b] = np.nan
    rallies.head[b] = 0
    for row in range(RING):
        for k in range(6):
            rallies.camera[b, row, k] = record[k]
        rallies.camera[b, row, 6] = 0.0
    if rallies.eyes.shape[0] > 0:
        begin_film(rallies.eyes[b, :FILM], seed, (record[0], record[1], record[2]), noise)
    _look(rallies, b, 0, noise)
    for k in range(rallies.earlier.shape[1]):
        for j in range(6):
            rallies.earlier[b, k, j] = rallies.seen[b, j]


@kernel
def judge(rallies: Rallies, b: int, state: int, what: int, pos: Vec, rules: Rules) -> tuple[int, int]:
    """Return the state that a touch leads to and the outcome (0: the rally goes on); keep what the touch decides.

    Args:
        rallies: Row b is written.
        b: Row.
        state: State before the touch.
        what: ``touch.Touch``.
        pos: Ball's position [m] at the touch.
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
        dx, dy = pos[0] - rallies.condition[b, 8], pos[1] - rallies.condition[b, 9]
        rallies.landing_error[b] = np.sqrt(dx * dx + dy * dy)
        if rallies.rounds_left[b] <= 1:
            return following, _RETURNED
    return following, 0


@kernel
def shoot(
    rallies: Rallies, b: int, noise: NoiseProfile, since: float, p0: Vec, v0: Vec, h: float, p1: Vec, v1: Vec
) -> None:
    """Let the camera film a piece of ball b's flight without touches; only where there is a camera.

    Args:
        rallies: Row b is written.
        b: Row.
        noise: Profile.
        since: When the piece begins, from the last ``film`` on [s].
        p0: Position then [m].
        v0: Velocity then [m/s].
        h: Its duration [s].
        p1: Position at its end [m].
        v1: Velocity at its end, before any bounce [m/s].
    """
    film_flight(
        rallies.eyes[b, :FILM],
        rallies.seed[b],
        rallies.condition[b],
        noise,
        rallies.clock[b] * GRID_STEP + since,
        p0,
        v0,
        h,
        p1,
        v1,
    )


@kernel
def keep_to_path(path: Array, step: int, state: int, pos: Vec, vel: Vec) -> tuple[Vec, Vec]:
    """Return where a driven ball is after ``step`` grid steps, and its velocity.

    Between two rows it flies as physics has it, 5 ms at a time, so that touches are found where they always are; a
    row then puts it back on its path, a tenth of a millimetre away. So the bounce, and what it does to the spin, is
    physics' too, a grid step sooner or later than the path's: while the two disagree on whether it has been, the
    ball is left alone.

    Args:
        path: Samples on the grid, the launch first: position, velocity, 0 before the bounce and 1 after it; from its
            end on ``NO_SAMPLE`` (n, 7).
        step: Since the launch, now.
        state: Trajectory state now.
        pos: Where physics takes it [m].
        vel: And its velocity [m/s].
    """
    if step >= path.shape[0] or state >= _TAU_2:
        return pos, vel
    row = path[step]
    if row[6] != (1.0 if state >= _TAU_1 else 0.0):
        return pos, vel
    return (row[0], row[1], row[2]), (row[3], row[4], row[5])


@kernel
def film(rallies: Rallies, b: int, pos: Vec, vel: Vec, state: int) -> None:
    """Let a grid step pass: put the camera's true sample into the ring."""
    rallies.clock[b] += 1
    head = (rallies.head[b] + 1) % RING
    rallies.head[b] = head
    sample = rallies.camera[b, head]
    for k in range(3):
        sample[k], sample[3 + k] = pos[k], vel[k]
    sample[6] = float(state // 2)


@kernel
def copy_path(motion: Motion, b: int, path: Array) -> None:
    """Write robot b's joint positions at the control step's beginning and after each substep into ``path``."""
    for j in range(7):
        path[0, j] = motion.start_pos[b, j]
        for k in range(motion.joint_pos.shape[1]):
            path[k + 1, j] = motion.joint_pos[b, k, j]


@kernel
def _fly_one(
    rallies: Rallies, b: int, motion: Motion, rules: Rules, noise: NoiseProfile, path: Array, step: Step
) -> Flown:
    """Fly ball b through one control step, with every touch in between."""
    fastest = speed_bound(path, motion.step)
    ball, condition = rallies.ball[b], rallies.condition[b]
    pos, vel, spin = (ball[0], ball[1], ball[2]), (ball[3], ball[4], ball[5]), (ball[6], ball[7], ball[8])
    state = rallies.state[b]
    filmed, reviewed = rallies.eyes.shape[0] > 0, rallies.hit.shape[0] > 0
    driven = rallies.camera.shape[1] > RING
    if reviewed:
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
            pos, vel, flown, what, normal = fly_step(
                pos,
                vel,
                spin,
                rest,
                condition[0],
                condition[1],
                rules.flight_model,
                path,
                start,
                motion.step,
                fastest,
            )
            if filmed:
                shoot(rallies, b, noise, GRID_STEP - rest, p0, v0, flown, pos, vel)
            rest -= flown
            if state in (_TAU_2, _TAU_23) and pos[0] > BALL_RADIUS:
                rallies.over[b] = True
            if what == NONE:
                break
            if what in (ROBOT_COURT, OPPONENT_COURT):
                vel, spin = table_bounce(vel, spin, normal, condition[2], condition[3])
            elif what == RACKET:
                moment = start + flown
                joints = joints_at(path, moment, motion.step)
                centre = racket_pose(joints).centre
                racket_vel, racket_spin = racket_motion(joints, joint_rates_at(path, moment, motion.step))
                contact = axpy(-BALL_RADIUS, normal, pos)
                surface_vel = point_velocity(centre, racket_vel, racket_spin, contact)
                if dot(sub(vel, surface_vel), normal) >= 0.0:
                    continue  # a graze that is over as it begins: no contact without approach
                legal = rules.transitions[state, RACKET] == _TAU_2
                if reviewed and legal:
                    since = rallies.clock[b] * GRID_STEP + (GRID_STEP - rest)
                    now = rallies.clock[b] // rules.grid_steps
                    rates = joint_rates_at(path, moment, motion.step)
                    note_hit(rallies.hit[b], pos, vel, spin, joints, rates, moment, now, since)
                before = vel
                vel, spin = racket_bounce(
                    vel,
                    spin,
                    normal,
                    surface_vel,
                    condition[4],
                    condition[5],
                    condition[6],
                    condition[7],
                    np.inf,
                )
                if reviewed and legal:
                    note_leaving(rallies.hit[b], pos, vel, spin)
                impulse = scale(BALL_MASS, sub(before, vel))
                turn = cross(sub(contact, centre), impulse)
                for k in range(3):
                    step.impulse[b, k] += impulse[k]
                    step.impulse[b, 3 + k] += turn[k]
                racket_speed = min(max(surface_vel[0], 0.0), MAX_SPEED_REWARDED)
            state, outcome = judge(rallies, b, state, what, pos, rules)
            if reviewed and state == _TAU_1:
                rallies.hit[b, BOUNCE] = rallies.clock[b] * GRID_STEP + (GRID_STEP - rest)
            bounced, hit, landed = (
                bounced or state == _TAU_1,
                hit or state == _TAU_2,
                landed or state == _TAU_3,
            )
            if outcome != 0:
                break
        if driven and outcome == 0:
            pos, vel = keep_to_path(rallies.camera[b, RING:], rallies.clock[b] + 1, state, pos, vel)
        film(rallies, b, pos, vel, state)
        if outcome != 0:
            break
    return Flown(pos, vel, spin, state, outcome, bounced, hit, landed, racket_speed)


@kernel
def foresee(rallies: Rallies, b: int, flown: Flown, rules: Rules, no_robot: Array) -> tuple[Flown, float]:
    """Fly a ball that was hit to the rally's end at once, as if the robot were not there.

    Nothing that the robot does now changes where the ball lands (but for touching it again), so a training rally
    may end here: its frames are spent before the contact, and the landing is paid right behind it.

    Returns:
        Where the ball comes to, and the sum of ``aim`` over the control steps until then.
    """
    condition = rallies.condition[b]
    pos, vel, spin, state, outcome, _, _, landed, _ = flown
    target = (condition[8], condition[9], BALL_RADIUS)
    aim, steps = 0.0, 0
    while outcome == 0:
        pos, vel, _, what, _ = fly_step(
            pos,
            vel,
            spin,
            GRID_STEP,
            condition[0],
            condition[1],
            rules.flight_model,
            no_robot,
            0.0,
            1.0,
            0.0,
        )
        if pos[0] > BALL_RADIUS:
            rallies.over[b] = True
        if what != NONE:
            state, outcome = judge(rallies, b, state, what, pos, rules)
            landed = landed or state == _TAU_3
        steps += 1
        if outcome == 0 and steps % rules.grid_steps == 0:
            near = norm(sub(pos, target))
            aim += 1.0 / ((1.0 + near * near) * (1.0 + near * near))
        if steps * GRID_STEP >= LONGEST_RETURN:
            outcome = _TIME_OUT
    return Flown(pos, vel, spin, state, outcome, False, False, landed, 0.0), aim


@kernel
def settle(
    rallies: Rallies,
    b: int,
    flown: Flown,
    motion: Motion,
    actions: Array,
    rules: Rules,
    noise: NoiseProfile,
    path: Array,
    step: Step,
) -> None:
    """Pay for ball b's control step, write where it came to, and let the robot look.

    Instants met in this step are paid their rows, all of them; without any, the continuing state's row is paid.
    """
    substeps = motion.joint_pos.shape[1]
    ball, condition = rallies.ball[b], rallies.condition[b]
    later_aim, bonus = 0.0, 0.0
    if rules.heading > 0.0 and flown.state == _TAU_23 and flown.outcome == 0 and not rallies.aimed[b]:
        rallies.aimed[b] = True
        x, y, over_net = heading(flown.pos, flown.vel, flown.spin, condition, rules.flight_model)
        off2 = ((x - condition[8]) ** 2 + (y - condition[9]) ** 2) / rules.heading_scale**2
        bonus = (1.0 if over_net > 0.0 else 0.5) * rules.heading / (1.0 + off2)
    if rallies.foreseen[b] and flown.state == _TAU_23 and flown.outcome == 0:
        flown, later_aim = foresee(rallies, b, flown, rules, path[:0])
    pos, vel, spin, state, outcome, bounced, hit, landed, racket_speed = flown
    target = (condition[8], condition[9], BALL_RADIUS)
    joints = joints_at(path, substeps * motion.step, motion.step)
    reach = norm(sub(pos, racket_pose(joints).centre))
    near = norm(sub(pos, target))
    g = 1.0 / ((1.0 + reach * reach) * (1.0 + reach * reach))
    aim = 1.0 / ((1.0 + near * near) * (1.0 + near * near))
    rows, terms = rules.rewards, step.terms[b]
    for k in range(8):
        terms[k] = 0.0
    if bounced:
        terms[1] = rows[_TAU_1, 0]
    if hit:
        terms[2] = rows[_TAU_2, 0] + rows[_TAU_2, 2] * racket_speed
    if landed:
        miss = rallies.landing_error[b] / rules.landing_scale
        terms[4] = rows[_TAU_3, 0] + rows[_TAU_3, 4] / ((1.0 + miss * miss) * (1.0 + miss * miss))
    if not (bounced or hit or landed or state == _TAU_0):
        terms[0] = rules.rate_scale * rows[state, 1] * g
        terms[3] = rules.rate_scale * rows[state, 3] * aim
    terms[3] += rules.rate_scale * rows[_TAU_23, 3] * later_aim + bonus
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
    terms[5] = -rules.torque_weight * rules.rate_scale * torque / substeps
    terms[6] = -rules.jitter_weight * jitter
    terms[7] = -rules.collision_weight * rules.rate_scale * collision / substeps
    total = 0.0
    for k in range(8):
        total += terms[k]
    step.reward[b] = total

    if state % 2 == 0:  # an instant lasts for one control step
        state += 1
    if outcome == 0 and (rallies.clock[b] * GRID_STEP >= rules.time_limit - 1e-9 or not norm(pos) < FARTHEST):
        outcome = _RETURNED if state == _TAU_30 else _TIME_OUT  # landed legally: nothing was cut
    step.outcome[b] = outcome
    rallies.state[b] = state
    for k in range(3):
        ball[k], ball[3 + k], ball[6 + k] = pos[k], vel[k], spin[k]
    _look(rallies, b, rallies.clock[b] // rules.grid_steps, noise)


@kernel
def play_step(
    rallies: Rallies, motion: Motion, actions: Array, rules: Rules, noise: NoiseProfile, step: Step
) -> None:
    """Play every rally for one control step; ``rallies`` and ``step`` are written in place."""
    path = np.empty((motion.joint_pos.shape[1] + 1, 7))
    for b in range(rallies.state.shape[0]):
        copy_path(motion, b, path)
        flown = _fly_one(rallies, b, motion, rules, noise, path, step)
        settle(rallies, b, flown, motion, actions, rules, noise, path, step)


@kernel
def launch_rallies(
    rallies: Rallies, rows: Integers, records: Array, seeds: npt.NDArray[np.uint64], noise: NoiseProfile
) -> None:
    """Put rallies ``records`` (n, 11) with ``seeds`` (n,) on ``rows`` (n,)."""
    for k in range(rows.shape[0]):
        launch_rally(rallies, rows[k], records[k], seeds[k], noise)


@kernel
def observe(
    rallies: Rallies,
    rows: Integers,
    joint_pos: Array,
    joint_vel: Array,
    told: Told,
    out: npt.NDArray[np.float32],
) -> None:
    """Write ``observation.critic_layout`` of ``rows`` (n,) into the same rows of ``out`` (B, D).

    Args:
        rallies: Rows to read.
        rows: Which.
        joint_pos: Joint positions now (B, 7).
        joint_vel: Joint velocities now (B, 7).
        told: What of the ball stands in them.
        out: Rows to write.
    """
    for k in range(rows.shape[0]):
        b = rows[k]
        o, q, qd = out[b], joint_pos[b], joint_vel[b]
        joints = (q[0], q[1], q[2], q[3], q[4], q[5], q[6])
        rates = (qd[0], qd[1], qd[2], qd[3], qd[4], qd[5], qd[6])
        centre = racket_pose(joints).centre
        velocity, _ = racket_motion(joints, rates)
        quaternion = racket_quaternion(joints)
        for j in range(7):
            o[j], o[7 + j] = q[j], qd[j]
        for j in range(3):
            o[14 + j], o[21 + j] = centre[j], velocity[j]
        for j in range(4):
            o[17 + j] = quaternion[j]
        for j in range(6):
            o[24 + j] = rallies.track[b, PRESENT + j] if told.is_filtered else rallies.seen[b, j]
        o[30], o[31] = rallies.condition[b, 8], rallies.condition[b, 9]
        s = int(rallies.seen[b, 6])
        o[32] = 2.0 * s / 3.0 - 1.0
        for j in range(4):
            o[33 + j] = 1.0 if j == s else 0.0
        at = 37
        if told.spin != _SPIN_HIDDEN:
            for j in range(3):
                o[at + j] = rallies.ball[b, 6 + j] if told.spin == _SPIN_TRUE else rallies.track[b, SPIN + j]
            at += 3
        if told.is_predicted:
            for j in range(PREDICTED):
                o[at + j] = rallies.track[b, PRESENT + j]
            at += PREDICTED
        if told.has_age:
            o[at] = rallies.clock[b] * GRID_STEP - rallies.seen[b, _TAKEN]
            at += 1
        for earlier in range(rallies.earlier.shape[1]):
            for j in range(6):
                o[at + j] = rallies.earlier[b, earlier, j]
            at += 6
        if told.is_privileged:
            for j in range(9):
                o[at + j] = rallies.ball[b, j]
            for j in range(8):  # drag, lift, table, rubber
                o[at + 9 + j] = rallies.condition[b, j]

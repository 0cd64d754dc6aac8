"""The state of many rallies as arrays, one row a rally, and the input and output of one control step."""

from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from common.perception.camera import DETECTION_BUFFER
from common.perception.camera_filter import ESTIMATE
from common.perception.flight_track import new_tracks
from common.physics.chain import Chain
from common.physics.vec import Vec
from common.rally.hit import HIT
from common.task.randomization import MAX_LATENCY_STEPS, RALLY_PARAMETERS
from common.task.reward import TERMS

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]
Integers = npt.NDArray[np.int64]

RING: Final = MAX_LATENCY_STEPS + 1  # true samples kept: one a grid step
SAMPLE: Final = 7  # numbers in a sample: position [m], velocity [m/s], trajectory state 0..3, or SERVED
STAMP: Final = SAMPLE  # column of ``Rallies.measurement``: when the sample was taken [s since launch]
NO_SAMPLE: Final = -1.0  # trajectory state of a row of a recorded track after its end
NO_TRACKS: Final = new_tracks(0)


class Rallies(NamedTuple):
    """The state of B rallies, one row each. The kernels write it in place. Arrays without rows are switched off."""

    ball: Array  # (B, 9) position [m], velocity [m/s], spin [rad/s]
    state: Integers  # (B,) states.State
    seed: npt.NDArray[np.uint64]  # (B,)
    parameters: Array  # (B, 16) randomization.RallyParameter
    clock: Integers  # (B,) grid steps since launch
    rounds_left: Integers  # (B,) rallies left in this episode, with the one in play
    landing_bonus_paid: Flags  # (B,) the bonus for the predicted landing point is paid once a rally
    ends_at_hit: Flags  # (B,) after the hit the flight is simulated to its landing at once, without the robot
    caught: Flags  # (B,) the racket has touched the ball legally
    over: Flags  # (B,) after that the ball has crossed the net
    landing: Array  # (B, 2) [m] where the ball landed; nan before a legal landing
    landing_error: Array  # (B,) [m] planar distance of the landing to the target
    # (B, RING + n, 7) first a ring of the true samples, newest at ``head``; then n rows of a recorded track, from the
    # launch on, which drives the ball until it is hit. They share one array for the reason given at ``camera_state``.
    true_sample_ring: Array
    head: Integers  # (B,)
    measurement: Array  # (B, 8) the robot's newest measurement of the ball, and its time stamp
    measurement_history: Array  # (B, history, 6) measurements of earlier control steps, newest first
    # (B, DETECTION_BUFFER + ESTIMATE) detections of the simulated camera and the camera filter's state, in one array:
    # with four separate arrays every step of every rally took twice as long, with and without a camera.
    camera_state: Array
    track: Array  # (B, TRACK) the flight filter's state
    hit: Array  # (B, HIT) the last legal contact; no rows: it is not kept
    last_action: Array  # (B, 7)


class RobotMotion(NamedTuple):
    """The robots' motion in one control step: MuJoCo's records of n substeps."""

    start_pos: Array  # (B, 7) joint positions before the step [m, rad]
    joint_pos: Array  # (B, n, 7)
    torque: Array  # (B, n, 7) actuator forces [N, Nm]
    contact: Array  # (B, n, bodies) touch sensors [N]
    step: float  # [s] MuJoCo's time step


class Rules(NamedTuple):
    """The constants of a step."""

    transitions: Integers  # states.transition_table()
    rewards: Array  # (10, 5) reward.reward_table()[stage - 1]
    landing_scale: float  # [m]
    landing_bonus: float  # weight of the bonus for the predicted landing point; 0 in stages 1 and 2
    landing_bonus_scale: float  # [m]
    rate_scale: float  # reference rate / control rate: scales what is paid by time (the jitter term is not)
    torque_weight: float
    torque_limit: Array  # (7,) [N, Nm]
    jitter_weight: float
    collision_weight: float
    grid_steps: int  # in a control step
    time_limit: float  # [s] of a rally
    flight_model: int  # ``flight.SIMPLE`` or ``flight.FULL``
    chain: Chain  # of the robot


class Step(NamedTuple):
    """The result of one control step, one row a rally. The kernels write it in place."""

    reward: Array  # (B,)
    terms: Array  # (B, 8) reward.TERMS
    outcome: Integers  # (B,) states.Outcome
    impulse: Array  # (B, 6) [N s, N m s] impulse of the ball on the racket, and its moment about the racket's centre


class FlightResult(NamedTuple):
    """Where a ball is after one control step, and what it touched."""

    pos: Vec
    vel: Vec
    spin: Vec
    state: int  # states.State
    outcome: int  # states.Outcome; 0: the rally continues
    bounced: bool  # tau_1 was reached
    hit: bool  # tau_2 was reached
    landed: bool  # tau_3 was reached
    racket_speed: float  # [m/s] v of the reward at the hit


def allocate(
    count: int,
    history: int = 0,
    has_camera: bool = False,
    tracks: Array = NO_TRACKS,
    keeps_hits: bool = False,
    path_rows: int = 0,
) -> tuple[Rallies, Step]:
    """Return zeroed rows for ``count`` rallies.

    Args:
        count: B.
        history: How many measurements of earlier control steps are kept.
        has_camera: Whether camera and camera filter measure the ball. Otherwise the measurement is the true state,
            late and noisy.
        tracks: ``flight_filter.new_tracks`` where the observation needs the flight filter.
        keeps_hits: Whether contacts are kept, for measures of the robot.
        path_rows: Samples of a recorded track that drives a ball until it is hit. 0: physics alone moves it.
    """
    rallies = Rallies(
        ball=np.zeros((count, 9)),
        state=np.zeros(count, np.int64),
        seed=np.zeros(count, np.uint64),
        parameters=np.zeros((count, RALLY_PARAMETERS)),
        clock=np.zeros(count, np.int64),
        rounds_left=np.ones(count, np.int64),
        landing_bonus_paid=np.zeros(count, np.bool_),
        ends_at_hit=np.zeros(count, np.bool_),
        caught=np.zeros(count, np.bool_),
        over=np.zeros(count, np.bool_),
        landing=np.full((count, 2), np.nan),
        landing_error=np.full(count, np.nan),
        true_sample_ring=np.zeros((count, RING + path_rows, SAMPLE)),
        head=np.zeros(count, np.int64),
        measurement=np.zeros((count, SAMPLE + 1)),
        measurement_history=np.zeros((count, history, 6)),
        camera_state=np.zeros((count if has_camera else 0, DETECTION_BUFFER + ESTIMATE)),
        track=tracks,
        hit=np.zeros((count if keeps_hits else 0, HIT)),
        last_action=np.zeros((count, 7)),
    )
    step = Step(
        np.zeros(count), np.zeros((count, len(TERMS))), np.zeros(count, np.int64), np.zeros((count, 6))
    )
    return rallies, step

"""Records of played rallies as plain values, so that drawing does not need the simulation.

The ball's positions are the environment's true samples on the 5 ms grid. Joints are known at the control steps;
between them a cubic interpolates their positions and velocities.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from common.env.rally_env import Launches, RallyEnv
from common.perception.camera import DETECTION, DETECTION_BUFFER, DETECTIONS, READ, detection_row
from common.perception.flight_track import INTERCEPTION, PRESENT, SPIN
from common.physics.constants import GRID_STEP
from common.rally.state import RING, SAMPLE
from common.task.config import TaskConfig
from common.task.experience import MATCH
from common.task.launch import RallyBlock
from common.task.randomization import RallyParameter
from common.task.states import Outcome

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]
Act = Callable[[npt.NDArray[np.float32]], npt.NDArray[np.float32]]

_TRACKED = slice(PRESENT, SPIN + 3)  # of the flight filter's row: its prediction, and then the spin
# Columns of ``RecordedRally.estimates``; the first one is the time
INTERCEPTION_IN = 1 + INTERCEPTION - PRESENT
INTERCEPTION_POS = slice(INTERCEPTION_IN + 1, INTERCEPTION_IN + 4)
SPIN_ESTIMATE = slice(1 + SPIN - PRESENT, 4 + SPIN - PRESENT)
ESTIMATE_SIZE = SPIN_ESTIMATE.stop

_ROUNDS = (
    2  # a rally of an episode's last round ends when the ball lands; in earlier rounds the ball flies on
)


@dataclass(frozen=True, slots=True)
class RecordedRally:
    """One rally, sampled on the 5 ms grid from its launch to its end: n samples."""

    seed: int
    outcome: Outcome
    target: Array  # (2,) [m]
    landing: Array  # (2,) [m] nan where nothing landed
    landing_error: float  # [m] nan where nothing landed
    time: Array  # (n,) [s] since launch
    joints: Array  # (n, 7) [m, rad]
    ball_pos: Array  # (n, 3) [m]
    ball_vel: Array  # (n, 3) [m/s]
    ball_spin: Array  # (n, 3) [rad/s]
    ball_turn: Array  # (n, 4) quaternion (w, x, y, z): the ball's turn since launch
    state: Integers  # (n,) 0 tau_01, 1 tau_12, 2 tau_23, 3 tau_30, 4 tau_s0
    # (m, 8) the robot's measurement after each control step: position, velocity, state, and their time [s]
    measurement: Array = field(default_factory=lambda: np.empty((0, SAMPLE + 1)))
    # (s, 5) the camera's detections that arrived: time, position, 1 if accepted; none in perception cheap
    detections: Array = field(default_factory=lambda: np.empty((0, DETECTION)))
    # (m, 17) after each control step: time since launch [s], the flight filter's ``observation.PREDICTION``, and its
    # estimate of the spin [rad/s]; no rows where the policy observes nothing of it
    estimates: Array = field(default_factory=lambda: np.empty((0, ESTIMATE_SIZE)))
    robot: str = "rails"


class _Dealer:
    """A source of rallies that calls ``before_dealing`` before the environment replaces ended rallies."""

    def __init__(self, rallies: RallyBlock) -> None:
        self._rallies = rallies
        self.before_dealing: Callable[[], None] = lambda: None

    def take(self, rows: Integers) -> Launches:
        """Return the first rallies, one for each of ``rows`` (n,); after the first call they are filler, unrecorded."""
        self.before_dealing()
        dealt = self._rallies.of(np.arange(rows.size))
        return Launches(dealt.launches, dealt.seeds, np.ones(rows.size, np.bool_), dealt.paths)


@dataclass(frozen=True, slots=True)
class _Moment:
    """All rows of the environment at the end of a control step."""

    clock: Integers  # (B,) [grid steps]
    true_sample_ring: Array  # (B, RING, 7)
    head: Integers  # (B,)
    spin: Array  # (B, 3)
    joint_pos: Array  # (B, 7)
    joint_vel: Array  # (B, 7)
    measurement: Array  # (B, 8)
    camera_state: Array  # (B, DETECTION_BUFFER + ESTIMATE), or no rows
    tracked: Array  # (B, ESTIMATE_SIZE - 1), or no rows


def record_rallies(
    act: Act, rallies: RallyBlock, task: TaskConfig, on_tick: Callable[[], None] = lambda: None
) -> list[RecordedRally]:
    """Return the records of ``rallies``, each played once by a robot that starts near home.

    Args:
        act: Actions (B, 7) for observations (B, D).
        rallies: The n rallies to play, in n environments.
        task: The task. A ball that has landed is recorded until its next touch.
        on_tick: Called after each control step.
    """
    count = len(rallies.seeds)
    dealer = _Dealer(rallies)
    longer = task.model_copy(update={"rounds": _ROUNDS})
    env = RallyEnv(count, longer, dealer, stage=3, experience=MATCH, path_rows=rallies.path_rows)
    obs = env.reset()
    targets = env.rallies.parameters[:, RallyParameter.TARGET_X : RallyParameter.TARGET_Y + 1].copy()
    moments = [_moment(env)]
    at_the_end: list[_Moment] = []
    dealer.before_dealing = lambda: at_the_end.append(_moment(env))
    found: dict[int, RecordedRally] = {}
    while len(found) < count:
        at_the_end.clear()
        step = env.step(act(obs))
        on_tick()
        obs = step.obs
        moments.append(at_the_end[0] if at_the_end else _moment(env))
        over = step.finished
        for k, row in enumerate(int(row) for row in over.rows):
            if row not in found:
                found[row] = _assembled(
                    moments,
                    row,
                    1.0 / task.control_rate_hz,
                    seed=int(over.seeds[k]),
                    outcome=Outcome(over.outcomes[k]),
                    target=targets[row],
                    landing=over.landings[k].astype(np.float64),
                    landing_error=float(over.landing_errors[k]),
                )
    return [replace(found[row], robot=task.robot) for row in range(count)]


def _moment(env: RallyEnv) -> _Moment:
    rallies, robot = env.rallies, env.robot
    return _Moment(
        rallies.clock.copy(),
        rallies.true_sample_ring.copy(),
        rallies.head.copy(),
        rallies.ball[:, 6:9].copy(),
        robot.joint_pos.copy(),
        robot.joint_vel[:, :7].copy(),
        rallies.measurement.copy(),
        rallies.camera_state.copy(),
        rallies.track[:, _TRACKED].copy(),
    )


def _assembled(
    moments: list[_Moment],
    row: int,
    period: float,
    *,
    seed: int,
    outcome: Outcome,
    target: Array,
    landing: Array,
    landing_error: float,
) -> RecordedRally:
    """Return row ``row``'s rally from the states at its control steps' ends; the last one is the rally's end."""
    samples, spins = [moments[0].true_sample_ring[row, moments[0].head[row]]], [moments[0].spin[row]]
    for before, after in pairwise(moments):
        began, ended = samples[-1][6], after.true_sample_ring[row, after.head[row], 6]
        for back in range(int(after.clock[row] - before.clock[row]) - 1, -1, -1):
            sample = after.true_sample_ring[row, (after.head[row] - back) % RING]
            samples.append(sample)
            # Spin changes at touches only, and a touch changes the state or ends the rally.
            has_touched = back == 0 or began != sample[6] == ended
            spins.append((after if has_touched else before).spin[row])
    ball, spin = np.array(samples), np.array(spins)
    time: Array = GRID_STEP * np.arange(len(ball), dtype=np.float64)
    joints = between_control_steps(
        np.array([m.joint_pos[row] for m in moments]),
        np.array([m.joint_vel[row] for m in moments]),
        period,
        time,
    )
    return RecordedRally(
        seed=seed,
        outcome=outcome,
        target=target,
        landing=landing,
        landing_error=landing_error,
        time=time,
        joints=joints,
        ball_pos=ball[:, :3],
        ball_vel=ball[:, 3:6],
        ball_spin=spin,
        ball_turn=turned(spin, GRID_STEP),
        state=ball[:, 6].astype(np.int64),
        measurement=np.array([moment.measurement[row] for moment in moments]),
        detections=_detections(moments, row),
        estimates=_estimates(moments, row, period),
    )


def _estimates(moments: list[_Moment], row: int, period: float) -> Array:
    """Return the flight filter's estimates of row ``row``'s ball, with their times."""
    found = [[k * period, *moment.tracked[row]] for k, moment in enumerate(moments) if len(moment.tracked)]
    return np.array(found).reshape(-1, ESTIMATE_SIZE)


def _detections(moments: list[_Moment], row: int) -> Array:
    """Return the detections (s, 5) of row ``row``'s ball that arrived, in order.

    The buffer holds the last 32 detections. Fewer arrive in a control step plus the latency. So a detection is still in
    the buffer after the step in which it arrives.
    """
    found: dict[int, Array] = {}
    for moment in moments:
        if len(moment.camera_state):
            buffer = moment.camera_state[row, :DETECTION_BUFFER]
            arrived = int(buffer[READ])
            for detection in range(max(0, arrived - DETECTIONS // 2), arrived):
                found[detection] = detection_row(buffer, detection).copy()
    return np.array([found[detection] for detection in sorted(found)]).reshape(-1, DETECTION)


def between_control_steps(pos: Array, vel: Array, period: float, time: Array) -> Array:
    """Return joint positions (n, 7) at ``time`` (n,) [s].

    Args:
        pos: Joint positions at the control steps' ends (m, 7), the first at time 0.
        vel: Joint velocities there (m, 7).
        period: Control period [s].
        time: Times [s], between 0 and the last control step's end.
    """
    k = np.minimum((time / period + 1e-9).astype(np.int64), len(pos) - 2)
    s = (time / period - k)[:, None]
    rise = s * s * (3.0 - 2.0 * s)
    start, end = s * (1.0 - s) ** 2, s * s * (s - 1.0)
    joints: Array = (1.0 - rise) * pos[k] + rise * pos[k + 1] + period * (start * vel[k] + end * vel[k + 1])
    return joints


def turned(spin: Array, step: float) -> Array:
    """Return quaternions (n, 4) of a ball that turns with ``spin`` (n, 3) [rad/s], ``step`` [s] for each row."""
    turn = np.empty((len(spin), 4))
    turn[0] = 1.0, 0.0, 0.0, 0.0
    for k in range(1, len(spin)):
        half = 0.5 * step * spin[k]
        angle = float(np.linalg.norm(half))
        w, v = np.cos(angle), half * np.sinc(angle / np.pi)
        a, b = turn[k - 1, 0], turn[k - 1, 1:]
        turn[k, 0] = w * a - v @ b
        turn[k, 1:] = w * b + a * v + np.cross(v, b)
    return turn

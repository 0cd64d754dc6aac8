"""Rallies as they were played, as plain values: so that drawing them is a matter of its own.

The ball's positions are the environment's true samples on the 5 ms grid. Joints are known at the control steps;
in between they follow the cubic that has their positions and velocities.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from common.env.rally_env import EnvConfig, Launches, RallyEnv
from common.physics.constants import GRID_STEP
from common.rally.camera import FILM, READ, SHOT, SHOTS, shot_row
from common.rally.launch import RallyBlock
from common.rally.noise import Condition
from common.rally.play import RING, SAMPLE
from common.rally.trajectory import Outcome

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]
Act = Callable[[npt.NDArray[np.float32]], npt.NDArray[np.float32]]

_PLAYED_ON = 2  # rounds: a rally of an episode's last round ends as the ball lands; before, the ball flies on


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
    ball_turn: Array  # (n, 4) quaternion (w, x, y, z): how far its spin has turned the ball since launch
    state: Integers  # (n,) 0 tau_01, 1 tau_12, 2 tau_23, 3 tau_30
    # (m, 8) what the robot went by after each control step: position, velocity, state, and when it was so [s]
    seen: Array = field(default_factory=lambda: np.empty((0, SAMPLE + 1)))
    # (s, 5) the simulated camera's shots that arrived: when, position, 1 if believed; none if perception is cheap
    shots: Array = field(default_factory=lambda: np.empty((0, SHOT)))


class _Dealer:
    """A source of rallies that looks at the environment before ended rallies are replaced by what it deals."""

    def __init__(self, rallies: RallyBlock) -> None:
        self._rallies = rallies
        self.before_dealing: Callable[[], None] = lambda: None

    def take(self, count: int) -> Launches:
        """Return the first ``count`` rallies; after the first call they are filler that nobody looks at."""
        self.before_dealing()
        dealt = self._rallies.of(np.arange(count))
        return Launches(dealt.launches, dealt.seeds, np.ones(count, np.bool_), dealt.paths)


@dataclass(frozen=True, slots=True)
class _Moment:
    """All rows of the environment at the end of a control step."""

    clock: Integers  # (B,) [grid steps]
    camera: Array  # (B, RING, 7)
    head: Integers  # (B,)
    spin: Array  # (B, 3)
    joint_pos: Array  # (B, 7)
    joint_vel: Array  # (B, 7)
    seen: Array  # (B, 8)
    eyes: Array  # (B, FILM + ESTIMATE), or no rows


def record(act: Act, rallies: RallyBlock, config: EnvConfig) -> list[RecordedRally]:
    """Return what a policy makes of ``rallies``, each played once by a robot that starts near home.

    Args:
        act: Actions (B, 7) for observations (B, D).
        rallies: What is played: n of them, in n environments.
        config: The task. A ball that landed is followed until it touches something again.
    """
    count = len(rallies.seeds)
    dealer = _Dealer(rallies)
    played = config.model_copy(update={"go_on": 0.0, "foresee": 0.0, "rounds": _PLAYED_ON})
    env = RallyEnv(count, played, dealer, stage=3, path_rows=rallies.path_rows)
    obs = env.reset()
    targets = env.rallies.condition[:, Condition.TARGET_X : Condition.TARGET_Y + 1].copy()
    moments = [_moment(env)]
    at_the_end: list[_Moment] = []
    dealer.before_dealing = lambda: at_the_end.append(_moment(env))
    found: dict[int, RecordedRally] = {}
    while len(found) < count:
        at_the_end.clear()
        step = env.step(act(obs))
        obs = step.obs
        moments.append(at_the_end[0] if at_the_end else _moment(env))
        over = step.finished
        for k, row in enumerate(int(row) for row in over.rows):
            if row not in found:
                found[row] = _assembled(
                    moments,
                    row,
                    1.0 / config.control_rate_hz,
                    seed=int(over.seeds[k]),
                    outcome=Outcome(over.outcomes[k]),
                    target=targets[row],
                    landing=over.landings[k].astype(np.float64),
                    landing_error=float(over.landing_errors[k]),
                )
    return [found[row] for row in range(count)]


def _moment(env: RallyEnv) -> _Moment:
    rallies, robot = env.rallies, env.robot
    return _Moment(
        rallies.clock.copy(),
        rallies.camera.copy(),
        rallies.head.copy(),
        rallies.ball[:, 6:9].copy(),
        robot.joint_pos.copy(),
        robot.joint_vel[:, :7].copy(),
        rallies.seen.copy(),
        rallies.eyes.copy(),
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
    """Return row ``row``'s rally from the ends of its control steps, the last one its own end."""
    samples, spins = [moments[0].camera[row, moments[0].head[row]]], [moments[0].spin[row]]
    for before, after in pairwise(moments):
        began, ended = samples[-1][6], after.camera[row, after.head[row], 6]
        for back in range(int(after.clock[row] - before.clock[row]) - 1, -1, -1):
            sample = after.camera[row, (after.head[row] - back) % RING]
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
        seen=np.array([moment.seen[row] for moment in moments]),
        shots=_shots(moments, row),
    )


def _shots(moments: list[_Moment], row: int) -> Array:
    """Return the shots (s, 5) of row ``row``'s ball that arrived, in order.

    A film keeps the last 32, which are more than a control step takes and latency holds back, so that every shot is
    there after the step in which it arrives.
    """
    found: dict[int, Array] = {}
    for moment in moments:
        if len(moment.eyes):
            film = moment.eyes[row, :FILM]
            arrived = int(film[READ])
            for shot in range(max(0, arrived - SHOTS // 2), arrived):
                found[shot] = shot_row(film, shot).copy()
    return np.array([found[shot] for shot in sorted(found)]).reshape(-1, SHOT)


def between_control_steps(pos: Array, vel: Array, period: float, time: Array) -> Array:
    """Return joint positions (n, 7) at ``time`` (n,) [s].

    Args:
        pos: Joint positions at the control steps' ends (m, 7), the first at time 0.
        vel: Joint velocities there (m, 7).
        period: Control period [s].
        time: When; between 0 and the last control step's end.
    """
    k = np.minimum((time / period + 1e-9).astype(np.int64), len(pos) - 2)
    s = (time / period - k)[:, None]
    rise = s * s * (3.0 - 2.0 * s)
    start, end = s * (1.0 - s) ** 2, s * s * (s - 1.0)
    joints: Array = (1.0 - rise) * pos[k] + rise * pos[k + 1] + period * (start * vel[k] + end * vel[k + 1])
    return joints


def turned(spin: Array, step: float) -> Array:
    """Return quaternions (n, 4) of a ball that turns by ``spin`` (n, 3) [rad/s], ``step`` [s] each, from no turn."""
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

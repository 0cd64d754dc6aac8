"""A recorded rally at any time, as pure functions: film and stills need no simulation."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from common.evaluation.rally_recorder import RecordedRally
from common.physics.constants import GRID_STEP

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

_JUMP: Final = (
    0.6  # [m/s] in one grid step: twice what drag does to the fastest ball, a tenth of a gentle touch
)
_NO_SPIN: Final = 5.0  # [rad/s] less than one turn per second


@dataclass(frozen=True, slots=True)
class BallPath:
    """A ball's path as a polyline: grid samples, and the touches between them, where it bends."""

    time: Array  # (m,) [s]
    pos: Array  # (m, 3) [m]
    state: Integers  # (m,) 0..3: of the segment that ends here


@dataclass(frozen=True, slots=True)
class Moment:
    """Everything that is drawn, at one time."""

    joints: Array  # (7,) [m, rad]
    ball_pos: Array  # (3,) [m]
    ball_turn: Array  # (4,) quaternion (w, x, y, z)
    ball_spin: Array  # (3,) [rad/s]
    target: Array  # (2,) [m]
    trail: BallPath | None = None  # the ball's path until now
    landing: Array | None = None  # (2,) [m] where it landed
    ghosts: tuple[Array, ...] = ()  # the robot at other times, joints (7,) each


def path_of(rally: RecordedRally) -> BallPath:
    """Return the ball's path with its touches: each is where the flights before and after it intersect."""
    time, pos, state = [rally.time[0]], [rally.ball_pos[0]], [rally.state[0]]
    for k in range(1, len(rally.time)):
        before, after = rally.ball_vel[k - 1], rally.ball_vel[k]
        change = before - after
        if float(np.linalg.norm(change)) > _JUMP:
            gap = rally.ball_pos[k - 1] - rally.ball_pos[k] + after * GRID_STEP
            ahead = float(np.clip(-(gap @ change) / (change @ change), 0.0, GRID_STEP))
            time.append(rally.time[k - 1] + ahead)
            pos.append(rally.ball_pos[k - 1] + ahead * before)
            state.append(rally.state[k - 1])
        time.append(rally.time[k])
        pos.append(rally.ball_pos[k])
        state.append(rally.state[k])
    return BallPath(np.array(time), np.array(pos), np.array(state))


def position_at(path: BallPath, time: float) -> Array:
    """Return the ball's position (3,) [m]; before its launch and after its end it is constant."""
    return np.array([np.interp(time, path.time, path.pos[:, axis]) for axis in range(3)])


def path_until(path: BallPath, time: float) -> BallPath:
    """Return the ball's path until ``time`` [s], its last point there."""
    count = max(int(np.searchsorted(path.time, time + 1e-9, side="right")), 1)
    if count == len(path.time) or time - path.time[count - 1] < 1e-9:
        return BallPath(path.time[:count], path.pos[:count], path.state[:count])
    return BallPath(
        np.append(path.time[:count], time),
        np.vstack((path.pos[:count], position_at(path, time))),
        np.append(path.state[:count], path.state[count]),
    )


def moment_at(rally: RecordedRally, path: BallPath, time: float) -> Moment:
    """Return the rally at ``time`` [s] since launch; after its end nothing moves."""
    time = float(np.clip(time, 0.0, rally.time[-1]))
    k = min(int(time / GRID_STEP + 1e-6), len(rally.time) - 1)
    after = min(k + 1, len(rally.time) - 1)
    share = time / GRID_STEP - k
    turn = (1.0 - share) * rally.ball_turn[k] + share * rally.ball_turn[after]
    return Moment(
        joints=(1.0 - share) * rally.joints[k] + share * rally.joints[after],
        ball_pos=position_at(path, time),
        ball_turn=turn / np.linalg.norm(turn),
        ball_spin=rally.ball_spin[k],
        target=rally.target,
        trail=path_until(path, time),
        landing=rally.landing if rally.state[k] == 3 else None,
    )


def spin_word(vel: Array, spin: Array) -> str:
    """Return the largest part of a spin [rad/s] of a ball that flies with ``vel`` [m/s]: topspin, sidespin ..."""
    if float(np.linalg.norm(spin)) < _NO_SPIN or float(np.linalg.norm(vel)) < 1e-6:
        return "no spin"
    forward = vel / np.linalg.norm(vel)
    across = np.cross([0.0, 0.0, 1.0], forward)
    length = float(np.linalg.norm(across))
    across = across / length if length > 1e-6 else np.zeros(3)
    top, drill = float(spin @ across), abs(float(spin @ forward))
    side = abs(float(spin @ np.cross(forward, across)))
    if abs(top) >= max(side, drill):
        return "topspin" if top > 0.0 else "backspin"
    return "sidespin" if side >= drill else "corkscrew"

"""What the page shows of a ball at one time: a function of the recorded rally."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from common.evaluation.rally_recorder import (
    INTERCEPTION_IN,
    INTERCEPTION_POS,
    SPIN_ESTIMATE,
    RecordedRally,
)
from common.physics.constants import BALL_RADIUS
from topspin.render.replay import BallPath, moment_at
from topspin.render.scene import corners_of

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

ESTIMATE_RGB: Final = (0.25, 0.95, 0.80)  # what the robot believes
_LENGTH: Final = (
    0.09,
    0.0012,
)  # length of a spin's arrow before the ball: [m], and per rate of spin [m s/rad]
_LEAST_SPIN: Final = 1.0  # [rad/s] slower spin has no arrow
_COMING: Final = (0, 1, 4)  # trajectory states before the hit


@dataclass(frozen=True, slots=True)
class Picture:
    """Everything that moves on the page."""

    joints: Array  # (7,) [m, rad]
    ball_pos: Array  # (3,) [m]
    ball_turn: Array  # (4,) quaternion (w, x, y, z)
    target: Array  # (2,) [m]
    trail: Array  # (n, 2, 3) [m] ends of its segments
    trail_states: Integers  # (n,) trajectory state of each
    landing: Array | None  # (2,) [m]
    spin: Array | None  # (2, 3) [m] ends of the arrow of the true spin
    spin_estimate: Array | None  # (2, 3) [m] of the robot's estimate
    prediction: Array | None  # (3,) [m] where the robot expects the ball at the interception


@dataclass(frozen=True, slots=True)
class Estimate:
    """What the robot believes of the ball, after one control step."""

    interception_in: float  # [s]
    interception_pos: Array  # (3,) [m]
    spin: Array  # (3,) [rad/s] after the bounce


def estimate_at(rally: RecordedRally, time: float) -> Estimate | None:
    """Return the flight filter's newest estimate at ``time`` [s]; None after the hit, and where the policy has none."""
    if not len(rally.estimates):
        return None
    row = rally.estimates[max(int(np.searchsorted(rally.estimates[:, 0], time + 1e-9)) - 1, 0)]
    grid = max(int(np.searchsorted(rally.time, time + 1e-9)) - 1, 0)
    if rally.state[grid] not in _COMING or not row[INTERCEPTION_POS].any():
        return None
    return Estimate(float(row[INTERCEPTION_IN]), row[INTERCEPTION_POS], row[SPIN_ESTIMATE])


def picture_at(rally: RecordedRally, path: BallPath, time: float, before: Array, approach: float) -> Picture:
    """Return the picture at ``time`` [s] since launch.

    Args:
        rally: The ball's recording.
        path: ``path_of(rally)``.
        time: Negative before the launch.
        before: (7,) joint positions at the end of the last show.
        approach: Share of the way from there to the start position that the robot has made.
    """
    moment = moment_at(rally, path, time)
    believed = estimate_at(rally, time)
    assert moment.trail is not None
    corners = corners_of(moment.trail)
    points = moment.trail.pos[corners]
    return Picture(
        joints=before + approach * (moment.joints - before),
        ball_pos=moment.ball_pos,
        ball_turn=moment.ball_turn,
        target=moment.target,
        trail=np.stack((points[:-1], points[1:]), axis=1),
        trail_states=moment.trail.state[corners[1:]],
        landing=moment.landing,
        spin=spin_arrow(moment.ball_pos, moment.ball_spin),
        spin_estimate=None if believed is None else spin_arrow(moment.ball_pos, believed.spin),
        prediction=believed.interception_pos
        if believed is not None and believed.interception_in > 0.0
        else None,
    )


def spin_arrow(pos: Array, spin: Array) -> Array | None:
    """Return the ends (2, 3) of the spin's arrow, along its axis by the right-hand rule; None for (nearly) no spin."""
    rate = float(np.linalg.norm(spin))
    if rate < _LEAST_SPIN:
        return None
    length = BALL_RADIUS + _LENGTH[0] + _LENGTH[1] * rate
    along = length / rate * spin
    return np.stack((pos - 0.4 * along, pos + along))


def rgb8(colour: tuple[float, float, float]) -> tuple[int, int, int]:
    """Return a colour in [0, 1] as bytes."""
    red, green, blue = (round(255 * part) for part in colour)
    return red, green, blue

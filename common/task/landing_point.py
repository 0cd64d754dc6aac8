"""Where a ball that was hit will land: for the landing bonus of stage 3."""

import math
from typing import Final

from common.jit import kernel
from common.physics.constants import BALL_RADIUS, GRID_STEP, NET_HEIGHT
from common.physics.flight import Air, flight_step
from common.physics.vec import Vec

LONGEST_RETURN: Final = 3.0  # [s] longest time from the hit until the ball is on the floor
SHORT_OF_NET: Final = -1.0  # [m] clearance of the net for a ball that comes down before it


@kernel
def _over_net(before: Vec, pos: Vec) -> float:
    """Return the clearance of the net at x = 0 of a ball on the line from ``before`` to ``pos`` [m]."""
    share = -before[0] / (pos[0] - before[0])
    return before[2] + share * (pos[2] - before[2]) - NET_HEIGHT - BALL_RADIUS


@kernel
def landing_point(pos: Vec, vel: Vec, spin: Vec, air: Air) -> tuple[float, float, float]:
    """Return where a ball comes down to the table's height. Nothing stops it: net and table are ignored.

    Args:
        pos: Position right after the hit [m].
        vel: Velocity [m/s].
        spin: Spin [rad/s].
        air: Of the rally.

    Returns:
        x and y there [m], and the clearance of the net [m]; ``SHORT_OF_NET`` if the ball comes down before the net.
    """
    over_net = SHORT_OF_NET
    for _ in range(math.ceil(LONGEST_RETURN / GRID_STEP)):
        before = pos
        pos, vel = flight_step(pos, vel, spin, GRID_STEP, air)
        if before[0] < 0.0 <= pos[0]:
            over_net = _over_net(before, pos)
        if pos[2] < BALL_RADIUS and vel[2] < 0.0:
            if before[2] <= BALL_RADIUS:
                break  # it was hit below the table's height and stays there
            share = (before[2] - BALL_RADIUS) / (before[2] - pos[2])
            x, y = before[0] + share * (pos[0] - before[0]), before[1] + share * (pos[1] - before[1])
            return x, y, over_net
    return pos[0], pos[1], over_net

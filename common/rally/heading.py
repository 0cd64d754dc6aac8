"""Where a ball that was hit is heading: what stage 3's bonus pays for, right after the contact."""

import math

from common.jit import kernel
from common.physics.arm import Array
from common.physics.constants import BALL_RADIUS, GRID_STEP, NET_HEIGHT
from common.physics.flight import flight_step
from common.physics.vec import Vec

LONGEST_RETURN = 3.0  # [s] of a ball that was hit, to the floor at the latest
NOT_THAT_FAR = -1.0  # [m] height over the net of a ball that comes down before it


@kernel
def heading(pos: Vec, vel: Vec, spin: Vec, condition: Array, model: int) -> tuple[float, float, float]:
    """Return where a ball would come down to the table's height, were nothing in its way.

    Args:
        pos: Position [m] right after the hit.
        vel: Velocity [m/s].
        spin: Spin [rad/s].
        condition: The rally's ``noise.Condition`` (14,).
        model: ``flight.SIMPLE`` or ``flight.FULL``.

    Returns:
        x and y there [m], and by how much the ball clears the net on its way [m]; -1 if it doesn't come that far.
    """
    over_net = NOT_THAT_FAR
    for _ in range(math.ceil(LONGEST_RETURN / GRID_STEP)):
        before = pos
        pos, vel = flight_step(pos, vel, spin, GRID_STEP, condition[0], condition[1], model)
        if before[0] < 0.0 <= pos[0]:
            share = -before[0] / (pos[0] - before[0])
            over_net = before[2] + share * (pos[2] - before[2]) - NET_HEIGHT - BALL_RADIUS
        if pos[2] < BALL_RADIUS and vel[2] < 0.0:
            if before[2] <= BALL_RADIUS:
                break  # hit below the table's height, and never above it
            share = (before[2] - BALL_RADIUS) / (before[2] - pos[2])
            x, y = before[0] + share * (pos[0] - before[0]), before[1] + share * (pos[1] - before[1])
            return x, y, over_net
    return pos[0], pos[1], over_net

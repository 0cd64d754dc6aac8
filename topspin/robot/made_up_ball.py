"""A ball that comes, bounces and passes: what the controller is warmed up and timed with."""

from collections.abc import Iterator
from typing import Final

GRAVITY: Final = 9.81  # [m/s^2]
RESTITUTION: Final = 0.9
RATE_HZ: Final = 180.0  # of the camera


def detections(seconds: float) -> Iterator[tuple[float, tuple[float, float, float]]]:
    """Yield time stamps [s] from 0 and positions [m] in the world frame, without noise, air or spin."""
    x, y, z, rise = 1.3, 0.1, 0.3, 1.0
    step = 1.0 / RATE_HZ
    for k in range(int(seconds * RATE_HZ)):
        yield k * step, (x, y, z)
        x, rise = x - 6.0 * step, rise - GRAVITY * step
        z += rise * step
        if z < 0.02 and rise < 0.0 and abs(x) < 1.37:
            rise = -RESTITUTION * rise

"""The simulated camera of ``perception: full``: irregular, noisy, lossy shots of the ball that arrive late.

A shot's moment, noise, loss and gross error are functions of the rally's seed and the shot's index. The ball is
shot in flight, between touches: whoever moves it hands over each piece of its path that nothing interrupts.
"""

from typing import Final

import numpy as np
import numpy.typing as npt

from common.jit import kernel
from common.physics.fly import path_at
from common.physics.vec import Vec
from common.rally.draws import Stream, between, normal_pair, uniform
from common.rally.noise import NoiseProfile

Array = npt.NDArray[np.float64]

MAX_RATE_HZ: Final = (
    200.0  # [Hz] with SHOTS: the latest 40 ms of latency and of a control step fit, twice over
)
SHOTS: Final = 32  # shots kept, newest over oldest
SHOT: Final = (
    5  # numbers in a shot: time stamp [s since launch], position [m], 1 if the estimator believed it
)

# A ball's film is one row of numbers: index of the next shot, shots kept so far, shots of these that have arrived,
# when the next will be taken [s since launch], and the shots
NEXT, TAKEN, READ, DUE, FIRST_SHOT = 0, 1, 2, 3, 4
FILM: Final = FIRST_SHOT + SHOTS * SHOT  # numbers in a row

# A shot's moment keeps to its own share of the period, so that shots never change places
_MOST_JITTER: Final = 0.45  # [period]
_SHOT, _OUTLIER = int(Stream.SHOT), int(Stream.OUTLIER)


@kernel
def shot_moment(seed: int, shot: int, noise: NoiseProfile) -> float:
    """Return when a shot is taken [s since launch]."""
    period = 1.0 / noise.camera_rate_hz
    jitter = noise.camera_jitter * normal_pair(seed, _SHOT, 4 * shot)[0]
    return shot * period + min(max(jitter, -_MOST_JITTER * period), _MOST_JITTER * period)


@kernel
def shot_position(seed: int, shot: int, pos: Vec, noise: NoiseProfile) -> Vec:
    """Return where a shot shows a ball that is at ``pos`` [m]."""
    a0, a1 = normal_pair(seed, _SHOT, 4 * shot + 1)
    a2, _ = normal_pair(seed, _SHOT, 4 * shot + 2)
    sigma = noise.camera_noise
    seen = (pos[0] + sigma * a0, pos[1] + sigma * a1, pos[2] + sigma * a2)
    if uniform(seed, _OUTLIER, 4 * shot) < noise.outlier_share:
        size = noise.outlier_size
        return (
            seen[0] + between(-size, size, seed, _OUTLIER, 4 * shot + 1),
            seen[1] + between(-size, size, seed, _OUTLIER, 4 * shot + 2),
            seen[2] + between(-size, size, seed, _OUTLIER, 4 * shot + 3),
        )
    return seen


@kernel
def shot_row(film: Array, shot: int) -> Array:
    """Return the numbers (5,) of the ``shot``-th that was kept, as a view; only the last 32 are still there."""
    first = FIRST_SHOT + SHOT * (shot % SHOTS)
    return film[first : first + SHOT]


@kernel
def begin_film(film: Array, seed: int, pos: Vec, noise: NoiseProfile) -> None:
    """Take the shot that a rally begins with: the ball is in view as it is launched, and no shot of it is lost.

    Args:
        film: Of one ball (FILM,); written.
        seed: The rally's.
        pos: Of the launch [m].
        noise: Profile.
    """
    film[NEXT], film[TAKEN], film[READ] = 1.0, 1.0, 0.0
    film[DUE] = shot_moment(seed, 1, noise)
    seen, row = shot_position(seed, 0, pos, noise), shot_row(film, 0)
    row[0], row[1], row[2], row[3], row[4] = 0.0, seen[0], seen[1], seen[2], 0.0


@kernel
def film_flight(
    film: Array,
    seed: int,
    condition: Array,
    noise: NoiseProfile,
    start: float,
    p0: Vec,
    v0: Vec,
    h: float,
    p1: Vec,
    v1: Vec,
) -> None:
    """Take the shots that fall into a piece of flight without touches.

    Args:
        film: Of one ball (FILM,); written.
        seed: The rally's.
        condition: ``noise.Condition`` of the rally (14,).
        noise: Profile.
        start: Of the piece [s since launch].
        p0: Position then [m].
        v0: Velocity then [m/s].
        h: The piece's duration [s], at most a grid step: the path is its cubic.
        p1: Position at its end.
        v1: Velocity at its end, before any bounce.
    """
    while film[DUE] <= start + h:
        moment, shot = film[DUE], int(film[NEXT])
        film[NEXT] += 1.0
        film[DUE] = shot_moment(seed, shot + 1, noise)
        in_burst = condition[12] <= moment < condition[13]
        if in_burst or uniform(seed, _SHOT, 8 * shot + 6) < noise.loss:
            continue
        pos = p0
        if h > 0.0:
            pos = path_at(p0, v0, p1, v1, h, max(moment - start, 0.0))
        seen = shot_position(seed, shot, pos, noise)
        row = shot_row(film, int(film[TAKEN]))
        row[0], row[1], row[2], row[3], row[4] = moment, seen[0], seen[1], seen[2], 0.0
        film[TAKEN] += 1.0

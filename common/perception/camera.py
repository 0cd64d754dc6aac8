"""The simulated camera of ``perception: full``: irregular, noisy, lossy detections of the ball that arrive late.

Time, noise, loss and gross error of a detection are functions of the rally's seed and the detection's index
(ADR-0002). The camera detects the ball in flight, between touches: the flight gives it each piece of the path that
has no touch.
"""

from typing import Final

import numpy as np
import numpy.typing as npt

from common.jit import kernel
from common.physics.fly import Segment, path_at
from common.physics.vec import Vec
from common.task.counter_rng import Stream, between, normal_pair, uniform
from common.task.randomization import RallyParameter, RandomizationProfile

Array = npt.NDArray[np.float64]

# [Hz] at this rate DETECTIONS cover twice the longest latency and control step (40 ms each)
MAX_RATE_HZ: Final = 200.0
DETECTIONS: Final = 32  # detections kept; the newest replaces the oldest
# Numbers in a detection: time stamp [s since launch], position [m] (3), 1 if the camera filter accepted it
DETECTION: Final = 5

# A ball's detection buffer is one row: index of the next detection, number of detections kept so far, number of those
# that have arrived, time of the next one [s since launch], and the detections
NEXT, TAKEN, READ, DUE, FIRST_DETECTION = 0, 1, 2, 3, 4
DETECTION_BUFFER: Final = FIRST_DETECTION + DETECTIONS * DETECTION  # numbers in a row

# Jitter is less than half a period, so detections keep their order
_MAX_JITTER: Final = 0.45  # [period]
_DETECTION, _OUTLIER = int(Stream.DETECTION), int(Stream.OUTLIER)


@kernel
def detection_time(seed: int, detection: int, profile: RandomizationProfile) -> float:
    """Return the time of a detection [s since launch]."""
    period = 1.0 / profile.camera_rate_hz
    jitter = profile.camera_jitter * normal_pair(seed, _DETECTION, 4 * detection)[0]
    return detection * period + min(max(jitter, -_MAX_JITTER * period), _MAX_JITTER * period)


@kernel
def detection_position(seed: int, detection: int, pos: Vec, profile: RandomizationProfile) -> Vec:
    """Return the detected position [m] of a ball at ``pos`` [m]."""
    a0, a1 = normal_pair(seed, _DETECTION, 4 * detection + 1)
    a2, _ = normal_pair(seed, _DETECTION, 4 * detection + 2)
    sigma = profile.camera_noise
    noisy = (pos[0] + sigma * a0, pos[1] + sigma * a1, pos[2] + sigma * a2)
    if uniform(seed, _OUTLIER, 4 * detection) < profile.outlier_share:
        size = profile.outlier_size
        return (
            noisy[0] + between(-size, size, seed, _OUTLIER, 4 * detection + 1),
            noisy[1] + between(-size, size, seed, _OUTLIER, 4 * detection + 2),
            noisy[2] + between(-size, size, seed, _OUTLIER, 4 * detection + 3),
        )
    return noisy


@kernel
def detection_row(buffer: Array, detection: int) -> Array:
    """Return the ``detection``-th kept detection (DETECTION,) as a view. Only the last ``DETECTIONS`` exist."""
    first = FIRST_DETECTION + DETECTION * (detection % DETECTIONS)
    return buffer[first : first + DETECTION]


@kernel
def begin_detections(buffer: Array, seed: int, pos: Vec, profile: RandomizationProfile) -> None:
    """Record a rally's first detection. The ball is in view at the launch, and this detection is never lost.

    Args:
        buffer: Of one ball (DETECTION_BUFFER,); written.
        seed: Of the rally.
        pos: Position of the launch [m].
        profile: Noise and rate.
    """
    buffer[NEXT], buffer[TAKEN], buffer[READ] = 1.0, 1.0, 0.0
    buffer[DUE] = detection_time(seed, 1, profile)
    detected, row = detection_position(seed, 0, pos, profile), detection_row(buffer, 0)
    row[0], row[1], row[2], row[3], row[4] = 0.0, detected[0], detected[1], detected[2], 0.0


@kernel
def detect_along_flight(
    buffer: Array, seed: int, parameters: Array, profile: RandomizationProfile, start: float, segment: Segment
) -> None:
    """Detect the ball at every detection time within a piece of flight without touches.

    Args:
        buffer: Of one ball (DETECTION_BUFFER,); written.
        seed: Of the rally.
        parameters: ``randomization.RallyParameter`` of the rally (RALLY_PARAMETERS,).
        profile: Noise, rate and losses.
        start: Start of the segment [s since launch].
        segment: The piece of flight; at most a grid step long.
    """
    burst_start, burst_end = parameters[RallyParameter.BURST_START], parameters[RallyParameter.BURST_END]
    while buffer[DUE] <= start + segment.h:
        stamp, detection = buffer[DUE], int(buffer[NEXT])
        buffer[NEXT] += 1.0
        buffer[DUE] = detection_time(seed, detection + 1, profile)
        in_burst = burst_start <= stamp < burst_end
        if in_burst or uniform(seed, _DETECTION, 8 * detection + 6) < profile.loss:
            continue
        pos = segment.p0
        if segment.h > 0.0:
            pos = path_at(segment, max(stamp - start, 0.0))
        detected = detection_position(seed, detection, pos, profile)
        row = detection_row(buffer, int(buffer[TAKEN]))
        row[0], row[1], row[2], row[3], row[4] = stamp, detected[0], detected[1], detected[2], 0.0
        buffer[TAKEN] += 1.0

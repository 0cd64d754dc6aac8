"""What the robot measures of the ball: the true state, late and noisy, or the estimate from a simulated camera."""

from typing import Final

import numpy as np
import numpy.typing as npt

from common.jit import inlined, kernel
from common.perception.camera import DETECTION_BUFFER, READ, TAKEN, detect_along_flight, detection_row
from common.perception.camera_filter import add_detection, begin_filter, estimate_at, is_guess
from common.perception.flight_filter import add_measurement, begin_track, predict_interception
from common.perception.flight_track import COMING, IS_SERVED, PRESENT, SERVED
from common.physics.constants import GRID_STEP
from common.physics.fly import Segment
from common.physics.vec import Vec
from common.rally.state import RING, STAMP, Rallies
from common.task.counter_rng import Stream, normal_pair, uniform
from common.task.launch_presets import SERVE
from common.task.randomization import RallyParameter, RandomizationProfile

Array = npt.NDArray[np.float64]

_CAMERA: Final = int(Stream.CAMERA)


@inlined
def sample_measurement(rallies: Rallies, b: int, step: int, profile: RandomizationProfile) -> None:
    """Measure ball b's true state one latency ago, with noise. If the sample is lost, the last measurement stays."""
    seed = rallies.seed[b]
    now = rallies.clock[b] * GRID_STEP
    parameters = rallies.parameters[b]
    in_burst = parameters[RallyParameter.BURST_START] <= now < parameters[RallyParameter.BURST_END]
    if step > 0 and (in_burst or uniform(seed, _CAMERA, 8 * step) < profile.loss):
        return
    latency = parameters[RallyParameter.LATENCY]
    row = (rallies.head[b] + RING - int(latency)) % RING
    measurement = rallies.measurement[b]
    measurement[STAMP] = max(now - latency * GRID_STEP, 0.0)
    sample = rallies.true_sample_ring[b, row]
    if profile.position_noise == 0.0 and profile.velocity_noise == 0.0:
        for k in range(6):
            measurement[k] = sample[k]
    else:
        a0, a1 = normal_pair(seed, _CAMERA, 4 * step + 1)
        a2, a3 = normal_pair(seed, _CAMERA, 4 * step + 2)
        a4, a5 = normal_pair(seed, _CAMERA, 4 * step + 3)
        measurement[0] = sample[0] + profile.position_noise * a0
        measurement[1] = sample[1] + profile.position_noise * a1
        measurement[2] = sample[2] + profile.position_noise * a2
        measurement[3] = sample[3] + profile.velocity_noise * a3
        measurement[4] = sample[4] + profile.velocity_noise * a4
        measurement[5] = sample[5] + profile.velocity_noise * a5
    measurement[6] = sample[6]


@kernel
def filter_measurement(rallies: Rallies, b: int, profile: RandomizationProfile) -> None:
    """Pass ball b's new detections to the camera filter, and take its estimate of one latency ago as the measurement.

    That latency is the mean over all rallies, which a policy expects under either perception (ADR-0020). The camera's
    latency in this rally is known, because the camera stamps its detections.
    """
    now = rallies.clock[b] * GRID_STEP
    latency = rallies.parameters[b, RallyParameter.LATENCY] * GRID_STEP
    buffer, row = rallies.camera_state[b, :DETECTION_BUFFER], rallies.camera_state[b, DETECTION_BUFFER:]
    while buffer[READ] < buffer[TAKEN]:
        detection = detection_row(buffer, int(buffer[READ]))
        pos = (detection[1], detection[2], detection[3])
        if buffer[READ] == 0.0:  # the camera detects the launch itself
            is_serve = rallies.parameters[b, RallyParameter.KIND] == SERVE
            begin_filter(row, detection[0], pos, profile.camera_noise, SERVED if is_serve else COMING)
            detection[4] = 1.0
        elif detection[0] + latency > now + 1e-9:
            break
        elif add_detection(row, detection[0], pos, profile.camera_noise):
            detection[4] = 1.0
        buffer[READ] += 1.0
    usual = 0.5 * (profile.observation_latency[0] + profile.observation_latency[1])
    measurement = rallies.measurement[b]
    measurement[STAMP] = max(now - usual, 0.0)
    pos, vel, state = estimate_at(row, measurement[STAMP])
    for k in range(3):
        measurement[k], measurement[3 + k] = pos[k], vel[k]
    measurement[6] = state


@inlined
def update_flight_filter(
    track: Array,
    measurement: Array,
    stamp: float,
    now: float,
    is_first: bool,
    is_guess: bool,
    position_noise: float,
    velocity_noise: float,
) -> None:
    """Update one track (``flight_filter.TRACK``,) with the measurement of this control step.

    Args:
        track: Written.
        measurement: Position [m], velocity [m/s], trajectory state 0..3 or ``SERVED``.
        stamp: Time stamp of the measurement [s].
        now: Time now [s].
        is_first: Whether it is the flight's first measurement.
        is_guess: Whether a camera filter has too few detections (``camera_filter.is_guess``). The track then starts
            again with this measurement.
        position_noise: Standard deviation of the measured position per axis [m].
        velocity_noise: Standard deviation of the measured velocity per axis [m/s].
    """
    comes = measurement[6] == COMING
    # The flight after a serve's first bounce is a new one: the bounce has changed its velocity and its spin
    if is_first or (is_guess and (comes or measurement[6] == SERVED)) or (comes and track[IS_SERVED] == 1.0):
        begin_track(track, measurement, stamp, position_noise, velocity_noise)
        predict_interception(track, now)
    elif measurement[6] <= 1.0 or measurement[6] == SERVED:
        add_measurement(track, measurement, stamp, measurement[6] == 1.0, position_noise, velocity_noise)
        predict_interception(track, now)
    else:  # the ball was hit: the track is over
        for k in range(6):
            track[PRESENT + k] = measurement[k]


@inlined
def update_perception(rallies: Rallies, b: int, step: int, profile: RandomizationProfile) -> None:
    """Measure ball b, and update the measurement history and the flight filter.

    Args:
        rallies: Row b is written.
        b: Row.
        step: Control steps since the launch.
        profile: Noise, latency and camera.
    """
    history = rallies.measurement_history[b]
    for k in range(history.shape[0] - 1, -1, -1):
        for j in range(6):
            history[k, j] = history[k - 1, j] if k > 0 else rallies.measurement[b, j]
    measurement = rallies.measurement[b]
    has_camera = rallies.camera_state.shape[0] > 0
    if has_camera:
        filter_measurement(rallies, b, profile)
    else:
        sample_measurement(rallies, b, step, profile)
    if rallies.track.shape[0] > 0:
        guess = has_camera and is_guess(rallies.camera_state[b, DETECTION_BUFFER:])
        update_flight_filter(
            rallies.track[b],
            measurement,
            measurement[STAMP],
            rallies.clock[b] * GRID_STEP,
            step == 0,
            guess,
            profile.position_noise,
            profile.velocity_noise,
        )


@kernel
def record_detections(
    rallies: Rallies, b: int, profile: RandomizationProfile, since: float, segment: Segment
) -> None:
    """Record the camera's detections of ball b along a piece of its flight. Only for rallies with a camera.

    Args:
        rallies: Row b is written.
        b: Row.
        profile: Noise and rate of the camera.
        since: Start of the segment after the newest grid step [s].
        segment: A piece of flight without touches.
    """
    detect_along_flight(
        rallies.camera_state[b, :DETECTION_BUFFER],
        rallies.seed[b],
        rallies.parameters[b],
        profile,
        rallies.clock[b] * GRID_STEP + since,
        segment,
    )


@inlined
def advance_clock(rallies: Rallies, b: int, pos: Vec, vel: Vec, state: int) -> None:
    """Advance ball b's clock by one grid step and put its true state into the ring."""
    rallies.clock[b] += 1
    head = (rallies.head[b] + 1) % RING
    rallies.head[b] = head
    sample = rallies.true_sample_ring[b, head]
    for k in range(3):
        sample[k], sample[3 + k] = pos[k], vel[k]
    sample[6] = float(state // 2)

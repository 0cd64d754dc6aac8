"""Rallies that the simulated camera detects, with the truth, for the tests of camera and camera filter."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from common.jit import kernel
from common.perception.camera import (
    DETECTION,
    DETECTION_BUFFER,
    READ,
    TAKEN,
    begin_detections,
    detect_along_flight,
    detection_row,
)
from common.perception.camera_filter import ESTIMATE, add_detection, begin_filter, estimate_at
from common.perception.flight_track import COMING
from common.physics.constants import GRID_STEP
from common.physics.flight import FULL
from common.physics.fly import NO_ROBOT, RobotPath, Segment, fly_step
from common.physics.table_bounce import table_bounce
from common.physics.touch import NONE, OPPONENT_COURT, ROBOT_COURT
from common.task.config import TaskConfig
from common.task.counter_rng import Stream, between
from common.task.launch import DRAG_FACTOR, KIND, LIFT_FACTOR, draw_rallies
from common.task.randomization import (
    PROFILES,
    RALLY_PARAMETERS,
    RallyParameter,
    RandomizationProfile,
    air_of,
    draw_parameters,
)

Array = npt.NDArray[np.float64]
CONTROL_STEPS = 50  # 1 s
_RESET = int(Stream.RESET)
_RESTITUTION, _FRICTION = int(RallyParameter.TABLE_RESTITUTION0), int(RallyParameter.TABLE_FRICTION)


class CameraRallies(NamedTuple):
    """One row a rally, one column a control step; nan after a rally's end."""

    truth: Array  # (n, CONTROL_STEPS, 7) position, velocity, state 0..3
    estimate: Array  # (n, CONTROL_STEPS, 7) for the same moment
    detections: Array  # (n, 250, 5) all detections that are not lost


@kernel
def _play_rally(
    record: Array,
    seed: int,
    profile: RandomizationProfile,
    latency: float,
    has_hit: bool,
    no_robot: RobotPath,
    truth: Array,
    estimate: Array,
    kept: Array,
) -> None:
    """Fly a rally without a robot. If ``has_hit``, a hit at 0.15 to 0.3 s after its bounce returns the ball."""
    parameters = np.empty(RALLY_PARAMETERS)
    draw_parameters(seed, record[DRAG_FACTOR], record[LIFT_FACTOR], record[KIND], profile, parameters)
    air = air_of(parameters, FULL)
    buffer, row = np.zeros(DETECTION_BUFFER), np.zeros(ESTIMATE)
    pos, vel = (record[0], record[1], record[2]), (record[3], record[4], record[5])
    spin = (record[6], record[7], record[8])
    begin_detections(buffer, seed, pos, profile)
    state, hit = 0, 1.0e9
    for step in range(truth.shape[0]):
        for sub in range(4):
            start, rest = (4 * step + sub) * GRID_STEP, GRID_STEP
            while rest > 0.0:
                since = start + GRID_STEP - rest
                h = min(rest, max(hit - since, 0.0)) if state == 1 else rest
                p0, v0 = pos, vel
                pos, vel, flown, what, normal = fly_step(pos, vel, spin, h, air, no_robot, 0.0)
                segment = Segment(p0, v0, pos, vel, flown)
                detect_along_flight(buffer, seed, parameters, profile, since, segment)
                rest -= flown
                if what == ROBOT_COURT and state == 0:
                    vel, spin = table_bounce(
                        vel, spin, normal, parameters[_RESTITUTION], parameters[_FRICTION]
                    )
                    state = 1
                    if has_hit:
                        hit = since + flown + between(0.15, 0.3, seed, _RESET, 0)
                elif what == OPPONENT_COURT and state == 2:
                    vel, spin = table_bounce(
                        vel, spin, normal, parameters[_RESTITUTION], parameters[_FRICTION]
                    )
                    state = 3
                elif what != NONE:
                    return
                elif state == 1 and rest > 0.0:
                    vel = (
                        between(4.0, 7.0, seed, _RESET, 1),
                        between(-1.5, 1.5, seed, _RESET, 2),
                        between(0.5, 3.0, seed, _RESET, 3),
                    )
                    spin = (0.0, -between(0.0, 100.0, seed, _RESET, 4), 0.0)
                    state = 2
        now = 4 * (step + 1) * GRID_STEP
        while buffer[READ] < buffer[TAKEN]:
            detection = detection_row(buffer, int(buffer[READ]))
            place = (detection[1], detection[2], detection[3])
            if buffer[READ] == 0.0:
                begin_filter(row, detection[0], place, profile.camera_noise, COMING)
                detection[4] = 1.0
            elif detection[0] + latency > now + 1e-9:
                break
            elif add_detection(row, detection[0], place, profile.camera_noise):
                detection[4] = 1.0
            kept[int(buffer[READ])] = detection
            buffer[READ] += 1.0
        estimated_pos, estimated_vel, estimated_state = estimate_at(row, now)
        for k in range(3):
            truth[step, k], truth[step, 3 + k] = pos[k], vel[k]
            estimate[step, k], estimate[step, 3 + k] = estimated_pos[k], estimated_vel[k]
        truth[step, 6], estimate[step, 6] = state, estimated_state


@kernel
def _play_all(
    records: Array,
    seeds: npt.NDArray[np.uint64],
    profile: RandomizationProfile,
    latency: float,
    has_hit: bool,
    no_robot: RobotPath,
    truth: Array,
    estimate: Array,
    kept: Array,
) -> None:
    for k in range(records.shape[0]):
        _play_rally(records[k], seeds[k], profile, latency, has_hit, no_robot, truth[k], estimate[k], kept[k])


def camera_rallies(
    rallies: int,
    *,
    profile: RandomizationProfile = PROFILES["standard"],
    latency: float = 0.025,
    seed: int = 0,
    launch: str = "paper",
    has_hit: bool = True,
) -> CameraRallies:
    """Return valid rallies with the truth, the camera's detections and the estimates."""
    block = draw_rallies(rallies, TaskConfig.model_validate({"launch": launch}), seed=seed)
    played = CameraRallies(
        np.full((rallies, CONTROL_STEPS, 7), np.nan),
        np.full((rallies, CONTROL_STEPS, 7), np.nan),
        np.full((rallies, 250, DETECTION), np.nan),
    )
    _play_all(block.launches, block.seeds, profile, latency, has_hit, NO_ROBOT, *played)
    return played


def errors_of(played: CameraRallies) -> tuple[Array, Array, Array, Array]:
    """Return errors of position [m] and velocity [m/s], true and estimated state: (m,) control steps in play."""
    in_play = np.isfinite(played.truth[:, :, 0])
    truth, estimate = played.truth[in_play], played.estimate[in_play]
    off = np.abs(estimate - truth)
    return (
        np.linalg.norm(off[:, :3], axis=1),
        np.linalg.norm(off[:, 3:6], axis=1),
        truth[:, 6],
        estimate[:, 6],
    )

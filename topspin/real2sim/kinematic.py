"""A recorded track as the path of a ball: the recording drives it until the racket touches it, and then physics.

A camera's samples are noisy and lie on no grid, so the path is the fitted flight plus the residuals,
smoothed over about 50 ms. Where the fit is right, the path is the fit's. Where the model of air or table is wrong, the
path follows the recorded ball. Spin comes from the fit, since recordings have none.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Final

import numpy as np

from common.jit import kernel
from common.physics import touch
from common.physics.constants import GRID_STEP
from common.physics.flight import Air
from common.physics.fly import NO_ROBOT, RobotPath, fly_step
from common.physics.table_bounce import table_bounce
from common.rally.state import NO_SAMPLE, SAMPLE
from common.rally.step import snap_to_recorded_track
from common.task.config import Randomization
from common.task.launch import KIND, LAUNCH_SIZE, LONGEST_FLIGHT
from common.task.launch_presets import SERVE, Kind
from common.task.randomization import PROFILES, table_of
from common.task.states import State
from topspin.real2sim.fit.predict import bounce_moments, predict
from topspin.real2sim.formats.tracks import Array, Track
from topspin.real2sim.replay import RecordedRallies

if TYPE_CHECKING:  # the fit needs scipy, an extra
    from topspin.real2sim.fit.identify import Fit

SMOOTHING: Final = 0.025  # [s] sigma of the window over residuals: 2 mm of noise become 0.7 mm and 0.03 m/s
FAR: Final = 5.0  # [medians of the residuals] samples farther from the fit are ignored
LEAST_FAR: Final = 0.005  # [m] smallest such distance
_NO_TABLE: Final = np.empty(0)
_COMING, _SERVED = int(State.TAU_01), int(State.TAU_S)
_TOUCHES_A_STEP: Final = 4
# Column 6 of a path by the number of bounces before, as the environment's true samples have it
_STAGES: Final = (int(State.TAU_0) // 2, int(State.TAU_1) // 2)
_SERVE_STAGES: Final = (_SERVED // 2, *_STAGES)


def _smoothed(times: Array, residuals: Array, at: Array) -> tuple[Array, Array]:
    """Return value and slope (m, 3) at ``at`` of lines through the residuals (n, 3), weighted by nearness."""
    if len(times) < 2:
        return np.zeros((len(at), 3)), np.zeros((len(at), 3))
    offset = times - at[:, None]
    # the window stays within the samples' times
    nearest = np.abs(offset).min(axis=1, keepdims=True)
    weight = np.exp(-0.5 * ((np.abs(offset) - nearest) / SMOOTHING) ** 2)
    total = weight.sum(axis=1, keepdims=True)
    mean_offset = (weight * offset).sum(axis=1, keepdims=True) / total
    mean = weight @ residuals / total
    spread = (weight * (offset - mean_offset) ** 2).sum(axis=1, keepdims=True)
    slope = (weight * (offset - mean_offset)) @ residuals / np.maximum(spread, 1e-12)
    return mean - mean_offset * slope, slope


def path_of(track: Track, fitted: "Fit") -> Array:
    """Return the path (n, 7) of a track's ball, as ``step.snap_to_recorded_track``.

    It ends with the last sample that the fit used: after it physics continues.
    """
    times, positions = track.times[: fitted.used_samples], track.positions[: fitted.used_samples]
    table = fitted.table if fitted.bounced else _NO_TABLE
    flight = fitted.options.flight
    grid = GRID_STEP * np.arange(math.floor(times[-1] / GRID_STEP + 1e-9) + 1, dtype=np.float64)
    pos, vel = np.empty((len(grid), 3)), np.empty((len(grid), 3))
    predict(fitted.launch, table, flight, grid, pos, vel)
    at_samples = np.empty_like(positions)
    predict(fitted.launch, table, flight, times, at_samples, np.empty_like(positions))
    residuals = positions - at_samples
    size = np.linalg.norm(residuals, axis=1)
    near = size <= max(FAR * float(np.median(size)), LEAST_FAR)
    stages = _SERVE_STAGES if fitted.is_serve else _STAGES
    bounces = np.full(len(stages) - 1, math.inf)
    if fitted.bounced:
        bounce_moments(fitted.launch, fitted.table, flight, float(times[-1]) + GRID_STEP, bounces)
    stage_of_row = np.searchsorted(bounces, grid, side="right")
    stage_of_sample = np.searchsorted(bounces, times, side="right")
    for stage in range(len(stages)):
        # a bounce that is modelled wrongly bends the residuals: each side is smoothed by itself
        rows, samples = stage_of_row == stage, near & (stage_of_sample == stage)
        shift, slope = _smoothed(times[samples], residuals[samples], grid[rows])
        pos[rows] += shift
        vel[rows] += slope
    return np.column_stack((pos, vel, np.array(stages, np.float64)[stage_of_row]))


@kernel
def first_touch(
    launch: Array, path: Array, model: int, table: tuple[float, float], no_robot: RobotPath
) -> int:
    """Return what a driven ball touches first (``touch.Touch``), without a robot.

    A serve's bounce on the server's own court does not count: its first touch is the one after it. A serve that touches
    anything else before returns ``touch.EDGE``.

    Args:
        launch: Position, velocity, spin, drag and lift factor, kind (12,).
        path: As ``step.snap_to_recorded_track`` (n, 7).
        model: ``flight.SIMPLE`` or ``flight.FULL``.
        table: Restitution and friction of the table in the rally [-].
        no_robot: ``fly.NO_ROBOT``.
    """
    pos, vel = (launch[0], launch[1], launch[2]), (launch[3], launch[4], launch[5])
    spin = (launch[6], launch[7], launch[8])
    air = Air(launch[9], launch[10], model)
    state = _SERVED if launch[KIND] == SERVE else _COMING
    if touch.table_gap(pos)[0] <= 0.0:
        return touch.EDGE
    if touch.net_gap(pos)[0] <= 0.0:
        return touch.NET
    for step in range(int(LONGEST_FLIGHT / GRID_STEP)):
        rest = GRID_STEP
        for _ in range(_TOUCHES_A_STEP):
            pos, vel, flown, what, normal = fly_step(pos, vel, spin, rest, air, no_robot, 0.0)
            if what == touch.NONE:
                break
            if state == _COMING:
                return what
            if what != touch.OPPONENT_COURT:
                return touch.EDGE
            state = _COMING
            vel, spin = table_bounce(vel, spin, normal, table[0], table[1])
            rest -= flown
        pos, vel = snap_to_recorded_track(path, step + 1, state, pos, vel)
    return touch.NONE


def driven(
    rallies: RecordedRallies,
    tracks: Sequence[Track],
    fits: Sequence["Fit"],
    randomization: Randomization = "standard",
) -> RecordedRallies:
    """Return fitted tracks' rallies with their recordings as paths; a rally is valid if its path is.

    Args:
        rallies: As ``replay.of_fits`` makes them.
        tracks: The recordings, in the same order.
        fits: Their fits.
        randomization: Profile under which they are played; a serve's first bounce depends on its tables.
    """
    each = [path_of(track, fitted) for track, fitted in zip(tracks, fits, strict=True)]
    paths = np.full((len(each), max(len(path) for path in each), SAMPLE), NO_SAMPLE)
    launches = np.empty((len(each), LAUNCH_SIZE))
    touched = np.empty(len(each), np.int64)
    for k, (path, fitted) in enumerate(zip(each, fits, strict=True)):
        paths[k, : len(path)] = path
        launches[k] = rallies.launches[k]
        launches[k, :6] = path[0, :6]
        launches[k, KIND] = SERVE if fitted.is_serve else int(Kind.RECORDED)
        table = table_of(PROFILES[randomization], rallies.seeds[k])
        touched[k] = first_touch(launches[k], paths[k], fitted.options.flight, table, NO_ROBOT)
    return replace(rallies, launches=launches, paths=paths, touched=touched)

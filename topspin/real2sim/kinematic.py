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
from common.rally.state import NO_SAMPLE, SAMPLE
from common.rally.step import snap_to_recorded_track
from common.task.launch import LAUNCH_SIZE, LONGEST_FLIGHT
from common.task.states import State
from topspin.real2sim.fit.predict import predict, touch_down
from topspin.real2sim.formats.tracks import Array, Track
from topspin.real2sim.replay import Flags, RecordedRallies

if TYPE_CHECKING:  # the fit needs scipy, an extra
    from topspin.real2sim.fit.identify import Fit

SMOOTHING: Final = 0.025  # [s] sigma of the window over residuals: 2 mm of noise become 0.7 mm and 0.03 m/s
FAR: Final = 5.0  # [medians of the residuals] samples farther from the fit are ignored
LEAST_FAR: Final = 0.005  # [m] smallest such distance
_NO_TABLE: Final = np.empty(0)
_ON_ITS_WAY = int(State.TAU_01)


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
    bounce = math.inf
    if fitted.bounced:
        bounce = touch_down(fitted.launch, flight, float(times[-1]) + GRID_STEP)[0]
    for before in (True, False):
        # a bounce that is modelled wrongly bends the residuals: each side is smoothed by itself
        rows, samples = (grid < bounce) == before, near & ((times < bounce) == before)
        shift, slope = _smoothed(times[samples], residuals[samples], grid[rows])
        pos[rows] += shift
        vel[rows] += slope
    return np.column_stack((pos, vel, grid >= bounce))


@kernel
def first_touch(launch: Array, path: Array, model: int, no_robot: RobotPath) -> int:
    """Return what a driven ball touches first (``touch.Touch``), without a robot.

    Args:
        launch: Position, velocity, spin, drag and lift factor (11,).
        path: As ``step.snap_to_recorded_track`` (n, 7).
        model: ``flight.SIMPLE`` or ``flight.FULL``.
        no_robot: ``fly.NO_ROBOT``.
    """
    pos, vel = (launch[0], launch[1], launch[2]), (launch[3], launch[4], launch[5])
    spin = (launch[6], launch[7], launch[8])
    if touch.table_gap(pos)[0] <= 0.0:
        return touch.EDGE
    if touch.net_gap(pos)[0] <= 0.0:
        return touch.NET
    for step in range(int(LONGEST_FLIGHT / GRID_STEP)):
        pos, vel, _, what, _ = fly_step(
            pos, vel, spin, GRID_STEP, Air(launch[9], launch[10], model), no_robot, 0.0
        )
        if what != touch.NONE:
            return what
        pos, vel = snap_to_recorded_track(path, step + 1, _ON_ITS_WAY, pos, vel)
    return touch.NONE


def driven(rallies: RecordedRallies, tracks: Sequence[Track], fits: Sequence["Fit"]) -> RecordedRallies:
    """Return fitted tracks' rallies with their recordings as paths; a rally is valid if its path is.

    Args:
        rallies: As ``replay.of_fits`` makes them.
        tracks: The recordings, in the same order.
        fits: Their fits.
    """
    each = [path_of(track, fitted) for track, fitted in zip(tracks, fits, strict=True)]
    paths = np.full((len(each), max(len(path) for path in each), SAMPLE), NO_SAMPLE)
    launches = np.empty((len(each), LAUNCH_SIZE))
    valid: Flags = np.zeros(len(each), np.bool_)
    for k, (path, fitted) in enumerate(zip(each, fits, strict=True)):
        paths[k, : len(path)] = path
        launches[k] = rallies.launches[k]
        launches[k, :6] = path[0, :6]
        what = first_touch(launches[k], paths[k], fitted.options.flight, NO_ROBOT)
        valid[k] = what == touch.ROBOT_COURT
    return replace(rallies, launches=launches, paths=paths, valid=valid)

"""Whether a file's numbers can be in the frame that its sidecar says, and which frame would fit.

A wrong unit, axis or origin gives a recording that looks like one and is none. Each check compares the recordings with
what every ball does: it falls, it flies along the table, and it bounces on the table's top. A check that fails is an
error of one line with the key of the sidecar that would fit.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from common.physics.constants import BALL_RADIUS, TABLE_HALF_LENGTH, TABLE_HALF_WIDTH
from topspin.real2sim.fit.bounces import SURFACE, Turn, turns
from topspin.real2sim.formats.frames import LENGTH_UNITS, TIME_UNITS, Frame, sidecar_of
from topspin.real2sim.formats.tracks import SPEEDS, TIME_STEPS, RecordingError, Track, inside_room

Array = npt.NDArray[np.float64]

MOST: Final = 0.5  # [-] a file is refused if a larger share of its recordings fails a check
LAG: Final = 5  # samples; speeds are measured over so many
ALONG: Final = 1.5  # [-] a ball that moves so much farther along y than along x flies along y
FARTHEST: Final = 1.0  # m; only a track this long along y shows it
FALL: Final = (5.0, 16.0)  # m/s^2; along the vertical axis, with the lift of fast spin
LEVEL: Final = 2.0  # [-] along it, the acceleration is at least so many times as large as along the others
FLOOR: Final = (-0.85, -0.60)  # m; a ball that misses the table bounces here
LONG_NAMES: Final = {"m": "metres", "cm": "centimetres", "mm": "millimetres"}


def check_units(path: Path, frame: Frame, times: Array, positions: Array) -> None:
    """Raise RecordingError if a recording's numbers are those of another unit of length or time.

    Args:
        path: The file.
        frame: Its frame, in which ``positions`` were mapped to the world.
        times: (n,) [s].
        positions: (n, 3) [m], world.
    """
    good = np.isfinite(times) & np.isfinite(positions).all(axis=1)
    t, p = times[good], positions[good]
    if len(t) <= LAG or np.any(np.diff(t) <= 0.0):
        return
    step = float(np.median(np.diff(t)))
    if not TIME_STEPS[0] <= step <= TIME_STEPS[1]:
        _check_time(path, frame, step)
        return
    if np.mean(inside_room(p)) > MOST:
        return
    speed = float(np.median(np.linalg.norm(p[LAG:] - p[:-LAG], axis=1) / (t[LAG:] - t[:-LAG])))
    for unit, size in LENGTH_UNITS.items():
        ratio = size / frame.length
        if 1.0 <= ratio * speed <= SPEEDS[1] and np.mean(inside_room(ratio * p)) > MOST:
            now = next((name for name, length in LENGTH_UNITS.items() if length == frame.length), "m")
            raise RecordingError(
                f"{path}: the {LONG_NAMES[now]} of this file look like {LONG_NAMES[unit]} ({speed:.0f} m/s, outside "
                f'the room); set length_unit = "{unit}" in {sidecar_of(path).name}'
            )


def _check_time(path: Path, frame: Frame, step: float) -> None:
    sidecar = sidecar_of(path).name
    if abs(step / frame.time - 1.0) < 1e-9:
        raise RecordingError(
            f"{path}: the times of this file look like frame numbers (a step of 1); set "
            f'time_unit = "frame" and rate_hz in {sidecar}'
        )
    for unit, size in TIME_UNITS.items():
        if TIME_STEPS[0] <= step * size / frame.time <= TIME_STEPS[1]:
            raise RecordingError(
                f"{path}: the times of this file look like {unit} (a step of {step:.3g} s); set "
                f'time_unit = "{unit}" in {sidecar}'
            )


def check_axes(path: Path, frame: Frame, tracks: Sequence[Track]) -> None:
    """Raise RecordingError if most tracks fly along y, or fall along another axis than z."""
    found = [_world_of(track) for track in tracks]
    wrong = [rotation for rotation in found if rotation is not None]
    if len(wrong) <= MOST * len(tracks):
        return
    rotation = max(wrong, key=lambda one: sum(np.array_equal(one, other) for other in wrong))
    falls = "" if rotation[2, 2] == 1.0 else f" and falls along {_name(-rotation[2])}, not -z"
    raise RecordingError(
        f"{path}: the ball flies along {_name(-rotation[0])}, not -x{falls}; "
        f"set axes = {_axes(rotation @ frame.rotation)} in {sidecar_of(path).name}"
    )


def check_state_axes(path: Path, frame: Frame, states: Array) -> None:
    """Raise RecordingError if most states (n, 9) fly along y. A state does not show where it falls."""
    velocities = states[np.isfinite(states).all(axis=1), 3:6]
    if not len(velocities):
        return
    along_y = np.abs(velocities[:, 1]) > ALONG * np.abs(velocities[:, 0])
    if np.mean(along_y) > MOST:
        rotation = _rotation(np.median(velocities[along_y], axis=0), np.array([0.0, 0.0, 1.0]))
        raise RecordingError(
            f"{path}: {int(along_y.sum())} of {len(velocities)} balls fly along {_name(-rotation[0])}, "
            f"not -x; set axes = {_axes(rotation @ frame.rotation)} in {sidecar_of(path).name}"
        )


def _world_of(track: Track) -> Array | None:
    """Return the rotation (3, 3) that would turn a track into the world's frame, or None if it is there."""
    way = track.positions[-1] - track.positions[0]
    up = np.array([0.0, 0.0, 1.0])
    first = turns(track)
    end = first[0].first_after if first else len(track.times)
    if end >= 2 * LAG:
        curve = 2.0 * np.polynomial.polynomial.polyfit(track.times[:end], track.positions[:end], 2)[2]
        axis = int(np.abs(curve).argmax())
        others = np.delete(np.abs(curve), axis).max()
        if FALL[0] <= abs(curve[axis]) <= FALL[1] and abs(curve[axis]) > LEVEL * others:
            up = -np.sign(curve[axis]) * np.eye(3)[axis]
    sideways = way - (way @ up) * up
    is_along_x = abs(sideways[0]) * ALONG >= abs(sideways[1]) or abs(sideways[1]) < FARTHEST
    if up[2] == 1.0 and is_along_x:
        return None
    return _rotation(sideways, up)


def _rotation(way: Array, up: Array) -> Array:
    """Return the rotation that turns the axis nearest to ``way`` to -x, and the axis ``up`` to z."""
    way = way - (way @ up) * up
    axis = int(np.abs(way).argmax())
    x = -np.sign(way[axis]) * np.eye(3)[axis]
    return np.stack([x, np.cross(up, x), up])


def _name(direction: Array) -> str:
    axis = int(np.abs(direction).argmax())
    return f"{'-' if direction[axis] < 0.0 else ''}{'xyz'[axis]}"


def _axes(rotation: Array) -> str:
    """Return a rotation as the sidecar's ``axes``."""
    return "[" + ", ".join(f'"{_name(row)}"' for row in rotation) + "]"


def check_origin(path: Path, frame: Frame, tracks: Sequence[Track]) -> None:
    """Raise RecordingError if most tracks that bounce do so at another height than that of the table's top."""
    found = [[turn for turn in turns(track) if turn.is_from_below] for track in tracks]
    places = [each[0].position for each in found if each]
    if not places:
        return
    wrong = [each[0].position for each in found if each and not any(map(_is_possible, each))]
    if len(wrong) <= MOST * len(places):
        return
    middle = np.median(wrong, axis=0)
    height = round(float(middle[2]) - BALL_RADIUS, 2)
    origin = frame.origin + frame.rotation.T @ np.array([0.0, 0.0, height]) / frame.length
    numbers = ", ".join(f"{value:.6g}" for value in np.round(origin, 6) + 0.0)
    if abs(height) > SURFACE:
        raise RecordingError(
            f"{path}: the ball bounces at z = {middle[2]:.2f} m, and must bounce at {BALL_RADIUS:g} m, where the "
            f"table's top is 0; set origin = [{numbers}] in {sidecar_of(path).name}"
        )
    raise RecordingError(
        f"{path}: the ball bounces beside the table, at x = {middle[0]:.2f} m and y = {middle[1]:.2f} m; set origin in "
        f"{sidecar_of(path).name} to the centre of the table's top in the file's frame and unit"
    )


def _is_possible(turn: Turn) -> bool:
    """Return whether a ball may bounce here: on the table, or on the floor beside it."""
    x, y, z = turn.position
    is_beside = abs(x) > TABLE_HALF_LENGTH or abs(y) > TABLE_HALF_WIDTH
    return turn.is_on_table or (is_beside and FLOOR[0] < z < FLOOR[1])

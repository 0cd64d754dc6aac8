"""The frame a file is in, and its transformation to the world, from a TOML file beside the recording.

    # throws.toml, beside throws.csv; every key is optional
    kind = "track"             # or "states"; default: the columns decide
    length_unit = "mm"         # m, cm, mm (of positions, velocities and origin)
    time_unit = "ms"           # s, ms, us, ns
    rate_hz = 180.0            # a file without times, or whose times are frame numbers (time_unit = "frame")
    spin_unit = "rad/s"        # rad/s, rps, rpm, deg/s
    axes = ["y", "-x", "z"]    # the file's axes along which the world's x, y and z lie
    origin = [0.0, 0.0, 760.0] # the centre of the table's top, in the file's frame and unit of length
    label = "topspin"          # of every recording in the file
    player = "Ma"              # who played every ball of the file
    columns = ["t", "x", "y", "z"] # names of the columns of a text file, in place of a first line with names
    velocity_delay_s = 0.015   # states: the velocities belong to moments so much later than the positions

A file without its own TOML file has that of its folder, ``folder.toml``, if there is one.

``axes`` is a rotation and never a mirror image: a mirrored spin would have the wrong sign.
"""

import math
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from topspin.real2sim.formats.tracks import RecordingError

Array = npt.NDArray[np.float64]

LENGTH_UNITS: Final = {"m": 1.0, "cm": 0.01, "mm": 0.001}
TIME_UNITS: Final = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
SPIN_UNITS: Final = {
    "rad/s": 1.0,
    "rps": 2.0 * math.pi,
    "rpm": 2.0 * math.pi / 60.0,
    "deg/s": math.pi / 180.0,
}
LONGEST_DELAY: Final = 0.1  # s
KINDS: Final = ("", "track", "states")
FRAME_NUMBER: Final = "frame"
FOLDER_SIDECAR: Final = "folder.toml"  # applies to all files of its folder that have no sidecar of their own
KEYS: Final = (
    *("kind", "length_unit", "time_unit", "rate_hz", "spin_unit", "axes", "origin", "label"),
    *("player", "columns", "velocity_delay_s"),
)


@dataclass(frozen=True, slots=True)
class Frame:
    """The transformation of a file's numbers to the world frame and SI.

    Attributes:
        rotation: R_world_file (3, 3), proper.
        origin: (3,) the world's origin in the file's frame, in the file's unit of length.
        length: The file's unit of length [m].
        time: The file's unit of time [s]; the duration of a frame if times are frame numbers.
        spin: The file's unit of spin [rad/s].
        step: Time between samples [s], for a file without times; 0: unknown.
        kind: ``track``, ``states``, or empty: the columns decide.
        label: The label of every recording.
        player: Who played every ball.
        columns: Names of a text file's columns; empty: its first line has them.
        velocity_delay: Time [s] by which the moments of a state's velocity are later than those of its position.
    """

    rotation: Array
    origin: Array
    length: float = 1.0
    time: float = 1.0
    spin: float = 1.0
    step: float = 0.0
    kind: str = ""
    label: str = ""
    player: str = ""
    columns: tuple[str, ...] = ()
    velocity_delay: float = 0.0

    def positions(self, file_positions: Array) -> Array:
        """Return positions (n, 3) [m] in the world frame; nan for rows that are not finite, as in all of these."""
        return self.length * (_finite(file_positions) - self.origin) @ self.rotation.T

    def velocities(self, file_velocities: Array) -> Array:
        """Return velocities (n, 3) [m/s] in the world frame; the file's are in its lengths per second."""
        return self.length * _finite(file_velocities) @ self.rotation.T

    def spins(self, file_spins: Array) -> Array:
        """Return spins (n, 3) [rad/s] in the world frame."""
        return self.spin * _finite(file_spins) @ self.rotation.T


def _finite(rows: Array) -> Array:
    """Return rows with nan in place of infinity, whose products with 0 make NumPy warn."""
    return np.where(np.isfinite(rows), rows, np.nan)


def world_frame() -> Frame:
    """Return the frame of a file in the world frame and SI."""
    return Frame(np.eye(3), np.zeros(3))


def rotation_of(axes: tuple[str, ...]) -> Array:
    """Return R_world_file of three axis names such as ``("y", "-x", "z")``; raises ValueError if it is no rotation."""
    rotation = np.zeros((3, 3))
    for row, name in enumerate(axes):
        axis = "xyz".find(name.removeprefix("-")) if len(name.removeprefix("-")) == 1 else -1
        if axis < 0:
            raise ValueError(f"got {name!r}; allowed: x, y, z, -x, -y, -z")
        rotation[row, axis] = -1.0 if name.startswith("-") else 1.0
    if len(axes) != 3 or abs(float(np.linalg.det(rotation)) - 1.0) > 1e-9:
        raise ValueError(
            f"got {list(axes)}; allowed: three different axes that make a rotation, no mirror image"
        )
    return rotation


def sidecar_of(path: Path) -> Path:
    """Return the path of a file's sidecar: its own, or that of its folder if only that is there."""
    own, shared = path.with_suffix(".toml"), path.parent / FOLDER_SIDECAR
    return shared if shared.is_file() and not own.is_file() else own


def read_frame(path: Path, used: tuple[str, ...] = KEYS) -> Frame:
    """Return the frame of the recording at ``path`` by its TOML file or its folder's; the world's without one.

    Args:
        path: Of the recording.
        used: Keys that have an effect on it. A folder's file may have others: they are for other recordings.

    Raises:
        RecordingError: The TOML file is at fault, or is the recording's own and has a key without effect.
    """
    sidecar = sidecar_of(path)
    if not sidecar.is_file():
        return world_frame()
    try:
        table = tomllib.loads(sidecar.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:  # not TOML, no text, or beyond Python's limits
        raise RecordingError(f"{sidecar}: not readable as TOML: {error}") from None
    frame = _frame(table, sidecar)
    idle = [key for key in table if key not in used]
    if idle and sidecar.name != FOLDER_SIDECAR:
        raise RecordingError(
            f"{sidecar}: {idle[0]} has no effect on a {path.suffix} file, whose frame is known; "
            f"allowed: {', '.join(used)}"
        )
    return frame


def _frame(table: dict[str, Any], sidecar: Path) -> Frame:
    for key in table:
        if key not in KEYS:
            raise RecordingError(f"{sidecar}: unknown key {key!r}; allowed: {', '.join(KEYS)}")
    rate = table.get("rate_hz")
    time_unit = _choice(table, "time_unit", (*TIME_UNITS, FRAME_NUMBER), "s", sidecar)
    if rate is not None and not (_is_number(rate) and rate > 0.0):
        raise RecordingError(f"{sidecar}: rate_hz: got {rate!r}; allowed: a number above 0")
    if time_unit == FRAME_NUMBER and rate is None:
        raise RecordingError(f"{sidecar}: time_unit 'frame' needs rate_hz, which is missing")
    delay = table.get("velocity_delay_s", 0.0)
    if not (_is_number(delay) and abs(delay) <= LONGEST_DELAY):
        raise RecordingError(
            f"{sidecar}: velocity_delay_s: got {delay!r}; allowed: -{LONGEST_DELAY:g} to {LONGEST_DELAY:g}"
        )
    return Frame(
        rotation=_rotation(table.get("axes", ["x", "y", "z"]), sidecar),
        origin=_origin(table.get("origin", [0.0, 0.0, 0.0]), sidecar),
        length=LENGTH_UNITS[_choice(table, "length_unit", tuple(LENGTH_UNITS), "m", sidecar)],
        time=1.0 / rate if time_unit == FRAME_NUMBER and rate is not None else TIME_UNITS.get(time_unit, 1.0),
        spin=SPIN_UNITS[_choice(table, "spin_unit", tuple(SPIN_UNITS), "rad/s", sidecar)],
        step=1.0 / rate if rate is not None else 0.0,
        kind=_choice(table, "kind", KINDS, "", sidecar),
        label=_text(table, "label", sidecar),
        player=_text(table, "player", sidecar),
        columns=_columns(table.get("columns", []), sidecar),
        velocity_delay=float(delay),
    )


def _text(table: dict[str, Any], key: str, sidecar: Path) -> str:
    value = table.get(key, "")
    if not isinstance(value, str):
        raise RecordingError(f"{sidecar}: {key}: got {value!r}; allowed: a string")
    return value


def _columns(columns: object, sidecar: Path) -> tuple[str, ...]:
    if not (isinstance(columns, list) and all(isinstance(name, str) for name in columns)):
        raise RecordingError(
            f'{sidecar}: columns: got {columns!r}; allowed: a list such as ["t", "x", "y", "z"]'
        )
    return tuple(columns)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _choice(table: dict[str, Any], key: str, allowed: tuple[str, ...], default: str, sidecar: Path) -> str:
    value = table.get(key, default)
    if value not in allowed:
        raise RecordingError(f"{sidecar}: {key}: got {value!r}; allowed: {', '.join(filter(None, allowed))}")
    return str(value)


def _rotation(axes: object, sidecar: Path) -> Array:
    if not (isinstance(axes, list) and all(isinstance(name, str) for name in axes)):
        raise RecordingError(f'{sidecar}: axes: got {axes!r}; allowed: a list such as ["x", "y", "z"]')
    try:
        return rotation_of(tuple(axes))
    except ValueError as error:
        raise RecordingError(f"{sidecar}: axes: {error}") from None


def _origin(origin: object, sidecar: Path) -> Array:
    if not (isinstance(origin, list) and len(origin) == 3 and all(map(_is_number, origin))):
        raise RecordingError(f"{sidecar}: origin: got {origin!r}; allowed: three numbers")
    return np.array(origin, np.float64)

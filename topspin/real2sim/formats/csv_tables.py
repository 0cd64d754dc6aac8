"""Tracks and states as tables of text: ``t;x;y;z``, ``Timestamp,X,Y,Z``, or position, velocity and spin columns.

The first line names the columns, in any case and order; other columns are ignored. The delimiter is the one of
``;``, ``,``, tab and space that the first line has. Lines that are empty or start with ``#`` are skipped; an empty
cell or ``nan`` is a missing value; any other text that is no number is an error. An ``id`` column divides a
file into recordings. Frame and units are in the TOML file beside it (``frames.py``); without one they are the
world's and SI.
"""

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from topspin.real2sim.formats.frames import Frame, read_frame
from topspin.real2sim.formats.tracks import (
    RecordingError,
    Recordings,
    States,
    Track,
    checked_states,
    checked_tracks,
)

Array = npt.NDArray[np.float64]

DELIMITERS: Final = (";", ",", "\t", " ")
ALIASES: Final = {
    "t": ("t", "time", "timestamp", "timestamps", "time_stamp", "time_s", "frame"),
    **{axis: (axis, f"pos_{axis}", f"position_{axis}", f"p{axis}") for axis in "xyz"},
    **{f"v{axis}": (f"v{axis}", f"vel_{axis}", f"v_{axis}", f"velocity_{axis}") for axis in "xyz"},
    **{
        f"w{axis}": (f"w{axis}", f"w_vel_{axis}", f"w_{axis}", f"spin_{axis}", f"omega_{axis}")
        for axis in "xyz"
    },
    "id": ("id", "track", "recording", "name"),
    "label": ("label", "type"),
}
_TEXT: Final = ("id", "label")
_POSITION, _VELOCITY, _SPIN = ("x", "y", "z"), ("vx", "vy", "vz"), ("wx", "wy", "wz")


@dataclass(frozen=True, slots=True)
class Table:
    """A parsed file: known columns by their canonical name, as many rows each."""

    numbers: dict[str, Array]
    texts: dict[str, list[str]]
    rows: int


def read_csv(path: Path, turn: bool) -> Recordings:
    """Return the tracks or states of a file; see ``recordings.load``."""
    frame = read_frame(path)
    table = _parsed(path)
    kind = frame.kind or ("states" if "wx" in table.numbers else "track")
    if kind == "states":
        return _states(path, table, frame, turn)
    return _tracks(path, table, frame)


def _parsed(path: Path) -> Table:
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise RecordingError(f"{path}: not readable as text: {error}") from None
    content = [
        (n, line) for n, line in enumerate(lines, 1) if line.strip() and not line.lstrip().startswith("#")
    ]
    if not content:
        raise RecordingError(
            f"{path}: got an empty file; allowed: a line of column names and lines of numbers"
        )
    header_line, header = content[0]
    delimiter = next((mark for mark in DELIMITERS if mark in header.strip()), ",")
    names = _cells(header, delimiter)
    columns = _columns(names, f"{path}:{header_line}")
    values: dict[str, list[float]] = {name: [] for name in columns if name not in _TEXT}
    texts: dict[str, list[str]] = {name: [] for name in columns if name in _TEXT}
    for n, line in content[1:]:
        cells = _cells(line, delimiter)
        if len(cells) != len(names):
            raise RecordingError(
                f"{path}:{n}: got {len(cells)} columns; allowed: {len(names)} as in the header"
            )
        for name, column in columns.items():
            if name in _TEXT:
                texts[name].append(cells[column])
            else:
                values[name].append(_number(cells[column], f"{path}:{n}: {names[column]}"))
    numbers = {name: np.array(column, np.float64) for name, column in values.items()}
    return Table(numbers, texts, len(content) - 1)


def _cells(line: str, delimiter: str) -> list[str]:
    parts = line.split() if delimiter == " " else line.split(delimiter)
    return [part.strip().strip('"') for part in parts]


def _columns(names: list[str], where: str) -> dict[str, int]:
    """Return where each known column stands; raises RecordingError if a name appears twice or there is no position."""
    columns: dict[str, int] = {}
    for column, name in enumerate(names):
        for known, aliases in ALIASES.items():
            if name.lower() in aliases:
                if known in columns:
                    raise RecordingError(
                        f"{where}: {names[columns[known]]!r} and {name!r} are the same column"
                    )
                columns[known] = column
    missing = [axis for axis in _POSITION if axis not in columns]
    if missing:
        raise RecordingError(
            f"{where}: no column {', '.join(missing)}; got {', '.join(names)}; allowed: t;x;y;z, or positions, "
            "velocities and spins"
        )
    return columns


def _number(cell: str, where: str) -> float:
    if not cell:
        return float("nan")
    try:
        return float(cell)
    except ValueError:
        raise RecordingError(f"{where}: got {cell!r}; allowed: a number") from None


def _stacked(path: Path, table: Table, names: tuple[str, ...], kind: str) -> Array:
    missing = [name for name in names if name not in table.numbers]
    if missing:
        raise RecordingError(f"{path}: {kind} need the columns {', '.join(missing)}, which are missing")
    return np.stack([table.numbers[name] for name in names], axis=1)


def _states(path: Path, table: Table, frame: Frame, turn: bool) -> Recordings:
    world = np.hstack(
        [
            frame.positions(_stacked(path, table, _POSITION, "states")),
            frame.velocities(_stacked(path, table, _VELOCITY, "states")),
            frame.spins(_stacked(path, table, _SPIN, "states")),
        ]
    )
    ids = table.texts.get("id", [f"{path.stem}/{k}" for k in range(table.rows)])
    labels = table.texts.get("label", [frame.label] * table.rows)
    dropped: Counter[str] = Counter()
    states = checked_states(ids, world, labels, dropped, turn)
    return Recordings(str(path), (), states, dict(dropped))


def _tracks(path: Path, table: Table, frame: Frame) -> Recordings:
    positions = frame.positions(_stacked(path, table, _POSITION, "tracks"))
    times = table.numbers.get("t")
    if times is None and frame.step == 0.0:
        raise RecordingError(f"{path}: no column t, and no rate_hz in {path.with_suffix('.toml').name}")
    ids = table.texts.get("id", [path.stem] * table.rows)
    labels = table.texts.get("label", [frame.label] * table.rows)
    dropped: Counter[str] = Counter()
    tracks: list[Track] = []
    rows_of: dict[str, list[int]] = {}
    for row, name in enumerate(ids):
        rows_of.setdefault(name, []).append(row)
    for name, rows in rows_of.items():
        t = frame.step * np.arange(len(rows), dtype=np.float64) if times is None else frame.time * times[rows]
        tracks += checked_tracks(name, t, positions[rows], labels[rows[0]], dropped)
    return Recordings(str(path), tuple(tracks), States.none(), dict(dropped))

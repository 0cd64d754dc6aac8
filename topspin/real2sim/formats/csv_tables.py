"""Tracks and states as tables of text: ``t;x;y;z``, ``Timestamp,X,Y,Z``, or position, velocity and spin columns.

How a file becomes columns: ``text_table.py``. An ``id`` column divides a file into recordings. Frame and units are in
the TOML file beside it (``frames.py``) or in the header; without them they are the world's and SI. A frame that can't
be the file's is an error that names the right one (``frame_check.py``).
"""

from collections import Counter
from pathlib import Path

import numpy as np
import numpy.typing as npt

from topspin.real2sim.formats.frame_check import MOST, check_axes, check_origin, check_state_axes, check_units
from topspin.real2sim.formats.frames import Frame, read_frame, sidecar_of
from topspin.real2sim.formats.text_table import POSITION, SPIN, VELOCITY, Table, read_table
from topspin.real2sim.formats.tracks import (
    RecordingError,
    Recordings,
    States,
    Track,
    checked_states,
    checked_tracks,
)

Array = npt.NDArray[np.float64]


def read_csv(path: Path, turn: bool) -> Recordings:
    """Return the tracks or states of a file; see ``recordings.load``."""
    frame = read_frame(path)
    table = read_table(path, frame)
    kind = frame.kind or ("states" if "wx" in table.numbers else "track")
    if kind == "states":
        return _states(path, table, frame, turn)
    return _tracks(path, table, frame)


def _stacked(path: Path, table: Table, names: tuple[str, ...], kind: str) -> Array:
    missing = [name for name in names if name not in table.numbers]
    if missing:
        raise RecordingError(f"{path}: {kind} need the columns {', '.join(missing)}, which are missing")
    return np.stack([table.numbers[name] for name in names], axis=1)


def _states(path: Path, table: Table, frame: Frame, turn: bool) -> Recordings:
    world = np.hstack(
        [
            frame.positions(_stacked(path, table, POSITION, "states")),
            frame.velocities(_stacked(path, table, VELOCITY, "states")),
            frame.spins(_stacked(path, table, SPIN, "states")),
        ]
    )
    check_state_axes(path, frame, world)
    ids = table.texts.get("id", [f"{path.stem}/{k}" for k in range(table.rows)])
    labels = table.texts.get("label", [frame.label] * table.rows)
    players = table.texts.get("player", [frame.player] * table.rows)
    dropped: Counter[str] = Counter()
    states = checked_states(ids, world, labels, dropped, turn, players, frame.velocity_delay)
    return Recordings(str(path), (), states, dict(dropped))


def _tracks(path: Path, table: Table, frame: Frame) -> Recordings:
    positions = frame.positions(_stacked(path, table, POSITION, "tracks"))
    times = table.numbers.get("t")
    if times is None and frame.step == 0.0:
        raise RecordingError(f"{path}: no column t, and no rate_hz in {sidecar_of(path).name}")
    ids = table.texts.get("id", [path.stem] * table.rows)
    labels = table.texts.get("label", [frame.label] * table.rows)
    players = table.texts.get("player", [frame.player] * table.rows)
    dropped: Counter[str] = Counter()
    tracks: list[Track] = []
    rows_of: dict[str, list[int]] = {}
    for row, name in enumerate(ids):
        rows_of.setdefault(name, []).append(row)
    wrong: list[RecordingError] = []
    for name, rows in rows_of.items():
        t = frame.step * np.arange(len(rows), dtype=np.float64) if times is None else frame.time * times[rows]
        try:
            check_units(path, frame, t, positions[rows])
        except RecordingError as error:  # a single one is dropped below, since no ball flies so
            wrong.append(error)
        tracks += checked_tracks(name, t, positions[rows], labels[rows[0]], dropped, players[rows[0]])
    if len(wrong) > MOST * len(rows_of):
        raise wrong[0]
    check_axes(path, frame, tracks)
    check_origin(path, frame, tracks)
    return Recordings(str(path), tuple(tracks), States.none(), dict(dropped))

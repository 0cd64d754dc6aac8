"""States of balls just after a stroke, as google-deepmind/competitive_robot_table_tennis publishes them (JSON).

A list of objects ``{id, pos_x, pos_y, pos_z, vel_x ... w_vel_z}`` in m, m/s and rad/s, with an optional ``player``.
A sidecar may give ``label``, ``player`` and ``velocity_delay_s``; the frame is the format's. Its frame: origin at the
centre of the table's top, x across the table (right positive), y along it, z up. The opponent stands at y > 0 and
plays towards -y, so the world's x (robot to opponent) is its y, and the world's y (to the robot's left) its -x.
"""

import json
from collections import Counter
from pathlib import Path
from typing import Final

import numpy as np

from topspin.real2sim.formats.frames import Frame, read_frame, rotation_of
from topspin.real2sim.formats.tracks import RecordingError, Recordings, States, checked_states

FRAME: Final = Frame(rotation_of(("y", "-x", "z")), np.zeros(3))
KEYS: Final = ("label", "player", "velocity_delay_s")  # of a sidecar
COLUMNS: Final = tuple(f"{what}_{axis}" for what in ("pos", "vel", "w_vel") for axis in "xyz")


def read_json(path: Path, turn: bool) -> Recordings:
    """Return the states of a file; see ``recordings.load``."""
    try:
        entries = json.loads(path.read_bytes())
    except json.JSONDecodeError as error:
        raise RecordingError(f"{path}:{error.lineno}: not readable as JSON: {error.msg}") from None
    except (ValueError, RecursionError) as error:  # no text, or numbers and nesting beyond Python's limits
        raise RecordingError(f"{path}: not readable as JSON: {error}") from None
    if not isinstance(entries, list):
        raise RecordingError(f"{path}: got a {type(entries).__name__}; allowed: a list of states")
    ids = [_id(entry, f"{path}: entry {k}") for k, entry in enumerate(entries)]
    rows = np.array([_row(entry, path) for entry in entries], np.float64).reshape(-1, 9)
    world = np.hstack(
        [FRAME.positions(rows[:, :3]), FRAME.velocities(rows[:, 3:6]), FRAME.spins(rows[:, 6:9])]
    )
    dropped: Counter[str] = Counter()
    given = read_frame(path, KEYS)
    players = [given.player if (own := entry.get("player")) is None else str(own) for entry in entries]
    labels = [given.label or path.stem] * len(ids)
    states: States = checked_states(ids, world, labels, dropped, turn, players, given.velocity_delay)
    return Recordings(str(path), (), states, dict(dropped))


def _id(entry: object, where: str) -> str:
    if not isinstance(entry, dict) or "id" not in entry:
        raise RecordingError(
            f"{where}: got {str(entry)[:60]}; allowed: an object with id, {', '.join(COLUMNS)}"
        )
    return str(entry["id"])


def _row(entry: dict[str, object], path: Path) -> list[float]:
    row: list[float] = []
    for name in COLUMNS:
        value = entry.get(name)
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise RecordingError(f"{path}: id {entry['id']}: {name}: got {value!r}; allowed: a number")
        try:
            row.append(float(value))
        except OverflowError:
            raise RecordingError(
                f"{path}: id {entry['id']}: {name}: got {str(value)[:20]}...; allowed: a float"
            ) from None
    return row

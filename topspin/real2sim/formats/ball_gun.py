"""Tracks of a ball gun, as intelligent-soft-robots/ball_prediction publishes them (HDF5): the only user of h5py.

``originals/<i>/{time_stamps (n,) [s], positions (n, 3) [m]}``. Its frame: x along the table away from the gun, y
across, z up from the floor. The gun stands at the table's end and shoots along the middle, so the world's frame
is turned by half a turn about z. The files don't give the table's position. These assumptions put every
recorded bounce on it:

* Height of the top: the ball's centre bounces at z = 0.759, so the top lies one ball radius below.
* The gun's x = 0 is the end of the table: the balls bounce at 1.9 to 2.6 of its 2.74 m.
* y = 0 is the table's middle: the balls stay within 0.11 m of it.

The published velocities are quotients of neighbouring samples and are not read. A sidecar may give ``label`` and
``player``; the frame is the format's.
"""

from collections import Counter
from pathlib import Path
from typing import Any, Final

import numpy as np

from common.physics.constants import BALL_RADIUS, TABLE_HALF_LENGTH
from topspin.real2sim.formats.frames import Frame, read_frame, rotation_of
from topspin.real2sim.formats.tracks import RecordingError, Recordings, States, Track, checked_tracks

BOUNCE_HEIGHT: Final = 0.759  # m; of the ball's centre, in the files' frame
FRAME: Final = Frame(
    rotation_of(("-x", "-y", "z")), np.array([TABLE_HALF_LENGTH, 0.0, BOUNCE_HEIGHT - BALL_RADIUS])
)
KEYS: Final = ("label", "player")  # of a sidecar
LABELS: Final = ("topspin", "backspin", "no_spin", "sidespin")
_GROUP: Final = "originals"


def read_hdf5(path: Path) -> Recordings:
    """Return the tracks of a file; see ``recordings.load``. Their label is the kind of spin in the file's name."""
    try:
        import h5py  # noqa: PLC0415 - an extra that other formats do not need
    except ImportError:
        raise RecordingError(f"{path}: HDF5 needs h5py: pip install -e '.[real2sim]'") from None
    given = read_frame(path, KEYS)
    label = given.label or next((known for known in LABELS if known in path.stem), "")
    dropped: Counter[str] = Counter()
    tracks: list[Track] = []
    try:
        with h5py.File(path, "r") as file:
            if not isinstance(file.get(_GROUP), h5py.Group):
                raise RecordingError(f"{path}: no group {_GROUP!r}; there are {', '.join(file) or 'none'}")
            group = file[_GROUP]
            for name in sorted(group, key=lambda key: (len(key), key)):
                times = _dataset(group[name], "time_stamps", f"{path}: {_GROUP}/{name}")
                positions = _dataset(group[name], "positions", f"{path}: {_GROUP}/{name}")
                if times.ndim != 1 or positions.shape != (len(times), 3):
                    raise RecordingError(
                        f"{path}: {_GROUP}/{name}: got times {times.shape} and positions {positions.shape}; "
                        "allowed: (n,) and (n, 3)"
                    )
                mapped = FRAME.positions(positions)
                tracks += checked_tracks(f"{path.stem}/{name}", times, mapped, label, dropped, given.player)
    except (OSError, KeyError, RuntimeError, TypeError) as error:  # h5py's, where bytes are damaged
        raise RecordingError(f"{path}: not readable as HDF5: {error}") from None
    return Recordings(str(path), tuple(tracks), States.none(), dict(dropped))


def _dataset(group: Any, name: str, where: str) -> Any:
    if not hasattr(group, "keys") or name not in group:
        found = ", ".join(group) if hasattr(group, "keys") else "no group"
        raise RecordingError(f"{where}: {name!r} is missing; there are: {found or 'none'}")
    try:
        return np.asarray(group[name][()], np.float64)
    except (TypeError, ValueError):
        raise RecordingError(f"{where}: {name!r}: got no numbers") from None

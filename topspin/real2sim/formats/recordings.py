"""Reading recordings of real balls: one function, three formats (docs/real2sim.md)."""

from pathlib import Path

from topspin.real2sim.formats.ball_gun import read_hdf5
from topspin.real2sim.formats.csv_tables import read_csv
from topspin.real2sim.formats.deepmind import read_json
from topspin.real2sim.formats.tracks import RecordingError, Recordings, require_some

SUFFIXES = (".json", ".hdf5", ".h5", ".csv", ".txt")


def load(path: Path, *, turn: bool = False) -> Recordings:
    """Return the recordings in a file, in the world frame and SI.

    Args:
        path: ``.json`` (states by DeepMind), ``.hdf5`` or ``.h5`` (tracks of a ball gun), ``.csv`` or ``.txt``
            (tracks or states, with a TOML file beside it for frame and units).
        turn: Turn states that fly towards the opponent by half a turn, instead of dropping them.

    Raises:
        RecordingError: The file can't be read, or nothing in it is usable.
    """
    if not path.is_file():
        raise RecordingError(f"{path}: no such file")
    if path.stat().st_size == 0:
        raise RecordingError(f"{path}: got an empty file; allowed: recordings")
    try:
        return require_some(_read(path, turn))
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror or error}") from None


def _read(path: Path, turn: bool) -> Recordings:
    suffix = path.suffix.lower()
    if suffix == ".json":
        return read_json(path, turn)
    if suffix in (".hdf5", ".h5"):
        return read_hdf5(path)
    if suffix in (".csv", ".txt"):
        return read_csv(path, turn)
    raise RecordingError(f"{path}: got a {suffix or 'nameless'} file; allowed: {', '.join(SUFFIXES)}")


def load_folder(
    folder: Path, pattern: str = "*", *, turn: bool = False, skipped: dict[str, str] | None = None
) -> tuple[Recordings, ...]:
    """Return the recordings of every file in a folder that matches ``pattern`` and has a known suffix, by name.

    Args:
        folder: The folder.
        pattern: Which files.
        turn: As for ``load``.
        skipped: Files that can't be used are left out, and their names and errors are written here. None: such a file
            raises its error.

    Raises:
        RecordingError: There is no folder or no file, or no file can be used.
    """
    if not folder.is_dir():
        raise RecordingError(f"{folder}: no such folder")
    paths = sorted(path for path in folder.glob(pattern) if path.suffix.lower() in SUFFIXES)
    if not paths:
        raise RecordingError(
            f"{folder}: no recordings; allowed: files {pattern} ending in {', '.join(SUFFIXES)}"
        )
    found = list[Recordings]()
    for path in paths:
        try:
            found.append(load(path, turn=turn))
        except RecordingError as error:
            if skipped is None:
                raise
            skipped[path.name] = str(error)
    if not found and skipped:
        first = next(iter(skipped.values()))
        raise RecordingError(f"{folder}: none of {len(paths)} files can be used; the first: {first}")
    return tuple(found)

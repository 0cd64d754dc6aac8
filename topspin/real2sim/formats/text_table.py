"""Tables of text as named columns of numbers: encoding, delimiter, decimal comma, header, units and vector cells.

The first line names the columns, in any case and order, unless the sidecar does (``columns``); other columns are
ignored, and so is ``frame`` beside a time. The delimiter is the one of ``;``, tab, ``,`` and space that the first line
has. Lines that are empty or start with ``#`` are skipped; but where the first line has numbers, a comment before it
with as many names is the header, as ``numpy.savetxt`` writes it. An empty cell, ``nan``, ``NA``, ``null`` or ``inf`` is
a missing value; any other text that is no number is an error. A name may have a unit, as in ``x [mm]``. A cell such as
``[1.2 0.1 0.25]`` holds three columns.
"""

import csv
import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from topspin.real2sim.formats.frames import LENGTH_UNITS, SPIN_UNITS, TIME_UNITS, Frame
from topspin.real2sim.formats.tracks import RecordingError

Array = npt.NDArray[np.float64]
Lines = list[tuple[int, str]]

DELIMITERS: Final = (";", "\t", ",", " ")
# What a name of a vector begins with; an axis follows, as in ``vel_x``, ``vel.x`` or ``vx``
VECTORS: Final = {
    "": ("", "p", "pos", "position", "point", "ball", "ball_pos", "ball_position", "pose_position"),
    "v": ("v", "vel", "velocity", "ball_vel", "ball_velocity", "twist_linear"),
    "w": ("w", "w_vel", "spin", "omega", "ball_spin", "angular_velocity", "twist_angular"),
}
COUNTER: Final = "frame"  # a time where the table has no other
NAMES: Final = {
    "t": ("t", "time", "timestamp", "timestamps", "time_stamp", "time_s", COUNTER, "stamp", "header_stamp"),
    "id": ("id", "track", "recording", "name"),
    "label": ("label", "type"),
    "player": ("player", "opponent"),
    **{
        f"{vector}{axis}": tuple(
            name for stem in stems for name in ({f"{stem}{axis}", f"{stem}_{axis}"} if stem else {axis})
        )
        for vector, stems in VECTORS.items()
        for axis in "xyz"
    },
}
TEXTS: Final = ("id", "label", "player")
POSITION: Final = ("x", "y", "z")
VELOCITY: Final = ("vx", "vy", "vz")
SPIN: Final = ("wx", "wy", "wz")
HEADERS: Final = {3: "x;y;z", 4: "t;x;y;z", 9: "x;y;z;vx;vy;vz;wx;wy;wz"}  # by the number of columns

_UNIT: Final = re.compile(r"^(.*?)\s*[\[(]\s*(.*?)\s*[\])]$")
_NUMBER: Final = re.compile(r"[+-]?((\d+([.,]\d*)?|[.,]\d+)(e[+-]?\d+)?|nan|inf(inity)?)", re.IGNORECASE)
_MISSING: Final = ("", "na", "n/a", "null", "none", "-")
_VECTOR: Final = re.compile(r"^[\[(]\s*(.*?)\s*[\])]$")


@dataclass(frozen=True, slots=True)
class Table:
    """A parsed file: known columns by the first of ``NAMES``, as many rows each, in the frame's units."""

    numbers: dict[str, Array]
    texts: dict[str, list[str]]
    rows: int


def read_table(path: Path, frame: Frame) -> Table:
    """Return the known columns of a text file.

    Args:
        path: The file.
        frame: Its sidecar: names of the columns, and the units to which those of the header are converted.

    Raises:
        RecordingError: The file is no such table.
    """
    try:
        return _read(path, frame)
    except csv.Error as error:
        raise RecordingError(f"{path}: not readable as a table: {error}") from None


def _read(path: Path, frame: Frame) -> Table:
    lines = decoded(path).splitlines()
    content = [
        (n, line) for n, line in enumerate(lines, 1) if line.strip() and not line.lstrip().startswith("#")
    ]
    if not content:
        raise RecordingError(
            f"{path}: got an empty file; allowed: a line of column names and lines of numbers"
        )
    delimiter = next((mark for mark in DELIMITERS if mark in content[0][1].strip()), ",")
    comments = [line for line in lines[: content[0][0] - 1] if line.strip()]
    names, body = _header(path, frame, content, delimiter, comments)
    rows = [(n, _cells(line, delimiter)) for n, line in body]
    for n, cells in rows:
        if len(cells) != len(names):
            raise RecordingError(
                f"{path}:{n}: got {len(cells)} columns; allowed: {len(names)} as in the header"
                + (" (decimal commas need ; between columns)" if len(cells) == 2 * len(names) else "")
            )
    names, rows = _without_vectors(path, names, rows)
    return _table(path, frame, names, rows, f"{path}:{content[0][0]}")


def decoded(path: Path) -> str:
    """Return the text of a file: UTF-8, or UTF-16 with a byte order mark; raises RecordingError for any other."""
    raw = path.read_bytes()
    encoding = "utf-16" if raw[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
    try:
        text = raw.decode(encoding)
    except UnicodeDecodeError as error:
        raise RecordingError(f"{path}: not readable as text ({error}); allowed: UTF-8 or UTF-16") from None
    if "\0" in text:
        raise RecordingError(
            f"{path}: not readable as text (zero bytes); allowed: UTF-8, or UTF-16 with a mark"
        )
    return text


def _cells(line: str, delimiter: str) -> list[str]:
    if delimiter == " ":
        return line.split()
    (cells,) = csv.reader([line], delimiter=delimiter, skipinitialspace=True)
    return [cell.strip() for cell in cells]


def _header(
    path: Path, frame: Frame, content: Lines, delimiter: str, comments: list[str]
) -> tuple[list[str], Lines]:
    """Return the columns' names, by the sidecar, the first line or the comment before it, and the lines after them."""
    first = _cells(content[0][1], delimiter)
    is_header = not all(_NUMBER.fullmatch(cell) for cell in first if cell.lower() not in _MISSING)
    if frame.columns:
        return list(frame.columns), content[1:] if is_header else content
    if is_header:
        return first, content[1:]
    if comments and len(named := _named(comments[-1])) == len(first):
        return named, content
    header = HEADERS.get(len(first), "t;x;y;z, or the names of positions, velocities and spins")
    names = ", ".join(f'"{name}"' for name in header.split(";"))
    sidecar = path.with_suffix(".toml").name
    cure = (
        f" (or columns = [{names}] in {sidecar})" if len(first) in HEADERS else f" (or columns in {sidecar})"
    )
    raise RecordingError(
        f"{path}:{content[0][0]}: got numbers, no column names; add the first line "
        f"{header.replace(';', delimiter) if len(first) in HEADERS else header}{cure}"
    )


def _named(comment: str) -> list[str]:
    """Return the columns that a comment names; none where it is no header. Its delimiter may differ from the rows'."""
    text = comment.strip().lstrip("#").strip()
    names = _cells(text, next((mark for mark in DELIMITERS if mark in text), ","))
    known = {alias for aliases in NAMES.values() for alias in aliases}
    return names if any(_bare(name)[0] in known for name in names) else []


def _without_vectors(
    path: Path, names: list[str], rows: list[tuple[int, list[str]]]
) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """Return names and cells with three columns in place of each column of vectors."""
    vectors = [
        column
        for column, name in enumerate(names)
        if rows and _VECTOR.match(rows[0][1][column]) and _vector_of(name) is not None
    ]
    if not vectors:
        return names, rows
    split_names: list[str] = []
    for column, name in enumerate(names):
        split_names += [f"{_vector_of(name)}{axis}" for axis in "xyz"] if column in vectors else [name]
    found: list[tuple[int, list[str]]] = []
    for n, cells in rows:
        split: list[str] = []
        for column, cell in enumerate(cells):
            if column not in vectors:
                split.append(cell)
                continue
            inside = _VECTOR.match(cell)
            parts = re.split(r"[\s,]+", inside.group(1)) if inside else []
            if len(parts) != 3:
                raise RecordingError(
                    f"{path}:{n}: {names[column]}: got {cell!r}; allowed: three numbers such as [1.2 0.1 0.25], "
                    f"or the columns {', '.join(f'{_vector_of(names[column])}{axis}' for axis in 'xyz')}"
                )
            split += parts
        found.append((n, split))
    return split_names, found


def _vector_of(name: str) -> str | None:
    """Return the key of VECTORS that a column of vectors is; None if it is none."""
    bare = _bare(name)[0]
    return next((vector for vector, stems in VECTORS.items() if bare and bare in stems), None)


def _bare(name: str) -> tuple[str, str]:
    """Return a column's name in lower case with underscores, and its unit; an empty unit if it has none."""
    with_unit = _UNIT.match(name.strip())
    bare, unit = with_unit.groups() if with_unit else (name, "")
    return re.sub(r"[.\s/]+", "_", bare.strip().lower()), unit


def _columns(names: list[str], where: str) -> dict[str, int]:
    """Return where each known column stands; raises RecordingError if a name appears twice or there is no position."""
    columns: dict[str, int] = {}
    bare = [_bare(name)[0] for name in names]
    has_time = any(name in NAMES["t"] and name != COUNTER for name in bare)
    for column, name in enumerate(names):
        if bare[column] == COUNTER and has_time:
            continue
        for known, aliases in NAMES.items():
            if bare[column] in aliases:
                if known in columns:
                    raise RecordingError(
                        f"{where}: {names[columns[known]]!r} and {name!r} are the same column"
                    )
                columns[known] = column
    missing = [axis for axis in POSITION if axis not in columns]
    if missing:
        raise RecordingError(
            f"{where}: no column {', '.join(missing)}; got {', '.join(names)}; allowed: t;x;y;z, or positions, "
            "velocities and spins"
        )
    return columns


def _table(
    path: Path, frame: Frame, names: list[str], rows: list[tuple[int, list[str]]], header: str
) -> Table:
    columns = _columns(names, header)
    cells = {name: [row[column] for _, row in rows] for name, column in columns.items()}
    numeric = [name for name in columns if name not in TEXTS]
    # one file has one decimal mark: 1,198 beside 0.5 is no number
    has_points = any("." in cell for name in numeric for cell in cells[name])
    numbers: dict[str, Array] = {}
    for name in numeric:
        raw = names[columns[name]]
        factor = _factor(name, _bare(raw)[1], frame, f"{header}: {raw}")
        values = [
            _number(cell, has_points, f"{path}:{n}: {raw}")
            for (n, _), cell in zip(rows, cells[name], strict=True)
        ]
        numbers[name] = factor * np.array(values, np.float64)
    texts: dict[str, list[str]] = {name: cells[name] for name in TEXTS if name in columns}
    for name in texts.keys() - {"id"}:  # nobody is a player called nan
        texts[name] = ["" if cell.lower() in (*_MISSING, "nan") else cell for cell in texts[name]]
    return Table(numbers, texts, len(rows))


def _factor(name: str, unit: str, frame: Frame, where: str) -> float:
    """Return the header's unit of a column in the frame's unit; 1 without a unit in the header."""
    if not unit:
        return 1.0
    if name == "t":
        units, frames = dict(TIME_UNITS), frame.time
    elif name in POSITION:
        units, frames = dict(LENGTH_UNITS), frame.length
    elif name in VELOCITY:
        units, frames = {f"{length}/s": size for length, size in LENGTH_UNITS.items()}, frame.length
    else:
        units, frames = dict(SPIN_UNITS), frame.spin
    if unit not in units:
        raise RecordingError(f"{where}: got the unit {unit!r}; allowed: {', '.join(units)}")
    return units[unit] / frames


def _number(cell: str, has_points: bool, where: str) -> float:
    """Return a cell's number; nan for one that is missing or infinite."""
    if cell.lower() in _MISSING:
        return math.nan
    if not _NUMBER.fullmatch(cell) or ("," in cell and has_points):
        raise RecordingError(f"{where}: got {cell!r}; allowed: a number")
    value = float(cell.replace(",", "."))
    return value if math.isfinite(value) else math.nan

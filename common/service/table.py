"""A run's CSV tables: a row at a time, read while they are written, and after people have had them in other programs.

All values are numbers, or empty. A full disk costs no row: rows wait until they can be written.
"""

import csv
import io
import logging
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from common.service.whole_file import write_whole

log = logging.getLogger(__name__)

_REFUSED: Final = "refused: no row of numbers, one for each column"


@dataclass(frozen=True, slots=True)
class Content:
    """What a table's file holds."""

    columns: tuple[str, ...]
    rows: tuple[dict[str, str], ...]
    refused: tuple[tuple[int, str], ...]  # number and text of each line that is no row
    lines: int  # of the file
    is_plain: bool  # whether the file is as `Table` writes it, to the end of its last line


def parse(text: str) -> Content:
    """Return a table's content; blank lines, a byte order mark, semicolons and decimal commas are understood."""
    lines = text.removeprefix("\ufeff").splitlines(keepends=True)
    if not lines:
        return Content((), (), (), 0, is_plain=True)
    mark = ";" if ";" in lines[0] and "," not in lines[0] else ","
    columns = tuple(name.strip() for name in lines[0].strip().split(mark))
    rows: list[dict[str, str]] = []
    refused: list[tuple[int, str]] = []
    for number, line in enumerate(lines[1:], 2):
        if not line.strip():
            continue
        values = line.strip().split(mark)
        if mark == ";":
            values = [value.replace(",", ".") for value in values]
        is_last_half = number == len(lines) and not line.endswith("\n")
        if not is_last_half and len(values) == len(columns) and all(map(_is_value, values)):
            rows.append(dict(zip(columns, values, strict=True)))
        else:
            refused.append((number, line.rstrip("\r\n")))
    is_plain = mark == "," and not text.startswith("\ufeff") and not refused and text.endswith("\n")
    return Content(columns, tuple(rows), tuple(refused), len(lines), is_plain)


def _is_value(text: str) -> bool:
    try:
        return text == "" or not math.isnan(float(text)) or text.lower().endswith("nan")
    except ValueError:
        return False


def read(file: Path) -> Content:
    """Return the content of a table's file; empty where there is none."""
    return parse(file.read_text(encoding="utf-8", errors="replace")) if file.is_file() else parse("")


def whole_rows(file: Path) -> list[dict[str, str]]:
    """Return the rows of a run's CSV file, by column; none where there is no file.

    The last line is left out where it is incomplete: it is being written, or its writer was killed. Another line that
    is no row is named in the log.
    """
    content = read(file)
    for number, line in content.refused:
        if number < content.lines:
            log.warning("%s file=%s line=%d text=%.60r", _REFUSED, file, number, line)
    return list(content.rows)


def rewrite(file: Path, columns: Sequence[str], rows: Sequence[Mapping[str, Any]]) -> None:
    """Replace a table's file in one step."""
    write_whole(file, _text(columns, rows, header=True))


def set_aside(file: Path, refused: Sequence[tuple[int, str]]) -> None:
    """Add lines that are no rows to a file beside the table, and log each: nothing is dropped in silence."""
    if not refused:
        return
    beside = file.with_suffix(".refused.csv")
    with beside.open("a", encoding="utf-8") as out:
        out.writelines(f"{line}\n" for _, line in refused)
    for number, line in refused:
        log.warning("%s file=%s line=%d text=%.60r kept_in=%s", _REFUSED, file, number, line, beside)


def _text(columns: Sequence[str], rows: Sequence[Mapping[str, Any]], header: bool) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, fieldnames=columns, extrasaction="ignore", lineterminator="\n")
    if header:
        writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


class Table:
    """Rows that are written one by one.

    Args:
        file: The CSV file; an existing one is continued. Where its columns are others, such as those of an earlier
            release, it is rewritten with both.
        columns: Names of the columns; other values of a row are left out.
    """

    def __init__(self, file: Path, columns: Sequence[str]) -> None:
        self._file, self._columns = file, tuple(columns)
        self._waiting: list[Mapping[str, Any]] = []
        self._is_ours = False  # the file has our columns, and ends with a whole line

    @property
    def waiting(self) -> int:
        """Number of rows that could not be written yet."""
        return len(self._waiting)

    def append(self, row: Mapping[str, Any]) -> None:
        """Write a row, and those that wait. Where that fails, all of them wait; it is logged once."""
        self._waiting.append(row)
        try:
            if not self._is_ours:
                self._adopt()
                self._is_ours = True
            self._write()
        except OSError as error:
            if len(self._waiting) == 1:
                log.error("can't write file=%s reason=%s; its rows wait", self._file, error.strerror)
            return
        if len(self._waiting) > 1:
            log.info("file=%s is written again rows=%d", self._file, len(self._waiting))
        self._waiting.clear()

    def _adopt(self) -> None:
        """Give an existing file our columns; those that only it has come last and stay."""
        found = read(self._file)
        own = tuple(name for name in found.columns if name not in self._columns)
        columns = (*self._columns, *own)
        if found.columns and (found.columns != columns or not found.is_plain):
            set_aside(self._file, found.refused)
            rewrite(self._file, columns, found.rows)
        if found.columns:
            self._columns = columns

    def _write(self) -> None:
        size = self._file.stat().st_size if self._file.exists() else 0
        text = _text(self._columns, self._waiting, header=size == 0)
        try:
            with self._file.open("a", encoding="utf-8", newline="") as file:
                file.write(text)
        except OSError:
            if self._file.exists():
                os.truncate(self._file, size)  # no part of a row stays
            raise

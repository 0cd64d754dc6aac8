"""A CSV file that gets a row at a time. A full disk costs no row: rows wait until they can be written."""

import csv
import io
import logging
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

log = logging.getLogger(__name__)


class Table:
    """Rows that are written one by one.

    Args:
        file: The CSV file; an existing one is continued.
        columns: Names of the columns; other values of a row are left out.
    """

    def __init__(self, file: Path, columns: Sequence[str]) -> None:
        self._file, self._columns = file, tuple(columns)
        self._waiting: list[Mapping[str, Any]] = []

    @property
    def waiting(self) -> int:
        """Number of rows that could not be written yet."""
        return len(self._waiting)

    def append(self, row: Mapping[str, Any]) -> None:
        """Write a row, and those that wait. Where that fails, all of them wait; it is logged once."""
        self._waiting.append(row)
        try:
            self._write()
        except OSError as error:
            if len(self._waiting) == 1:
                log.error("can't write file=%s reason=%s; its rows wait", self._file, error.strerror)
            return
        if len(self._waiting) > 1:
            log.info("file=%s is written again rows=%d", self._file, len(self._waiting))
        self._waiting.clear()

    def _write(self) -> None:
        size = self._file.stat().st_size if self._file.exists() else 0
        text = io.StringIO()
        writer = csv.DictWriter(text, fieldnames=self._columns, extrasaction="ignore")
        if size == 0:
            writer.writeheader()
        writer.writerows(self._waiting)
        try:
            with self._file.open("a", newline="") as file:
                file.write(text.getvalue())
        except OSError:
            if self._file.exists():
                os.truncate(self._file, size)  # no part of a row stays
            raise

"""A history as it grows: each look reads only what is new."""

import json
from pathlib import Path
from typing import Any


class Tail:
    """The events of one service's history so far.

    Args:
        file: The history; it may not be there yet.
    """

    def __init__(self, file: Path) -> None:
        self._file, self._at = file, 0
        self._events: list[dict[str, Any]] = []

    def events(self) -> list[dict[str, Any]]:
        """Return all events, in order; a line without its end is being written, and left for the next look."""
        if self._file.exists():
            with self._file.open("rb") as source:
                source.seek(self._at)
                whole, _, _ = source.read().rpartition(b"\n")
            if whole:
                self._events += [json.loads(line) for line in whole.split(b"\n")]
                self._at += len(whole) + 1
        return self._events

"""A history: what a service did with each rollout, a line for each event, written as it happens.

Each line is a JSON object: `event`, `t` [s on the machine's monotonic clock, the same for all its processes], and the
event's own values. Every line is one write, so a process that is killed leaves whole lines. Lines that a full disk does
not take wait in memory. Actor and learner each write their own history, and neither reads the other's:
`benchmarks.chaos.check` compares them.
"""

import json
import logging
import os
import time
from pathlib import Path
from typing import Any, Final

from common.errors import ReportedError

log = logging.getLogger(__name__)

MOST_WAITING: Final = 2**24  # [byte] of lines that the disk does not take


class History:
    """One service's file.

    Args:
        folder: Where it is, as FOLDER/NAME.jsonl; empty: nothing is written.
        name: Of the service, such as actor-0. Its later lives add to the same file.
    """

    def __init__(self, folder: str, name: str) -> None:
        self._file = -1
        self._waiting, self._is_refused = b"", False
        if not folder:
            return
        self._path = Path(folder) / f"{name}.jsonl"
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._file = os.open(self._path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o644)
        except OSError as error:
            raise ReportedError(f"can't write the history {self._path}: {error.strerror}") from None

    def note(self, event: str, **values: Any) -> None:
        """Write an event with its values, which JSON can hold."""
        if self._file < 0:
            return
        line = json.dumps({"event": event, "t": round(time.monotonic(), 4), **values})
        self._write(self._waiting + line.encode() + b"\n")

    def close(self) -> None:
        """Close the file."""
        if self._file >= 0:
            if self._waiting:
                self._write(self._waiting)
            os.close(self._file)
            self._file = -1

    def _write(self, lines: bytes) -> None:
        try:
            self._waiting = lines[os.write(self._file, lines) :]
            self._is_refused = False
        except OSError as error:
            self._waiting = lines
            if not self._is_refused:
                self._is_refused = True
                log.warning("the history waits for its disk file=%s reason=%s", self._path, error.strerror)
        if len(self._waiting) > MOST_WAITING:
            log.error(
                "the history ends: its disk takes no more file=%s waiting=%d", self._path, len(self._waiting)
            )
            os.close(self._file)
            self._file = -1

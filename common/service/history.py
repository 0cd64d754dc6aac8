"""A history: what a service did with each rollout, a line for each event, written as it happens.

Each line is a JSON object: `event`, `t` [s on the machine's monotonic clock, the same for all its processes], and the
event's own values. Every line is one write, so a process that is killed leaves whole lines. Actor and learner each
write their own, and neither reads the other's: `benchmarks.chaos.check` compares them.
"""

import json
import os
import time
from pathlib import Path
from typing import Any

from common.errors import ReportedError


class History:
    """One service's file.

    Args:
        folder: Where it is, as FOLDER/NAME.jsonl; empty: nothing is written.
        name: Of the service, such as actor-0. Its later lives add to the same file.
    """

    def __init__(self, folder: str, name: str) -> None:
        self._file = -1
        if not folder:
            return
        file = Path(folder) / f"{name}.jsonl"
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            self._file = os.open(file, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o644)
        except OSError as error:
            raise ReportedError(f"can't write the history {file}: {error.strerror}") from None

    def note(self, event: str, **values: Any) -> None:
        """Write an event with its values, which JSON can hold."""
        if self._file >= 0:
            line = json.dumps({"event": event, "t": round(time.monotonic(), 4), **values})
            os.write(self._file, line.encode() + b"\n")

    def close(self) -> None:
        """Close the file."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1

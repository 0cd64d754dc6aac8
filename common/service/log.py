"""Log lines: one per change of state, ``time level logger message``, the message's fields as key=value."""

import logging
import sys
import time
from pathlib import Path
from typing import Final, TextIO

LEVELS: Final = ("debug", "info", "warning", "error")

_FORMAT: Final = "%(asctime)s.%(msecs)03dZ %(levelname)-7s {name} %(name)s %(message)s"


class _Lossy(logging.StreamHandler[TextIO]):
    """Writes lines, and leaves out those that can't be written: a full disk must not fill the log with tracebacks."""

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802 - logging's name
        """Report an error other than the machine's."""
        if not isinstance(sys.exc_info()[1], OSError):
            super().handleError(record)


class _LossyFile(_Lossy, logging.FileHandler):
    """The same, to a file."""


def set_up_logging(level: str, name: str, file: Path | None = None) -> None:
    """Send this process's log lines to stderr and ``file``, and remove earlier handlers.

    Args:
        level: One of `LEVELS`.
        name: Name of the process, such as ``actor/0``; it is in each line, since services share a terminal.
        file: If given, lines are appended to it; its folder is created.
    """
    formatter = logging.Formatter(_FORMAT.format(name=name), datefmt="%Y-%m-%dT%H:%M:%S")
    formatter.converter = time.gmtime
    handlers: list[logging.Handler] = [_Lossy(sys.stderr)]
    if file is not None:
        file.parent.mkdir(parents=True, exist_ok=True)
        handlers.append(_LossyFile(file, encoding="utf-8"))
    root = logging.getLogger()
    for old in list(root.handlers):
        root.removeHandler(old)
        old.close()
    for handler in handlers:
        handler.setFormatter(formatter)
        root.addHandler(handler)
    root.setLevel(level.upper())
    logging.captureWarnings(True)

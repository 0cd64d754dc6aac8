"""Log lines: one per change of state, ``time level logger message``, the message's fields as key=value."""

import logging
import sys
import time
from pathlib import Path
from typing import Final

LEVELS: Final = ("debug", "info", "warning", "error")

_FORMAT: Final = "%(asctime)s.%(msecs)03dZ %(levelname)-7s {name} %(name)s %(message)s"


def set_up_logging(level: str, name: str, file: Path | None = None) -> None:
    """Send this process's log lines to stderr and ``file``, and remove earlier handlers.

    Args:
        level: One of `LEVELS`.
        name: Name of the process, such as ``actor/0``; it is in each line, since services share a terminal.
        file: If given, lines are appended to it; its folder is created.
    """
    formatter = logging.Formatter(_FORMAT.format(name=name), datefmt="%Y-%m-%dT%H:%M:%S")
    formatter.converter = time.gmtime
    handlers: list[logging.Handler] = [logging.StreamHandler(sys.stderr)]
    if file is not None:
        file.parent.mkdir(parents=True, exist_ok=True)
        handlers.append(logging.FileHandler(file, encoding="utf-8"))
    root = logging.getLogger()
    for old in list(root.handlers):
        root.removeHandler(old)
        old.close()
    for handler in handlers:
        handler.setFormatter(formatter)
        root.addHandler(handler)
    root.setLevel(level.upper())
    logging.captureWarnings(True)

"""How far a long piece of work is: a bar in a terminal, else a line of the log now and then."""

import logging
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Final

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

log = logging.getLogger(__name__)

LINE_EVERY_S: Final = 10.0


def bar(doing: str, things: str) -> Progress:
    """Return a bar with the time that is left, shown in a terminal only."""
    return Progress(
        TextColumn(doing),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn(f"{things},"),
        TimeRemainingColumn(),
        TextColumn("left"),
        console=Console(stderr=True),
        transient=True,
        disable=not sys.stderr.isatty(),
    )


@contextmanager
def rallies_left(rallies: int) -> Iterator[Callable[[int], None]]:
    """Yield what ``play_match`` calls as ``on_left``."""
    progress = bar("playing", "rallies")
    next_line = time.monotonic() + LINE_EVERY_S

    def on_left(left: int) -> None:
        nonlocal next_line
        progress.update(task, completed=rallies - left)
        if progress.disable and time.monotonic() >= next_line:
            next_line = time.monotonic() + LINE_EVERY_S
            log.info("played rallies=%d of=%d", rallies - left, rallies)

    with progress:
        task = progress.add_task("", total=rallies)
        yield on_left

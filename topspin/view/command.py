"""`topspin view`: a live page in 3-D that shows the robot play."""

# ruff: noqa: PLC0415 - what a command runs on is imported after its flags are read: --help answers at once

import logging
import os
import socket
import sys
import time
from collections.abc import Sequence
from threading import Event
from typing import TYPE_CHECKING, Final

from common.errors import ReportedError
from common.service.config import load
from common.service.log import set_up_logging
from common.service.process import DONE
from common.service.run_folder import RunFolder
from topspin.view.config import ViewConfig

if TYPE_CHECKING:
    from topspin.view.page import Page

log = logging.getLogger(__name__)

PROG: Final = "topspin view"
_WAIT_S: Final = 1.0  # between two looks for a run's first policy


class ViewError(ReportedError):
    """The page can't be served: one line."""


def main(argv: Sequence[str], stop: Event) -> int:
    """Serve the page until a stop is requested; return the exit status."""
    config = load(ViewConfig, argv, prog=PROG, section="view")
    set_up_logging(config.log_level, "view")
    from topspin.report.collect import find

    run = find(config.run) if config.run else None
    port = free_port(config.host, config.port)
    if run is not None and not wait_for_policy(run, stop):
        return DONE
    with _page(config, port, run) as page:
        sys.stdout.write(f"{PROG}: open http://{config.host}:{port} (Ctrl-C ends it)\n")
        sys.stdout.flush()
        _show(page, 1.0 / config.rate_hz, stop)
    return DONE


def free_port(host: str, port: int) -> int:
    """Return the port to listen at; for 0 any free one.

    Raises:
        ViewError: The port is taken, or the address is none of this machine's.
    """
    try:
        with socket.create_server((host, port)) as server:
            return int(server.getsockname()[1])
    except OSError as error:
        # create_server adds the address to its texts; errors of names have negative numbers
        reason = os.strerror(error.errno) if error.errno and error.errno > 0 else error.strerror
        raise ViewError(
            f"can't listen at --host {host} --port {port}: {reason}; "
            "allowed: an address of this machine and a free port, or --port 0 for any free one"
        ) from None


def wait_for_policy(run: RunFolder, stop: Event) -> bool:
    """Wait for a training's first policy; return whether it is there, and not a stop."""
    from common.policy.contract import WEIGHTS_FILE

    weights = run.latest_policy / WEIGHTS_FILE
    if not weights.exists():
        sys.stdout.write(
            f"{PROG}: run {run.root.name} has no policy yet; it comes within a minute of training\n"
        )
    while not weights.exists():
        if stop.wait(_WAIT_S):
            return False
    return True


def _page(config: ViewConfig, port: int, run: RunFolder | None) -> "Page":
    try:
        from topspin.view.page import Page  # the libraries of the extra ``view``
    except ImportError as error:
        raise ViewError(
            f"the page needs {error.name}, which isn't installed; pip install -e '.[view]'"
        ) from None
    return Page(config, port, run)


def _show(page: "Page", period: float, stop: Event) -> None:
    """Show a picture every ``period`` seconds. A late picture is not made up for: the next one shows what is then."""
    last = due = time.monotonic()
    while not stop.wait(max(due - time.monotonic(), 0.0)):
        now = time.monotonic()
        page.tick(now, now - last)
        last, due = now, max(due + period, now)

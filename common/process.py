"""How a service's process is asked to stop, and ends: signals, statuses, one line per known error.

==  ==========================================================================
0   the work was done, or the service was asked to stop
1   it could not be done: the line on stderr says why
2   a setting can't be used
130 asked twice to stop: left at once
==  ==========================================================================
"""

import logging
import os
import signal
import sys
import threading
from collections.abc import Callable
from types import FrameType
from typing import Final

from common.comms.keys import KeyPartError
from common.comms.transport import TransportError
from common.config import ConfigError, HelpRequest
from common.errors import ReportedError
from common.metrics import MetricsError

log = logging.getLogger(__name__)

DONE: Final = 0
FAILED: Final = 1
BAD_CONFIG: Final = 2
INTERRUPTED: Final = 130

# What a person can do something about gets one line; anything else is a bug and keeps its traceback.
STATUS_OF_ERROR: Final[dict[type[Exception], int]] = {
    ConfigError: BAD_CONFIG,
    KeyPartError: BAD_CONFIG,
    MetricsError: FAILED,
    ReportedError: FAILED,
    TransportError: FAILED,
}

_EXIT_WITHIN_S: Final = 10.0


def run_service(prog: str, main: Callable[[threading.Event], int]) -> int:
    """Return the exit status of ``main``, which is given the event that SIGINT and SIGTERM set.

    Args:
        prog: How the program is called; starts the line of an error.
        main: The service: returns its status, raises what it can't handle.
    """
    stop = stop_on_signals()
    try:
        status = main(stop)
    except HelpRequest as request:
        sys.stdout.write(str(request))
        status = DONE
    except tuple(STATUS_OF_ERROR) as error:
        sys.stderr.write(f"{prog}: {error}\n")
        status = next(code for kind, code in STATUS_OF_ERROR.items() if isinstance(error, kind))
    except Exception:
        log.exception("stopped by a bug")
        status = FAILED
    _exit_at_the_latest(status)
    return status


def stop_on_signals() -> threading.Event:
    """Return an event that the first SIGINT or SIGTERM sets; the second leaves the process at once."""
    stop = threading.Event()

    def on_signal(number: int, _frame: FrameType | None) -> None:
        if stop.is_set():
            os._exit(INTERRUPTED)
        log.info("stopping signal=%s", signal.Signals(number).name)
        stop.set()

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, on_signal)
    return stop


def _exit_at_the_latest(status: int) -> None:
    """End the process with ``status`` even if a thread that nobody stopped would keep it."""

    def watch() -> None:
        threading.main_thread().join()
        threading.Event().wait(_EXIT_WITHIN_S)  # a clean exit ends this daemon thread before
        names = [thread.name for thread in threading.enumerate() if not thread.daemon]
        sys.stderr.write(f"left behind after {_EXIT_WITHIN_S:g} s: {', '.join(names)}\n")
        sys.stderr.flush()
        os._exit(status)

    threading.Thread(target=watch, name="exit", daemon=True).start()

"""How a service's process is asked to stop, and ends: signals, statuses, one line per known error.

==  ==========================================================================
0   the work was done, or the service was asked to stop
1   it could not be done: the line on stderr says why
2   a setting can't be used
130 told to stop by somebody who insisted (`INSISTS_AFTER_S`): left at once
==  ==========================================================================
"""

import logging
import math
import os
import signal
import sys
import threading
import time
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

INSISTS_AFTER_S: Final = {signal.SIGINT: 0.0, signal.SIGTERM: 15.0}
"""How long after the first signal another one leaves at once [s]. A person's second Ctrl-C means it. A second SIGTERM
may be an echo, which must not cut a last checkpoint short: a service manager tells every process of a group, and
deploy.local its learner once more when the workers have ended, 12 s later at most."""

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
    """Return an event that the first SIGINT or SIGTERM sets; who insists makes the process leave at once."""
    stop = threading.Event()
    first = math.inf  # [s] when it came

    def on_signal(number: int, _frame: FrameType | None) -> None:
        nonlocal first
        now = time.monotonic()
        if now - first >= INSISTS_AFTER_S[signal.Signals(number)]:
            os._exit(INTERRUPTED)
        if not stop.is_set():
            first = now
            log.info("stopping signal=%s", signal.Signals(number).name)
            stop.set()

    for number in INSISTS_AFTER_S:
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

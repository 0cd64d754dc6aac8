"""How a service's process stops and ends: signals, exit statuses, one line per known error.

==  ==========================================================================
0   the work was done, or the service stopped on request
1   it failed: the line on stderr says why
2   a setting can't be used
130 a command was stopped before it was done, or a repeated signal ended the process at once (`SECOND_SIGNAL_AFTER_S`)
==  ==========================================================================
"""

import errno
import io
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

from common.errors import ConfigError, HelpRequest, ReportedError, StoppedError

log = logging.getLogger(__name__)

DONE: Final = 0
FAILED: Final = 1
BAD_CONFIG: Final = 2
INTERRUPTED: Final = 130

# An error that a user can fix gets one line. Any other error is a bug and keeps its traceback.
STATUS_OF_ERROR: Final[dict[type[Exception], int]] = {
    ConfigError: BAD_CONFIG,
    StoppedError: INTERRUPTED,
    ReportedError: FAILED,
}

# Faults of the machine or of what a person made of it, and not of the program, also where the error names no file.
MACHINE_FAULTS: Final = frozenset(
    {
        *(
            errno.ENOSPC,
            errno.EDQUOT,
            errno.EFBIG,
            errno.EROFS,
            errno.EIO,
            errno.ESTALE,
            errno.EACCES,
            errno.EPERM,
        ),
        *(errno.ENOMEM, errno.EMFILE, errno.ENFILE, errno.EAGAIN, errno.EPIPE),
    }
)

SECOND_SIGNAL_AFTER_S: Final = {signal.SIGINT: 0.0, signal.SIGTERM: 25.0}
"""Time after the first signal from which on another one ends the process at once [s]. A second Ctrl-C is a person's
decision. A second SIGTERM may repeat the first one and must not interrupt the last checkpoint: a service manager
signals every process of a group, and deploy.local signals its learner again when the workers have ended, at most 20 s
later (``deploy.topology``)."""

_EXIT_WITHIN_S: Final = 10.0

GRAPHICS: Final = frozenset(
    {"", "egl", "osmesa", "glfw", "glx", "cgl", "wgl", "enable", "enabled", "on", "true", "1"}
    | {"disable", "disabled", "off", "false", "0"}
)
"""Values of MUJOCO_GL. MuJoCo can't be imported with another one, not even by a program that draws nothing."""


def run_service(prog: str, main: Callable[[threading.Event], int]) -> int:
    """Return the exit status of ``main``, which is given the event that SIGINT and SIGTERM set.

    Args:
        prog: How the program is called; starts the line of an error.
        main: Runs the service and returns its status; raises errors that it can't handle.
    """
    own_environment()
    stop = stop_on_signals()
    try:
        check_graphics()
        status = main(stop)
    except HelpRequest as request:
        sys.stdout.write(str(request))
        status = DONE
    except tuple(STATUS_OF_ERROR) as error:
        sys.stderr.write(f"{prog}: {error}\n")
        status = next(code for kind, code in STATUS_OF_ERROR.items() if isinstance(error, kind))
    except OSError as error:
        if error.filename is None and error.errno not in MACHINE_FAULTS:
            log.exception("stopped by a bug")
        else:
            where = f"{error.filename}: " if error.filename is not None else ""
            sys.stderr.write(f"{prog}: {where}{error.strerror or error}\n")
        status = FAILED
    except MemoryError as error:
        sys.stderr.write(f"{prog}: {str(error) or os.strerror(errno.ENOMEM)}\n")
        status = FAILED
    except Exception:
        log.exception("stopped by a bug")
        status = FAILED
    _exit_at_the_latest(status)
    return status


def own_environment() -> None:
    """Set what a person's environment sets for other programs, and what would stop or change ours."""
    os.environ["MPLBACKEND"] = "agg"  # figures go to files; a notebook's own can't be loaded here
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # an encoding without our signs


def check_graphics() -> None:
    """Raise ConfigError if MUJOCO_GL has a value with which MuJoCo can't be imported."""
    value = os.environ.get("MUJOCO_GL", "")
    if value.lower().strip() not in GRAPHICS:
        raise ConfigError(f"MUJOCO_GL = {value!r}; allowed: egl, osmesa, glfw, disable, or unset")


def stop_on_signals() -> threading.Event:
    """Return an event that the first SIGINT or SIGTERM sets; a repeated signal ends the process at once."""
    stop = threading.Event()
    first = math.inf  # [s] time of the first signal

    def on_signal(number: int, _frame: FrameType | None) -> None:
        nonlocal first
        now = time.monotonic()
        if now - first >= SECOND_SIGNAL_AFTER_S[signal.Signals(number)]:
            os._exit(INTERRUPTED)
        if not stop.is_set():
            first = now
            log.info("stopping signal=%s", signal.Signals(number).name)
            stop.set()

    for number in SECOND_SIGNAL_AFTER_S:
        signal.signal(number, on_signal)
    return stop


def _exit_at_the_latest(status: int) -> None:
    """End the process with ``status`` even if a thread that was not stopped keeps it alive."""

    def watch() -> None:
        threading.main_thread().join()
        threading.Event().wait(_EXIT_WITHIN_S)  # a clean exit ends this daemon thread before
        names = [thread.name for thread in threading.enumerate() if not thread.daemon]
        sys.stderr.write(f"left behind after {_EXIT_WITHIN_S:g} s: {', '.join(names)}\n")
        sys.stderr.flush()
        os._exit(status)

    threading.Thread(target=watch, name="exit", daemon=True).start()

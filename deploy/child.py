"""`python -m deploy.child MODULE [flags]`: run a service that ends when its parent process ends.

Its standard input is a pipe that the parent holds open. When the parent ends, also after a crash, the pipe closes. The
service then gets SIGTERM, and is ended if it does not stop. So no process of a run stays alive.

`python -m deploy.child --spare MODULE` imports the slow modules and waits. A line in the pipe (`Assignment`) then says
which process it replaces. So a killed actor plays again as soon as its environments are ready.
"""

import importlib
import json
import os
import runpy
import signal
import sys
import threading
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

PATIENCE_S: Final = 10.0
SPARE: Final = "--spare"


@dataclass(frozen=True, slots=True)
class Assignment:
    """The process that a spare one replaces."""

    log: str  # file for its output
    arguments: tuple[str, ...]  # flags of the service

    def to_line(self) -> bytes:
        """Return the line for the pipe."""
        return json.dumps(asdict(self)).encode() + b"\n"

    @classmethod
    def from_line(cls, line: bytes) -> "Assignment":
        """Return what `to_line` gave."""
        values = json.loads(line)
        return cls(values["log"], tuple(values["arguments"]))


def follow_parent() -> None:
    """End this process when its standard input ends."""

    def watch() -> None:
        while os.read(0, 1024):
            pass
        os.kill(os.getpid(), signal.SIGTERM)
        threading.Event().wait(PATIENCE_S)
        os._exit(128 + signal.SIGTERM)

    threading.Thread(target=watch, name="parent", daemon=True).start()


def wait_for_assignment(module: str) -> Assignment:
    """Wait for an assignment and return it; end this process if the parent ends before."""
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    importlib.import_module(f"{module}.service")
    line = b""
    while not line.endswith(b"\n"):
        byte = os.read(0, 1)  # no buffer: `follow_parent` reads on
        if not byte:
            sys.exit(0)
        line += byte
    return Assignment.from_line(line)


def main() -> None:
    """Run the module named first with the flags that follow, as `python -m` would."""
    module, arguments = sys.argv[1], tuple(sys.argv[2:])
    if module == SPARE:
        module = arguments[0]
        place = wait_for_assignment(module)
        arguments = place.arguments
        log = os.open(place.log, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
        for output in (1, 2):
            os.dup2(log, output)
    with suppress(OSError):  # Linux only: the name in top
        Path("/proc/self/comm").write_text(f"topspin {module.rpartition('.')[2]}"[:15])
    sys.argv = [module, *arguments]
    follow_parent()
    runpy.run_module(module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()

"""Starting, watching, restarting and stopping the processes of a run."""

import logging
import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

log = logging.getLogger(__name__)

RESTART_PAUSE_S = 0.5  # a process that dies at once is not restarted in a busy loop ...
RESTART_PAUSE_MAX_S = 30.0  # ... and ever more rarely
STABLE_S = 20.0  # a process that lived this long starts over with the short pause


@dataclass(frozen=True, slots=True)
class Spec:
    """A process to keep."""

    name: str  # of its log: actor-0
    role: str
    arguments: tuple[str, ...]  # after python -m
    restart: bool  # whether it comes back when it dies


def restart_pause(deaths: int) -> float:
    """Return how long to wait before a process that died ``deaths`` times in a row is started again [s]."""
    return min(RESTART_PAUSE_S * 2.0 ** max(deaths - 1, 0), RESTART_PAUSE_MAX_S)


@dataclass(slots=True)
class Child:
    """A kept process, as it stands."""

    spec: Spec
    process: subprocess.Popen[bytes]
    started: float
    restarts: int = 0
    deaths_in_a_row: int = 0
    restart_at: float | None = None
    exits: list[int] = field(default_factory=list)


class Family:
    """The processes of a run. ``watch`` must be called again and again.

    Args:
        specs: What to keep.
        logs: Folder of one log file each.
    """

    def __init__(self, specs: list[Spec], logs: Path) -> None:
        self._logs = logs
        self.children = {spec.name: Child(spec, self._start(spec), time.monotonic()) for spec in specs}

    def _start(self, spec: Spec) -> subprocess.Popen[bytes]:
        with (self._logs / f"{spec.name}.log").open("ab") as log_file:
            # One thread each: with more, numerics libraries on every process fight for the same cores.
            environment = os.environ | {
                "OMP_NUM_THREADS": "1",
                "OPENBLAS_NUM_THREADS": "1",
                "MKL_NUM_THREADS": "1",
            }
            return subprocess.Popen(
                [sys.executable, "-m", *spec.arguments],
                stdin=subprocess.DEVNULL,
                stdout=log_file,
                stderr=subprocess.STDOUT,
                env=environment,
                start_new_session=True,  # a Ctrl-C in the terminal is ours to pass on, in order
            )

    def watch(self, now: float) -> None:
        """Note who died, and start again who is to be kept."""
        for child in self.children.values():
            status = child.process.poll()
            if status is None:
                continue
            if child.restart_at is None and len(child.exits) == child.restarts:
                child.exits.append(status)
                if not child.spec.restart:
                    continue
                child.deaths_in_a_row = 1 if now - child.started > STABLE_S else child.deaths_in_a_row + 1
                child.restart_at = now + restart_pause(child.deaths_in_a_row)
                log.warning(
                    "process died name=%s pid=%d status=%d; starting it again",
                    child.spec.name,
                    child.process.pid,
                    status,
                )
            if child.restart_at is not None and now >= child.restart_at:
                child.process = self._start(child.spec)
                child.started, child.restart_at = now, None
                child.restarts += 1

    def status_of(self, name: str) -> int | None:
        """Return a process's exit status, or None while it runs."""
        return self.children[name].process.poll()

    def stop(self, names: list[str], patience_s: float) -> None:
        """Ask processes to end, and end those that don't."""
        running = [
            self.children[name].process for name in names if self.children[name].process.poll() is None
        ]
        for process in running:
            process.send_signal(signal.SIGTERM)
        deadline = time.monotonic() + patience_s
        for process in running:
            try:
                process.wait(max(0.0, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                log.warning("process pid=%d did not end within %.0f s and is killed", process.pid, patience_s)
                process.kill()
                process.wait()

    def names(self, role: str) -> list[str]:
        """Return the names of all processes of a role."""
        return [name for name, child in self.children.items() if child.spec.role == role]

"""Starting, watching, restarting and stopping the processes of a run."""

import logging
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from common.config import ENVIRONMENT_PREFIX
from common.process import BAD_CONFIG
from deploy.child import SPARE, Assignment

log = logging.getLogger(__name__)

RESTART_PAUSE_S = 0.5  # a process that dies at once is not restarted in a busy loop ...
RESTART_PAUSE_MAX_S = 30.0  # ... and ever more rarely
STABLE_S = 20.0  # a process that lived this long starts over with the short pause
SPARE_AFTER_S = 10.0  # once a run has started up, one process waits to take the place of one that dies
SPARE_ROLE = "actor"  # imports torch and MuJoCo, 2 s of a whole core; and there are many of them


@dataclass(frozen=True, slots=True)
class Spec:
    """A process to keep."""

    name: str  # of its log: actor-0
    role: str
    arguments: tuple[str, ...]  # module and flags, as after python -m
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
        self._spare: subprocess.Popen[bytes] | None = None
        self._next_spare = time.monotonic() + SPARE_AFTER_S
        self.children = {spec.name: Child(spec, self._start(spec), time.monotonic()) for spec in specs}

    def _start(self, spec: Spec) -> subprocess.Popen[bytes]:
        log_file = self._logs / f"{spec.name}.log"
        spare, self._spare = (self._spare, None) if spec.role == SPARE_ROLE else (None, self._spare)
        if spare is not None and spare.poll() is None and spare.stdin is not None:
            with suppress(BrokenPipeError):
                spare.stdin.write(Assignment(str(log_file), spec.arguments[1:]).to_line())
                spare.stdin.flush()
                return spare
        return _launch(spec.arguments, log_file)

    def watch(self, now: float) -> None:
        """Note who died, and start again who is to be kept."""
        if self._spare is None and now >= self._next_spare:
            module = next(
                (c.spec.arguments[0] for c in self.children.values() if c.spec.role == SPARE_ROLE), ""
            )
            if module:
                self._spare = _launch((SPARE, module), self._logs / "spare.log")
        for child in self.children.values():
            status = child.process.poll()
            if status is None:
                continue
            if child.restart_at is None and len(child.exits) == child.restarts:
                child.exits.append(status)
                if not child.spec.restart or status == BAD_CONFIG:
                    continue
                child.deaths_in_a_row = 1 if now - child.started > STABLE_S else child.deaths_in_a_row + 1
                child.restart_at = now + restart_pause(child.deaths_in_a_row)
                log.warning(
                    "process died name=%s pid=%d status=%d last_line=%r; starting it again",
                    child.spec.name,
                    child.process.pid,
                    status,
                    self.last_line(child.spec.name),
                )
            if child.restart_at is not None and now >= child.restart_at:
                _let_go(child.process)
                child.process = self._start(child.spec)
                child.started, child.restart_at = now, None
                child.restarts += 1

    def hopeless(self) -> str:
        """Return the name of a process that no restart can help, or "": its settings can't be used."""
        return next((n for n, c in self.children.items() if c.exits and c.exits[-1] == BAD_CONFIG), "")

    def last_line(self, name: str) -> str:
        """Return the last line of a process's log."""
        lines = (self._logs / f"{name}.log").read_text(errors="replace").strip().splitlines()
        return lines[-1] if lines else ""

    def status_of(self, name: str) -> int | None:
        """Return a process's exit status, or None while it runs."""
        return self.children[name].process.poll()

    def stop(self, names: list[str], patience_s: float) -> None:
        """Ask processes to end, and end those that don't; the spare goes with the first."""
        if self._spare is not None:
            self._spare.kill()  # it has nothing to lose
            self._spare.wait()
            _let_go(self._spare)
            self._spare, self._next_spare = None, float("inf")
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
        for name in names:
            _let_go(self.children[name].process)


def _launch(arguments: Sequence[str], log_file: Path) -> subprocess.Popen[bytes]:
    with log_file.open("ab") as output:
        # One thread each: with more, numerics libraries on every process fight for the same cores.
        # And no settings but those that the run has written down: all of them are in its config.toml.
        environment = {
            name: value for name, value in os.environ.items() if not name.startswith(ENVIRONMENT_PREFIX)
        }
        environment |= {
            "OMP_NUM_THREADS": "1",
            "OPENBLAS_NUM_THREADS": "1",
            "MKL_NUM_THREADS": "1",
        }
        return subprocess.Popen(
            [sys.executable, "-m", "deploy.child", *arguments],
            stdin=subprocess.PIPE,  # held open: it ends when we do, and the child with it
            stdout=output,
            stderr=subprocess.STDOUT,
            env=environment,
            start_new_session=True,  # a Ctrl-C in the terminal is ours to pass on, in order
        )


def _let_go(process: subprocess.Popen[bytes]) -> None:
    if process.stdin is not None:
        process.stdin.close()

"""Starting, watching, restarting and stopping the processes of a run."""

import logging
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

from common.service.config_sources import ENVIRONMENT_PREFIX
from common.service.process import BAD_CONFIG, DONE
from deploy.child import SPARE, Assignment

log = logging.getLogger(__name__)

RESTART_PAUSE_S = (
    0.5  # first pause, so that a process that fails at its start is not restarted in a busy loop
)
RESTART_PAUSE_MAX_S = 30.0  # longest pause; it doubles with each failure
STABLE_S = 20.0  # after this lifetime the pause is the first one again
KEEPER_STABLE_S = 600.0  # the same for the process that keeps the run's state
KEEPER_DEATHS = 5  # most in a row of this process: then the run ends
SPARE_AFTER_S = 10.0  # then one process starts and waits to replace one that dies
SPARE_ROLE = "actor"  # imports torch and MuJoCo, which takes 2 s of a whole core; a run has many actors


@dataclass(frozen=True, slots=True)
class Spec:
    """A process to keep alive."""

    name: str  # such as actor-0; also its log's name
    role: str
    arguments: tuple[str, ...]  # module and flags, as after python -m
    restart: bool  # whether it comes back when it dies
    has_children: bool = False  # whether it starts processes of its own, which must not outlive it
    keeps_run: bool = False  # whether the run ends with it: when it is done, or when restarts do not help
    again: Callable[[], tuple[str, ...]] = lambda: ()  # more flags of a restart
    made: Callable[[], str] = lambda: ""  # names the newest thing that lasts, such as a checkpoint


def next_start(spec: Spec, status: int, life_s: float, deaths: int) -> float | None:
    """Return how long to wait before a process is started again [s], or None if it stays ended.

    Args:
        spec: The process.
        status: Its exit status; negative: the signal that ended it.
        life_s: How long it lived [s].
        deaths: How often it has died in a row, with this one.
    """
    if not spec.restart or status == BAD_CONFIG:
        return None
    if spec.keeps_run:
        fails_at_start = status > 0 and life_s < STABLE_S  # the next one would fail in the same way
        if status == DONE or fails_at_start or deaths > KEEPER_DEATHS:
            return None
    return restart_pause(deaths)


def is_a_new_row(spec: Spec, status: int, life_s: float, has_made: bool) -> bool:
    """Return whether a death is the first of a row: the process had worked.

    Args:
        spec: The process.
        status: Its exit status; negative: the signal that ended it.
        life_s: How long it lived [s].
        has_made: Whether it made something that lasts.
    """
    if not spec.keeps_run:
        return life_s > STABLE_S
    # A fault of its own would come back after each checkpoint; what kills it from outside need not
    return life_s > KEEPER_STABLE_S or (status < 0 and has_made)


def restart_pause(deaths: int) -> float:
    """Return how long to wait before a process that died ``deaths`` times in a row is started again [s]."""
    return min(RESTART_PAUSE_S * 2.0 ** max(deaths - 1, 0), RESTART_PAUSE_MAX_S)


@dataclass(slots=True)
class Child:
    """The state of one process."""

    spec: Spec
    process: subprocess.Popen[bytes]
    started: float
    restarts: int = 0
    deaths_in_a_row: int = 0
    restart_at: float | None = None
    exits: list[int] = field(default_factory=list)
    has_ended: bool = False  # it is not started again
    made: str = ""  # what the last life had made at its end


class Supervisor:
    """The processes of a run. ``watch`` must be called regularly.

    Args:
        specs: The processes.
        logs: Folder for one log file per process.
    """

    def __init__(self, specs: list[Spec], logs: Path) -> None:
        self._logs = logs
        self._spare: subprocess.Popen[bytes] | None = None
        self._next_spare = time.monotonic() + SPARE_AFTER_S
        self.children = {spec.name: Child(spec, self._start(spec), time.monotonic()) for spec in specs}

    def _start(self, spec: Spec, *more: str) -> subprocess.Popen[bytes]:
        log_file = self._logs / f"{spec.name}.log"
        spare, self._spare = (self._spare, None) if spec.role == SPARE_ROLE else (None, self._spare)
        if spare is not None and spare.poll() is None and spare.stdin is not None:
            with suppress(BrokenPipeError):
                spare.stdin.write(Assignment(str(log_file), spec.arguments[1:]).to_line())
                spare.stdin.flush()
                return spare
        return _launch((*spec.arguments, *more), log_file)

    def watch(self, now: float) -> None:
        """Record which processes ended, and restart those with ``restart``."""
        if self._spare is None and now >= self._next_spare:
            module = next(
                (c.spec.arguments[0] for c in self.children.values() if c.spec.role == SPARE_ROLE), ""
            )
            if module:
                self._spare = _launch((SPARE, module), self._logs / "spare.log")
        for child in self.children.values():
            status = child.process.poll()
            if status is None or child.has_ended:
                continue
            if child.restart_at is None:
                self._note_death(child, status, now)
            if child.restart_at is not None and now >= child.restart_at:
                _close_pipe(child.process)
                child.process = self._start(child.spec, *child.spec.again())
                child.started, child.restart_at = now, None
                child.restarts += 1

    def _note_death(self, child: Child, status: int, now: float) -> None:
        """Record that a process has ended, and when it is started again."""
        child.exits.append(status)
        if child.spec.has_children:
            _end_group(child.process)
        life_s = now - child.started
        before, child.made = child.made, child.spec.made()
        is_new = is_a_new_row(child.spec, status, life_s, child.made != before)
        child.deaths_in_a_row = 1 if is_new else child.deaths_in_a_row + 1
        pause = next_start(child.spec, status, life_s, child.deaths_in_a_row)
        if pause is None:
            child.has_ended = True
            return
        child.restart_at = now + pause
        log.warning(
            "process died name=%s pid=%d status=%d last_line=%r; restarting it",
            child.spec.name,
            child.process.pid,
            status,
            self.last_line(child.spec.name),
        )

    def add(self, spec: Spec) -> None:
        """Start one more process."""
        self.children[spec.name] = Child(spec, self._start(spec), time.monotonic())

    def retire(self, name: str) -> None:
        """Ask a process to end, once; it is not started again."""
        child = self.children[name]
        if child.spec.restart:
            child.spec = replace(child.spec, restart=False)
            child.has_ended = child.restart_at is not None  # it is dead already, and stays so
            with suppress(ProcessLookupError):
                child.process.terminate()

    def forget_retired(self) -> list[str]:
        """Return the retired processes that have ended since the last call; they are no longer among the children."""
        ended = [name for name, child in self.children.items() if child.has_ended and not child.spec.restart]
        for name in ended:
            _close_pipe(self.children.pop(name).process)
        return ended

    def has_ended(self, name: str) -> bool:
        """Return whether a process has ended and is not started again; `watch` notes it."""
        return self.children[name].has_ended

    def kill(self, name: str) -> None:
        """End a process that hangs; `watch` starts it again."""
        _end_group(self.children[name].process)

    def has_bad_config(self) -> str:
        """Return the name of a process whose settings can't be used, so that no restart helps, or ""."""
        return next((n for n, c in self.children.items() if c.exits and c.exits[-1] == BAD_CONFIG), "")

    def last_line(self, name: str) -> str:
        """Return the last line of a process's log."""
        lines = (self._logs / f"{name}.log").read_text(errors="replace").strip().splitlines()
        return lines[-1] if lines else ""

    def status_of(self, name: str) -> int | None:
        """Return a process's exit status, or None while it runs."""
        return self.children[name].process.poll()

    def stop(self, names: list[str], patience_s: float) -> None:
        """Send SIGTERM to processes, and kill those that do not end in time; the first call also ends the spare."""
        if self._spare is not None:
            self._spare.kill()  # it has no state
            self._spare.wait()
            _close_pipe(self._spare)
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
                _end_group(process)
                process.wait()
        for name in names:
            _close_pipe(self.children[name].process)


def _launch(arguments: Sequence[str], log_file: Path) -> subprocess.Popen[bytes]:
    with log_file.open("ab") as output:
        # One thread each: with more, numerics libraries on every process fight for the same cores.
        # No settings from the environment: all settings of the run are in its config.toml.
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
            stdin=subprocess.PIPE,  # stays open: it closes when this process ends, and then the child ends
            stdout=output,
            stderr=subprocess.STDOUT,
            env=environment,
            start_new_session=True,  # a Ctrl-C reaches only this process, which stops the others in order
        )


def _end_group(process: subprocess.Popen[bytes]) -> None:
    """End a process at once, and what it has started and left behind."""
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)


def _close_pipe(process: subprocess.Popen[bytes]) -> None:
    if process.stdin is not None:
        process.stdin.close()

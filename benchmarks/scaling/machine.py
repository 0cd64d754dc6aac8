"""Virtual time: processes that share cores fairly, and acts that happen later.

A process is a generator. It yields what it does next: `Work`, which takes a core, or `Wait`. Processes that work share
the cores equally (processor sharing): with more of them than cores, all slow down alike. Nothing is random.
"""

import heapq
import math
from collections import deque
from collections.abc import Callable, Generator
from dataclasses import dataclass
from itertools import count
from typing import NamedTuple


class Work(NamedTuple):
    """CPU time that a process needs on one core."""

    seconds: float


class Wait(NamedTuple):
    """A process sleeps until it is woken, or until a time."""

    until: float = math.inf  # [s]


Script = Generator[Work | Wait, None, None]


@dataclass(slots=True, eq=False)
class Process:
    """One process."""

    script: Script
    waits: int = 0  # how often it has waited: tells an old alarm from its own
    is_waiting: bool = False
    works_since: float | None = None  # [s]
    worked: float = 0.0  # [s] time in which it had work

    def busy(self, now: float) -> float:
        """Return how long it has had work until ``now`` [s], also while it shared a core."""
        return self.worked + (now - self.works_since if self.works_since is not None else 0.0)


class Machine:
    """The cores, and the clock.

    Args:
        cores: Cores that the processes share; need not be whole.
        slowdown: CPU time of the same work when every core is busy, over that with one busy core; from 1. Between
            them it grows linearly with the busy cores.
    """

    def __init__(self, cores: float, slowdown: float = 1.0) -> None:
        if cores <= 0 or slowdown < 1:
            raise ValueError(f"cores {cores}, slowdown {slowdown}; allowed: above 0, and from 1")
        self._cores, self._slowdown = cores, slowdown
        self.now = 0.0  # [s]
        self.used = 0.0  # [s] CPU time of all cores so far
        # Work that one process has been given since the beginning [s]. All working processes are given the same, so
        # a piece of work ends where this has grown by its seconds, however many come and go meanwhile.
        self._given = 0.0
        self._order = count()  # of equal times: first come, first served
        self._ready: deque[Process] = deque()
        self._working: list[tuple[float, int, Process]] = []  # heap by the end of their work, as ``_given``
        self._alarms: list[tuple[float, int, Callable[[], None]]] = []  # heap by time

    def start(self, script: Script) -> Process:
        """Return a new process, which begins now."""
        process = Process(script)
        self._ready.append(process)
        return process

    def wake(self, process: Process) -> None:
        """Let a process go on that waits; nothing for any other, which looks for news before it waits."""
        if process.is_waiting:
            process.is_waiting = False
            self._ready.append(process)

    def at(self, time: float, act: Callable[[], None]) -> None:
        """Call ``act`` at ``time`` [s]."""
        heapq.heappush(self._alarms, (max(time, self.now), next(self._order), act))

    def run(self, is_over: Callable[[], bool]) -> None:
        """Go on until ``is_over``, which is asked after every event.

        Raises:
            RuntimeError: Every process waits, and nothing will wake one.
        """
        while True:
            while self._ready:
                self._resume(self._ready.popleft())
            if is_over():
                return
            speed = self._speed()
            done = self.now + (self._working[0][0] - self._given) / speed if self._working else math.inf
            alarm = self._alarms[0][0] if self._alarms else math.inf
            if math.isinf(min(done, alarm)):
                raise RuntimeError("every process waits, and nothing will wake one")
            self.used += (min(done, alarm) - self.now) * min(float(len(self._working)), self._cores)
            if done <= alarm:
                self.now = max(done, self.now)
                self._given, _, process = heapq.heappop(self._working)
                process.worked = process.busy(self.now)
                process.works_since = None
                self._ready.append(process)
            else:
                self._given += (alarm - self.now) * speed
                self.now, _, act = heapq.heappop(self._alarms)
                act()

    def _speed(self) -> float:
        """Return the work that each working process is given in a second."""
        working = len(self._working)
        if not working:
            return 1.0
        busy = min(float(working), self._cores)
        crowd = max(0.0, (busy - 1.0) / (self._cores - 1.0)) if self._cores > 1 else 0.0
        return min(1.0, self._cores / working) / (1.0 + (self._slowdown - 1.0) * crowd)

    def _resume(self, process: Process) -> None:
        for asked in process.script:
            if isinstance(asked, Wait):
                process.is_waiting = True
                process.waits += 1
                if math.isfinite(asked.until):
                    self.at(asked.until, _alarm_of(self, process, process.waits))
                return
            if asked.seconds > 0:
                process.works_since = self.now
                heapq.heappush(self._working, (self._given + asked.seconds, next(self._order), process))
                return


def _alarm_of(machine: Machine, process: Process, waits: int) -> Callable[[], None]:
    def ring() -> None:
        if process.waits == waits:
            machine.wake(process)

    return ring

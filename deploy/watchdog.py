"""Which processes of a run hang.

A process that works sends a heartbeat every second, or is busy: it imports, compiles, or trains a large dataset. A
process that hangs is silent and uses no CPU time. One that waits for a core, because the machine has too much to do, is
busy too. The learner is the hub: while it is silent, nothing can be said about
the others.
"""

import os
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

BUSY_SHARE: Final = 0.05  # [-] of a core: a process that waits uses less than 0.02
LOOK_S: Final = 5.0  # between two measurements of the CPU time
MOST_LIMITS: Final = 20.0  # a process that is busy and silent for so many limits hangs too
OWN_GAP_S: Final = 10.0  # between two looks: a longer one means that the whole run was stopped (Ctrl-Z)
HUB_FRESH_S: Final = 5.0  # silence of the hub after which the others are not judged


@dataclass(frozen=True, slots=True)
class Pulse:
    """What is known about one process. Times are of one clock [s]."""

    started: float
    heard: float | None = None  # time of its last heartbeat
    busy: float | None = None  # last time at which it used CPU time


def is_hung(pulse: Pulse, now: float, limit_s: float) -> bool:
    """Return whether a process has given no sign of life for ``limit_s``."""
    heard = pulse.started if pulse.heard is None else max(pulse.heard, pulse.started)
    sign = heard if pulse.busy is None else max(heard, pulse.busy)
    return now - sign > limit_s or now - heard > MOST_LIMITS * limit_s


def hung(pulses: Mapping[str, Pulse], hub: str, now: float, limit_s: float) -> list[str]:
    """Return the names of the processes that hang; none but the hub while that is silent. 0: none is judged."""
    if limit_s <= 0:
        return []
    if hub in pulses and is_hung(pulses[hub], now, limit_s):
        return [hub]
    heard = pulses[hub].heard if hub in pulses else None
    if heard is None or now - heard > HUB_FRESH_S:
        return []
    since = pulses[hub].started  # what a worker could not send while there was no hub does not count
    return [
        name
        for name, pulse in pulses.items()
        if name != hub and is_hung(pulse, now, limit_s) and now - since > limit_s
    ]


def family(process: int) -> list[int]:
    """Return a process and those that it has started, and so on."""
    found = [process]
    for children in Path(f"/proc/{process}/task").glob("*/children"):
        with suppress(OSError):  # a thread that has just ended
            for child in children.read_text().split():
                found += family(int(child))
    return found


def cpu_seconds(process: int) -> float | None:
    """Return the CPU time that a process and its children have used [s], or None where the system does not tell."""
    try:
        stats = [Path(f"/proc/{one}/stat").read_text().rpartition(")")[2].split() for one in family(process)]
        return sum(int(fields[11]) + int(fields[12]) for fields in stats) / os.sysconf("SC_CLK_TCK")
    except (OSError, ValueError, IndexError):
        return None


def wants_a_core(process: int) -> bool:
    """Return whether a thread of a process or its children is running, or would be if a core were free.

    False if it can't be told.
    """
    for one in family(process):
        for stat in Path(f"/proc/{one}/task").glob("*/stat"):
            with suppress(OSError):  # a thread that has just ended
                if stat.read_text().rpartition(")")[2].split()[:1] == ["R"]:
                    return True
    return False


@dataclass(slots=True)
class Watchdog:
    """Measures the CPU time of processes, and says which hang.

    Args:
        hub: Name of the process that the others' heartbeats pass through.
        limit_s: Time without a sign of life; 0: off.
        cpu_of: Returns the CPU time of a process id.
        wants_core: Returns whether it would run if it got a core.
    """

    hub: str
    limit_s: float
    cpu_of: Callable[[int], float | None] = cpu_seconds
    wants_core: Callable[[int], bool] = wants_a_core
    _marks: dict[int, tuple[float, float]] = field(default_factory=dict)  # time and CPU time, by process id
    _busy: dict[int, float] = field(default_factory=dict)
    _looked: float | None = None  # time of the last look
    _awake: float = 0.0  # since when it has looked without a gap

    def look(
        self, processes: Iterable[tuple[str, int, float]], heard: Mapping[str, float], now: float
    ) -> list[str]:
        """Return the names of the processes that hang.

        Args:
            processes: Name, process id and time of the start of each that runs.
            heard: Time of each one's last heartbeat.
            now: [s]
        """
        if self._looked is not None and now - self._looked > OWN_GAP_S:
            self._awake = now
        self._looked = now
        pulses = {}
        for name, process, started in processes:
            self._measure(process, now)
            pulses[name] = Pulse(max(started, self._awake), heard.get(name), self._busy.get(process))
        return hung(pulses, self.hub, now, self.limit_s)

    def _measure(self, process: int, now: float) -> None:
        since, before = self._marks.get(process, (now - LOOK_S, None))
        if now - since < LOOK_S:
            return
        used = self.cpu_of(process)
        if used is None:
            return
        has_worked = before is not None and used - before >= BUSY_SHARE * (now - since)
        if has_worked or self.wants_core(process):
            self._busy[process] = now
        self._marks[process] = (now, used)

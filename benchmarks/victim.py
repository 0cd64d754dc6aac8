"""A run under attack: real processes, one that asks its learner all the time, and what is seen of it from outside."""

import multiprocessing
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from multiprocessing.connection import Connection
from threading import Event
from typing import Any, Final

import psutil

from benchmarks.running import running
from common.comms.codec import encode
from common.comms.keys import Keys
from common.comms.messages import ActorReport
from common.comms.transport import Flow
from common.comms.zenoh_config import ZenohConfig
from common.comms.zenoh_transport import open_zenoh
from common.errors import ReportedError
from common.evaluation.evaluate import check
from deploy.config import DeployConfig
from deploy.prepare import prepared

START_S: Final = 120.0
EPOCHS: Final = 3  # after an attack, so that no rollout from before makes them all
PROBE: Final = "1"  # id of the actor that asks all the time
PROBE_PAUSE_S: Final = 0.02
ASK_S: Final = 5.0
LOOK_S: Final = 0.02
PROCESSES: Final = multiprocessing.get_context("spawn")


class Line:
    """The line to a process beside the run, and its process id."""

    def __init__(self, line: "Connection[Any, Any]", pid: int) -> None:
        self._line, self.pid = line, pid

    @property
    def has_word(self) -> bool:
        """Whether a message has come."""
        return self._line.poll()

    def tell(self) -> None:
        """Send a message without content."""
        self._line.send("")

    def hear(self) -> Any:
        """Return the next message."""
        return self._line.recv()


@contextmanager
def beside(work: Callable[..., None], *arguments: object) -> Iterator["Line"]:
    """Yield the line to a process that does this work; it is killed at the end."""
    here, there = PROCESSES.Pipe()
    process = PROCESSES.Process(target=work, args=(*arguments, there), daemon=True)
    process.start()
    try:
        yield Line(here, process.pid or 0)
    finally:
        process.kill()
        process.join()


def probe(link: ZenohConfig, run_name: str, line: "Connection[Any, Any]") -> None:
    """Ask the learner all the time; answer each message with the longest wait since the last one."""
    transport = open_zenoh(link, name=f"actor-{PROBE}")
    report = encode(ActorReport(run_name, PROBE, 1, 0, 0, (), (), 0, (), leaving=False))
    key, worst = Keys(run_name).report(PROBE), 0.0
    while True:
        started = time.monotonic()
        transport.request(key, report, ASK_S, Flow.CONTROL).wait()
        worst = max(worst, time.monotonic() - started)
        if line.poll(PROBE_PAUSE_S):
            line.recv()
            line.send(worst)
            worst = 0.0


class Victim:
    """A run of real processes, and the process that asks its learner all the time."""

    def __init__(self, config: DeployConfig, stop: Event, stack: ExitStack) -> None:
        self._stop = stop
        self._run = stack.enter_context(prepared(config))
        self.name, self.folder = self._run.name, self._run.folder
        self.link: ZenohConfig = self._run.link
        self._supervisor = stack.enter_context(running(self._run))
        self.wait(lambda: self.epochs() >= EPOCHS, START_S, f"training; see {self.folder.logs}")
        self._learner = psutil.Process(self._supervisor.children["learner-0"].process.pid)
        self._probe = stack.enter_context(beside(probe, self.link, self.name))
        self.stall_s()  # until the probe has its link

    def epochs(self) -> int:
        """Return how many epochs have been trained."""
        try:
            return max(0, self.folder.metrics.read_bytes().count(b"\n") - 1)
        except FileNotFoundError:
            return 0

    def memory(self) -> int:
        """Return the learner's memory [bytes]; 0 if it has died."""
        try:
            return int(self._learner.memory_info().rss)
        except psutil.NoSuchProcess:
            return 0

    def deaths(self) -> int:
        """Return how many of the run's processes have died."""
        self._supervisor.watch(time.monotonic())
        return sum(len(child.exits) for child in self._supervisor.children.values())

    def stall_s(self) -> float:
        """Return the longest wait for an answer since the last call [s]."""
        self._probe.tell()
        self.wait(lambda: self._probe.has_word, 60.0, "the process that asks")
        return float(self._probe.hear())

    def wait(self, condition: Callable[[], object], timeout_s: float, what: str) -> None:
        """Wait, with the processes watched. Raises ReportedError after the time-out."""
        if not self.comes(condition, timeout_s):
            raise ReportedError(f"waited {timeout_s:.0f} s for {what}")

    def comes(self, condition: Callable[[], object], timeout_s: float) -> bool:
        """Return whether a condition comes true in time."""
        deadline = time.monotonic() + timeout_s
        while not condition():
            check(self._stop)
            if time.monotonic() > deadline:
                return False
            self._supervisor.watch(time.monotonic())
            time.sleep(LOOK_S)
        return True

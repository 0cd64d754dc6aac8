"""The part of a core that a learner uses while many actors wait for credits.

    python -m benchmarks.idle --json

It starts a real learner, and senders that report as waiting actors do: each has its token and its own pace, and none
plays. Several of them share a session, so the machine carries a thousand.
"""

import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from threading import Event

import psutil
from pydantic import Field

from benchmarks.settings import BenchmarkConfig, print_figures, run
from common.comms.codec import decode, encode
from common.comms.keys import Keys
from common.comms.messages import ActorReport, PolicySnapshot, Verdict
from common.comms.transport import Flow, PendingReply, Reply, Transport
from common.comms.zenoh_config import ZenohConfig
from common.comms.zenoh_transport import open_zenoh
from common.errors import ReportedError
from common.evaluation.evaluate import check
from common.service.process import DONE
from deploy.prepare import free_endpoint

RUN = "idle"
SESSIONS = 8  # that the senders share
START_S = 60.0


@dataclass(slots=True)
class Sender:
    """One actor that waits."""

    actor: str
    report: bytes
    transport: Transport
    next_report: float = 0.0
    after_s: float = 0.25
    pending: PendingReply | None = None


@dataclass(slots=True)
class Senders:
    """All actors that wait."""

    keys: Keys
    all: list[Sender] = field(default_factory=list)
    answered: int = 0

    def step(self, now: float) -> None:
        """Take answers, and send the reports that are due."""
        for sender in self.all:
            if sender.pending is not None and (outcome := sender.pending.poll()) is not None:
                sender.pending = None
                if isinstance(outcome, Reply):
                    sender.after_s = decode(outcome.payload, Verdict).report_after_s
                    self.answered += 1
                    sender.next_report = now + sender.after_s
            if sender.pending is None and now >= sender.next_report:
                sender.next_report = now + sender.after_s
                key = self.keys.report(sender.actor)
                sender.pending = sender.transport.request(key, sender.report, 5.0, Flow.CONTROL)


class IdleConfig(BenchmarkConfig):
    """Measure the share of a core that the learner uses while actors wait for credits and nothing is trained."""

    actors: int = Field(1000, ge=1, le=10_000, description="actors that wait")
    warm_up: float = Field(
        30.0, ge=0, description="time before the measurement", json_schema_extra={"unit": "s"}
    )
    seconds: float = Field(
        30.0, gt=0, description="duration of the measurement", json_schema_extra={"unit": "s"}
    )


def training_hash(keys: Keys, transport: Transport) -> str:
    """Return the learner's training hash, from its policy."""
    deadline = time.monotonic() + START_S
    while time.monotonic() < deadline:
        outcome = transport.request(keys.policy(), b"", 5.0, Flow.POLICY).wait()
        if isinstance(outcome, Reply):
            return decode(outcome.payload, PolicySnapshot).training_hash
        time.sleep(0.1)
    raise ReportedError(f"no policy within {START_S:.0f} s")


def measure(config: IdleConfig, endpoint: str, process: psutil.Process, stop: Event) -> dict[str, float]:
    """Return the figures."""
    keys = Keys(RUN)
    sessions = [open_zenoh(ZenohConfig(endpoint=endpoint), stop) for _ in range(SESSIONS)]
    senders = Senders(keys)
    try:
        matching = training_hash(keys, sessions[0])
        for number in range(config.actors):
            transport = sessions[number % SESSIONS]
            report = ActorReport(
                RUN, f"a{number}", 1, 0, 0, (), (), 0, (), leaving=False, training_hash=matching
            )
            transport.declare_alive(keys.alive("actor", f"a{number}", 1))
            senders.all.append(Sender(report.actor, encode(report), transport))

        def work(seconds: float) -> None:
            until = time.monotonic() + seconds
            while (now := time.monotonic()) < until:
                check(stop)
                senders.step(now)
                time.sleep(0.02)

        work(config.warm_up)
        before, started, answered = sum(process.cpu_times()[:2]), time.monotonic(), senders.answered
        work(config.seconds)
        wall = time.monotonic() - started
        used, reports = sum(process.cpu_times()[:2]) - before, senders.answered - answered
    finally:
        for session in sessions:
            session.close()
    return {
        "learner_core_share": round(used / wall, 4),
        "actors": config.actors,
        "reports_per_s": round(reports / wall, 1),
        "cpu_us_per_report": round(1e6 * used / max(reports, 1), 1),
        "seconds": round(wall, 1),
    }


def main(config: IdleConfig, stop: Event) -> int:
    """Measure and print."""
    endpoint, folder = free_endpoint(), Path(tempfile.mkdtemp(prefix="topspin-idle-"))
    flags = ["--run", RUN, "--endpoint", endpoint, "--folder", str(folder / RUN), "--actors", "1"]
    with (folder / "learner.log").open("wb") as log:
        learner = subprocess.Popen(
            [sys.executable, "-m", "services.learner", *flags], stdout=log, stderr=subprocess.STDOUT
        )
        try:
            result = measure(config, endpoint, psutil.Process(learner.pid), stop)
        finally:
            learner.terminate()
            learner.wait(30.0)
    shutil.rmtree(folder, ignore_errors=True)
    print_figures(result, config.json_line)
    return DONE


if __name__ == "__main__":
    sys.exit(run("idle", IdleConfig, main))

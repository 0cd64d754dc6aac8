"""A learner, its routers, and light senders as real processes, and what each of them costs."""

import multiprocessing
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field, replace
from multiprocessing.connection import Connection
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Event
from typing import Any, Final, Literal

import numpy as np
import psutil

from benchmarks.idle import training_hash
from benchmarks.play import HORIZON, STAGE
from benchmarks.scale.senders import Part, Sent, work
from benchmarks.scale.sizes import new_training, played
from common.comms.codec import decode, encode
from common.comms.keys import Keys
from common.comms.messages import Status
from common.comms.zenoh_config import ZenohConfig
from common.comms.zenoh_transport import open_zenoh
from common.errors import ReportedError
from common.evaluation.evaluate import check
from common.service.member import LEARNER_ID
from deploy.prepare import free_endpoint

RUN: Final = "scale"
READY_S: Final = 240.0
Layout = Literal["hub", "router", "tree"]


@dataclass(frozen=True, slots=True)
class Fleet:
    """What is started.

    Args:
        senders: How many.
        processes: That they share.
        layout: hub: the learner is the hub. router: everyone is a client of one router. tree: the learner is a client
            of a router; two more connect to it, and the senders are clients of these.
        envs: Environments of a sender's rollout.
        dataset: Rollouts of a dataset.
        takes_policies: Whether senders subscribe to policies.
    """

    senders: int
    processes: int
    layout: Layout
    envs: int
    dataset: int
    takes_policies: bool


@dataclass(slots=True)
class Running:
    """Its processes."""

    learner: psutil.Process
    routers: dict[str, psutil.Process]
    hub: str  # endpoint that the learner is at
    pipes: list[Connection] = field(default_factory=list)

    def cpu(self) -> dict[str, float]:
        """Return the CPU time that each process has used [s]."""
        members = {"learner": self.learner, **self.routers}
        return {name: sum(process.cpu_times()[:2]) for name, process in members.items()}

    def sent(self) -> list[Sent]:
        """Return what the senders have done so far."""
        for pipe in self.pipes:
            pipe.send(None)
        return [pipe.recv() for pipe in self.pipes]


@contextmanager
def started(fleet: Fleet, stop: Event) -> Iterator[Running]:
    """Yield a fleet that works; end all of it at the end."""
    context = multiprocessing.get_context("spawn")
    with TemporaryDirectory(prefix="topspin-scale-") as place, ExitStack() as stack:
        folder, hub = Path(place), free_endpoint()
        routers: dict[str, psutil.Process] = {}
        doors = [hub]

        def start(name: str, *command: str) -> psutil.Process:
            return psutil.Process(stack.enter_context(_program(name, folder, *command)).pid)

        if fleet.layout != "hub":
            routers["router"] = start("router", "deploy.router", "--endpoint", hub, "--metrics-port", "0")
        if fleet.layout == "tree":
            doors = [free_endpoint(), free_endpoint()]
            for number, door in enumerate(doors):
                name = f"leaf_{number}"
                flags = ("--endpoint", door, "--peers", hub, "--metrics-port", "0")
                routers[name] = start(name, "deploy.router", *flags)
        learner = start("learner", "services.learner", *_learner_flags(fleet, hub, folder))
        running = Running(learner, routers, hub)
        with closing(open_zenoh(ZenohConfig(endpoint=hub), stop)) as transport:
            matching = training_hash(Keys(RUN), transport)
        rollout = played(new_training(), fleet.envs, 0)
        payload = encode(replace(rollout, training_hash=matching))
        for number, count in enumerate(_shares(fleet.senders, fleet.processes)):
            part = Part(
                endpoint=doors[number % len(doors)],
                run=RUN,
                first=number * 10_000,
                count=count,
                envs=fleet.envs,
                takes_policies=fleet.takes_policies,
            )
            ours, theirs = context.Pipe()
            process = context.Process(target=work, args=(part, payload, theirs), daemon=True)
            process.start()
            theirs.close()
            stack.callback(_end_senders, process, ours)
            running.pipes.append(ours)
        deadline = time.monotonic() + READY_S
        while (ready := sum(sent.ready for sent in running.sent())) < fleet.senders:
            check(stop)
            if time.monotonic() > deadline:
                raise ReportedError(
                    f"{ready} of {fleet.senders} senders have an answer after {READY_S:.0f} s"
                )
            time.sleep(0.5)
        yield running


def _shares(total: int, parts: int) -> list[int]:
    """Return ``total`` in ``parts`` whole numbers that differ by 1 at most."""
    return [total // parts + (number < total % parts) for number in range(parts)]


def _learner_flags(fleet: Fleet, hub: str, folder: Path) -> tuple[str, ...]:
    # A learning rate of nearly 0: the same rollouts again and again would ruin a policy, and cost the same
    options = {
        **{"run": RUN, "endpoint": hub, "folder": folder / RUN, "actors": fleet.senders, "metrics-port": 0},
        **{"mode": "hub" if fleet.layout == "hub" else "client", "curriculum.first-stage": STAGE},
        **{"intake.dataset-rollouts": fleet.dataset},
        **{"ppo.learning-rate": 1e-9, "ppo.learning-rate-min": 1e-9, "ppo.learning-rate-max": 1e-9},
    }
    return tuple(f"--{name}={value}" for name, value in options.items())


@contextmanager
def _program(name: str, folder: Path, module: str, *flags: str) -> Iterator[subprocess.Popen[bytes]]:
    with (folder / f"{name}.log").open("wb") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", module, *flags], stdout=log, stderr=subprocess.STDOUT
        )
        try:
            yield process
        finally:
            process.terminate()
            try:
                process.wait(30.0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def _end_senders(process: Any, pipe: Connection) -> None:
    pipe.close()
    process.join(20.0)
    if process.is_alive():
        process.kill()
        process.join()


def measure(fleet: Fleet, warm_up_s: float, seconds: float, stop: Event) -> dict[str, Any]:
    """Return what a fleet reaches and costs in ``seconds``, after a warm-up."""
    with (
        started(fleet, stop) as running,
        closing(open_zenoh(ZenohConfig(endpoint=running.hub), stop)) as link,
    ):
        statuses = link.subscribe(Keys(RUN).every_status(), capacity=256)

        def heartbeat(until: float) -> tuple[Status, dict[str, float], list[Sent]]:
            """Return the learner's first heartbeat after a moment, with all costs and counts then."""
            while True:
                check(stop)
                link.wait(0.2)
                for sample in statuses.poll():
                    status = decode(sample.payload, Status)
                    if (status.role, status.id) == ("learner", LEARNER_ID) and time.monotonic() >= until:
                        return status, running.cpu(), running.sent()
                if time.monotonic() > until + 60.0:
                    raise ReportedError("no heartbeat of the learner for 60 s")

        now = time.monotonic()
        before, cpu_before, sent_before = heartbeat(now + warm_up_s)
        after, cpu_after, sent_after = heartbeat(time.monotonic() + seconds)
    span = after.time - before.time
    frames = after.counters["frames"] - before.counters["frames"]
    used = {name: cpu_after[name] - cpu_before[name] for name in cpu_after}
    times = np.array([value for sent in sent_after for value in sent.verdict_s]) * 1e3

    def rate(name: str) -> float:
        total = sum(getattr(sent, name) for sent in sent_after) - sum(getattr(s, name) for s in sent_before)
        return round(float(total) / span, 1)

    return {
        "senders": fleet.senders,
        "layout": fleet.layout,
        "envs_each": fleet.envs,
        "dataset_frames": fleet.dataset * fleet.envs * HORIZON,
        "takes_policies": fleet.takes_policies,
        "frames_per_s": round(frames / span, 1),
        "learner_cpu_us_per_frame": round(1e6 * used["learner"] / max(frames, 1.0), 2),
        "core_share": {name: round(value / span, 3) for name, value in used.items()},
        "rollouts_per_s": rate("rollouts"),
        "refused": sum(sent.refused for sent in sent_after),
        "reports_per_s": rate("reports"),
        "policies_delivered_per_s": rate("policies"),
        "verdict_ms_p50": round(float(np.percentile(times, 50)), 1) if times.size else None,
        "verdict_ms_p99": round(float(np.percentile(times, 99)), 1) if times.size else None,
        "seconds": round(span, 1),
    }

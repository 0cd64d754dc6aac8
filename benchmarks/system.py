"""Speed of a whole run with learning, and the balance of its ledger.

    python -m benchmarks.system --json

It starts a real run with the topology of `deploy.local`, lets it warm up, and measures it for a while.
"""

import os
import shutil
import sys
import time
from contextlib import closing
from threading import Event
from typing import Any

import psutil
from pydantic import Field

from benchmarks.running import check_learner, running
from benchmarks.settings import BenchmarkConfig, print_figures, run
from common.comms.codec import decode
from common.comms.keys import Keys
from common.comms.messages import Status
from common.errors import ReportedError
from common.evaluation.evaluate import check
from common.service.member import LEARNER_ID
from common.service.process import DONE
from common.service.run_folder import LATEST, RUNS
from common.service.table import whole_rows
from deploy.config import DeployConfig
from deploy.prepare import PreparedRun, open_link, prepared

FATES = ("trained", "refused", "dropped", "in_flight", "lost")


def cpu_seconds(processes: list[psutil.Process]) -> float:
    """Return the CPU time that living processes have used so far [s]."""
    return sum(sum(process.cpu_times()[:2]) for process in processes)


def measure(run: PreparedRun, warm_up_s: float, seconds: float, stop: Event) -> dict[str, Any]:
    """Return the figures of a run."""
    folder = run.folder
    learner: Status | None = None
    with running(run) as supervisor, closing(open_link(run, stop)) as transport:
        statuses = transport.subscribe(Keys(run.name).every_status(), capacity=4096)

        def watch(until: float) -> None:
            nonlocal learner
            while time.monotonic() < until:
                check(stop)
                supervisor.watch(time.monotonic())
                check_learner(run, supervisor)
                for sample in statuses.poll():
                    status = decode(sample.payload, Status)
                    if (status.role, status.id) == ("learner", LEARNER_ID):
                        learner = status
                transport.wait(0.5)

        deadline = time.monotonic() + 120.0
        while learner is None or learner.counters["trained"] == 0:
            if time.monotonic() > deadline:
                raise ReportedError(f"nothing was trained within 120 s: see {folder.logs}")
            watch(time.monotonic() + 0.5)
        watch(time.monotonic() + warm_up_s)
        processes = [psutil.Process(child.process.pid) for child in supervisor.children.values()]
        before, cpu_before, started = learner, cpu_seconds(processes), time.monotonic()
        watch(started + seconds)
        cpu, wall, after = cpu_seconds(processes) - cpu_before, time.monotonic() - started, learner
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    rows = whole_rows(folder.metrics)
    window = [
        row for row in rows if before.counters["frames"] < float(row["frames"]) <= after.counters["frames"]
    ]
    # A heartbeat has the learner's own clock: the rate is frames / time between two of them
    span = after.time - before.time
    result = {
        "frames_per_s": round((after.counters["frames"] - before.counters["frames"]) / span, 1),
        "idle_share": round(1.0 - cpu / (cores * wall), 4),
        "average_lag": round(sum(float(row["lag"]) for row in window) / max(len(window), 1), 3),
        "published": int(after.counters["published"]),
        **{fate: int(after.counters[fate]) for fate in FATES},
        "unaccounted": int(after.counters["published"] - sum(after.counters[fate] for fate in FATES)),
        "restarts": sum(child.restarts for child in supervisor.children.values()),
        "epochs": len(window),
        "actors": run.config.actors,
        "cores": cores,
        "cpu_seconds": round(cpu, 1),
        "seconds": round(wall, 1),
    }
    return result


class SystemConfig(BenchmarkConfig):
    """Measure a whole run with learning: frames per second, idle share of the cores, policy lag, lost rollouts."""

    seconds: float = Field(
        60.0, gt=0, description="duration of the measurement", json_schema_extra={"unit": "s"}
    )
    warm_up: float = Field(
        10.0,
        ge=0,
        description="time between the first trained dataset and the measurement",
        json_schema_extra={"unit": "s"},
    )
    actors: int = Field(DeployConfig().actors, ge=1, le=1000, description="actor processes")
    keep: bool = Field(False, description="keep the run folder")


def main(config: SystemConfig, stop: Event) -> int:
    """Measure and print."""
    name = time.strftime("benchmark-%Y%m%d-%H%M%S")
    with prepared(DeployConfig(run=name, actors=config.actors, evaluate=False, panel="off")) as prepared_run:
        result = measure(prepared_run, config.warm_up, config.seconds, stop)
    if not config.keep:
        shutil.rmtree(prepared_run.folder.root, ignore_errors=True)
        if not (RUNS / LATEST).exists():  # the link to the folder that is gone
            (RUNS / LATEST).unlink(missing_ok=True)
    print_figures(result, config.json_line)
    return DONE


if __name__ == "__main__":
    sys.exit(run("system", SystemConfig, main))

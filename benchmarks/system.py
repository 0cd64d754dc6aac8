"""How fast is a whole run, end to end, and does its ledger balance? (`python -m benchmarks.system --json`).

Starts a real run with `deploy.local`'s own topology, learning on, lets it warm up, and watches it for a while.
"""

import argparse
import json
import os
import shutil
import sys
import time
from pathlib import Path
from typing import Any

import psutil

from common.comms.codec import decode
from common.comms.keys import Keys
from common.comms.messages import Status
from common.comms.zenoh_config import ZenohConfig
from common.comms.zenoh_transport import open_zenoh
from common.run_folder import RunFolder, whole_rows
from deploy.config import DeployConfig
from deploy.local import load_endpoint, prepared, specs
from deploy.processes import Family

FATES = ("trained", "refused", "dropped", "in_flight", "lost")


def cpu_seconds(processes: list[psutil.Process]) -> float:
    """Return the CPU time that living processes have used so far [s]."""
    return sum(sum(process.cpu_times()[:2]) for process in processes)


def measure(config: DeployConfig, warm_up_s: float, seconds: float) -> dict[str, Any]:
    """Return the figures of one run."""
    with prepared(config) as (run, folder, config_file):
        return measure_prepared(config, run, folder, config_file, warm_up_s, seconds)


def measure_prepared(
    config: DeployConfig, run: str, folder: RunFolder, config_file: Path, warm_up_s: float, seconds: float
) -> dict[str, Any]:
    """Return the figures of the run that `prepared` gave."""
    family = Family(specs(config, config_file), folder.logs)
    transport = None
    learner: Status | None = None
    try:
        transport = open_zenoh(ZenohConfig(endpoint=load_endpoint(config_file)))
        statuses = transport.subscribe(Keys(run).every_status(), capacity=4096)

        def watch(until: float) -> None:
            nonlocal learner
            while time.monotonic() < until:
                family.watch(time.monotonic())
                if family.status_of("learner-0") is not None:
                    raise SystemExit(f"the learner ended early: see {folder.logs / 'learner-0.log'}")
                for sample in statuses.poll():
                    status = decode(sample.payload, Status)
                    if status.role == "learner":
                        learner = status
                transport.wait(0.5)

        deadline = time.monotonic() + 120.0
        while learner is None or learner.counters["trained"] == 0:
            if time.monotonic() > deadline:
                raise SystemExit(f"nothing was trained within 120 s: see {folder.logs}")
            watch(time.monotonic() + 0.5)
        watch(time.monotonic() + warm_up_s)
        processes = [psutil.Process(child.process.pid) for child in family.children.values()]
        before, cpu_before, started = learner, cpu_seconds(processes), time.monotonic()
        watch(started + seconds)
        cpu, wall, after = cpu_seconds(processes) - cpu_before, time.monotonic() - started, learner
    finally:
        family.stop([name for name in family.children if name != "learner-0"], 10.0)
        family.stop(["learner-0"], 30.0)
        if transport is not None:
            transport.close()
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    rows = whole_rows(folder.metrics)
    window = [
        row for row in rows if before.counters["frames"] < float(row["frames"]) <= after.counters["frames"]
    ]
    # Heartbeats carry the learner's own clock: the frames between two of them over the time between them.
    span = after.time - before.time
    result = {
        "frames_per_s": round((after.counters["frames"] - before.counters["frames"]) / span, 1),
        "idle_share": round(1.0 - cpu / (cores * wall), 4),
        "average_lag": round(sum(float(row["lag"]) for row in window) / max(len(window), 1), 3),
        "published": int(after.counters["published"]),
        **{fate: int(after.counters[fate]) for fate in FATES},
        "unaccounted": int(after.counters["published"] - sum(after.counters[fate] for fate in FATES)),
        "restarts": sum(child.restarts for child in family.children.values()),
        "epochs": len(window),
        "actors": config.actors,
        "cores": cores,
        "cpu_seconds": round(cpu, 1),
        "seconds": round(wall, 1),
    }
    return result


def main() -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.system", description=__doc__)
    parser.add_argument("--json", action="store_true", help="print the figures as one JSON object, last line")
    parser.add_argument(
        "--seconds", type=float, default=60.0, help="length of the measurement [s] (default 60)"
    )
    parser.add_argument(
        "--warm-up", type=float, default=10.0, help="time between the first trained batch and it [s]"
    )
    parser.add_argument("--actors", type=int, default=DeployConfig().actors, help="actor processes")
    parser.add_argument("--keep", action="store_true", help="keep the run folder")
    arguments = parser.parse_args()
    config = DeployConfig(
        run=time.strftime("benchmark-%Y%m%d-%H%M%S"), actors=arguments.actors, evaluate=False, panel="off"
    )
    result = measure(config, arguments.warm_up, arguments.seconds)
    if not arguments.keep:
        shutil.rmtree(Path("runs") / config.run, ignore_errors=True)
    for name, value in result.items():
        print(f"{name:>16} {value}", file=sys.stderr)
    print(json.dumps(result) if arguments.json else "")
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""What a run's processes gain over time: memory, open files and threads.

    python -m benchmarks.soak --minutes 20 --json

It starts a real run with the topology of `deploy.local`, lets it warm up, and fits a line through each process's memory
that no other process shares. The line is the Theil-Sen line: the median of the slopes of all pairs of samples, which
one large sample does not turn.
"""

import logging
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import chdir, suppress
from dataclasses import dataclass, field
from pathlib import Path
from threading import Event
from typing import Any, Final

import numpy as np
import psutil
from pydantic import Field
from scipy.stats import theilslopes

from benchmarks.running import check_learner, running
from benchmarks.settings import BenchmarkConfig, print_figures, run
from common.errors import ReportedError
from common.evaluation.evaluate import check
from common.service.log import set_up_logging
from common.service.process import DONE
from common.service.table import whole_rows
from deploy.config import DeployConfig
from deploy.prepare import PreparedRun, prepared

log = logging.getLogger(__name__)

MIB: Final = 2**20
START_S: Final = 180.0
TOLD_S: Final = 60.0  # between lines of progress


@dataclass(slots=True)
class Series:
    """Samples of one process."""

    times: list[float] = field(default_factory=list)  # [min]
    memory: list[float] = field(default_factory=list)  # [MiB], not shared
    handles: list[int] = field(default_factory=list)
    threads: list[int] = field(default_factory=list)

    def take(self, process: psutil.Process, minutes: float) -> None:
        """Add a sample."""
        self.memory.append(process.memory_full_info().uss / MIB)
        self.handles.append(process.num_fds())
        self.threads.append(process.num_threads())
        self.times.append(minutes)


def slope(times: Sequence[float], values: Sequence[float]) -> tuple[float, float, float]:
    """Return the Theil-Sen slope and its 95 % interval."""
    found = theilslopes(values, times, 0.95)
    return float(found.slope), float(found.low_slope), float(found.high_slope)


def gained(values: Sequence[int]) -> int:
    """Return by how much the median of the last third exceeds that of the first."""
    third = max(len(values) // 3, 1)
    return int(np.median(values[-third:]) - np.median(values[:third]))


def figures(series: Mapping[str, Series]) -> dict[str, Any]:
    """Return what is printed, from the samples of each process by name."""
    slopes = {name: slope(one.times, one.memory) for name, one in series.items()}
    return {
        "memory_slope_mib_per_min_max": round(max(found[0] for found in slopes.values()), 4),
        "memory_slope_mib_per_min": {
            name: {"slope": round(at, 4), "low": round(low, 4), "high": round(high, 4)}
            for name, (at, low, high) in slopes.items()
        },
        "memory_mib": {name: round(one.memory[-1], 1) for name, one in series.items()},
        "handles_gained_max": max(gained(one.handles) for one in series.values()),
        "threads_gained_max": max(gained(one.threads) for one in series.values()),
        "samples": min(len(one.times) for one in series.values()),
    }


class SoakConfig(BenchmarkConfig):
    """Watch the memory, the open files and the threads of a run's processes."""

    minutes: float = Field(
        20.0, gt=0, description="duration after the warm-up", json_schema_extra={"unit": "min"}
    )
    warm_up: float = Field(3.0, ge=0, description="time before it", json_schema_extra={"unit": "min"})
    interval: float = Field(5.0, gt=0, description="between two samples", json_schema_extra={"unit": "s"})
    actors: int = Field(2, ge=1, le=100, description="actor processes")


def watch(run: PreparedRun, config: SoakConfig, stop: Event) -> dict[str, Any]:
    """Return the figures of a run."""
    with running(run) as supervisor:
        series: dict[str, Series] = {}

        def work(seconds: float, samples: bool) -> None:
            began = time.monotonic()
            next_sample, next_line = began, began + TOLD_S
            while (now := time.monotonic()) < began + seconds:
                check(stop)
                supervisor.watch(now)
                check_learner(run, supervisor)
                if samples and now >= next_sample:
                    next_sample += config.interval
                    for name, child in supervisor.children.items():
                        with suppress(psutil.Error):
                            process = psutil.Process(child.process.pid)
                            series.setdefault(name, Series()).take(process, (now - began) / 60.0)
                if now >= next_line:
                    next_line += TOLD_S
                    log.info(
                        "%s minutes=%.0f", "measuring" if samples else "warming up", (now - began) / 60.0
                    )
                time.sleep(0.2)

        deadline = time.monotonic() + START_S
        while not whole_rows(run.folder.metrics):
            if time.monotonic() > deadline:
                raise ReportedError(f"nothing was trained within {START_S:.0f} s: see {run.folder.logs}")
            work(0.5, samples=False)
        work(60.0 * config.warm_up, samples=False)
        before = len(whole_rows(run.folder.metrics))
        work(60.0 * config.minutes, samples=True)
        epochs = len(whole_rows(run.folder.metrics)) - before
        restarts = sum(child.restarts for child in supervisor.children.values())
    return figures(series) | {"epochs": epochs, "restarts": restarts, "minutes": config.minutes}


def main(config: SoakConfig, stop: Event) -> int:
    """Watch and print."""
    set_up_logging("info", "soak")
    folder = Path(tempfile.mkdtemp(prefix="topspin-soak-"))
    settings = DeployConfig(run="soak", actors=config.actors, panel="off")
    with chdir(folder), prepared(settings) as prepared_run:
        result = watch(prepared_run, config, stop)
    shutil.rmtree(folder, ignore_errors=True)
    print_figures(result, config.json_line)
    return DONE


if __name__ == "__main__":
    os.environ.setdefault("PYTHONUNBUFFERED", "1")
    sys.exit(run("soak", SoakConfig, main))

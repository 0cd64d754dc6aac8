"""How long a person waits: for `--help`, for the version, for the first trained batch, for a robot's first observation.

    python -m benchmarks.startup --json

Every figure is the median of fresh processes. Beside it stand a Python that does nothing, and one that imports what
every settings model needs; and the CPU time, which other work on the machine changes less.
"""

import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from threading import Event
from typing import Any, Final

from pydantic import Field

from benchmarks.settings import BenchmarkConfig, print_figures, run
from common.errors import ReportedError
from common.evaluation.evaluate import check
from common.service.process import DONE
from common.service.run_folder import RunFolder
from common.service.table import whole_rows
from deploy.topology import ROLES
from topspin.__main__ import COMMANDS

PROJECT: Final = Path(__file__).parents[1]
HELP: Final = (
    ("-m", "topspin", "--help"),
    *(("-m", "topspin", name, "--help") for name in COMMANDS),
    *(("-m", f"services.{role.name}", "--help") for role in ROLES),
    ("-m", "deploy.local", "--help"),
    ("-m", "deploy.router", "--help"),
)
OTHERS: Final = {
    "version_s": ("-m", "topspin", "--version"),
    "python_s": ("-c", "pass"),
    "pydantic_s": ("-c", "import pydantic_settings; from pydantic import BaseModel"),
}
OBSERVE: Final = """
import json, time, topspin
policy = topspin.load_policy("default")
observer = topspin.Observer(policy.contract.task)
sample = topspin.BallSample((0.5, 0.1, 0.3), (-5.0, 0.0, 0.5), 0, 1.98)
warm_up_s = observer.warm_up()
observer.begin((0.9, -0.3))
started = time.perf_counter()
observer.observe(2.0, [0.0] * 7, [0.0] * 7, sample)
print(json.dumps([warm_up_s, 1e3 * (time.perf_counter() - started)]))
"""
LONGEST_S: Final = 120.0  # to the first batch


def environment() -> dict[str, str]:
    """Return the environment of a process that may start in any folder."""
    paths = [str(PROJECT), *os.environ.get("PYTHONPATH", "").split(os.pathsep)]
    return os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, paths))}


def seconds_of(words: Sequence[str]) -> tuple[float, float]:
    """Return how long a Python process takes from its start to its end, and its CPU time [s]."""
    started, cpu = time.perf_counter(), sum(os.times()[2:4])
    subprocess.run([sys.executable, *words], env=environment(), check=True, stdout=subprocess.DEVNULL)
    return time.perf_counter() - started, sum(os.times()[2:4]) - cpu


def command_figures(processes: int, stop: Event) -> dict[str, Any]:
    """Return the medians of every `--help`, the version and the references; all take turns."""
    taken: dict[tuple[str, ...], list[tuple[float, float]]] = {
        words: [] for words in (*HELP, *OTHERS.values())
    }
    for _ in range(processes):
        for words, found in taken.items():
            check(stop)
            found.append(seconds_of(words))
    median, cpu = (
        {words: round(statistics.median(pair[k] for pair in found), 3) for words, found in taken.items()}
        for k in (0, 1)
    )
    slowest = max(HELP, key=lambda words: median[words])
    return {
        "help_s_max": median[slowest],
        "help_slowest": " ".join(slowest),
        "help_cpu_s_max": max(cpu[words] for words in HELP),
        "version_cpu_s": cpu[OTHERS["version_s"]],
        **{name: median[words] for name, words in OTHERS.items()},
    }


def observe_figures(processes: int, stop: Event) -> dict[str, float]:
    """Return the median of the first observation after the warm-up, and of the warm-up."""
    found = []
    for _ in range(processes):
        check(stop)
        done = subprocess.run(
            [sys.executable, "-c", OBSERVE], env=environment(), check=True, capture_output=True, text=True
        )
        found.append(json.loads(done.stdout))
    warm_up_s, first_ms = (statistics.median(values) for values in zip(*found, strict=True))
    return {"first_observe_ms": round(first_ms, 3), "observe_warm_up_s": round(warm_up_s, 2)}


def first_batch(folder: Path, stop: Event) -> float:
    """Return the time from the start of `topspin train` to the first row of its metrics.csv [s]."""
    metrics = RunFolder(folder / "runs" / "first").metrics
    started = time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, "-m", "topspin", "train", "--run", "first", "--panel", "off"],
        cwd=folder,
        env=environment(),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        while not whole_rows(metrics):
            check(stop)
            if process.poll() is not None or time.perf_counter() - started > LONGEST_S:
                raise ReportedError(f"nothing was trained: status {process.poll()}, {LONGEST_S:.0f} s")
            time.sleep(0.02)
        return time.perf_counter() - started
    finally:
        process.terminate()
        process.wait()


def batch_figures(runs: int, stop: Event) -> dict[str, float]:
    """Return the median time to the first trained batch; {} without runs. Kernels are compiled before."""
    if not runs:
        return {}
    subprocess.run([sys.executable, "-m", "topspin.compile_kernels"], env=environment(), check=True)
    found = []
    for _ in range(runs):
        with tempfile.TemporaryDirectory() as folder:
            found.append(first_batch(Path(folder), stop))
    return {"first_batch_s": round(statistics.median(found), 2), "first_batch_s_max": round(max(found), 2)}


class StartupConfig(BenchmarkConfig):
    """Measure how long a person waits for the help, the version, the first batch, and the first observation."""

    processes: int = Field(5, ge=1, le=1000, description="processes for each figure")
    runs: int = Field(3, ge=0, le=100, description="trainings until their first batch; 0: none")


def main(config: StartupConfig, stop: Event) -> int:
    """Measure and print."""
    found = (
        command_figures(config.processes, stop)
        | batch_figures(config.runs, stop)
        | observe_figures(config.processes, stop)
    )
    print_figures(found | {"processes": config.processes, "runs": config.runs}, config.json_line)
    return DONE


if __name__ == "__main__":
    sys.exit(run("startup", StartupConfig, main))

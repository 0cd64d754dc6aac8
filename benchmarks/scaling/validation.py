"""Predicted frames/s beside those of short real runs on this machine."""

import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from threading import Event
from typing import Any, Final, NamedTuple

import psutil

from benchmarks.running import check_learner, running
from benchmarks.scaling.plan import Plan
from benchmarks.scaling.prediction import Setting, simulated, start_s
from benchmarks.system import cpu_seconds
from common.errors import ReportedError
from common.evaluation.evaluate import check
from common.service.run_folder import LATEST, RUNS
from common.service.table import whole_rows
from deploy.config import DeployConfig
from deploy.prepare import PreparedRun, prepared
from services.actor.config import ENVS, FEWEST_ENVS

RUNS_VALIDATED: Final = ((1, 1), (2, 1), (3, 1), (2, 2))  # actors, learners
LONGEST_S: Final = 120.0  # without a row of the run's metrics
LOOK_S: Final = 0.2
BUSY: Final = ("user", "nice", "system", "irq", "softirq", "steal")  # what a core does when it is not idle


@dataclass(frozen=True, slots=True)
class Measured:
    """A real run."""

    frames_per_s: float
    lag: float
    start_s: float  # from the start of its processes to its first trained dataset
    cores_used: float  # by the run
    others: (
        float  # cores that other work of the machine used meanwhile: near 0, or the figures are not the run's
    )


def rate(rows: Sequence[Mapping[str, str]], warm_up_s: float) -> tuple[float, float]:
    """Return frames/s and the mean lag of the datasets after the warm-up, from rows of metrics.csv.

    The first row after the warm-up is where the time begins: its own frames are not counted.

    Raises:
        ReportedError: Fewer than two datasets came after it.
    """
    after = [row for row in rows if float(row["seconds"]) >= warm_up_s]
    if len(after) < 2:
        raise ReportedError(
            f"{len(after)} datasets after a warm-up of {warm_up_s:g} s; allowed: two or more, with more --seconds"
        )
    span = float(after[-1]["seconds"]) - float(after[0]["seconds"])
    frames = float(after[-1]["frames"]) - float(after[0]["frames"])
    return frames / span, sum(float(row["lag"]) for row in after[1:]) / (len(after) - 1)


def measured(run: PreparedRun, warm_up_s: float, seconds: float, stop: Event) -> Measured:
    """Return what a run does for ``seconds`` after its warm-up, which begins with its first trained dataset."""
    started, first = time.monotonic(), 0.0
    before: Used | None = None
    with running(run) as supervisor:
        rows: list[dict[str, str]] = []
        while not rows or float(rows[-1]["seconds"]) < warm_up_s + seconds:
            check(stop)
            supervisor.watch(time.monotonic())
            check_learner(run, supervisor)
            time.sleep(LOOK_S)
            rows, now = whole_rows(run.folder.metrics), time.monotonic() - started
            first = first or (now if rows else 0.0)
            if before is None and rows and float(rows[-1]["seconds"]) >= warm_up_s:
                before = used()
            if now > LONGEST_S + (warm_up_s + seconds if rows else 0.0):
                raise ReportedError(f"too little was trained in {now:.0f} s: see {run.folder.logs}")
        after = used()
    before = before or after
    wall = max(after.wall - before.wall, 1e-9)
    own = (after.own - before.own) / wall
    return Measured(*rate(rows, warm_up_s), first, own, (after.machine - before.machine) / wall - own)


class Used(NamedTuple):
    """CPU time so far [s]."""

    wall: float  # on the clock
    own: float  # of this process, and of those that it has started
    machine: float  # of all processes


def used() -> Used:
    """Return what has been used so far."""
    me, times = psutil.Process(), psutil.cpu_times()
    own = cpu_seconds([me, *me.children(recursive=True)])
    return Used(time.monotonic(), own, sum(getattr(times, name, 0.0) for name in BUSY))


def validate(
    setting: Setting, cores: int, warm_up_s: float, seconds: float, stop: Event
) -> list[dict[str, Any]]:
    """Return predicted and measured figures of each run; one after the other, without an evaluator."""
    return [_compared(setting, cores, *sizes, warm_up_s, seconds, stop) for sizes in RUNS_VALIDATED]


def _compared(
    setting: Setting, cores: int, actors: int, learners: int, warm_up_s: float, seconds: float, stop: Event
) -> dict[str, Any]:
    name = time.strftime(f"scaling-%Y%m%d-%H%M%S-{actors}-{learners}")
    config = DeployConfig(run=name, actors=actors, learners=learners, evaluate=False, panel="off")
    with prepared(config) as run:
        found = measured(run, warm_up_s, seconds, stop)
    shutil.rmtree(run.folder.root, ignore_errors=True)
    if not (RUNS / LATEST).exists():  # the link to the folder that is gone
        (RUNS / LATEST).unlink(missing_ok=True)
    envs = max(FEWEST_ENVS, ENVS // actors)
    plan = Plan(cores=cores, actors=actors, learners=learners, envs=envs, evaluates=False)
    predicted = simulated(plan, setting)
    # Other work is load like a generator's: what the run was left with is predicted too
    left = simulated(replace(plan, cores=max(cores - max(found.others, 0.0), 0.1 * cores)), setting)
    return {
        "actors": actors,
        "learners": learners,
        "predicted": round(predicted.frames_per_s, 1),
        "measured": round(found.frames_per_s, 1),
        "error": round(predicted.frames_per_s / found.frames_per_s - 1.0, 4),
        "predicted_beside_others": round(left.frames_per_s, 1),
        "error_beside_others": round(left.frames_per_s / found.frames_per_s - 1.0, 4),
        "cores_predicted": round(predicted.cores_used + actors * setting.costs.generator_share, 2),
        "cores_measured": round(found.cores_used, 2),
        "others": round(found.others, 2),
        "lag_predicted": round(predicted.lag, 3),
        "lag_measured": round(found.lag, 3),
        "start_s_predicted": round(start_s(plan, setting.costs), 1),
        "start_s_measured": round(found.start_s, 1),
    }

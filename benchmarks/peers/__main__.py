"""Our training beside other trainers, on the same task, with the same batch, on the same cores, by the same clock.

    python -m benchmarks.peers --json                                             # about 41 minutes on two cores
    python -m benchmarks.peers --json --repeats 1 --minutes 0.75 --tune-seconds 0     # about 10 minutes

Each peer trains our Gymnasium vector environment, stage 1, in a virtual environment of its own, which is thrown away.
All have 256 environments, 32 steps, 4 passes in minibatches of 2,048, our network's shape, and our learner's values
where they have such a setting; everything else is a peer's own way. Each has a launch script in ``launch``. Ours is
`topspin train`. Time is wall time from the start of a trainer's process. Trainings are interleaved, and each policy is
judged afterwards on the same balls, without noise, by our evaluator's match.
"""

import importlib.metadata
import math
import shutil
import sys
import tempfile
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from statistics import median
from threading import Event
from typing import Any, Final

import torch
from pydantic import Field

from benchmarks.peers import task
from benchmarks.peers.measuring import Trained, catch_rate, fresh_balls, seconds_to_goal, train
from benchmarks.peers.trainers import OURS, SHARED, Trainer, find_trainers, install
from benchmarks.settings import BenchmarkConfig, print_figures, run
from common.errors import ReportedError, StoppedError
from common.evaluation.evaluate import check

FINAL_BALLS: Final = 1000
CURVE_BALLS: Final = 400  # of the policies on the way


class PeersConfig(BenchmarkConfig):
    """Compare our training with other trainers: frames per second, per CPU second, and catch rate by wall time."""

    repeats: int = Field(3, ge=1, le=100, description="trainings of each trainer")
    minutes: float = Field(
        1.25,
        gt=0,
        description="wall time of each training, with its start",
        json_schema_extra={"unit": "min"},
    )
    peers: tuple[str, ...] = Field(
        (), description="peers: single_file, sb3, rsl_rl, pufferlib, sample_factory, rllib; empty: all"
    )
    tune_seconds: float = Field(
        25.0,
        ge=0,
        description="trial in which a peer of one process chooses between 1 thread and all cores; 0: all cores",
        json_schema_extra={"unit": "s"},
    )
    keep: bool = Field(False, description="keep environments, logs and policies, and say where")


class Contest:
    """The trainers that run here, and what they reached.

    Args:
        config: Settings.
        folder: For everything that they write.
        stop: Set by Ctrl-C.
    """

    def __init__(self, config: PeersConfig, folder: Path, stop: Event) -> None:
        self._config, self._folder, self._stop = config, folder, stop
        self._pythons: dict[str, str] = {}
        self._threads: dict[str, int] = {}
        self._rows: dict[str, list[dict[str, Any]]] = {}
        self._failures: dict[str, list[str]] = {}
        self._final, self._curve = fresh_balls(FINAL_BALLS), fresh_balls(CURVE_BALLS)
        self.trainers = find_trainers(config.peers)

    def run(self) -> None:
        """Install, tune and train. What fails is left out, and said."""
        for trainer in self.trainers:
            self._guarded(trainer, self._prepare)
        ready = [trainer for trainer in self.trainers if trainer.name in self._threads]
        for repeat in range(self._config.repeats):
            shift = repeat % len(ready) if ready else 0
            for trainer in (*ready[shift:], *ready[:shift]):
                self._guarded(trainer, partial(self._train, repeat=repeat))

    def _guarded(self, trainer: Trainer, act: Callable[[Trainer], None]) -> None:
        """Do something with a trainer; note why it failed."""
        try:
            act(trainer)
        except StoppedError:
            raise
        except ReportedError as error:
            self._failures.setdefault(trainer.name, []).append(str(error))
            print(f"{error}", file=sys.stderr, flush=True)

    def _prepare(self, trainer: Trainer) -> None:
        """Install a trainer, and choose its threads."""
        self._pythons[trainer.name] = install(trainer, self._folder)
        several = task.CORES if trainer.is_one_process else 1
        seconds, rates = self._config.tune_seconds, {}
        if several > 1 and seconds:
            for threads in (1, several):
                with suppress(ReportedError):  # too slow to say anything
                    rates[threads] = self._once(trainer, f"tune-{threads}", seconds, 0, threads).frames_per_s
        self._threads[trainer.name] = max(rates, key=rates.__getitem__) if rates else several
        print(f"{trainer.name}: {self._threads[trainer.name]} threads", file=sys.stderr, flush=True)

    def _once(self, trainer: Trainer, name: str, seconds: float, seed: int, threads: int) -> Trained:
        folder = self._folder / f"{trainer.name}-{name}"
        return train(trainer, self._pythons[trainer.name], folder, seconds, seed, threads, self._stop)

    def _train(self, trainer: Trainer, repeat: int) -> None:
        """Train once, and judge."""
        seconds, threads = 60.0 * self._config.minutes, self._threads[trainer.name]
        trained = self._once(trainer, str(repeat), seconds, 1 + repeat, threads)
        if not trained.policies:
            raise ReportedError(f"{trainer.name}: saved no policy")
        row = {
            "frames_per_s": trained.frames_per_s,
            "frames_per_cpu_s": trained.frames_per_cpu_s,
            "cores": trained.cores,
            "frames": trained.frames,
            "catch_rate": catch_rate(trained.policies[-1][1], self._final, lambda: check(self._stop)),
            "seconds_to_catch_080": seconds_to_goal(trained.policies, self._curve, lambda: check(self._stop)),
        }
        self._rows.setdefault(trainer.name, []).append(row)
        shown = "  ".join(
            f"{name} {value if value is None else round(value, 3)}" for name, value in row.items()
        )
        print(f"{trainer.name}: {shown}", file=sys.stderr, flush=True)

    def figures(self) -> dict[str, Any]:
        """Return all figures: medians with ranges of each trainer, and ours over the best peer's."""
        found = {name: summary(rows) for name, rows in self._rows.items()}
        peers = [self._described(trainer) | found.get(trainer.name, {}) for trainer in self.trainers]
        others = [found[name] for name in found if name != OURS]
        ours = found.get(OURS)
        times = {name: row["seconds_to_catch_080"] or math.inf for name, row in found.items()}
        first = min(times, key=times.__getitem__, default=None)
        return {
            "speedup_over_best": over_best(ours, others, "frames_per_s"),
            "frames_per_cpu_s_over_best": over_best(ours, others, "frames_per_cpu_s"),
            "first_to_catch_080": first if first and math.isfinite(times[first]) else None,
            "minutes": self._config.minutes,
            "repeats": self._config.repeats,
            "cores": task.CORES,
            "shared": {name: importlib.metadata.version(name) for name in SHARED},
            "peers": peers,
        }

    def _described(self, trainer: Trainer) -> dict[str, Any]:
        """Return what a trainer is, and why it was not run, or failed in some of its trainings."""
        failures = self._failures.get(trainer.name, [])
        if trainer.name not in self._rows:
            return {"peer": trainer.name, "not_run": failures[0] if failures else "stopped before"}
        return {
            "peer": trainer.name,
            "version": trainer.version,
            "network": trainer.network or "ours",
            "threads": self._threads[trainer.name] if trainer.is_one_process else "one a process",
            **({"failures": failures} if failures else {}),
        }


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the medians of a trainer's trainings, with the ranges of those that count.

    A training that did not reach the goal took longer than any that did.
    """
    result: dict[str, Any] = {}
    for name in ("frames_per_s", "frames_per_cpu_s", "cores", "frames", "catch_rate"):
        values = [float(row[name]) for row in rows]
        result[name] = round(median(values), 3)
        result[f"{name}_range"] = [round(min(values), 3), round(max(values), 3)]
    times = [row["seconds_to_catch_080"] or math.inf for row in rows]
    result["seconds_to_catch_080"] = median(times) if math.isfinite(median(times)) else None
    result["reached_080"] = sum(map(math.isfinite, times))
    return result


def over_best(ours: dict[str, Any] | None, others: list[dict[str, Any]], name: str) -> float | None:
    """Return our median over the best peer's; None: there is none of one of them."""
    if ours is None or not others:
        return None
    best: float = max(other[name] for other in others)
    return round(float(ours[name]) / best, 3)


def main(config: PeersConfig, stop: Event) -> int:
    """Measure and print."""
    torch.set_num_threads(1)
    folder = Path(tempfile.mkdtemp(prefix="topspin-peers-"))
    try:
        contest = Contest(config, folder, stop)
        contest.run()
        figures = contest.figures()
    finally:
        if config.keep:
            print(f"kept: {folder}", file=sys.stderr)
        else:
            shutil.rmtree(folder, ignore_errors=True)
    print_figures(figures, config.json_line)
    return 0


if __name__ == "__main__":
    sys.exit(run("peers", PeersConfig, main))

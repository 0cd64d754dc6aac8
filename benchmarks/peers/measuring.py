"""One training of one trainer, watched from outside, and the judgement of the policies that it left."""

import os
import re
import signal
import subprocess
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from threading import Event
from typing import Final

import numpy as np
import numpy.typing as npt
import psutil
import torch

from benchmarks.peers import task
from benchmarks.peers.trainers import PROJECT, Trainer
from common.errors import ReportedError
from common.evaluation.evaluate import check
from common.evaluation.match import Acts, evaluation_rallies, play_match
from common.policy.folder import load_policy
from common.task.launch import RallyBlock

Floats = npt.NDArray[np.float32]

LOOK_S: Final = 0.5
SETTLE_S: Final = 5.0  # after the first update, before the rate is measured
PATIENCE_S: Final = 90.0  # to end in, after the time is up
GOAL: Final = 0.8  # [share] of balls caught
_COLOUR: Final = re.compile(r"\x1b\[[0-9;]*m")  # of a terminal
FRESH_SEED: Final = 1_000_003  # of balls that no trainer has


@dataclass(frozen=True, slots=True)
class Trained:
    """What a training left."""

    frames_per_s: float
    frames_per_cpu_s: float
    cores: float  # that it used
    frames: int
    policies: list[tuple[float, Path]]  # [s] since the start, and the file; oldest first


class SavedPolicy:
    """A policy that ``task.save`` wrote."""

    def __init__(self, file: Path) -> None:
        self._policy = task.load(file)

    def act(self, obs: Floats) -> Floats:
        """Return the deterministic actions (B, 7) for observations (B, D); only the policy's part is used."""
        with torch.inference_mode():
            actions: Floats = self._policy(torch.from_numpy(obs[:, : task.OBS])).numpy()
        return actions


class CpuMeter:
    """The CPU time of a process and of all that it has started [s]."""

    def __init__(self, pid: int) -> None:
        self._process = psutil.Process(pid)
        self.members: dict[int, psutil.Process] = {}  # all that it has started so far
        self._used: dict[int, float] = {}  # by process, the ended ones too
        self.samples: list[tuple[float, float]] = []  # wall time and CPU time so far

    def look(self, now: float) -> None:
        """Take a sample."""
        with suppress(psutil.NoSuchProcess):
            self.members |= {child.pid: child for child in self._process.children(recursive=True)}
        for process in (self._process, *self.members.values()):
            with suppress(psutil.NoSuchProcess):
                self._used[process.pid] = sum(process.cpu_times()[:2])
        self.samples.append((now, sum(self._used.values())))

    def at(self, moment: float) -> float:
        """Return the CPU time used until a moment."""
        times, used = np.array(self.samples).T
        return float(np.interp(moment, times, used))


def train(
    trainer: Trainer, python: str, folder: Path, seconds: float, seed: int, threads: int, stop: Event
) -> Trained:
    """Let a trainer train for ``seconds`` from the start of its process on.

    Raises:
        ReportedError: It failed, or made no two updates; the text has the end of its log.
    """
    folder.mkdir(parents=True)
    started = time.time()
    flags = [f"--started={started}", f"--seconds={seconds}", f"--seed={seed}", f"--threads={threads}"]
    log = folder / "log.txt"
    with log.open("wb") as out:
        process = subprocess.Popen(
            [python, "-m", f"benchmarks.peers.{trainer.module}", str(folder), *flags],
            cwd=PROJECT,
            env={**os.environ, "PYTHONPATH": str(PROJECT)},  # for the processes that it starts
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        meter = CpuMeter(process.pid)
        try:
            while process.poll() is None and time.time() - started < seconds + PATIENCE_S:
                check(stop)
                meter.look(time.time() - started)
                time.sleep(LOOK_S)
        finally:
            end(process, meter)
    return figures_of(trainer, folder, log, meter)


def end(process: subprocess.Popen[bytes], meter: CpuMeter) -> None:
    """End a trainer's processes, those too whose parent has ended."""
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    for member in meter.members.values():
        with suppress(psutil.NoSuchProcess):  # one whose number another process has now is no member
            member.kill()


def figures_of(trainer: Trainer, folder: Path, log: Path, meter: CpuMeter) -> Trained:
    """Return the figures of a training that is over."""
    file = folder / task.PROGRESS
    lines = file.read_text(encoding="utf-8").splitlines() if file.exists() else []
    rows = np.array([[float(value) for value in line.split(",")] for line in lines]).reshape(-1, 2)
    settled = rows[rows[:, 0] >= rows[0, 0] + SETTLE_S] if len(rows) else rows
    settled = settled if len(settled) > 1 else rows
    if len(settled) < 2:
        said = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        last = _COLOUR.sub("", said[-1]) if said else "nothing"
        raise ReportedError(f"{trainer.name}: {len(rows)} updates; it said last: {last}")
    (start, before), (over, after) = settled[0], settled[-1]
    used = meter.at(over) - meter.at(start)
    return Trained(
        frames_per_s=float((after - before) / (over - start)),
        frames_per_cpu_s=float((after - before) / used),
        cores=float(used / (over - start)),
        frames=int(after),
        policies=sorted((float(path.name.split("-")[0]), path) for path in _policies(folder)),
    )


def _policies(folder: Path) -> list[Path]:
    return [path for path in folder.iterdir() if path.name[0].isdigit() and path.suffix != ".part"]


def fresh_balls(count: int) -> RallyBlock:
    """Return the balls that every policy is judged on."""
    return evaluation_rallies(count, task.TASK, FRESH_SEED)


def catch_rate(path: Path, balls: RallyBlock, on_tick: Callable[[], None]) -> float:
    """Return the share of balls that a saved policy catches, without noise."""
    policy: Acts = load_policy(path) if path.is_dir() else SavedPolicy(path)
    return float(play_match(policy, balls, task.TASK, task.ENVS, on_tick).caught.mean())


def seconds_to_goal(
    policies: list[tuple[float, Path]], balls: RallyBlock, on_tick: Callable[[], None]
) -> float | None:
    """Return when the first policy was saved that catches ``GOAL`` [s]; None: none does."""
    return next((at for at, path in policies if catch_rate(path, balls, on_tick) >= GOAL), None)

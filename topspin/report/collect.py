"""Reading a run folder: settings, curves and policy. Each may be missing, and is then reported as missing."""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from common.errors import ConfigError
from common.policy.contract import PolicyError
from common.policy.folder import Policy, load_policy
from common.service.run_folder import LATEST, RUNS, RunFolder
from common.service.table import whole_rows

Array = npt.NDArray[np.float64]

CURVES: Final = ("target_error_mean", "catch_rate", "over_rate", "return_rate")
"""The paper's curves: average target error, catching, returning and return-to-opponent rate."""


class RunError(ConfigError):
    """A run that can't be reported on: one line."""


@dataclass(frozen=True, slots=True)
class TrainingCurve:
    """A run's epochs, from metrics.csv."""

    frames: Array  # (n,)
    seconds: Array  # (n,) since the first trained batch, through restarts
    stages: Array  # (n,)

    @property
    def reached(self) -> tuple[int, ...]:
        """The stages that were trained, in order."""
        return tuple(sorted({int(stage) for stage in self.stages if np.isfinite(stage)}))

    def stage_changes(self) -> list[tuple[int, float]]:
        """Return (stage, frames at which it began) of every stage after the first."""
        where = np.flatnonzero(np.diff(self.stages)) + 1
        return [(int(self.stages[k]), float(self.frames[k - 1])) for k in where]


@dataclass(frozen=True, slots=True)
class Curve:
    """The evaluations of a run while it trained, from report/evaluations.csv."""

    frames: Array  # (n,)
    minutes: Array  # (n,) of training
    values: Mapping[str, Array]  # CURVES by name, (n,) each, nan where nothing landed


@dataclass(frozen=True, slots=True)
class Run:
    """The content of a run folder."""

    name: str
    settings: Mapping[str, Any]  # config.toml
    training: TrainingCurve | None
    curve: Curve | None
    policy: Policy | None
    missing: tuple[str, ...]  # missing parts, in words


def find(run: str) -> RunFolder:
    """Return the folder of a run, given by name or as a folder. Raises RunError with the runs that exist."""
    for folder in (RunFolder.of(run), RunFolder(Path(run))):
        if folder.config.is_file():
            return RunFolder(folder.root.resolve())
    known = sorted(path.parent.name for path in RUNS.glob("*/config.toml") if path.parent.name != LATEST)
    there = f"runs there: {', '.join(known)}" if known else f"there are no runs in {RUNS}/"
    raise RunError(f"no run {run!r}: neither {RUNS}/{run} nor {run} is a folder with a config.toml; {there}")


def read(run: str, which: str = "best") -> Run:
    """Return the content of a run's folder; ``which`` of its policies: best or latest."""
    folder = find(run)
    missing = []
    try:
        settings = tomllib.loads(folder.config.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise RunError(f"{folder.config} is not TOML: {error}") from None
    training = training_curve(folder.metrics)
    if training is None:
        missing.append("no epochs in metrics.csv: frames, hours and stages are unknown")
    curve = evaluation_curve(folder.evaluations, training)
    if curve is None:
        missing.append(f"no evaluations in report/{folder.evaluations.name}: it has no training curves")
    policy = None
    path = folder.best_policy if which == "best" else folder.latest_policy
    try:
        policy = load_policy(path)
    except PolicyError as error:
        other = folder.latest_policy if which == "best" else folder.best_policy
        hint = f"; it has policy/{other.name}: --policy {other.name}" if other.exists() else ""
        why = (
            f"can't be played: {str(error).replace(f'{folder.root}/', '')}"
            if path.exists()
            else "isn't there"
        )
        missing.append(f"policy/{which} {why}; it has no measures{hint}")
    if policy is None and curve is None:
        raise RunError(f"run {folder.root.name!r} has nothing to report: {'; '.join(missing)}")
    return Run(folder.root.name, settings, training, curve, policy, tuple(missing))


def _column(rows: list[dict[str, str]], name: str) -> Array:
    return np.array([float(row.get(name) or "nan") for row in rows])


def training_curve(path: Path) -> TrainingCurve | None:
    """Return a run's epochs from its metrics.csv; None before the first."""
    rows = whole_rows(path)
    if not rows:
        return None
    return TrainingCurve(*(_column(rows, name) for name in ("frames", "seconds", "stage")))


def evaluation_curve(path: Path, training: TrainingCurve | None) -> Curve | None:
    """Return a run's evaluations from its evaluations.csv; None before the first."""
    rows = whole_rows(path)
    if not rows:
        return None
    frames = _column(rows, "frames")
    # A resumed run continues from its newest checkpoint: later evaluations are made again.
    kept = [k for k in range(len(frames)) if frames[k] < frames[k + 1 :].min(initial=np.inf)]
    rows, frames = [rows[k] for k in kept], frames[kept]
    # The evaluator's clock restarts with its process; the learner's continues.
    seconds = _column(rows, "seconds")
    if training is not None:
        seconds = np.interp(frames, np.append(0, training.frames), np.append(0, training.seconds))
    return Curve(frames, seconds / 60, {name: _column(rows, name) for name in CURVES})

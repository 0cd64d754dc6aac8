"""Time from an untrained policy to the paper's figures, over several seeds.

    python -m benchmarks.time_to_quality --seeds 5 --json

Each seed is a real run of `deploy.local`, one after the other. Its evaluator's curve says when a policy may have
reached the goal: 81 % of 1,000 balls returned, 0.31 m from the target. Every evaluated policy is kept, and the one of
such a row plays 1,000 other balls while training goes on. The time counts only if it meets the goal on these as well:
balls that choose a policy flatter it. The figures printed for a run are those of a third set of balls. Time is wall
time from the start of the command, with imports and start-up. A run that does not reach the goal counts as slower than
all that do. Balls, noise and contacts are those of the training (``--more``). Each seed's figures are kept with its
run: with ``--run NAME`` the program goes on with the next seed. A seed that was stopped is trained anew, since its time
is unknown; what it left is moved aside.
"""

import csv
import json
import math
import shlex
import signal
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import count
from pathlib import Path
from threading import Event
from typing import Any, Final, NamedTuple

from pydantic import Field

from benchmarks.settings import BenchmarkConfig, as_flags, run
from benchmarks.trainings import Wanted, check, evaluated
from common.errors import ReportedError
from common.policy.folder import load_policy
from common.service.run_folder import RunFolder
from common.service.table import whole_rows
from common.service.whole_file import write_whole
from common.task.config import MatchConditions

RETURN_RATE, TARGET_ERROR = 0.81, 0.31  # [share], [m] the paper's table
LOOK_S: Final = 1.0
PATIENCE_S: Final = 180.0  # in which a run ends and measures its policy
RALLIES: Final = 1000
# The run's evaluator chooses on the rallies of the run's seed. These are other ones:
CONFIRMING_SEED, REPORTED_SEED = 1_000_003, 2_000_003
CURVE: Final = (
    "minutes",
    "frames",
    "stage",
    "catch_rate",
    "return_rate",
    "return_after_catch",
    "target_error_mean",
)


class TimeToQualityConfig(BenchmarkConfig):
    """Measure how long training takes to the paper's figures: return rate and distance to the target.

    The exit status is 1 if a seed did not reach the goal.
    """

    seeds: int = Field(
        1, ge=1, le=100, description="runs, one after the other, with seeds 0, 1, ...; 5 make a range"
    )
    minutes: float = Field(
        60.0, gt=0, description="limit of each training", json_schema_extra={"unit": "min"}
    )
    run: str = Field(
        "",
        description="name of the runs, before -SEED; empty: a time stamp. Runs of this name that were measured with "
        "the same settings are not trained again",
    )
    return_rate: float = Field(RETURN_RATE, ge=0, le=1, description="goal; default: the paper's")
    target_error: float = Field(
        TARGET_ERROR, gt=0, description="goal; default: the paper's", json_schema_extra={"unit": "m"}
    )
    more: str = Field("", description="more flags of deploy.local: --more='--actors 2 --task.launch strong'")


class Goal(NamedTuple):
    """What a policy must reach."""

    return_rate: float  # at least
    target_error: float  # [m] at most

    def is_met(self, measures: Mapping[str, Any]) -> bool:
        """Return whether an evaluation meets both figures."""
        error = float(measures["target_error_mean"] or math.inf)
        return float(measures["return_rate"] or 0.0) >= self.return_rate and error <= self.target_error


def first_passage(
    rows: Iterable[Mapping[str, Any]], goal: Goal, is_confirmed: Callable[[Mapping[str, Any]], bool]
) -> Mapping[str, Any] | None:
    """Return the first row of a curve in which the goal is reached, or None.

    Args:
        rows: Evaluations, oldest first.
        goal: What counts.
        is_confirmed: Returns whether the policy of a row meets the goal on other balls.
    """
    return next((row for row in rows if goal.is_met(row) and is_confirmed(row)), None)


def match_flags(policy: Path) -> list[str]:
    """Return the flags of ``topspin evaluate`` for the conditions under which a policy is trained."""
    conditions = MatchConditions.model_validate(
        load_policy(policy).contract.task.model_dump(include=set(MatchConditions.model_fields))
    )
    return as_flags({name.replace("_", "-"): value for name, value in conditions})


def measure(policy: Path, seed: int) -> dict[str, Any]:
    """Return a policy's measures on rallies of ``seed``, under the conditions of its training."""
    return evaluated(policy, ["--rallies", str(RALLIES), "--seed", str(seed), *match_flags(policy)])


def train(
    config: TimeToQualityConfig, name: str, seed: int, stop: Event, resumes: bool = False
) -> dict[str, Any] | None:
    """Train a run until the goal or the end of its time, and return its figures; None if it was stopped before.

    Args:
        config: Settings.
        name: Of the run.
        seed: Of the run.
        stop: Ends it.
        resumes: Whether a run that is there goes on; its minutes are then those since now.

    Raises:
        ReportedError: The run that is there has other settings, or the training failed.
    """
    folder, goal = RunFolder.of(name), Goal(config.return_rate, config.target_error)
    flags = ["--seed", str(seed), "--evaluator.keep-policies", "true", *shlex.split(config.more)]
    run = ["--run", name, *flags, "--minutes", str(config.minutes)]
    if folder.config.exists() and resumes:
        check(Wanted(name, tuple(flags)), folder)
        run = ["--run", name, "--resume"]
    elif folder.config.exists():
        set_aside(folder)
    started = time.monotonic()
    curve: list[dict[str, Any]] = []
    passage = None
    training = subprocess.Popen(
        [sys.executable, "-m", "deploy.local", *run, "--panel", "off"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,  # a Ctrl-C in the terminal reaches it once, from here
    )

    def policy_of(row: Mapping[str, Any]) -> Path:
        return folder.evaluated_policy(int(row["version"]))

    def is_confirmed(row: Mapping[str, Any]) -> bool:
        return not stop.is_set() and goal.is_met(measure(policy_of(row), CONFIRMING_SEED))

    with training as process:
        try:
            is_running = True
            while is_running and passage is None and not stop.is_set():
                is_running = process.poll() is None  # asked first: the last rows are looked at too
                new: list[dict[str, Any]] = [
                    dict(row) for row in whole_rows(folder.evaluations)[len(curve) :]
                ]
                for row in new:
                    row["minutes"] = round((time.monotonic() - started) / 60.0, 2)
                    shown = "  ".join(f"{key} {row[key]}" for key in CURVE)
                    print(f"seed {seed}  {shown}", file=sys.stderr, flush=True)
                curve += new
                passage = first_passage(new, goal, is_confirmed)
                stop.wait(LOOK_S)
        finally:
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
                process.wait(PATIENCE_S)
    if passage is None and stop.is_set():
        return None
    if not curve or (passage is None and training.returncode):
        what = "was not evaluated" if not curve else f"ended with {training.returncode}"
        raise ReportedError(f"training {name} {what}: see {folder.logs}")
    reported = measure(policy_of(passage) if passage else folder.best_policy, REPORTED_SEED)
    _write(curve, folder.report / "time_to_quality.csv")
    at = passage or curve[-1]
    return {
        "run": name,
        "seed": seed,
        "reached": passage is not None,
        "minutes": at["minutes"],
        "frames": int(at["frames"]),
        **{key: reported[key] for key in ("return_rate", "return_after_catch", "target_error_mean")},
    }


def set_aside(folder: RunFolder) -> None:
    """Rename a run's folder: NAME-aside-1, or the next free number."""
    free = next(
        path
        for n in count(1)
        if not (path := folder.root.with_name(f"{folder.root.name}-aside-{n}")).exists()
    )
    folder.root.rename(free)
    print(f"{folder.root} was stopped, or has other settings: moved to {free}", file=sys.stderr, flush=True)


def measured(config: TimeToQualityConfig, name: str, seed: int, stop: Event) -> dict[str, Any] | None:
    """Return the figures of a run that was measured before, or train and measure it; None if it was stopped."""
    file = RunFolder.of(name).report / "time_to_quality.json"
    asked = config.model_dump(mode="json", include={"minutes", "return_rate", "target_error", "more"})
    if file.is_file():
        known = json.loads(file.read_text(encoding="utf-8"))
        if known["asked"] == asked:
            found: dict[str, Any] = known["found"]
            return found
    trained = train(config, name, seed, stop)
    if trained is not None:
        write_whole(file, json.dumps({"asked": asked, "found": trained}) + "\n")
    return trained


def _write(curve: Sequence[Mapping[str, Any]], path: Path) -> None:
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, CURVE, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(curve)


def spread(runs: Sequence[Mapping[str, Any]], key: str) -> dict[str, float | None]:
    """Return median, lowest and highest of one figure; None where they belong to a run that missed the goal."""
    values = sorted(run[key] if run["reached"] else math.inf for run in runs)
    found = {"median": statistics.median(values), "lowest": values[0], "highest": values[-1]}
    return {name: round(value, 2) if math.isfinite(value) else None for name, value in found.items()}


def main(config: TimeToQualityConfig, stop: Event) -> int:
    """Train, measure and print."""
    base = config.run or time.strftime("quality-%Y%m%d-%H%M%S")
    runs: list[dict[str, Any]] = []
    for seed in range(config.seeds):
        found = None if stop.is_set() else measured(config, f"{base}-{seed}", seed, stop)
        if found is None:
            break  # a seed that was stopped says nothing
        runs.append(found)
        print("  ".join(f"{key} {value}" for key, value in runs[-1].items()), file=sys.stderr, flush=True)
    if not runs:
        raise ReportedError("stopped before the first seed had ended")
    result = {
        "goal_return_rate": config.return_rate,
        "goal_target_error": config.target_error,
        "reached": sum(run["reached"] for run in runs),
        "seeds": len(runs),
        "minutes": spread(runs, "minutes"),
        "frames": spread(runs, "frames"),
        "runs": runs,
    }
    if config.json_line:
        print(json.dumps(result))
    else:
        minutes, frames = result["minutes"], result["frames"]
        print(
            f"{result['reached']} of {len(runs)} reached {config.return_rate:.0%} at {config.target_error} m: "
            f"minutes {minutes}, frames {frames}"
        )
    return 0 if result["reached"] == len(runs) else 1


if __name__ == "__main__":
    sys.exit(run("time_to_quality", TimeToQualityConfig, main))

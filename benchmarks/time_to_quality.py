"""Time from an untrained policy to the paper's figures, over several seeds.

    python -m benchmarks.time_to_quality --seeds 5 --json

Each seed is a real run of `deploy.local`, one after the other. Its evaluator's curve says when a policy may have
reached the goal: 81 % of 1,000 balls returned, 0.31 m from the target. That policy then plays 1,000 other balls while
training goes on, and the time counts only if it meets the goal on these as well: balls that choose a policy flatter
it. The figures printed for a run are those of a third set of balls. Time is wall time from the start of the command,
with imports and start-up. A run that does not reach the goal counts as slower than all that do. Balls, noise and
contacts are those of the training (``--more``). Each seed's figures are kept with its run: with ``--run NAME`` the
program goes on where it was stopped, with the next seed.
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
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from threading import Event
from typing import Any, Final, NamedTuple

from pydantic import Field

from benchmarks.settings import BenchmarkConfig, as_flags, run
from common.errors import ReportedError
from common.policy.contract import PolicyError
from common.policy.folder import load_policy, save_policy
from common.service.run_folder import RunFolder
from common.service.table import whole_rows
from common.service.whole_file import write_whole
from common.task.config import MatchConditions

RETURN_RATE, TARGET_ERROR = 0.81, 0.31  # [share], [m] the paper's table
LOOK_S: Final = 1.0
SAVED_S: Final = 10.0  # in which the policy of a row is written
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
    curve: Sequence[Mapping[str, Any]],
    asked: int,
    goal: Goal,
    is_confirmed: Callable[[Mapping[str, Any]], bool],
) -> Mapping[str, Any] | None:
    """Return the row of a curve in which the goal was first reached, or None.

    Only the newest row is confirmed: the policies of others are no longer at hand.

    Args:
        curve: Evaluations so far.
        asked: Rows that have been looked at before.
        goal: What counts.
        is_confirmed: Returns whether the policy of a row is at hand, and meets the goal on other balls.
    """
    if len(curve) <= asked or not goal.is_met(curve[-1]):
        return None
    return curve[-1] if is_confirmed(curve[-1]) else None


def kept(folder: RunFolder, row: Mapping[str, Any], wait_s: float = SAVED_S) -> Path | None:
    """Return a copy of the policy that a row of a run's curve measured, or None if it is not at hand.

    Training goes on, and a better policy may replace it at any time. The row is written a moment before its policy.

    Args:
        folder: Of the run.
        row: Of its curve.
        wait_s: For the policy.
    """
    until = time.monotonic() + wait_s
    while True:
        try:
            policy = load_policy(folder.best_policy)
        except PolicyError:
            policy = None
        if policy is not None and policy.contract.version == int(row["version"]):
            save_policy(copy := folder.report / "passed", policy.network, policy.moments, policy.contract)
            return copy
        if time.monotonic() >= until:
            return None
        time.sleep(0.1)


def match_flags(policy: Path) -> list[str]:
    """Return the flags of ``topspin evaluate`` for the conditions under which a policy is trained."""
    conditions = MatchConditions.model_validate(
        load_policy(policy).contract.task.model_dump(include=set(MatchConditions.model_fields))
    )
    return as_flags({name.replace("_", "-"): value for name, value in conditions})


def measure(policy: Path, seed: int) -> dict[str, Any]:
    """Return a policy's measures on rallies of ``seed``, under the conditions of its training."""
    flags = ["--policy", str(policy), "--rallies", str(RALLIES), "--seed", str(seed), *match_flags(policy)]
    done = subprocess.run(
        [sys.executable, "-m", "topspin", "evaluate", *flags, "--json"],
        capture_output=True,
        text=True,
        check=False,
        start_new_session=True,  # a Ctrl-C ends the benchmark, which then waits for it
    )
    if done.returncode:
        raise ReportedError(f"measuring {policy} ended with {done.returncode}: {done.stderr.strip()[-300:]}")
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def train(
    config: TimeToQualityConfig, name: str, seed: int, stop: Event, resumes: bool = False
) -> dict[str, Any]:
    """Train a run until the goal or the end of its time, and return its figures.

    Args:
        config: Settings.
        name: Of the run.
        seed: Of the run.
        stop: Ends it.
        resumes: Whether a run that is there goes on; its minutes are then those since now.
    """
    folder, goal = RunFolder.of(name), Goal(config.return_rate, config.target_error)
    is_there = folder.config.exists()
    if is_there and not resumes:
        raise ReportedError(f"{folder.root} is there already, and its curve is older; choose another --run")
    run = ["--run", name, "--resume"] if is_there else ["--run", name, "--seed", str(seed)]
    command = [sys.executable, "-m", "deploy.local", *run, "--panel", "off"]
    limit = ["--minutes", str(config.minutes), *shlex.split(config.more)]
    started = time.monotonic()
    seen = len(whole_rows(folder.evaluations)) if is_there else 0
    curve: list[dict[str, Any]] = []
    passage, asked = None, 0
    training = subprocess.Popen(
        [*command, *([] if is_there else limit)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,  # a Ctrl-C in the terminal reaches it once, from here
    )
    passed: list[Path] = []

    def is_confirmed(row: Mapping[str, Any]) -> bool:
        policy = kept(folder, row)
        if policy is None or not goal.is_met(measure(policy, CONFIRMING_SEED)):
            return False
        passed.append(policy)
        return True

    with training as process:
        try:
            while process.poll() is None and passage is None and not stop.is_set():
                for written in whole_rows(folder.evaluations)[seen + len(curve) :]:
                    row: dict[str, Any] = dict(written)
                    row["minutes"] = round((time.monotonic() - started) / 60.0, 2)
                    curve.append(row)
                    shown = "  ".join(f"{key} {row[key]}" for key in CURVE)
                    print(f"seed {seed}  {shown}", file=sys.stderr, flush=True)
                passage = first_passage(curve, asked, goal, is_confirmed)
                asked = len(curve)
                time.sleep(LOOK_S)
        finally:
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
                process.wait(PATIENCE_S)
    if not curve or (passage is None and training.returncode and not stop.is_set()):
        what = "was not evaluated" if not curve else f"ended with {training.returncode}"
        raise ReportedError(f"training {name} {what}: see {folder.logs}")
    reported = measure(passed[0] if passed else folder.best_policy, REPORTED_SEED)
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


def measured(config: TimeToQualityConfig, name: str, seed: int, stop: Event) -> dict[str, Any]:
    """Return the figures of a run that was measured before, or train and measure it."""
    file = RunFolder.of(name).report / "time_to_quality.json"
    asked = config.model_dump(mode="json", include={"minutes", "return_rate", "target_error", "more"})
    if file.is_file():
        known = json.loads(file.read_text(encoding="utf-8"))
        if known["asked"] == asked:
            found: dict[str, Any] = known["found"]
            return found
    found = train(config, name, seed, stop)
    if found["reached"] or not stop.is_set():
        write_whole(file, json.dumps({"asked": asked, "found": found}) + "\n")
    return found


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
        if stop.is_set():
            break
        runs.append(measured(config, f"{base}-{seed}", seed, stop))
        print("  ".join(f"{key} {value}" for key, value in runs[-1].items()), file=sys.stderr, flush=True)
    if not runs:
        raise ReportedError("stopped before the first seed")
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

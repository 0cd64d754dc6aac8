"""Time from an untrained policy to the paper's figures.

    python -m benchmarks.time_to_quality --json

It starts a real run with `deploy.local` and follows its evaluator's curve until a policy returns 81 % of 1,000 balls
and lands 0.31 m from the target. Then it measures the run's best policy on fresh rallies. Time is wall time
from the start of the command, with imports and start-up.
"""

import csv
import json
import math
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path
from threading import Event
from typing import Any

from pydantic import Field

from benchmarks.settings import BenchmarkConfig, run
from common.errors import ReportedError
from common.service.run_folder import RunFolder
from common.service.table import whole_rows

RETURN_RATE, TARGET_ERROR = 0.81, 0.31  # [share], [m] the paper's table
LOOK_S = 1.0
PATIENCE_S = 180.0  # in which a run ends and measures its policy
FRESH_SEED = (
    1_000_003  # the run's evaluator chooses the best policy on other rallies: those of the run's seed
)
CURVE = ("minutes", "frames", "stage", "catch_rate", "return_rate", "return_after_catch", "target_error_mean")


def is_reached(row: dict[str, Any], return_rate: float, target_error: float) -> bool:
    """Return whether an evaluation meets both figures."""
    error = float(row["target_error_mean"] or math.inf)
    return float(row["return_rate"] or 0.0) >= return_rate and error <= target_error


def train(config: "TimeToQualityConfig", name: str, stop: Event) -> list[Any]:
    """Train a run until the goal or the end of ``minutes``. Return its curve, each row with its wall time."""
    folder = RunFolder.of(name)
    command = [
        sys.executable,
        "-m",
        "deploy.local",
        "--run",
        name,
        "--minutes",
        str(config.minutes),
        "--panel",
        "off",
    ]
    started = time.monotonic()
    curve: list[dict[str, Any]] = []
    training = subprocess.Popen(
        [*command, *shlex.split(config.more)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,  # a Ctrl-C in the terminal reaches it once, from here
    )
    with training as process:
        try:
            while process.poll() is None:
                for written in whole_rows(folder.evaluations)[len(curve) :]:
                    row: dict[str, Any] = dict(written)
                    row["minutes"] = round((time.monotonic() - started) / 60.0, 2)
                    curve.append(row)
                    shown = "  ".join(f"{key} {row[key]}" for key in CURVE)
                    print(shown, file=sys.stderr, flush=True)
                is_met = bool(curve) and is_reached(curve[-1], config.return_rate, config.target_error)
                if stop.is_set() or (is_met and not config.go_on):
                    break
                time.sleep(LOOK_S)
        finally:
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
                process.wait(PATIENCE_S)
    if not curve:
        raise ReportedError(f"nothing was evaluated: see {folder.logs}")
    return curve


def verify(name: str, rallies: int, seed: int) -> dict[str, Any]:
    """Return the measures of a run's best policy on fresh rallies."""
    policy = str(RunFolder.of(name).best_policy)
    arguments = ("--policy", policy, "--rallies", str(rallies), "--seed", str(seed), "--json")
    done = subprocess.run(
        [sys.executable, "-m", "topspin", "evaluate", *arguments], capture_output=True, text=True, check=True
    )
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


class TimeToQualityConfig(BenchmarkConfig):
    """Measure how long training takes to the paper's figures: return rate and distance to the target.

    The exit status is 1 if the goal was not reached.
    """

    minutes: float = Field(60.0, gt=0, description="limit of the training", json_schema_extra={"unit": "min"})
    run: str = Field("", description="name of the run; empty: a time stamp")
    return_rate: float = Field(RETURN_RATE, ge=0, le=1, description="goal; default: the paper's")
    target_error: float = Field(
        TARGET_ERROR, gt=0, description="goal; default: the paper's", json_schema_extra={"unit": "m"}
    )
    go_on: bool = Field(False, description="train to the end even if the goal is reached before")
    curve: str = Field("", description="file of the curve; empty: report/ in the run folder")
    more: str = Field("", description="more flags of deploy.local: --more='--actors 2 --seed 1'")


def main(config: TimeToQualityConfig, stop: Event) -> int:
    """Train, measure and print."""
    name = config.run or time.strftime("quality-%Y%m%d-%H%M%S")
    goal = (config.return_rate, config.target_error)
    curve = train(config, name, stop)
    path = Path(config.curve) if config.curve else RunFolder.of(name).report / "time_to_quality.csv"
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, CURVE, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(curve)
    reached = next((row for row in curve if is_reached(row, *goal)), None)
    at = reached or curve[-1]
    verified = verify(name, rallies=1000, seed=FRESH_SEED)
    result = {
        "reached": reached is not None,
        "minutes": at["minutes"],
        "frames": int(at["frames"]),
        "return_rate": float(at["return_rate"]),
        "target_error_mean": float(at["target_error_mean"] or "nan"),
        "verified_return_rate": verified["return_rate"],
        "verified_return_after_catch": verified["return_after_catch"],
        "verified_target_error_mean": verified["target_error_mean"],
        "goal_return_rate": goal[0],
        "goal_target_error": goal[1],
        "run": name,
        "curve": str(path),
    }
    for key, value in result.items():
        print(f"{key:>28} {value}", file=sys.stderr)
    if config.json_line:
        print(json.dumps(result))
    return 0 if reached else 1


if __name__ == "__main__":
    sys.exit(run("time_to_quality", TimeToQualityConfig, main))

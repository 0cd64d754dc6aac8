"""How long from nothing to the paper's figures? (`python -m benchmarks.time_to_quality --json`).

Starts a real run with `deploy.local` and follows its evaluator's curve until a policy returns 81 % of 1,000 balls and
lands 0.31 m from the target; the run's best policy is then measured on rallies that it wasn't chosen by. Flags after
`--` go to `deploy.local`. Time is wall time from the start of the command: imports and start-up are in it.
"""

import argparse
import csv
import json
import math
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from common.run_folder import RunFolder, whole_rows

RETURN_RATE, TARGET_ERROR = 0.81, 0.31  # [share], [m] the paper's table
LOOK_S = 1.0
PATIENCE_S = 180.0  # for a run to end and measure its policy
FRESH_SEED = 1_000_003  # a run's evaluator chooses the best on rallies of the run's own seed: not on these
CURVE = ("minutes", "frames", "stage", "catch_rate", "return_rate", "return_after_catch", "target_error_mean")


def is_reached(row: dict[str, Any], return_rate: float, target_error: float) -> bool:
    """Return whether an evaluation meets both figures."""
    error = float(row["target_error_mean"] or math.inf)
    return float(row["return_rate"] or 0.0) >= return_rate and error <= target_error


def train(name: str, minutes: float, goal: tuple[float, float], more: list[str], goes_on: bool) -> list[Any]:
    """Train a run until the goal or the end of ``minutes``; return its curve, each row with its wall time."""
    folder = RunFolder.of(name)
    command = [
        sys.executable,
        "-m",
        "deploy.local",
        "--run",
        name,
        "--minutes",
        str(minutes),
        "--panel",
        "off",
    ]
    started = time.monotonic()
    curve: list[dict[str, Any]] = []
    with subprocess.Popen([*command, *more], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        try:
            while process.poll() is None:
                for written in whole_rows(folder.evaluations)[len(curve) :]:
                    row: dict[str, Any] = dict(written)
                    row["minutes"] = round((time.monotonic() - started) / 60.0, 2)
                    curve.append(row)
                    shown = "  ".join(f"{key} {row[key]}" for key in CURVE)
                    print(shown, file=sys.stderr, flush=True)
                if not goes_on and curve and is_reached(curve[-1], *goal):
                    break
                time.sleep(LOOK_S)
        finally:
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
                process.wait(PATIENCE_S)
    if not curve:
        raise SystemExit(f"nothing was evaluated: see {folder.logs}")
    return curve


def verify(name: str, rallies: int, seed: int) -> dict[str, Any]:
    """Return the measures of a run's best policy on rallies of its own."""
    policy = str(RunFolder.of(name).best_policy)
    arguments = ("--policy", policy, "--rallies", str(rallies), "--seed", str(seed), "--json")
    done = subprocess.run(
        [sys.executable, "-m", "services.evaluator", *arguments], capture_output=True, text=True, check=True
    )
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def main() -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.time_to_quality", description=__doc__)
    parser.add_argument("--json", action="store_true", help="print the figures as one JSON object, last line")
    parser.add_argument("--minutes", type=float, default=60.0, help="give up after this long (default 60)")
    parser.add_argument("--run", default=time.strftime("quality-%Y%m%d-%H%M%S"), help="name of the run")
    parser.add_argument(
        "--return-rate", type=float, default=RETURN_RATE, help="goal (default 0.81, the paper's)"
    )
    parser.add_argument(
        "--target-error", type=float, default=TARGET_ERROR, help="goal [m] (default 0.31, the paper's)"
    )
    parser.add_argument(
        "--go-on", action="store_true", help="train to the end even if the goal was met before"
    )
    parser.add_argument("--curve", type=Path, help="file for the curve (default: report/ of the run folder)")
    parser.add_argument("more", nargs="*", help="flags of deploy.local, behind --")
    arguments = parser.parse_args()
    goal = (arguments.return_rate, arguments.target_error)
    curve = train(arguments.run, arguments.minutes, goal, arguments.more, arguments.go_on)
    path = arguments.curve or RunFolder.of(arguments.run).report / "time_to_quality.csv"
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, CURVE, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(curve)
    reached = next((row for row in curve if is_reached(row, *goal)), None)
    at = reached or curve[-1]
    verified = verify(arguments.run, rallies=1000, seed=FRESH_SEED)
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
        "run": arguments.run,
        "curve": str(path),
    }
    for name, value in result.items():
        print(f"{name:>28} {value}", file=sys.stderr)
    print(json.dumps(result) if arguments.json else "")
    return 0 if reached else 1


if __name__ == "__main__":
    sys.exit(main())

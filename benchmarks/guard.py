"""Fail where a part has become much slower against its limit than it was.

    make bench-guard

Rates differ by a factor of three between machines, but a rate over that of its limit, measured in one process, hardly
does. This compares such ratios with the recorded ones in ``results/guard.json`` and fails below 75 % of them.
"""

import json
import sys
from pathlib import Path
from threading import Event
from typing import Final

from pydantic import Field

from benchmarks import actor, env, learner
from benchmarks.settings import BenchmarkConfig, run
from services.learner.config import PPOConfig

FILE: Final = Path(__file__).parent / "results" / "guard.json"
LEAST_SHARE: Final = 0.75  # of the recorded ratio


def ratios(seconds: float) -> dict[str, float]:
    """Return the measured ratios."""
    return {
        "env": round(env.measure(512, "standard", seconds, 0).ratio, 4),
        "actor": actor.measure(256, seconds, 0)["ratio"],
        # float32: how much faster bfloat16 is depends on the machine
        "learner": float(learner.measure(256, seconds, 0, PPOConfig(precision="float32"))["matmul_share"]),
    }


def slower(measured: dict[str, float], recorded: dict[str, float]) -> list[str]:
    """Return the names whose ratio is below ``LEAST_SHARE`` of the recorded one."""
    return [name for name, ratio in recorded.items() if not measured[name] >= LEAST_SHARE * ratio]


class GuardConfig(BenchmarkConfig):
    """Compare the speed of environment, actor and learner against their limits with the recorded ratios."""

    seconds: float = Field(
        6.0, gt=0, description="duration of each measurement", json_schema_extra={"unit": "s"}
    )
    write: bool = Field(False, description="record the ratios instead")


def main(config: GuardConfig, _stop: Event) -> int:
    """Measure, print, and return 1 where a ratio has fallen."""
    measured = ratios(config.seconds)
    if config.write:
        FILE.write_text(json.dumps(measured, indent=2) + "\n")
    recorded = json.loads(FILE.read_text())
    for name, ratio in measured.items():
        print(f"{name:>8} {ratio:.3f} of its limit, recorded {recorded[name]:.3f}", file=sys.stderr)
    fallen = slower(measured, recorded)
    if config.json_line:
        print(json.dumps({"measured": measured, "recorded": recorded, "fallen": fallen}))
    if fallen:
        print(f"slower than {LEAST_SHARE:.0%} of the recorded ratio: {', '.join(fallen)}", file=sys.stderr)
    return int(bool(fallen))


if __name__ == "__main__":
    sys.exit(run("guard", GuardConfig, main))

"""How a policy's return rate depends on what it meets: noise, air, latency, what it was told of the spin, a stranger.

    python -m benchmarks.robustness --policy default --json
    python -m benchmarks.robustness --policy default --plot docs/pictures/robustness.svg

Each row is one match of the same balls. An opponent plays ten balls of one kind; the row "ball" compares the first ball
of unknown opponents with their tenth.
"""

import json
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from threading import Event
from typing import Any, Final

import numpy as np
from pydantic import Field

from benchmarks.settings import BenchmarkConfig, run
from common.errors import ReportedError
from common.evaluation.evaluate import check
from common.evaluation.match import evaluation_rallies, match_task, play_match
from common.evaluation.measures import MatchResult, measures
from common.physics.constants import GRID_STEP
from common.policy.box import policy_folder
from common.policy.folder import Policy, load_policy
from common.task.config import MatchConditions, PresetName, TaskConfig
from common.task.randomization import MAX_LATENCY_STEPS, RandomizationProfile, profile_of

BALLS_EACH: Final = 10  # of an opponent
LATENCIES_MS: Final = (0, 10, 20, 30, 40, 50, 60)
LAUNCHES: Final[tuple[PresetName, ...]] = ("paper", "strong", "match", "elite", "serve")
# What the robot expects of a ball's spin, where it is told the truth
TOLD: Final[Mapping[PresetName, str]] = {
    "paper": "mild",
    "strong": "strong",
    "mixed": "mixed",
    "match": "strong",
    "elite": "strong",
    "serve": "mild",
    "all": "mixed",
}

Row = dict[str, Any]


def rate(result: MatchResult) -> Row:
    """Return the return rate and its 95 % interval."""
    found = measures(result)
    return {name: found[name] for name in ("rallies", "return_rate", "return_rate_ci")}


def conditions(launch: PresetName) -> list[tuple[str, str, dict[str, Any], int | None]]:
    """Return what is varied, its value, the settings that differ from the default, and the latency [ms] if set."""
    found: list[tuple[str, str, dict[str, Any], int | None]] = [("none", "standard", {}, None)]
    found += [("noise", name, {"randomization": name}, None) for name in ("off", "hard")]
    found += [("aerodynamics", "simple", {"flight": "simple"}, None)]
    found += [("latency_ms", str(latency), {}, latency) for latency in LATENCIES_MS]
    spins = {"told": TOLD[launch], "expected": "mixed", "learnt": "learnt"}
    found += [("spin", name, {"expected_spin": spin}, None) for name, spin in spins.items()]
    return found


def profile_with(task: TaskConfig, latency_ms: int | None) -> RandomizationProfile:
    """Return the task's profile, with every ball sample this late if it is given."""
    profile = profile_of(task.randomization, task.rubber)
    if latency_ms is None:
        return profile
    latency = latency_ms / 1e3
    if not 0 <= latency <= MAX_LATENCY_STEPS * GRID_STEP:
        raise ReportedError(
            f"latency {latency_ms} ms; allowed: 0 to {round(1e3 * MAX_LATENCY_STEPS * GRID_STEP)} ms"
        )
    return profile._replace(observation_latency=(latency, latency))


def measure(
    policy: Policy, launch: PresetName, rallies: int, seed: int, on_tick: Callable[[], None]
) -> list[Row]:
    """Return the rows of one launch preset."""
    rows: list[Row] = []
    for varied, value, settings, latency in conditions(launch):
        changes = dict(settings)
        spin = changes.pop("expected_spin", "contract")
        match = MatchConditions.model_validate({"launch": launch} | changes)
        task = match_task(policy.contract, match, spin).model_copy(update={"carry_over": 0.0})
        block = evaluation_rallies(rallies, task, seed)
        opponents = np.arange(len(block.seeds)) // BALLS_EACH
        result = play_match(
            policy, block, task, on_tick=on_tick, opponents=opponents, profile=profile_with(task, latency)
        )
        rows.append({"launch": launch, "varied": varied, "value": value} | rate(result))
        if varied == "spin" and value == "learnt":
            ordinal = {seed: k % BALLS_EACH for k, seed in enumerate(block.seeds.tolist())}
            number = np.array([ordinal[seed] for seed in result.seeds.tolist()])
            rows += [
                {"launch": launch, "varied": "ball", "value": str(k + 1)} | rate(result.of(number == k))
                for k in (0, BALLS_EACH - 1)
            ]
    return rows


def plot(rows: list[Row], path: Path) -> None:
    """Write a picture: one panel for each thing that is varied, one colour for each launch preset."""
    try:
        from matplotlib.figure import Figure  # noqa: PLC0415 - an extra that measuring does not need
    except ModuleNotFoundError as error:
        raise ReportedError(f"a plot needs {error.name}: pip install -e '.[report]'") from None
    panels = {
        "noise and air": [
            ("none", "standard"),
            ("noise", "off"),
            ("noise", "hard"),
            ("aerodynamics", "simple"),
        ],
        "latency [ms]": [("latency_ms", str(latency)) for latency in LATENCIES_MS],
        "spin": [("spin", name) for name in ("told", "expected", "learnt")],
        "ball of a stranger": [("ball", "1"), ("ball", str(BALLS_EACH))],
    }
    figure = Figure(figsize=(12, 3.6), layout="constrained")
    axes = figure.subplots(1, len(panels), sharey=True)
    by_key = {(row["launch"], row["varied"], row["value"]): row for row in rows}
    for ax, (title, keys) in zip(axes, panels.items(), strict=True):
        is_ordered = keys[0][1].isdigit()  # a line between values without an order would say nothing
        for launch in LAUNCHES:
            found = [by_key[launch, *key] for key in keys if (launch, *key) in by_key]
            if not found:
                continue
            y = [100 * row["return_rate"] for row in found]
            low, high = zip(*(row["return_rate_ci"] for row in found), strict=True)
            ax.errorbar(
                [row["value"] if row["varied"] != "aerodynamics" else "simple\nair" for row in found],
                y,
                yerr=[
                    [a - 100 * b for a, b in zip(y, low, strict=True)],
                    [100 * b - a for a, b in zip(y, high, strict=True)],
                ],
                marker="o",
                markersize=3,
                linestyle="-" if is_ordered else "none",
                linewidth=1.2,
                label=launch,
            )
        ax.set_xlabel(title)
        ax.grid(alpha=0.3)
    axes[0].set_ylabel("returned [%]")
    axes[0].set_ylim(0, 100)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside right upper")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)


class RobustnessConfig(BenchmarkConfig):
    """Measure how a policy's return rate depends on noise, air, latency, expected spin and acquaintance."""

    policy: str = Field("default", description="a policy of the box, or a policy folder")
    launches: tuple[PresetName, ...] = Field(LAUNCHES, description="launch presets to play")
    rallies: int = Field(
        1000,
        ge=BALLS_EACH,
        le=1_000_000,
        description=f"of each match; an opponent plays {BALLS_EACH} of them",
    )
    seed: int = Field(20260, ge=0, lt=2**63, description="of the balls")
    plot: str = Field("", description="picture to write, .svg or .png; empty: none")


def main(config: RobustnessConfig, stop: Event) -> int:
    """Measure and print."""
    policy = load_policy(policy_folder(config.policy))
    rows: list[Row] = []
    for launch in config.launches:
        rows += measure(policy, launch, config.rallies, config.seed, lambda: check(stop))
        if not config.json_line:
            for row in rows[-(len(conditions(launch)) + 2) :]:
                print(
                    f"{launch:>8}  {row['varied']:>14} {row['value']:<10} {100 * row['return_rate']:5.1f} %"
                )
    if config.plot:
        plot(rows, Path(config.plot))
    if config.json_line:
        print(json.dumps({"policy": config.policy, "seed": config.seed, "rows": rows}))
    return 0


if __name__ == "__main__":
    sys.exit(run("robustness", RobustnessConfig, main))

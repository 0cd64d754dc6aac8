"""Minutes to the paper's figures on more cores, predicted, and what bounds each number of cores.

    python -m benchmarks.scaling --json                          # measures the costs first: about a minute
    python -m benchmarks.scaling --save costs.json               # ... and keeps them
    python -m benchmarks.scaling --costs costs.json --cores 64,512 --json
    python -m benchmarks.scaling --costs costs.json --validate   # real runs too: four minutes more

Costs of every part are measured on one machine, as CPU time. A simulation in virtual time, with the program's own
pacing, turns them into frames/s of a run with any number of actors and learners. The best split that a small search
finds is printed, and the part whose doubled speed would help it most. Minutes come from a law of how many frames a
training needs with datasets of that size, fitted to measured trainings in ``results/large_batches.json``. Without that
file there are frames/s and bounds only.
"""

import json
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from threading import Event
from typing import Any

from pydantic import Field

from benchmarks.scaling import costs, large_batches
from benchmarks.scaling.costs import Costs, Network
from benchmarks.scaling.large_batches import FramesToGoal
from benchmarks.scaling.prediction import Prediction, Setting, predict
from benchmarks.settings import BenchmarkConfig, run
from common.evaluation.evaluate import check
from common.service.process import DONE


class ScalingConfig(BenchmarkConfig):
    """Predict minutes to the paper's figures on more cores, and name what bounds each number of cores."""

    cores: tuple[int, ...] = Field((2, 8, 32, 128, 512), min_length=1, description="numbers of cores: 2,8,32")
    costs: str = Field("", description="file of costs to predict from; empty: they are measured here")
    save: str = Field("", description="file that measured costs are written to; empty: none")
    points: str = Field(
        str(large_batches.FILE.relative_to(Path(__file__).parents[2])),
        description="file of measured trainings by the size of their datasets",
    )
    learner_frames_per_s: float = Field(
        0.0,
        ge=0,
        description="also predict with one learner on an accelerator that trains so many frames/s from memory; 0: no",
        json_schema_extra={"unit": "frames/s"},
    )
    host_cores: int = Field(
        64, ge=1, description="cores of a machine: a larger fleet has a network between its machines"
    )
    link_gbit: float = Field(
        10.0, gt=0, description="the hub's link in such a fleet", json_schema_extra={"unit": "Gbit/s"}
    )
    network_us: float = Field(
        50.0,
        ge=0,
        description="delay of a message in such a fleet, one way",
        json_schema_extra={"unit": "us"},
    )
    part_seconds: float = Field(
        1.0, gt=0, description="measurement of each part's costs", json_schema_extra={"unit": "s"}
    )
    seed: int = Field(0, ge=0, lt=2**63, description="of all random numbers of the costs")
    validate_runs: bool = Field(
        False, alias="validate", description="compare predictions with short real runs on this machine"
    )
    warm_up: float = Field(
        25.0,
        ge=0,
        description="of a real run, from its first trained dataset; a spare actor, which starts 10 s after the others, "
        "takes a core for several seconds of it",
        json_schema_extra={"unit": "s"},
    )
    seconds: float = Field(
        20.0, gt=0, description="measurement of a real run", json_schema_extra={"unit": "s"}
    )


def main(config: ScalingConfig, stop: Event) -> int:
    """Measure or read the costs, predict, validate and print."""
    found = costs_of(config, stop)
    network = Network(
        host_cores=config.host_cores,
        bytes_per_s=config.link_gbit * 1e9 / 8,
        latency_s=config.network_us * 1e-6,
    )
    measured = large_batches.read(Path(config.points))
    law = large_batches.fit(measured.points) if measured else None
    print(f"costs of {found.machine}; {said_of_learning(law, config.points)}", file=sys.stderr)
    rows = []
    for rate in sorted({0.0, config.learner_frames_per_s}):
        setting = Setting(found, network, law, rate)
        for cores in config.cores:
            check(stop)
            prediction = predict(cores, setting)
            print(sentence(prediction), file=sys.stderr, flush=True)
            rows.append(row(prediction))
    compared: list[dict[str, Any]] = []
    if config.validate_runs:
        from benchmarks.scaling.measuring import usable_cores  # noqa: PLC0415 - imports torch
        from benchmarks.scaling.validation import validate  # noqa: PLC0415

        setting = Setting(found, network)
        compared = validate(setting, usable_cores(), config.warm_up, config.seconds, stop)
    table(rows)
    table(compared)
    if config.json_line:
        figures = {"machine": found.machine, "predictions": rows, "validation": compared}
        goal = measured.model_dump(exclude={"points"}) if measured else None
        print(json.dumps(figures | {"goal": goal, "learning": learning(law), "costs": found.model_dump()}))
    return DONE


def costs_of(config: ScalingConfig, stop: Event) -> Costs:
    """Return the costs of the file, or measured ones."""
    if config.costs:
        return costs.read(Path(config.costs))
    from benchmarks.scaling.measuring import measure  # noqa: PLC0415 - imports torch and MuJoCo

    found = measure(config.part_seconds, config.seed, stop)
    if config.save:
        Path(config.save).write_text(found.model_dump_json(indent=1) + "\n")
    return found


def learning(law: FramesToGoal | None) -> dict[str, float] | None:
    """Return the fitted law's figures; None without one."""
    if law is None:
        return None
    return {
        "frames_least": round(law.least),
        "dataset_noise": round(law.noise),
        "spread": round(law.spread, 3),
        "reached": law.reached,
        "missed": law.missed,
    }


def said_of_learning(law: FramesToGoal | None, file: str) -> str:
    """Return a sentence about how frames become minutes."""
    if law is None:
        return f"no minutes, since {file} is not there: frames/s and bounds only"
    missed = f", {law.missed} missed it and do not count" if law.missed else ""
    return (
        f"{law.least / 1e6:.1f} M frames (1 + D / {law.noise:,.0f}) to the goal with datasets of D frames, times or "
        f"divided by {math.exp(law.spread):.2f}, from {law.reached} trainings{missed}"
    )


def row(found: Prediction) -> dict[str, Any]:
    """Return a prediction's figures."""
    plan, result = found.plan, found.result
    return {
        "cores": int(plan.cores),
        "learner": "accelerator" if plan.learner_frames_per_s else "cores",
        "actors": plan.actors,
        "envs": plan.envs,
        "learners": plan.learners,
        "dataset": plan.dataset,
        "frames_per_s": round(result.frames_per_s),
        "minutes": None if found.minutes is None else round(found.minutes, 2),
        "bound": found.bound,
        "gains": {part: round(gain, 3) for part, gain in found.gains.items()},
        "actor_busy": round(result.actor_busy, 3),
        "learner_busy": round(result.learner_busy, 3),
        "exchange": round(result.exchange, 3),
        "hub_busy": round(result.hub_busy, 3),
        "cores_used": round(result.cores_used, 1),
        "lag": round(result.lag, 2),
        "refused": result.refused,
        "rollout_mb_per_s": round(found.bytes_per_s / 1e6, 1),
        "start_s": round(found.start_s, 1),
        "extrapolated": found.is_extrapolated,
    }


def sentence(found: Prediction) -> str:
    """Return a prediction in words."""
    plan, result = found.plan, found.result
    learners = f"{plan.learners} learner{'s' if plan.learners > 1 else ''}"
    if plan.learner_frames_per_s:
        learners = f"a learner of {plan.learner_frames_per_s:,.0f} frames/s"
    text = (
        f"{plan.cores:g} cores: {plan.actors} actors of {plan.envs} environments and {learners} train "
        f"{result.frames_per_s:,.0f} frames/s in datasets of {plan.dataset:,}"
    )
    if found.minutes is not None:
        text += f", {found.minutes:.1f} minutes to the goal"
        text += " (no training had such datasets)" if found.is_extrapolated else ""
    gain = found.gains[found.bound]
    return f"{text}; bound by {found.bound}: twice as fast, it would be {gain:.2f} times as fast."


def table(rows: Sequence[dict[str, Any]]) -> None:
    """Print rows for a person."""
    if not rows:
        return
    names = [name for name, value in rows[0].items() if not isinstance(value, dict)]
    cells = [names, *([str("-" if row[name] is None else row[name]) for name in names] for row in rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    for line in cells:
        print("  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True)), file=sys.stderr)


if __name__ == "__main__":
    sys.exit(run("scaling", ScalingConfig, main))

"""What the curriculum and the measured bounces are worth: three ways to train that differ in what they name alone.

    python -m benchmarks.ablation --seeds 0,1,2 --json

Hu et al. compare the curriculum with stage 3 alone, and their collision equations with the simulator's own contacts.
All three arms here are the default method without what acts in stage 3 alone: the way home after a hit, and the bonus
for the predicted landing. Stages have the authors' shares of the frames. The last weights of each run play the same
2,000 balls with the measured bounces, whatever contacts they were trained with. Differences are taken seed by seed.
Trainings are made once (``benchmarks.trainings``), and the program goes on where it was stopped.
"""

import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from itertools import combinations
from threading import Event
from typing import Any, Final

from pydantic import Field

from benchmarks.recipe import MEASURES, medians, result
from benchmarks.settings import BenchmarkConfig, as_flags, run
from benchmarks.trainings import Wanted, examined, finished, make
from common.service.process import DONE, FAILED
from common.service.run_folder import RunFolder
from topspin.report.paired import over_seeds

BASE: Final[dict[str, str]] = {
    "experience.leads-home": "false",
    "learner.ppo.correction-weight": "0",
    "task.reward.landing-bonus": "0",
    "learner.curriculum.stage-shares": "0.14,0.48,0.38",
    "final-rallies": "2000",
}
"""Flags of all arms."""
ARMS: Final[dict[str, dict[str, str]]] = {
    "curriculum": {},
    "stage 3 alone": {"learner.curriculum.first-stage": "3"},
    "simulator's contacts": {"task.collision": "original"},
}
"""Flags of each arm besides."""
BOUNCES: Final = "tailored"  # the measured ones
EXAM: Final = "measured_bounces"  # report/EXAM.json of a run with other contacts


class AblationConfig(BenchmarkConfig):
    """Train with the curriculum, with stage 3 alone, and with the simulator's contacts, and compare seed by seed."""

    frames: int = Field(
        30_000_000, ge=1, description="of each training", json_schema_extra={"unit": "frames"}
    )
    seeds: tuple[int, ...] = Field((0, 1, 2), description="seeds of each arm: 0,1,2")
    run: str = Field("ablation", min_length=1, description="name of the runs, before -ARM-SEED")
    more: tuple[str, ...] = Field(
        (),
        description='more flags of topspin train, the same for all, as JSON: ["--actors", "1"]',
    )
    train: bool = Field(True, description="false: print what is there")


def wanted(config: AblationConfig, arm: str, seed: int) -> Wanted:
    """Return the training of an arm with one seed."""
    name = arm.replace("'", "").replace(" ", "-")
    own = ("--seed", str(seed), "--frames", str(config.frames), *as_flags(BASE | ARMS[arm]), *config.more)
    return Wanted(f"{config.run}-{name}-{seed}", own)


def figures(config: AblationConfig) -> dict[str, list[dict[str, Any]]]:
    """Return the measures of the runs of each arm that have ended."""
    return {
        arm: [measured(folder) for folder in finished(wanted(config, arm, seed) for seed in config.seeds)]
        for arm in ARMS
    }


def measured(folder: RunFolder) -> dict[str, Any]:
    """Return the measures of a run's last weights with the measured bounces."""
    own = result(folder)
    if own["collision"] == BOUNCES:
        return own
    flags = {"collision": BOUNCES, "rallies": BASE["final-rallies"], "seed": own["seed"]}
    exam = examined(folder, EXAM, as_flags(flags))
    return own | {key: exam[key] for key in (*MEASURES, "collision")}


def differences(arms: Mapping[str, Sequence[Mapping[str, Any]]]) -> list[dict[str, Any]]:
    """Return the differences between arms over the seeds that both have, two at least, with interval and p-value."""
    found = []
    for one, other in combinations(arms, 2):
        for measure in MEASURES:
            a, b = (
                {run["seed"]: run[measure] for run in arms[arm] if run[measure] is not None}
                for arm in (one, other)
            )
            apart = over_seeds(a, b)
            if apart is not None:
                rounded = {
                    name: None if value is None else round(value, 4) for name, value in asdict(apart).items()
                }
                found.append({"first": one, "second": other, "measure": measure, **rounded})
    return found


def main(config: AblationConfig, stop: Event) -> int:
    """Train what is missing, and print measures and differences."""
    # The first seed of all arms, then the next: what is there after a stop can be compared
    asked = [wanted(config, arm, seed) for seed in config.seeds for arm in ARMS]
    faults = make(asked, stop, config.train)
    arms = figures(config)
    apart = differences(arms)
    if config.json_line:
        measured = {arm: {"runs": runs, "median": medians(runs)} for arm, runs in arms.items()}
        print(json.dumps({"frames": config.frames, "arms": measured, "differences": apart}))
        return FAILED if faults else DONE
    for arm, runs in arms.items():
        print(arm)
        for one in runs:
            print(f"  seed {one['seed']}  " + "  ".join(f"{key} {one[key]}" for key in MEASURES))
    for one in apart:
        sure = "no interval: equal differences"
        if one["p"] is not None:
            sure = f"95 % interval {one['low']:+.4f} to {one['high']:+.4f}, p {one['p']:.3f}"
        name = f"{one['second']} minus {one['first']}, {one['measure']}"
        print(f"{name}: {one['mean']:+.4f}, {sure}, {one['pairs']} pairs")
    return FAILED if faults else DONE


if __name__ == "__main__":
    sys.exit(run("ablation", AblationConfig, main))

"""From the paper's recipe to the default, one change at a time: what each is worth.

    python -m benchmarks.ladder --frames 15000000 --seeds 1 --json

Every rung trains with all changes of the rungs below it and one of its own. The first is recipe ``paper-50hz``, the
last has the default's settings. A rung's worth depends on those below it: another order would give other figures.
Runs are runs/NAME-RUNG-SEED. What is trained already is not trained again (``benchmarks.trainings``), so the program
goes on where it was stopped, and two of it can share the rungs (``--rungs``).
"""

import json
import sys
from threading import Event
from typing import Any, Final, NamedTuple

from pydantic import Field

from benchmarks.recipe import MEASURES, medians, result
from benchmarks.settings import BenchmarkConfig, as_flags, run
from benchmarks.trainings import Wanted, finished, make
from common.errors import ReportedError
from common.service.process import DONE, FAILED

RECIPE: Final = "paper-50hz"


class Rung(NamedTuple):
    """One change."""

    name: str
    flags: dict[str, str]  # of ``topspin train``, with those of the rungs below it


RUNGS: Final = (
    Rung("the paper's recipe at 50 Hz", {}),
    Rung(
        "the normaliser's new count is absorbed, and the mean of the weights is kept",
        {"learner.curriculum.count-reset": "absorbed", "learner.evaluated-weights": "mean"},
    ),
    Rung(
        "small noise of the actions at the start: log -1.6 in place of 0", {"network.initial-log-std": "-1.6"}
    ),
    Rung(
        "smaller datasets, larger minibatches, fewer passes; the learning rate follows the KL",
        {
            "actor.horizon": "32",
            "actor.envs": "0",
            "learner.ppo.mini-epochs": "4",
            "learner.ppo.minibatch": "2048",
            "learner.ppo.schedule": "adaptive",
            "learner.ppo.learning-rate-min": "2e-5",
            "learner.ppo.value-weight": "1",
            "learner.ppo.bound-weight": "0.001",
            "learner.ppo.reward-scale": "0.1",
            "learner.divergence.collapse": "0.5",
        },
    ),
    Rung(
        "a longer view: gamma 0.99 and lambda 0.9 a step of 20 ms",
        {"learner.ppo.gamma": "0.99", "learner.ppo.gae-lambda": "0.9"},
    ),
    Rung("the critic sees the simulator's truth", {"task.observation.critic": "privileged"}),
    Rung(
        "our reward: a steeper landing, a bonus for it, entries by time a quarter",
        {
            "task.reward.landing-scale": "0.5",
            "task.reward.landing-bonus": "100",
            "task.reward.reference-rate-hz": "50",
            "task.reward.collision": "10",
        },
    ),
    Rung(
        "spin estimate, prediction and sample age are observed",
        {
            "task.observation.spin": "estimated",
            "task.observation.prediction": "true",
            "task.observation.age": "true",
        },
    ),
    Rung(
        "the robot is led home after its hits; after a stage change the critic learns first",
        {
            "experience.leads-home": "true",
            "learner.ppo.correction-weight": "500",
            "learner.ppo.refit-frames": "200000",
        },
    ),
    Rung(
        "short stages 1 and 2; episodes of several rallies, most of which end at the hit; full aerodynamics",
        {
            "learner.curriculum.stage-shares": "",
            "experience.continue-share": "0.4",
            "experience.end-at-hit-share": "0.8",
            "task.flight": "full",
        },
    ),
)


class LadderConfig(BenchmarkConfig):
    """Train from the paper's recipe to the default, one change a rung, and print what each reaches."""

    frames: int = Field(
        15_000_000, ge=1, description="of each training", json_schema_extra={"unit": "frames"}
    )
    seeds: tuple[int, ...] = Field((1,), description="seeds of each rung: 1,2")
    rungs: tuple[int, ...] = Field((), description="which rungs are trained, from 0; empty: all")
    run: str = Field("ladder", min_length=1, description="name of the runs, before -RUNG-SEED")
    train: bool = Field(True, description="false: print what is there")


def flags_of(rung: int) -> list[str]:
    """Return the flags of a rung: its own and those of the rungs below it."""
    together: dict[str, str] = {}
    for one in RUNGS[: rung + 1]:
        together |= one.flags
    return as_flags(together)


def wanted(config: LadderConfig, rung: int, seed: int) -> Wanted:
    """Return the training of a rung with one seed."""
    flags = ("--recipe", RECIPE, "--seed", str(seed), "--frames", str(config.frames), *flags_of(rung))
    return Wanted(f"{config.run}-{rung}-{seed}", flags)


def figures(config: LadderConfig) -> list[dict[str, Any]]:
    """Return what the runs of each rung reached; rungs without a measured run are left out."""
    found = []
    for rung, one in enumerate(RUNGS):
        runs = [result(one) for one in finished(wanted(config, rung, seed) for seed in config.seeds)]
        if runs:
            found.append({"rung": rung, "name": one.name, "runs": runs, "median": medians(runs)})
    return found


def main(config: LadderConfig, stop: Event) -> int:
    """Train what is missing, and print every rung."""
    rungs = config.rungs or tuple(range(len(RUNGS)))
    if wrong := [rung for rung in rungs if not 0 <= rung < len(RUNGS)]:
        raise ReportedError(f"no rung {wrong[0]}; allowed: 0 to {len(RUNGS) - 1}")
    # The first seed of all rungs, then the next: what is there after a stop says something about each
    asked = [wanted(config, rung, seed) for seed in config.seeds for rung in rungs]
    faults = make(asked, stop, config.train)
    found = figures(config)
    if config.json_line:
        print(json.dumps({"frames": config.frames, "ladder": found}))
        return FAILED if faults else DONE
    for one in found:
        each = "  ".join(f"{key} {one['median'][key]}" for key in MEASURES)
        print(f"{one['rung']}  {each}  ({len(one['runs'])} seeds)  {one['name']}")
    return FAILED if faults else DONE


if __name__ == "__main__":
    sys.exit(run("ladder", LadderConfig, main))

"""From the paper's recipe to the default, one change at a time: what each is worth.

    python -m benchmarks.ladder --frames 15000000 --seeds 1 --json

Every rung trains with all changes of the rungs below it and one of its own. The first is recipe ``paper-50hz``, the
last has the default's settings. A rung's worth depends on those below it: another order would give other figures.
Runs are in runs/NAME-RUNG-SEED. What is trained already is not trained again, so the program goes on where it was
stopped, and two of it can share the rungs (``--rungs``).
"""

import json
import signal
import subprocess
import sys
from collections.abc import Sequence
from threading import Event
from typing import Any, Final, NamedTuple

from pydantic import Field

from benchmarks.recipe import MEASURES, differences, medians, result
from benchmarks.settings import BenchmarkConfig, run
from common.errors import ReportedError
from common.service.config import to_tables
from common.service.config_sources import read_toml
from common.service.process import DONE, FAILED
from common.service.run_folder import RunFolder
from deploy.config import SECTION
from deploy.config import settings as load_deploy
from topspin.report.groups import experiment

RECIPE: Final = "paper-50hz"
LOOK_S: Final = 1.0


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
        "small first noise; smaller datasets, larger minibatches, fewer passes; the learning rate follows the KL",
        {
            "network.initial-log-std": "-1.6",
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
        "hits are corrected, and the robot is led home after them",
        {
            "experience.hit-correction": "true",
            "learner.ppo.correction-weight": "500",
            "learner.ppo.refit-frames": "200000",
            "learner.curriculum.aiming-log-std": "-2.5",
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
    return [part for name, value in together.items() for part in (f"--{name}", value)]


def is_measured(folder: RunFolder) -> bool:
    """Return whether a run has trained to its end: one that was stopped leaves a summary without rates."""
    return folder.final.is_file() and "return_rate" in json.loads(folder.final.read_text(encoding="utf-8"))


def new_run(config: LadderConfig, rung: int, seed: int) -> list[str]:
    """Return the flags that start the training of a rung."""
    return ["--recipe", RECIPE, "--seed", str(seed), "--frames", str(config.frames), *flags_of(rung)]


def check_is_rung(config: LadderConfig, rung: int, seed: int, folder: RunFolder) -> None:
    """Raise ReportedError if a run is not the training of a rung: its settings, seed or frames are others."""
    own = read_toml(folder.config)
    wanted = to_tables(load_deploy(("--run", "rung", *new_run(config, rung, seed)), "ladder"), SECTION)
    other = differences(experiment(own), experiment(wanted))
    other += [f"{name} {own.get(name)}" for name in ("seed", "frames") if own.get(name) != wanted.get(name)]
    if other:
        raise ReportedError(
            f"{folder.root} is not rung {rung} of this ladder, but has {', '.join(other)}; choose another --run"
        )


def train(config: LadderConfig, rung: int, seed: int, stop: Event) -> str:
    """Train one rung with one seed, or go on with it; nothing if its end is measured. Return why it failed, or ""."""
    name = f"{config.run}-{rung}-{seed}"
    folder = RunFolder.of(name)
    is_there = folder.config.is_file()
    if is_there:
        check_is_rung(config, rung, seed, folder)
        if is_measured(folder):
            return ""
    flags = ["--resume"] if is_there else new_run(config, rung, seed)
    command = [sys.executable, "-m", "topspin", "train", "--run", name, "--panel", "off", *flags]
    print(f"rung {rung}, seed {seed}: {RUNGS[rung].name}", file=sys.stderr, flush=True)
    with subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
    ) as training:
        while training.poll() is None and not stop.is_set():
            stop.wait(LOOK_S)
        if training.poll() is None:
            training.send_signal(signal.SIGINT)  # it saves, and goes on from there next time
        status = training.wait()
    if status and not stop.is_set():
        return f"training {name} ended with {status}: see {folder.logs}"
    return ""


def figures(config: LadderConfig, rungs: Sequence[int]) -> list[dict[str, Any]]:
    """Return what the runs of each rung reached; rungs without a measured run are left out."""
    found = []
    for rung in rungs:
        runs = []
        for seed in config.seeds:
            folder = RunFolder.of(f"{config.run}-{rung}-{seed}")
            if is_measured(folder):
                check_is_rung(config, rung, seed, folder)
                runs.append(result(folder))
        if runs:
            found.append({"rung": rung, "name": RUNGS[rung].name, "runs": runs, "median": medians(runs)})
    return found


def main(config: LadderConfig, stop: Event) -> int:
    """Train what is missing, and print every rung."""
    rungs = config.rungs or tuple(range(len(RUNGS)))
    if wrong := [rung for rung in rungs if not 0 <= rung < len(RUNGS)]:
        raise ReportedError(f"no rung {wrong[0]}; allowed: 0 to {len(RUNGS) - 1}")
    faults = []
    for rung in rungs if config.train else ():
        for seed in config.seeds:
            if not stop.is_set() and (fault := train(config, rung, seed, stop)):
                print(fault, file=sys.stderr, flush=True)
                faults.append(fault)
    found = figures(config, range(len(RUNGS)))
    if config.json_line:
        print(json.dumps({"frames": config.frames, "ladder": found}))
        return FAILED if faults else DONE
    for one in found:
        each = "  ".join(f"{key} {one['median'][key]}" for key in MEASURES)
        print(f"{one['rung']}  {each}  ({len(one['runs'])} seeds)  {one['name']}")
    return FAILED if faults else DONE


if __name__ == "__main__":
    sys.exit(run("ladder", LadderConfig, main))

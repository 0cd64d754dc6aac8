"""Frames to the paper's figures with larger datasets: what a hundred actors buy.

    python -m benchmarks.batch_sizes --sizes 8192,32768,131072 --seeds 0,1 --json

Each training is one of ``benchmarks.time_to_quality``: a passage counts only if other balls confirm it. Two actors
(four for the largest) play as many environments as a dataset needs, and a minibatch is the learner's own
(``minibatch_of``). So the frames are those of a hundred actors, and the minutes are not. Trainings are written to
``results/large_batches.json``, from which ``benchmarks.scaling`` fits its law. What is in the file is not trained
again, unless it missed the goal with fewer ``--frames``. ``--minibatch`` and ``--more`` try other rules, and need a
file of their own (``--out``), since ``benchmarks.scaling`` counts the steps of the first one.
"""

import json
import math
import shlex
import sys
import time
from operator import attrgetter
from pathlib import Path
from threading import Event
from typing import Final

from pydantic import Field

from benchmarks.scaling.large_batches import FILE, LargeBatches, Point, read
from benchmarks.settings import BenchmarkConfig, as_flags, run
from benchmarks.time_to_quality import RETURN_RATE, TARGET_ERROR, TimeToQualityConfig, train
from common.errors import ReportedError
from common.service.process import DONE
from common.service.whole_file import write_whole
from services.learner.config import minibatch_of

HORIZON: Final = 32  # control steps of a rollout
FEWEST_ACTORS: Final = 2
TRAINING: Final = attrgetter("dataset", "minibatch", "more", "seed")  # what makes a point another one
LARGEST_ROLLOUT: Final = 131_072  # frames: 26 MB, and a message may have 64 MiB


class BatchSizesConfig(BenchmarkConfig):
    """Train to the paper's figures with datasets of several sizes, and fit how the frames grow."""

    sizes: tuple[int, ...] = Field(
        (8192, 32_768, 131_072, 524_288),
        description="of datasets: 8192,32768; whole numbers of rollouts of 32 control steps",
        json_schema_extra={"unit": "frames"},
    )
    seeds: tuple[int, ...] = Field((0, 1), description="seeds of each size: 0,1")
    frames: int = Field(
        60_000_000,
        ge=1,
        description="a training that needs more has missed the goal",
        json_schema_extra={"unit": "frames"},
    )
    run: str = Field(
        "",
        description="name of the runs, before -SIZE-SEED; empty: a time stamp. A run of this name that was "
        "stopped goes on",
    )
    minibatch: int = Field(
        0,
        ge=0,
        description="of each training; 0: as the learner has by default",
        json_schema_extra={"unit": "frames"},
    )
    more: str = Field("", description="more flags of deploy.local")
    out: Path = Field(FILE, description="file of the trainings")
    train: bool = Field(True, description="false: print what is there")


def flags_of(size: int, minibatch: int) -> list[str]:
    """Return the flags of deploy.local for datasets and minibatches of so many frames.

    Raises:
        ReportedError: No whole number of environments makes such a dataset.
    """
    actors = max(FEWEST_ACTORS, math.ceil(size / LARGEST_ROLLOUT))
    envs, rest = divmod(size, HORIZON * actors)
    if rest or not envs:
        raise ReportedError(
            f"dataset of {size} frames; allowed: a multiple of {HORIZON * actors}, {actors} rollouts"
        )
    flags = {
        "actors": actors,
        "actor.envs": envs,
        "actor.horizon": HORIZON,
        "learner.ppo.minibatch": minibatch,
    }
    return as_flags(flags)


def answers(point: Point, config: BatchSizesConfig) -> bool:
    """Return whether a training is one of those that are wanted now."""
    is_same = (point.minibatch, point.more) == (minibatch_of(config.minibatch, point.dataset), config.more)
    return is_same and (point.frames is not None or point.limit >= config.frames)


def missing(config: BatchSizesConfig, points: tuple[Point, ...]) -> list[tuple[int, int]]:
    """Return size and seed of the trainings that ``points`` lacks: the first seed of all sizes, then the next."""
    known = {(point.dataset, point.seed) for point in points if answers(point, config)}
    return [(size, seed) for seed in config.seeds for size in config.sizes if (size, seed) not in known]


def main(config: BatchSizesConfig, stop: Event) -> int:
    """Train what is missing, write it, and print the trainings."""
    if config.out == FILE and (config.minibatch or config.more):
        raise ReportedError(
            f"--minibatch or --more with --out {FILE}; allowed: another file, since this one is of one rule"
        )
    goal = {"return_rate": RETURN_RATE, "target_error": TARGET_ERROR}
    known = read(config.out)
    points = known.points if known else ()
    base = config.run or time.strftime("batches-%Y%m%d-%H%M%S")
    for size, seed in missing(config, points) if config.train else ():
        if stop.is_set():
            break
        minibatch = minibatch_of(config.minibatch, size)
        flags = [*flags_of(size, minibatch), "--frames", str(config.frames), *shlex.split(config.more)]
        settings = TimeToQualityConfig(minutes=1e6, more=shlex.join(flags))
        found = train(settings, f"{base}-{size}-{seed}", seed, stop, resumes=True)
        if found is None:
            break  # it was stopped, and says nothing
        point = Point(
            dataset=size,
            minibatch=minibatch,
            frames=found["frames"] if found["reached"] else None,
            limit=config.frames,
            seed=seed,
            more=config.more,
        )
        # It takes the place of one that missed the goal with fewer frames
        others = [one for one in points if TRAINING(one) != TRAINING(point)]
        points = (*others, point)
        write_whole(config.out, LargeBatches(**goal, points=points).model_dump_json(indent=1) + "\n")
        print(f"dataset {size}  seed {seed}  frames {point.frames}", file=sys.stderr, flush=True)
    if config.json_line:
        print(json.dumps(goal | {"points": [point.model_dump() for point in points]}))
        return DONE
    for point in sorted(points, key=lambda one: (one.dataset, one.seed)):
        reached = f"{point.frames:,} frames" if point.frames else "not reached"
        print(f"dataset {point.dataset:>9,}  seed {point.seed}  {reached}")
    return DONE


if __name__ == "__main__":
    sys.exit(run("batch_sizes", BatchSizesConfig, main))

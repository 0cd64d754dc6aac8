"""Valid rallies per second that one core draws, flies, validates and passes through the codec.

    python -m benchmarks.generator --json

An actor uses fewer than 1,000 rallies per second, so one generator can supply many actors.
"""

import json
import sys
import time
from dataclasses import asdict, dataclass
from threading import Event

from pydantic import Field

from benchmarks.settings import BenchmarkConfig, run
from common.comms.codec import decode, encode
from common.comms.messages import RallyBatch
from common.task.config import FlightName, PresetName, Randomization, TaskConfig
from common.task.launch import draw_rallies


@dataclass(frozen=True, slots=True)
class Speed:
    """Result of one run."""

    launch: str  # preset
    randomization: str  # profile
    flight: str  # model of the air
    batch: int  # rallies per message
    rallies: int  # valid rallies that passed the codec
    candidates: int  # launches drawn for them
    bytes: int  # on the wire
    seconds: float


def batch_on_the_wire(task: TaskConfig, size: int, seed: int, block: int) -> tuple[RallyBatch, int]:
    """Return a block of valid rallies as its receiver decodes it, and its size [bytes]."""
    drawn = draw_rallies(size, task, seed=seed, block=block)
    message = RallyBatch(
        source="benchmark",
        incarnation=0,
        sequence=block,
        shard=0,
        block=block,
        rallies=drawn.launches,
        seeds=drawn.seeds,
        candidates=drawn.drawn,
        launch=task.launch,
        randomization=task.randomization,
    )
    payload = encode(message)
    return decode(payload, RallyBatch), len(payload)


def measure(launch: str, randomization: str, flight: str, size: int, seed: int, seconds: float) -> Speed:
    """Draw blocks for ``seconds`` and return the number of rallies."""
    task = TaskConfig.model_validate({"launch": launch, "randomization": randomization, "flight": flight})
    batch_on_the_wire(task, 1, seed, 0)  # compiles the kernels
    rallies = candidates = n_bytes = block = 0
    start = time.perf_counter()
    elapsed = 0.0
    while elapsed < seconds:
        received, received_bytes = batch_on_the_wire(task, size, seed, block)
        rallies += len(received.seeds)
        candidates += received.candidates
        n_bytes += received_bytes
        block += 1
        elapsed = time.perf_counter() - start
    return Speed(launch, randomization, flight, size, rallies, candidates, n_bytes, elapsed)


class GeneratorConfig(BenchmarkConfig):
    """Measure the generator's core on one thread: draw random launches, validate them, encode and decode the batch.

    A launch is valid if the ball crosses the net and its first touch is the robot's court. There is no network and no
    other process: the result is an upper bound for a generator.
    """

    launch: PresetName = Field("paper", description="launch preset")
    randomization: Randomization = Field("standard", description="profile with the ranges of drag and lift")
    flight: FlightName = Field("full", description="model of the air")
    batch: int = Field(500, ge=1, description="valid rallies per message")
    seed: int = Field(0, ge=0, lt=2**63, description="of the blocks")
    seconds: float = Field(
        3.0, gt=0, description="duration of the measurement", json_schema_extra={"unit": "s"}
    )


def main(config: GeneratorConfig, _stop: Event) -> int:
    """Measure and print."""
    speed = measure(
        *(config.launch, config.randomization, config.flight), config.batch, config.seed, config.seconds
    )
    valid_per_s = speed.rallies / speed.seconds
    share = speed.rallies / speed.candidates
    if config.json_line:
        figures = {
            "valid_per_s": round(valid_per_s),
            "yield": round(share, 4),
            "candidates_per_s": round(speed.candidates / speed.seconds),
            "bytes_per_rally": round(speed.bytes / speed.rallies, 1),
        }
        print(json.dumps(figures | asdict(speed)))
    else:
        print(
            f"{valid_per_s:,.0f} valid rallies/s, {share:.1%} of the candidates "
            f"({speed.launch}, randomization {speed.randomization}, air {speed.flight}, "
            f"{speed.rallies:,} in {speed.seconds:.1f} s)"
        )
    return 0


if __name__ == "__main__":
    sys.exit(run("generator", GeneratorConfig, main))

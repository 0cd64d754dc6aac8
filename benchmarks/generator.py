"""How many valid rallies a second one core draws, flies, validates and puts through the codec.

    python -m benchmarks.generator --json

An actor consumes well under 1,000 rallies a second, so one generator should feed them all with room to spare.
"""

import argparse
import json
import time
from dataclasses import asdict, dataclass

from common.comms.codec import decode, encode
from common.comms.messages import RallyBatch
from common.rally.launch import draw_rallies
from common.rally.launch_presets import PRESETS
from common.rally.noise import PROFILES


@dataclass(frozen=True, slots=True)
class Speed:
    """What one run measured."""

    preset: str
    noise: str
    batch: int  # rallies per message
    rallies: int  # valid ones, through the codec
    candidates: int  # launches drawn for them
    bytes: int  # on the wire
    seconds: float


def batch_on_the_wire(preset: str, noise: str, size: int, seed: int, block: int) -> tuple[RallyBatch, int]:
    """Return a block of valid rallies as its receiver gets it, and its size [bytes]."""
    drawn = draw_rallies(size, seed=seed, block=block, preset=preset, noise=noise)
    message = RallyBatch(
        source="benchmark",
        incarnation=0,
        sequence=block,
        shard=0,
        block=block,
        rallies=drawn.launches,
        seeds=drawn.seeds,
        candidates=drawn.drawn,
        preset=preset,
        noise=noise,
    )
    payload = encode(message)
    return decode(payload, RallyBatch), len(payload)


def measure(preset: str, noise: str, size: int, seed: int, seconds: float) -> Speed:
    """Draw blocks for ``seconds`` and return how far that went."""
    batch_on_the_wire(preset, noise, 1, seed, 0)  # compiles
    rallies = candidates = n_bytes = block = 0
    start = time.perf_counter()
    elapsed = 0.0
    while elapsed < seconds:
        received, received_bytes = batch_on_the_wire(preset, noise, size, seed, block)
        rallies += len(received.seeds)
        candidates += received.candidates
        n_bytes += received_bytes
        block += 1
        elapsed = time.perf_counter() - start
    return Speed(preset, noise, size, rallies, candidates, n_bytes, elapsed)


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """Return the command line's options."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.generator",
        description="Measure the generator's core on one thread: draw random launches, fly each to its first "
        "touch, keep those that cross the net and touch the robot's court first, encode and decode "
        "the batch. No network, no process: what a generator could publish at best.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("--preset", choices=PRESETS, default="paper", help="which launches are drawn")
    parser.add_argument("--noise", choices=PROFILES, default="standard", help="how far drag and lift vary")
    parser.add_argument(
        "--batch", type=int, default=500, metavar="N", help="valid rallies per message, 1 or more"
    )
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="of the blocks drawn, 0 or more")
    parser.add_argument("--seconds", type=float, default=3.0, metavar="S", help="how long to measure, > 0")
    parser.add_argument("--json", action="store_true", help="print one JSON object as the last line")
    options = parser.parse_args(arguments)
    if options.batch < 1:
        parser.error(f"--batch: got {options.batch}; allowed: 1 or more")
    if options.seed < 0:
        parser.error(f"--seed: got {options.seed}; allowed: 0 or more")
    if not options.seconds > 0.0:
        parser.error(f"--seconds: got {options.seconds}; allowed: more than 0")
    return options


def main() -> None:
    """Measure and print."""
    options = parse()
    speed = measure(options.preset, options.noise, options.batch, options.seed, options.seconds)
    valid_per_s = speed.rallies / speed.seconds
    share = speed.rallies / speed.candidates
    if options.json:
        figures = {
            "valid_per_s": round(valid_per_s),
            "yield": round(share, 4),
            "candidates_per_s": round(speed.candidates / speed.seconds),
            "bytes_per_rally": round(speed.bytes / speed.rallies, 1),
            "launch": speed.preset,
        }
        print(json.dumps(figures | asdict(speed)))
    else:
        print(
            f"{valid_per_s:,.0f} valid rallies/s, {share:.1%} of the candidates "
            f"({speed.preset}, noise {speed.noise}, {speed.rallies:,} in {speed.seconds:.1f} s)"
        )


if __name__ == "__main__":
    main()

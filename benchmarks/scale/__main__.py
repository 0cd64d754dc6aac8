"""What the traffic of a run costs as it grows: bytes, broadcasts, the learner's CPU, and a hub with 1,000 clients.

    python -m benchmarks.scale --json              # about 9 minutes on two cores
    python -m benchmarks.scale --json --many 0     # without the 1,000 senders: about 4 minutes

- Bytes: each field of a rollout's message per frame, a policy's message, and what shorter numbers would save.
- Broadcast: a policy from the learner's hub to 64 subscribers.
- Cost: a real learner trains what 4, 16 and 64 senders send, one rollout of each in a dataset. They have as many
  environments as `topspin train --actors N` gives each: 64, 16 and 16. Its CPU time per frame says what a sender costs.
  Then 64 senders of 4 environments: as many frames in a dataset as the 4 senders have, in pieces of 128.
- Many: 1,000 senders through one router, and through a tree of three, with and without policies to them. The difference
  says what the hub's core is used for.

Senders are real sessions with the actors' outbox. They send a recorded rollout again and again, and play nothing.
"""

import sys
from statistics import median
from threading import Event
from typing import Any, Final

import torch
from pydantic import Field

from benchmarks.scale import broadcast, sizes
from benchmarks.scale.fleet import Fleet, Layout, measure
from benchmarks.settings import BenchmarkConfig, print_figures, run

FEW: Final = ((4, 64), (16, 16), (64, 16), (64, 4))  # senders, and environments of each
LAYOUTS: Final[tuple[Layout, ...]] = ("router", "tree")
MANY_ENVS, MANY_DATASET = 4, 64  # of each sender, and rollouts of a dataset


class ScaleConfig(BenchmarkConfig):
    """Measure messages' bytes, a policy's broadcast, and what more senders cost the learner and its hub."""

    seconds: float = Field(
        20.0, gt=0, description="duration of each measurement", json_schema_extra={"unit": "s"}
    )
    warm_up: float = Field(
        5.0, ge=0, description="time before each measurement", json_schema_extra={"unit": "s"}
    )
    processes: int = Field(4, ge=1, le=64, description="processes that senders or subscribers share")
    subscribers: int = Field(64, ge=1, le=1000, description="subscribers of a policy")
    policies: int = Field(100, ge=10, description="policies to broadcast")
    pause: float = Field(0.25, gt=0, description="time between two of them", json_schema_extra={"unit": "s"})
    many: int = Field(1000, ge=0, le=10_000, description="light senders through routers; 0: none")
    repeats: int = Field(1, ge=1, le=20, description="measurements of 4, 16 and 64 senders, interleaved")


def main(config: ScaleConfig, stop: Event) -> int:
    """Measure and print."""
    torch.set_num_threads(1)
    training = sizes.new_training()
    figures: dict[str, Any] = {
        **sizes.rollout_sizes(sizes.played(training, 256, 0)),
        "bytes_per_frame_16_envs": sizes.rollout_sizes(sizes.played(training, 16, 0))["bytes_per_frame"],
        **sizes.policy_sizes(training),
        **broadcast.measure(config.subscribers, config.processes, config.policies, config.pause, stop),
    }
    costs: list[list[float]] = [[] for _ in FEW]
    figures["few"] = []
    for _ in range(config.repeats):
        for (senders, envs), found_costs in zip(FEW, costs, strict=True):
            processes = min(config.processes, senders)
            fleet = Fleet(senders, processes, "hub", envs, dataset=senders, takes_policies=True)
            found = measure(fleet, config.warm_up, config.seconds, stop)
            show(found)
            figures["few"].append(found)
            found_costs.append(found["learner_cpu_us_per_frame"])
    four, sixteen, sixty_four, in_pieces = map(median, costs)
    figures["learner_cpu_us_per_frame"] = {
        **{"4": four, "16": sixteen, "64": sixty_four},
        "64_same_dataset": in_pieces,
    }
    figures["cost_growth_4_to_64"] = round(sixty_four / four, 3)
    figures["cost_growth_4_to_64_same_dataset"] = round(in_pieces / four, 3)
    if config.many:
        figures["many"] = []
        for takes_policies in (False, True):
            for layout in LAYOUTS:
                fleet = Fleet(config.many, config.processes, layout, MANY_ENVS, MANY_DATASET, takes_policies)
                found = measure(fleet, config.warm_up, config.seconds, stop)
                show(found)
                figures["many"].append(found)
    print_figures(figures, config.json_line)
    return 0


def show(found: dict[str, Any]) -> None:
    """Print a measurement for a person."""
    print("  ".join(f"{name} {value}" for name, value in found.items()), file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(run("scale", ScaleConfig, main))

"""What a run is made of: one table of its processes, for this machine and for clusters.

`deploy.local` starts processes from it, and `deploy.manifests` writes it for containers, Kubernetes, Slurm and systemd.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Protocol


class Sizes(Protocol):
    """How many services a run has."""

    @property
    def actors(self) -> int:
        """Number of actors."""

    @property
    def generators(self) -> int:
        """Number of generators."""

    @property
    def evaluate(self) -> bool:
        """Whether there is an evaluator."""


@dataclass(frozen=True, slots=True)
class Resources:
    """What one process needs and may take. Cores: [-], memory: [MiB]."""

    cores: float
    cores_limit: float
    memory_mib: int
    memory_limit_mib: int


@dataclass(frozen=True, slots=True)
class Role:
    """One kind of process of a run."""

    name: str  # its module is services.<name>
    count: Callable[[Sizes], int]
    has_index: (
        bool  # whether its number decides what it does: an actor's noise and shard, a generator's shards
    )
    keeps_files: bool  # whether it writes into the run folder
    resources: Resources
    grace_s: int  # [s] time to end in order: a checkpoint, the last verdicts
    summary: str

    def arguments(self, index: str, file: str, port: str, *more: str) -> tuple[str, ...]:
        """Return module and flags of one process, as after ``python -m``.

        Args:
            index: Its number, from 0, or what a manager of processes replaces by it; "": the learner gives it one.
            file: The run's settings.
            port: Of its /metrics.
            more: Flags that follow.
        """
        name = ("--id", index) if index else ()
        which = ("--index", index) if self.has_index and index else ()
        return (
            f"services.{self.name}",
            *("--config", file, *name, "--metrics-port", port),
            *which,
            *more,
        )


# Learner and actor compute with one thread; the limits leave room for the threads of the transport.
# Memory: measured 440, 540, 200 and 530 MiB with small networks; the learner's grows with datasets and queue.
ROLES: Final = (
    Role(
        "learner",
        lambda sizes: 1,
        has_index=False,
        keeps_files=True,
        resources=Resources(1.0, 2.0, 1024, 4096),
        grace_s=60,
        summary="trains the policy and keeps the run's state",
    ),
    Role(
        "evaluator",
        lambda sizes: int(sizes.evaluate),
        has_index=False,
        keeps_files=True,
        resources=Resources(0.25, 1.0, 768, 2048),
        grace_s=15,
        summary="measures the newest policy and keeps the best",
    ),
    Role(
        "generator",
        lambda sizes: sizes.generators,
        has_index=True,
        keeps_files=False,
        resources=Resources(0.1, 1.0, 384, 1024),
        grace_s=15,
        summary="publishes valid rallies",
    ),
    Role(
        "actor",
        lambda sizes: sizes.actors,
        has_index=True,
        keeps_files=False,
        resources=Resources(1.0, 1.5, 768, 2048),
        grace_s=20,
        summary="plays rallies and sends rollouts",
    ),
)


def role(name: str) -> Role:
    """Return a role by its name."""
    return next(found for found in ROLES if found.name == name)

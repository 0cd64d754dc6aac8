"""What each part of a training run costs, as one file of numbers, and what collectives between learners take.

All times are CPU seconds of one core, except those of `exchange`, ``latency_s`` and of the link, which are wall time.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Final, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from common.errors import ReportedError
from services.actor.config import ActorOptions

HORIZON: Final = ActorOptions().horizon  # control steps of a rollout


class Line(BaseModel):
    """A cost that is ``each + per * size``."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    each: float = Field(0.0, ge=0)  # [s]
    per: float = Field(0.0, ge=0)  # [s] per frame, or per byte

    def of(self, size: float) -> float:
        """Return the cost of one thing of this size [s]."""
        return self.each + self.per * size

    @classmethod
    def through(cls, small: tuple[float, float], large: tuple[float, float]) -> Self:
        """Return the line through two measured points (size, seconds); neither part is below 0."""
        per = max(0.0, (large[1] - small[1]) / (large[0] - small[0]))
        return cls(each=max(0.0, small[1] - per * small[0]), per=per)

    def times(self, factor: float) -> Self:
        """Return the line of a part that is as many times slower."""
        return self.model_copy(update={"each": self.each * factor, "per": self.per * factor})


class Costs(BaseModel):
    """The measured costs of one machine: the file that ``--save`` writes and ``--costs`` reads."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    machine: str = Field(description="processor, and how many cores of it the measurement had")
    play_s: dict[int, float] = Field(
        min_length=1, description="an actor's rollout of 32 steps, encoded, by environments [s]"
    )
    adopt_s: float = Field(0.0, ge=0, description="an actor reads and installs a policy [s]")
    send: Line = Field(Line(), description="an actor sends a rollout, by bytes")
    opening: Line = Field(Line(), description="the learner opens a rollout, by frames")
    reading: Line = Field(Line(), description="the learner reads a rollout into the dataset, by frames")
    step: Line = Field(Line(), description="a gradient step, by the frames of a rank's part of the minibatch")
    whole_frame_s: float = Field(
        0.0, ge=0, description="what every rank does for each frame of the whole dataset, in all passes [s]"
    )
    publish_s: float = Field(0.0, ge=0, description="the learner encodes a policy [s]")
    hub: Line = Field(Line(), description="the hub takes a rollout and returns its verdict, by bytes")
    hub_policy_byte_s: float = Field(
        0.0, ge=0, description="the hub sends a byte of a policy to one actor [s]"
    )
    latency_s: float = Field(0.0, ge=0, description="a small message, one way [s]")
    exchange: Line = Field(Line(), description="one step of a ring of learners, by the bytes it moves")
    rollout: Line = Field(Line(), description="bytes of a rollout, by frames")
    policy_bytes: float = Field(0.0, ge=0)
    gradient_bytes: float = Field(0.0, ge=0)
    generator_share: float = Field(0.0, ge=0, description="share of a core that makes one actor's rallies")
    evaluator_share: float = Field(0.0, ge=0, description="share of a core that the evaluator uses")
    slowdown: float = Field(
        1.0, ge=1, description="CPU time of the same work with all cores busy, over that alone"
    )
    start_s: float = Field(0.0, ge=0, description="CPU time of a process from its start to its first rollout")

    def playing(self, envs: int) -> float:
        """Return the CPU time of a rollout of ``envs`` environments [s].

        Between the measured sizes it is interpolated. Beyond the largest a frame costs what it costs there, and below
        the smallest a rollout costs what it costs there.
        """
        sizes = sorted(self.play_s)
        times = [self.play_s[size] for size in sizes]
        if envs > sizes[-1]:
            return times[-1] * envs / sizes[-1]
        return float(np.interp(envs, sizes, times))


def read(file: Path) -> Costs:
    """Return the costs of a file.

    Raises:
        ReportedError: It is not there, or no file of costs.
    """
    try:
        return Costs.model_validate_json(file.read_bytes())
    except OSError as error:
        raise ReportedError(f"--costs {file}: {error.strerror}; allowed: a file that --save wrote") from None
    except ValidationError as error:
        raise ReportedError(f"--costs {file}: {first_fault(error)}") from None


def first_fault(error: ValidationError) -> str:
    """Return the first fault of a file, in one line."""
    fault = error.errors()[0]
    where = ".".join(map(str, fault["loc"]))
    return f"{where}: {fault['msg']}" if where else str(fault["msg"])


class Network(BaseModel):
    """What lies between the hosts of a fleet that is larger than one machine. The learners share one while they fit."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    host_cores: int = Field(64, ge=1)
    bytes_per_s: float = Field(1.25e9, gt=0)  # of the hub's link, in each direction
    latency_s: float = Field(5e-5, ge=0)  # one way

    def remote_share(self, cores: float) -> float:
        """Return the share of a fleet that is not on the hub's host."""
        return max(0.0, 1.0 - self.host_cores / cores)


def ring_step_s(costs: Costs, network: Network, ranks: int, size: float) -> float:
    """Return the time of one step of a ring in which each rank sends ``size`` bytes to the next one [s]."""
    local = costs.exchange.of(size)
    if ranks <= network.host_cores:
        return local
    return network.latency_s + max(local, costs.exchange.each + size / network.bytes_per_s)


def sum_s(costs: Costs, network: Network, ranks: int, size: float) -> float:
    """Return the time of a sum of ``size`` bytes over the ranks [s].

    In a ring every rank sends 2 (K - 1) parts of size / K (Patarasuk and Yuan 2009), as gloo does.
    """
    return 2 * (ranks - 1) * ring_step_s(costs, network, ranks, size / ranks)


def gather_s(costs: Costs, network: Network, ranks: int, size: float) -> float:
    """Return the time until every rank has the parts of all, ``size`` bytes together [s]: K - 1 steps of a ring."""
    return (ranks - 1) * ring_step_s(costs, network, ranks, size / ranks)


def exchange_line(sizes: Sequence[tuple[float, float]]) -> Line:
    """Return the cost of a ring's step from sums of two ranks: (bytes, seconds), the smaller first.

    Such a sum takes two steps, each with half of the bytes.
    """
    (small, small_s), (large, large_s) = sizes
    return Line.through((small / 2, small_s / 2), (large / 2, large_s / 2))

"""Every message on the wire, with the dtype, shape, unit and range of each field.

A field is added at the end, with a default: older senders are then still understood. Any other change raises
the message's VERSION, and that of the messages it is part of. Arrays are read-only once decoded.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from types import MappingProxyType
from typing import Annotated, Any, ClassVar

import numpy as np
import numpy.typing as npt

from common.comms.wire import Wire

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
Bool = npt.NDArray[np.bool_]
U8 = npt.NDArray[np.uint8]
U64 = npt.NDArray[np.uint64]
I32 = npt.NDArray[np.int32]

Count = Annotated[int, Wire("1", low=0, high=2**62)]
# Of an actor's incarnation. Out of reach at any rate (4 a second: 70 million years), and whole as a heartbeat's float.
Sequence = Annotated[int, Wire("1", low=0, high=2**53)]
Stage = Annotated[int, Wire("1", low=1, high=3)]
Seconds = Annotated[float, Wire("s", low=0)]
Numbers = Annotated[Mapping[str, float], Wire("by name")]

RALLY_WIDTH = 11  # columns of a rally on the wire


@dataclass(frozen=True, slots=True, eq=False)
class RallyBatch:
    """Valid launches by row: position 3 (m), velocity 3 (m/s), spin 3 (rad/s), drag and lift factor."""

    VERSION: ClassVar[int] = 1

    source: str  # id of the generator
    incarnation: Count
    sequence: Count  # of this source and shard: a gap is a lost batch
    shard: Count
    block: Count  # index of the block of candidates: the same for everyone who asks for it
    rallies: Annotated[F64, Wire("m, m/s, rad/s, 1", "<f8", f"N {RALLY_WIDTH}")]
    seeds: Annotated[U64, Wire("1", "<u8", "N")]
    candidates: Count  # launches drawn to find these
    preset: str
    noise: str


@dataclass(frozen=True, slots=True)
class RallyRequest:
    """Asks a generator for one block by its index; the reply is a `RallyBatch`."""

    VERSION: ClassVar[int] = 1

    shard: Count
    block: Count


AVERAGE = b"average"
"""Asked with this payload, the policy's queryable answers with the running mean of the weights; with none, with the
newest weights."""


@dataclass(frozen=True, slots=True, eq=False)
class PolicySnapshot:
    """All that an actor needs to play one version of the policy, in one blob."""

    VERSION: ClassVar[int] = 2

    run: str
    generation: Count
    version: Count
    stage_number: Count  # how many stage changes went before
    stage: Stage
    epoch: Count
    frames: Count
    contract_hash: str  # of the observation, action and network layout
    weights: bytes  # safetensors
    obs_mean: Annotated[F64, Wire("as the observation", "<f8", "D")]
    obs_var: Annotated[F64, Wire("its square", "<f8", "D", low=0)]
    obs_count: Count


@dataclass(frozen=True, slots=True)
class StageChange:
    """The curriculum went on; ``number`` counts the changes of a run, through restarts."""

    VERSION: ClassVar[int] = 1

    run: str
    generation: Count
    number: Count
    stage: Stage
    frames: Count
    epoch: Count
    reason: str


@dataclass(frozen=True, slots=True)
class StageLog:
    """All stage changes of a run so far, oldest first: the truth behind the hints."""

    VERSION: ClassVar[int] = 1

    changes: tuple[StageChange, ...]

    def fault(self) -> str:
        """Return what is inconsistent, or ""."""
        numbers = [change.number for change in self.changes]
        return "" if numbers == sorted(set(numbers)) else f"stage numbers {numbers}; allowed: increasing"


@dataclass(frozen=True, slots=True, eq=False)
class Episodes:
    """Summaries of the E episodes that ended in a rollout."""

    VERSION: ClassVar[int] = 2

    outcome: Annotated[U8, Wire("index of the outcome", "|u1", "E")]
    target_error: Annotated[F32, Wire("m", "<f4", "E", low=0, nan=True)]  # NaN: the ball did not land
    caught: Annotated[Bool, Wire("", "|b1", "E")]
    over: Annotated[Bool, Wire("", "|b1", "E")]
    landed: Annotated[Bool, Wire("", "|b1", "E")]
    unvalidated: Annotated[Bool, Wire("", "|b1", "E")]  # launches that nobody has checked: in no rate
    returns: Annotated[F32, Wire("reward", "<f4", "E")]


@dataclass(frozen=True, slots=True, eq=False)
class Rollout:
    """One contiguous block of T control steps in B environments, as it was played."""

    VERSION: ClassVar[int] = 3

    run: str
    generation: Count
    version: Count  # of the policy that acted
    stage_number: Count
    actor: str
    incarnation: Count
    sequence: Sequence  # from 0 without a gap
    contract_hash: str
    obs: Annotated[F32, Wire("as the observation", "<f4", "T B D")]  # raw: the learner normalises
    actions: Annotated[F32, Wire("1", "<f4", "T B 7")]  # as sampled, before the clip to [-1, 1]
    log_mu: Annotated[F32, Wire("1", "<f4", "T B")]  # log-density of the action under the policy that acted
    rewards: Annotated[F32, Wire("reward", "<f4", "T B")]
    terminated: Annotated[Bool, Wire("", "|b1", "T B")]
    truncated: Annotated[Bool, Wire("", "|b1", "T B")]
    final_obs: Annotated[F32, Wire("as the observation", "<f4", "K D")]  # the last real one of each truncated
    final_index: Annotated[I32, Wire("t * B + b", "<i4", "K", low=0)]  # the step it followed, increasing
    last_obs: Annotated[F32, Wire("as the observation", "<f4", "B D")]  # after step T: bootstrap at the cut
    episodes: Episodes
    reward_terms: Annotated[F32, Wire("reward", "<f4", "R")]  # sum over the block, by term
    # By what the actions before a hit should have differed (hindsight.correction), or all of them where a teacher
    # says what it would have done; rows of zeros: nothing is known
    corrections: Annotated[F32, Wire("half-range", "<f4", "T B 7")]
    seconds: Numbers = field(default_factory=lambda: MappingProxyType({}))  # by phase of the actor's loop

    def fault(self) -> str:
        """Return what is inconsistent, or ""."""
        if self.rewards.size == 0:
            return f"no steps: shape {self.rewards.shape}; allowed: T and B from 1"
        if (self.terminated & self.truncated).any():
            return "a step is both terminated and truncated"
        if not np.array_equal(np.flatnonzero(self.truncated), self.final_index):
            return (
                f"{self.final_index.size} final_index do not name the {self.truncated.sum()} truncated steps"
            )
        return ""


class VerdictKind(StrEnum):
    """What became of a rollout."""

    ACCEPTED = "accepted"
    INVALID = "invalid"
    WRONG_RUN = "wrong_run"
    WRONG_CONTRACT = "wrong_contract"
    WRONG_GENERATION = "wrong_generation"
    STALE_STAGE = "stale_stage"
    TOO_OLD = "too_old"
    DUPLICATE = "duplicate"  # seen before; ``first`` holds the verdict of then
    BUSY = "busy"
    UNREADABLE = "unreadable"  # so broken that nobody can say whose it was
    CREDITS = "credits"  # the answer to an ActorReport


# Each sequence number gets exactly one of these; after any other kind the actor sends it again.
FINAL_VERDICTS = frozenset(
    {
        VerdictKind.ACCEPTED,
        VerdictKind.INVALID,
        VerdictKind.WRONG_RUN,
        VerdictKind.WRONG_CONTRACT,
        VerdictKind.WRONG_GENERATION,
        VerdictKind.STALE_STAGE,
        VerdictKind.TOO_OLD,
    }
)


@dataclass(frozen=True, slots=True)
class Verdict:
    """The learner's answer to a rollout or a report, and where it stands itself."""

    VERSION: ClassVar[int] = 1

    kind: VerdictKind
    first: VerdictKind  # the verdict of record: as ``kind``, but for duplicates
    reason: str  # for people
    generation: Count
    version: Count
    stage_number: Count
    stage: Stage
    # The pacing. An absolute limit, so that a lost or repeated answer changes nothing.
    credit_limit: Count  # the actor may publish sequence numbers below this ...
    credit_version: Count  # ... played by this version or a later one


@dataclass(frozen=True, slots=True)
class Refusal:
    """A rollout that got a final verdict other than accepted."""

    VERSION: ClassVar[int] = 1

    sequence: Sequence
    kind: VerdictKind
    generation: Count  # of the learner that said so


@dataclass(frozen=True, slots=True)
class ActorReport:
    """What became of an actor's rollouts as far as it knows; the reply is a `Verdict` with fresh credits.

    What is below ``published`` and not listed was accepted, or refused by the learner of ``generation``,
    who knows that itself.
    """

    VERSION: ClassVar[int] = 1

    run: str
    actor: str
    incarnation: Count
    version: Count  # of the policy that it holds
    published: Sequence  # numbers used so far
    in_flight: tuple[int, ...]
    dropped: tuple[int, ...]  # given up
    generation: Count  # of the learner that the actor heard last; 0 is none
    refused: tuple[Refusal, ...]  # by learners of other generations
    leaving: bool  # nothing will follow


@dataclass(frozen=True, slots=True)
class Status:
    """A heartbeat: cumulative counters, so that a lost one costs nothing."""

    VERSION: ClassVar[int] = 1

    role: str
    id: str
    incarnation: Count
    time: Annotated[float, Wire("s since 1970", low=0)]
    state: str
    counters: Numbers
    gauges: Numbers


class Command(StrEnum):
    """What one can ask a running service to do."""

    PAUSE = "pause"
    RESUME = "resume"
    DRAIN = "drain"  # finish what is under way, then stop
    STOP = "stop"


@dataclass(frozen=True, slots=True)
class Control:
    """A command to one service; the reply is a `ControlReply`."""

    VERSION: ClassVar[int] = 1

    command: Command


@dataclass(frozen=True, slots=True)
class ControlReply:
    """Whether a command was taken, and the state that the service is in now."""

    VERSION: ClassVar[int] = 1

    ok: bool
    state: str
    reason: str


# Every type that may stand alone on the wire.
MESSAGES: tuple[type[Any], ...] = (
    RallyBatch,
    RallyRequest,
    PolicySnapshot,
    StageChange,
    StageLog,
    Rollout,
    Verdict,
    ActorReport,
    Status,
    Control,
    ControlReply,
)

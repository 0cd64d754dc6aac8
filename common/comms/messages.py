"""All messages on the wire, with the dtype, shape, unit and range of each field.

A new field is added at the end, with a default: then messages of older senders stay valid. Any other change raises
the message's VERSION, and the VERSION of the messages that contain it. Decoded arrays are read-only.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from types import MappingProxyType
from typing import Annotated, Any, ClassVar, Final

import numpy as np
import numpy.typing as npt

from common.comms.budgets import HASH_PATTERN, ID_PATTERN, LISTED_REFUSALS
from common.comms.wire import Wire

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
Bool = npt.NDArray[np.bool_]
U8 = npt.NDArray[np.uint8]
U64 = npt.NDArray[np.uint64]
I32 = npt.NDArray[np.int32]

Count = Annotated[int, Wire("1", low=0, high=2**62)]
# Of an actor's incarnation. No actor reaches the limit (4 a second: 70 million years), and a heartbeat's float is
# exact.
Sequence = Annotated[int, Wire("1", low=0, high=2**53)]
Sequences = Annotated[tuple[int, ...], Wire("1", low=0, high=2**53)]
Stage = Annotated[int, Wire("1", low=1, high=3)]
Seconds = Annotated[float, Wire("s", low=0)]
Id = Annotated[str, Wire(text=ID_PATTERN)]  # what can stand in a key
Hash = Annotated[str, Wire(text=HASH_PATTERN)]
Numbers = Annotated[Mapping[str, float], Wire("by name")]

RALLY_WIDTH = 12  # columns of a rally on the wire


@dataclass(frozen=True, slots=True, eq=False)
class RallyBatch:
    """Valid launches, one a row: position 3 (m), velocity 3 (m/s), spin 3 (rad/s), drag and lift factor, kind."""

    VERSION: ClassVar[int] = 3

    source: Id  # id of the generator
    incarnation: Count
    sequence: Count  # of this source and shard: a gap is a lost batch
    shard: Count
    block: Count  # index of the block of candidates: the same block for every request
    rallies: Annotated[F64, Wire("m, m/s, rad/s, 1", "<f8", f"N {RALLY_WIDTH}")]
    seeds: Annotated[U64, Wire("1", "<u8", "N")]
    candidates: Count  # launches that were drawn to find these
    launch: str  # preset
    randomization: str  # profile


@dataclass(frozen=True, slots=True)
class RallyRequest:
    """A request to a generator for one block by its index. The reply is a `RallyBatch`."""

    VERSION: ClassVar[int] = 1

    shard: Count
    block: Count


AVERAGE = b"average"
"""Payload of a policy request for the weights to evaluate, by default their running mean. An empty payload requests
the newest weights."""


@dataclass(frozen=True, slots=True, eq=False)
class PolicySnapshot:
    """One version of the policy, with all that an actor needs to play it."""

    VERSION: ClassVar[int] = 4

    run: Id
    generation: Count
    version: Count
    stage_number: Count  # stage changes before this version
    stage: Stage
    epoch: Count
    frames: Count
    contract_hash: Hash  # of task and network
    training_hash: Hash  # of task, network and experience
    weights: bytes  # safetensors; matrices in bfloat16 where the learner computes with it (ADR-0067)
    obs_mean: Annotated[F64, Wire("as the observation", "<f8", "D")]
    obs_var: Annotated[F64, Wire("its square", "<f8", "D", low=0)]
    obs_count: Count
    ranks: Annotated[int, Wire("1", low=1, high=1024)] = 1  # learners that train together (`keys.rank_of`)


@dataclass(frozen=True, slots=True)
class StageChange:
    """A change to the next curriculum stage. ``number`` counts the changes of a run, across restarts."""

    VERSION: ClassVar[int] = 1

    run: Id
    generation: Count
    number: Count
    stage: Stage
    frames: Count
    epoch: Count
    reason: str


@dataclass(frozen=True, slots=True)
class StageLog:
    """All stage changes of a run so far, oldest first. Hints may be lost; this reply is complete."""

    VERSION: ClassVar[int] = 1

    changes: tuple[StageChange, ...]

    def fault(self) -> str:
        """Return the inconsistency, or "" if there is none."""
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
    unvalidated: Annotated[
        Bool, Wire("", "|b1", "E")
    ]  # launches that no generator validated: they count in no rate
    returns: Annotated[F32, Wire("reward", "<f4", "E")]


@dataclass(frozen=True, slots=True, eq=False)
class Rollout:
    """One contiguous block of T control steps in B environments, as played. Some of it travels as float16."""

    VERSION: ClassVar[int] = 5

    run: Id
    generation: Count
    version: Count  # of the policy that acted
    stage_number: Count
    actor: Id
    incarnation: Count
    sequence: Sequence  # from 0 without a gap
    training_hash: Hash  # of the actor's task, network and experience
    # raw: the learner normalises
    obs: Annotated[F32, Wire("as the observation", "<f4", "T B D", sent="<f2")]
    actions: Annotated[F32, Wire("1", "<f4", "T B 7")]  # as sampled, before the clip to [-1, 1]
    log_mu: Annotated[F32, Wire("1", "<f4", "T B")]  # log density of the action under the policy that acted
    rewards: Annotated[F32, Wire("reward", "<f4", "T B")]
    terminated: Annotated[Bool, Wire("", "|b1", "T B")]
    truncated: Annotated[Bool, Wire("", "|b1", "T B")]
    final_obs: Annotated[
        F32, Wire("as the observation", "<f4", "K D", sent="<f2")
    ]  # last observation of each truncated episode
    final_index: Annotated[I32, Wire("t * B + b", "<i4", "K", low=0)]  # the step that it follows, increasing
    last_obs: Annotated[
        F32, Wire("as the observation", "<f4", "B D", sent="<f2")
    ]  # after step T: bootstrap at the block's end
    episodes: Episodes
    reward_terms: Annotated[F32, Wire("reward", "<f4", "R")]  # sum over the block, by term
    # Target change of the mean action on the way home (actor.way_home), or difference to the teacher's action. A row
    # of zeros: no correction
    corrections: Annotated[F32, Wire("half-range", "<f4", "T B 7", sent="<f2")]
    seconds: Numbers = field(default_factory=lambda: MappingProxyType({}))  # by phase of the actor's loop

    def fault(self) -> str:
        """Return the inconsistency, or "" if there is none."""
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
    """The fate of a rollout."""

    ACCEPTED = "accepted"
    INVALID = "invalid"
    WRONG_RUN = "wrong_run"
    WRONG_CONTRACT = "wrong_contract"
    WRONG_GENERATION = "wrong_generation"
    STALE_STAGE = "stale_stage"
    TOO_OLD = "too_old"
    DUPLICATE = "duplicate"  # received before; ``first`` holds the first verdict
    BUSY = "busy"
    UNREADABLE = "unreadable"  # its sender is unknown: it is damaged, or names another actor than its key
    CREDITS = "credits"  # the answer to an ActorReport
    LIFE_ENDED = "life_ended"  # the answer to one whose life's account is closed: the actor must start anew


# Each sequence number gets exactly one of these. After any other kind the actor sends the rollout again (ADR-0004).
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
    """The learner's answer to a rollout or a report, with the learner's own state."""

    VERSION: ClassVar[int] = 1

    kind: VerdictKind
    first: VerdictKind  # the first verdict; differs from ``kind`` only for duplicates
    reason: str  # for the log
    generation: Count
    version: Count
    stage_number: Count
    stage: Stage
    # Flow control by an absolute limit: a lost or repeated answer changes nothing.
    credit_limit: Count  # the actor may publish sequence numbers less than this ...
    credit_version: Count  # ... if this version or a later one played them
    report_after_s: Annotated[float, Wire("s", low=0, high=64)] = (
        0.25  # pause of an idle actor between reports
    )


@dataclass(frozen=True, slots=True)
class Refusal:
    """A rollout with a final verdict other than accepted."""

    VERSION: ClassVar[int] = 1

    sequence: Sequence
    kind: VerdictKind
    generation: Count  # of the learner that gave the verdict


@dataclass(frozen=True, slots=True)
class ActorReport:
    """The fates of an actor's rollouts, as far as the actor knows them. The reply is a `Verdict` with new credits.

    A rollout with a number less than ``published`` that is not listed was accepted, or the learner of ``generation``
    refused it, and that learner knows it.
    """

    VERSION: ClassVar[int] = 1

    run: Id
    actor: Id
    incarnation: Count
    version: Count  # of the policy that the actor holds
    published: Sequence  # sequence numbers used so far
    in_flight: Sequences
    dropped: Sequences  # given up
    generation: Count  # of the learner that answered last; 0: none so far
    refused: tuple[Refusal, ...]  # by learners of other generations
    leaving: bool  # the actor sends nothing more
    training_hash: Hash = ""  # of the actor's task, network and experience; "" fits no learner

    def fault(self) -> str:
        """Return the inconsistency, or "" if there is none."""
        counts = (("in_flight", self.in_flight), ("dropped", self.dropped), ("refused", self.refused))
        return next(
            (
                f"{len(n)} {name}; allowed: up to {LISTED_REFUSALS}"
                for name, n in counts
                if len(n) > LISTED_REFUSALS
            ),
            "",
        )


@dataclass(frozen=True, slots=True)
class JoinRequest:
    """A request of an actor that has no number yet. The reply is a `Place`."""

    VERSION: ClassVar[int] = 1

    actor: Annotated[
        str, Wire(text=f"|{ID_PATTERN}")
    ]  # its name, such as its certificate's; "": it has none yet


@dataclass(frozen=True, slots=True)
class Place:
    """What an actor needs to join a run."""

    VERSION: ClassVar[int] = 1

    actor: Id
    index: Count  # its number: it decides the action noise and the shard of rallies
    settings: bytes  # TOML: what must be as the learner has it


FATES: Final = ("published", "trained", "refused", "dropped", "in_flight", "lost")
"""Counters of a learner's heartbeat: where rollouts are. The first is the sum of the others."""


@dataclass(frozen=True, slots=True)
class Status:
    """A heartbeat. Its counters are cumulative, so a lost heartbeat loses no information."""

    VERSION: ClassVar[int] = 1

    role: Id
    id: Id
    incarnation: Count
    time: Annotated[float, Wire("s since 1970", low=0)]
    state: str
    counters: Numbers
    gauges: Numbers


class Command(StrEnum):
    """A command to a running service."""

    DRAIN = "drain"  # finish the work in progress, then stop


@dataclass(frozen=True, slots=True)
class Control:
    """A command to one service. The reply is a `ControlReply`; without TLS every command is refused."""

    VERSION: ClassVar[int] = 1

    command: Command


@dataclass(frozen=True, slots=True)
class ControlReply:
    """Whether the service accepted a command, and its state now."""

    VERSION: ClassVar[int] = 1

    ok: bool
    state: str
    reason: str


# All types that travel on their own.
MESSAGES: tuple[type[Any], ...] = (
    RallyBatch,
    RallyRequest,
    PolicySnapshot,
    StageChange,
    StageLog,
    Rollout,
    Verdict,
    ActorReport,
    JoinRequest,
    Place,
    Status,
    Control,
    ControlReply,
)

"""The verdict on a rollout as one table of rules; the first rule that applies decides.

Identity comes first, then the recorded verdict. A number that has a verdict gets the same one again, whatever has
changed since. So an actor whose answer was lost and the learner never disagree.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Final

import numpy as np

from common.comms.codec import DecodeError, decode, salvage
from common.comms.messages import Rollout, VerdictKind
from common.task.reward import TERMS
from common.task.states import Outcome

# Far beyond the numbers of any rally: one extreme number would distort the normalisers for good.
LARGEST: Final = (("obs", 1e4), ("last_obs", 1e4), ("final_obs", 1e4), ("actions", 1e3), ("rewards", 1e5))


@dataclass(frozen=True, slots=True)
class LearnerState:
    """What the learner trains now: run, version and stage."""

    run: str
    generation: int
    version: int
    stage_number: int
    stage: int
    training_hash: str
    datasets_left: int = 2**31  # until the stage changes or training ends, with the one in the update


@dataclass(frozen=True, slots=True)
class Header:
    """The fields of one rollout that a verdict depends on. ``fault`` says why its content can't be used."""

    run: str
    generation: int
    version: int
    stage_number: int
    actor: str
    incarnation: int
    sequence: int
    training_hash: str
    fault: str = ""

    @property
    def life(self) -> tuple[str, int]:
        """The actor, and which of its lives."""
        return self.actor, self.incarnation


@dataclass(frozen=True, slots=True)
class Case:
    """Everything that the rules depend on."""

    header: Header
    learner: LearnerState
    is_known: bool  # its number has a verdict
    queued: int
    queue_limit: int
    version_at_use: int  # the learner's version when an update will use this rollout
    max_lag: int
    credit_end: int  # numbers from there on were never granted, by a whole window


def differs(what: str, got: object, wanted: object) -> str:
    """Return that two values differ, or ""."""
    return "" if got == wanted else f"{what} {got}; allowed: {wanted}"


def _ahead(case: Case) -> str:
    newest = case.learner.version
    is_ahead = case.header.generation == case.learner.generation and case.header.version > newest
    return f"version {case.header.version}; the newest is {newest}" if is_ahead else ""


def _too_old(case: Case) -> str:
    version, at_use = case.header.version, case.version_at_use
    is_too_old = at_use - version > case.max_lag
    return f"version {version} would be used at {at_use}; allowed lag: {case.max_lag}" if is_too_old else ""


def _beyond_credits(case: Case) -> str:
    number, end = case.header.sequence, case.credit_end
    return f"number {number} without a credit; allowed: less than {end}" if number >= end else ""


# Each rule returns why it applies, or "".
RULES: Final[tuple[tuple[VerdictKind, Callable[[Case], str]], ...]] = (
    (VerdictKind.WRONG_RUN, lambda case: differs("run", case.header.run, case.learner.run)),
    (VerdictKind.DUPLICATE, lambda case: "this number has a verdict already" if case.is_known else ""),
    (VerdictKind.INVALID, lambda case: case.header.fault or _ahead(case)),
    (
        VerdictKind.WRONG_GENERATION,
        lambda case: differs("generation", case.header.generation, case.learner.generation),
    ),
    (
        VerdictKind.WRONG_CONTRACT,
        lambda case: differs("training", case.header.training_hash, case.learner.training_hash),
    ),
    (
        VerdictKind.STALE_STAGE,
        lambda case: differs("stage number", case.header.stage_number, case.learner.stage_number),
    ),
    (VerdictKind.TOO_OLD, _too_old),
    (VerdictKind.INVALID, _beyond_credits),
    (
        VerdictKind.BUSY,
        lambda case: f"{case.queued} wait" if case.queued >= case.queue_limit else "",
    ),
    (VerdictKind.ACCEPTED, lambda case: "in the queue"),
)

_HEADER_FIELDS: Final = tuple(field.name for field in fields(Header) if field.name != "fault")


def judge(case: Case) -> tuple[VerdictKind, str]:
    """Return the first rule that applies, and why."""
    return next((kind, reason) for kind, rule in RULES if (reason := rule(case)))


def open_rollout(payload: bytes, limit_bytes: int, obs_size: int) -> tuple[Header, Rollout | None] | None:
    """Return the header and the rollout; the rollout is None if its content is invalid.

    A single None means that the header can't be read, so that its sender is unknown.
    """
    try:
        rollout = decode(payload, Rollout, limit_bytes=limit_bytes)
    except DecodeError as error:
        found = salvage(payload, Rollout, _HEADER_FIELDS)
        if found.keys() != set(_HEADER_FIELDS):
            return None
        return Header(**found, fault=str(error)), None
    header = {name: getattr(rollout, name) for name in _HEADER_FIELDS}
    if fault := content_fault(rollout, obs_size):
        return Header(**header, fault=fault), None
    return Header(**header), rollout


def content_fault(rollout: Rollout, obs_size: int) -> str:
    """Return why a well-formed rollout can't be trained on, or ""."""
    sizes = (
        ("observations", rollout.obs.shape[-1], obs_size),
        ("reward terms", rollout.reward_terms.size, len(TERMS)),
    )
    for name, got, wanted in sizes:
        if got != wanted:
            return f"{got} {name}; allowed: {wanted}"
    if (unknown := rollout.episodes.outcome[rollout.episodes.outcome >= len(Outcome)]).size:
        return f"outcome {unknown[0]}; allowed: 0 to {len(Outcome) - 1}"
    for name, limit in LARGEST:
        largest = np.abs(getattr(rollout, name)).max(initial=0.0)
        if largest > limit:
            return f"{name} of {largest:g}; allowed: up to {limit:g}"
    return ""

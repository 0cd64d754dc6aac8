"""Builders for the tests of the outbox, the intake and their ledger."""

import dataclasses
from typing import Any

from benchmarks.fuzz.message_examples import make_rollout
from common.comms.messages import Verdict, VerdictKind
from services.learner.admission import Header, LearnerState
from services.learner.config import IntakeConfig
from services.learner.intake import Intake, Queued
from services.learner.turns import Rank, taken

LEARNER_STATE = LearnerState(
    run="night", generation=1, version=10, stage_number=2, stage=3, training_hash="c0ffee"
)
ROLLOUT = make_rollout()


def make_header(sequence: int = 0, **changes: Any) -> Header:
    header = Header(
        run="night",
        generation=1,
        version=10,
        stage_number=2,
        actor="actor-0",
        incarnation=1,
        sequence=sequence,
        training_hash="c0ffee",
    )
    return dataclasses.replace(header, **changes)


def make_intake(*, learner: LearnerState = LEARNER_STATE, **settings: Any) -> Intake:
    return Intake(IntakeConfig(**{"dataset_rollouts": 4, **settings}), learner)


def take_dataset(intake: Intake) -> tuple[Queued, ...]:
    """Return the next dataset of a learner that trains alone; () while too few rollouts wait."""
    (count,) = taken([Rank(intake.queued, 1, 1, 0)], intake.part)
    return intake.take(count) if count else ()


def make_verdict(kind: VerdictKind, **changes: Any) -> Verdict:
    verdict = Verdict(
        kind=kind,
        first=kind,
        reason="",
        generation=1,
        version=10,
        stage_number=2,
        stage=3,
        credit_limit=2,
        credit_version=10,
    )
    return dataclasses.replace(verdict, **changes)

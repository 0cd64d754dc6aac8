"""One valid message of every type, with defaults that a test can replace."""

import dataclasses
from typing import Any

import numpy as np

from common.comms.messages import (
    MESSAGES,
    ActorReport,
    Command,
    Control,
    ControlReply,
    Episodes,
    JoinRequest,
    Place,
    PolicySnapshot,
    RallyBatch,
    RallyRequest,
    Refusal,
    Rollout,
    StageChange,
    StageLog,
    Status,
    Verdict,
    VerdictKind,
)

T, B, D, E = 3, 2, 5, 2


def make_rollout(**changes: Any) -> Rollout:
    """Return a rollout of three steps of two environments, with ``changes``."""
    rng = np.random.default_rng(1)
    truncated = np.zeros((T, B), bool)
    truncated[1, 0] = True

    def block(*shape: int) -> Any:
        return rng.normal(size=shape).astype("<f4")

    rollout = Rollout(
        run="night",
        generation=1,
        version=7,
        stage_number=2,
        actor="actor-0",
        incarnation=3,
        sequence=11,
        training_hash="c0ffee",
        obs=block(T, B, D),
        actions=block(T, B, 7),
        log_mu=block(T, B),
        rewards=block(T, B),
        terminated=np.zeros((T, B), bool),
        truncated=truncated,
        final_obs=block(1, D),
        final_index=np.array([B], "<i4"),
        last_obs=block(B, D),
        episodes=Episodes(
            outcome=np.array([0, 4], np.uint8),
            target_error=np.array([0.2, np.nan], "<f4"),
            caught=np.array([True, False]),
            over=np.array([True, False]),
            landed=np.array([True, False]),
            unvalidated=np.array([False, True]),
            returns=np.array([30.0, 1.0], "<f4"),
        ),
        reward_terms=block(4),
        corrections=block(T, B, 7),
        seconds={"step": 0.5, "policy": 0.1},
    )
    return dataclasses.replace(rollout, **changes)


def make_verdict(**changes: Any) -> Verdict:
    """Return a verdict that accepts, with ``changes``."""
    verdict = Verdict(
        kind=VerdictKind.ACCEPTED,
        first=VerdictKind.ACCEPTED,
        reason="",
        generation=1,
        version=8,
        stage_number=2,
        stage=3,
        credit_limit=14,
        credit_version=8,
    )
    return dataclasses.replace(verdict, **changes)


def make_stage(number: int) -> StageChange:
    """Return the stage change with a number."""
    return StageChange("night", 1, number, min(number + 1, 3), 1000 * number, 10 * number, "epochs")


EXAMPLES: tuple[Any, ...] = (
    RallyBatch(
        source="generator-0",
        incarnation=1,
        sequence=5,
        shard=0,
        block=9,
        rallies=np.arange(24, dtype="<f8").reshape(2, 12),
        seeds=np.array([1, 2**64 - 1], "<u8"),
        candidates=7,
        launch="paper",
        randomization="standard",
    ),
    RallyRequest(shard=1, block=2),
    PolicySnapshot(
        run="night",
        generation=1,
        version=8,
        stage_number=2,
        stage=3,
        epoch=12,
        frames=10**9,
        contract_hash="c0ffee",
        training_hash="7ea",
        weights=bytes(range(256)),
        obs_mean=np.zeros(D, "<f8"),
        obs_var=np.ones(D, "<f8"),
        obs_count=10**9,
    ),
    make_stage(1),
    StageLog(changes=(make_stage(0), make_stage(1))),
    make_rollout(),
    make_verdict(),
    ActorReport(
        run="night",
        actor="actor-0",
        incarnation=3,
        version=8,
        published=12,
        in_flight=(11,),
        dropped=(4,),
        generation=1,
        refused=(Refusal(7, VerdictKind.TOO_OLD, 0),),
        leaving=False,
    ),
    JoinRequest(actor=""),
    Place(actor="3", index=3, settings=b"actors = 8\n"),
    Status("actor", "actor-0", 3, 1.8e9, "playing", {"frames": 5.0}, {"lag": 1.0}),
    Control(Command.DRAIN),
    ControlReply(ok=True, state="draining", reason=""),
)

assert {type(example) for example in EXAMPLES} == set(MESSAGES), "a message without an example"

import dataclasses
import json

import msgpack
import pytest

from common.comms.codec import encode
from common.comms.messages import ActorReport, VerdictKind
from services.actor.outbox import Flight, Outbox, OutboxConfig, report
from services.learner.admission import RULES, open_rollout
from services.learner.intake import Intake, IntakeConfig
from services.learner.ledger import Account, AccountSnapshot, Fate, restored
from tests.unit.comms.message_examples import make_rollout
from tests.unit.comms.test_codec import sealed
from tests.unit.services.accounting import LEARNER_STATE, ROLLOUT, make_header, make_intake
from tests.unit.services.learner.rollouts import make_rollout as make_full_rollout

LIMIT = 2**20
FLIGHT = Flight(0, b"", born=0.0)


@pytest.mark.parametrize(
    ("changes", "kind", "reason"),
    [
        ({}, VerdictKind.ACCEPTED, "in the queue"),
        ({"run": "day"}, VerdictKind.WRONG_RUN, "run day; allowed: night"),
        ({"fault": "Rollout.obs: nan"}, VerdictKind.INVALID, "Rollout.obs: nan"),
        ({"version": 11}, VerdictKind.INVALID, "version 11; the newest is 10"),
        ({"generation": 0, "version": 99}, VerdictKind.WRONG_GENERATION, "generation 0; allowed: 1"),
        ({"training_hash": "f00"}, VerdictKind.WRONG_CONTRACT, "training f00; allowed: c0ffee"),
        ({"stage_number": 1}, VerdictKind.STALE_STAGE, "stage number 1; allowed: 2"),
        ({"version": 8}, VerdictKind.ACCEPTED, "in the queue"),
        ({"version": 7}, VerdictKind.TOO_OLD, "version 7 would be used at 10; allowed lag: 2"),
        ({"version": 7, "stage_number": 1}, VerdictKind.STALE_STAGE, "stage number"),
        ({"fault": "bad", "generation": 0}, VerdictKind.INVALID, "bad"),
    ],
)
def test_the_first_rule_that_applies_decides(changes, kind, reason):
    verdict = make_intake().arrive(make_header(**changes), ROLLOUT, now=0.0)

    assert verdict.kind is verdict.first is kind
    assert reason in verdict.reason


def test_every_kind_of_verdict_on_a_rollout_has_its_rule():
    others = {VerdictKind.UNREADABLE, VerdictKind.CREDITS}

    assert [kind for kind, _ in RULES][-1] is VerdictKind.ACCEPTED
    assert {kind for kind, _ in RULES} == set(VerdictKind) - others


def test_a_retry_gets_the_recorded_verdict_whatever_has_changed_since():
    intake = make_intake(dataset_rollouts=1)
    intake.arrive(make_header(0), ROLLOUT, 0.0)
    intake.arrive(make_header(1, stage_number=1), ROLLOUT, 0.0)
    intake.take_dataset()
    intake.finish_update(dataclasses.replace(LEARNER_STATE, version=50, stage_number=3))

    accepted, refused = (
        intake.arrive(make_header(0), ROLLOUT, 0.0),
        intake.arrive(make_header(1), ROLLOUT, 0.0),
    )

    assert (accepted.kind, accepted.first) == (VerdictKind.DUPLICATE, VerdictKind.ACCEPTED)
    assert (refused.kind, refused.first) == (VerdictKind.DUPLICATE, VerdictKind.STALE_STAGE)
    assert intake.queued == 0


def test_a_full_queue_is_busy_and_leaves_the_verdict_open():
    intake = make_intake(dataset_rollouts=1, queue_rollouts=1)
    intake.arrive(make_header(0), ROLLOUT, 0.0)

    assert intake.arrive(make_header(1), ROLLOUT, 0.0).kind is VerdictKind.BUSY
    intake.take_dataset()
    assert intake.arrive(make_header(1), ROLLOUT, 0.0).kind is VerdictKind.ACCEPTED


def test_lag_is_counted_to_the_version_at_use():
    intake = make_intake(dataset_rollouts=2, max_lag=1)
    kinds = [intake.arrive(make_header(sequence), ROLLOUT, 0.0).kind for sequence in range(5)]

    # numbers 0, 1 are used at version 10, numbers 2, 3 at 11, number 4 would be at 12
    assert kinds == [VerdictKind.ACCEPTED] * 4 + [VerdictKind.TOO_OLD]


def test_with_no_lag_allowed_nothing_is_accepted_during_an_update():
    intake = make_intake(dataset_rollouts=1, max_lag=0)
    intake.arrive(make_header(0), ROLLOUT, 0.0)
    intake.take_dataset()

    assert intake.arrive(make_header(1), ROLLOUT, 0.0).kind is VerdictKind.TOO_OLD


def test_datasets_are_complete_in_order_and_one_at_a_time():
    intake = make_intake(dataset_rollouts=2)
    intake.arrive(make_header(0), ROLLOUT, 0.0)
    assert intake.take_dataset() == ()
    intake.arrive(make_header(1), ROLLOUT, 0.0)

    assert [entry.header.sequence for entry in intake.take_dataset()] == [0, 1]
    with pytest.raises(RuntimeError, match="an update of 2 rollouts is running"):
        intake.take_dataset()


def test_rollouts_that_wait_at_a_stage_change_are_lost_and_counted():
    intake = make_intake(dataset_rollouts=1)
    for sequence in range(3):
        intake.arrive(make_header(sequence), ROLLOUT, 0.0)
    intake.take_dataset()
    intake.finish_update(dataclasses.replace(LEARNER_STATE, version=11, stage_number=3))

    ledger = intake.ledgers()["actor-0", 1]
    assert (ledger.trained, ledger.lost, ledger.in_flight, ledger.balance) == (1, 2, 0, 0)


def make_report(outbox: Outbox, leaving: bool = False) -> ActorReport:
    return report(outbox, run="night", actor="actor-0", incarnation=1, version=10, leaving=leaving)


def test_a_late_report_of_a_dead_actor_does_not_make_it_alive():
    intake = make_intake(dataset_rollouts=1, max_lag=0)
    said = make_report(Outbox(OutboxConfig(), next_sequence=2, generation=1, flights=(FLIGHT,)))
    intake.gone("actor-0", 1)
    limit = intake.report(said, 0.0).credit_limit

    ledger = intake.ledgers()["actor-0", 1]
    assert (ledger.published, ledger.in_flight, ledger.lost) == (2, 0, 2)
    assert limit == 0  # so that there are credits for its next life
    assert intake.report(dataclasses.replace(said, incarnation=2, published=0), 0.0).credit_limit == 1


def test_after_a_last_report_a_returning_token_puts_rollouts_in_flight_again():
    """The link broke while the last report was on it. The next last report decides."""
    intake = make_intake()
    outbox = Outbox(OutboxConfig(), next_sequence=1, generation=1, flights=(FLIGHT,))
    intake.report(make_report(outbox, leaving=True), 0.0)
    assert intake.ledgers()["actor-0", 1].lost == 1

    intake.seen("actor-0", 1)  # its first token event may be read late and changes nothing
    assert intake.ledgers()["actor-0", 1].lost == 1
    intake.gone("actor-0", 1)
    intake.seen("actor-0", 1)

    assert intake.ledgers()["actor-0", 1].in_flight == 1


def test_a_token_without_messages_makes_no_account():
    intake = make_intake()
    intake.seen("actor-0", 1)

    assert intake.ledgers() == {}


def test_a_dead_actors_missing_rollouts_are_lost_until_its_token_returns():
    intake = make_intake()
    intake.arrive(make_header(3), ROLLOUT, 0.0)
    assert intake.ledgers()["actor-0", 1].in_flight == 4
    assert intake.gaps() == 3

    intake.gone("actor-0", 1)
    assert intake.ledgers()["actor-0", 1].lost == 3
    # messages from before its death may be read after the liveliness loss
    assert intake.arrive(make_header(4), ROLLOUT, 0.0).kind is VerdictKind.ACCEPTED
    assert intake.ledgers()["actor-0", 1].lost == 3

    outbox = Outbox(OutboxConfig(), next_sequence=5, generation=1)
    flights = tuple(Flight(sequence, b"", born=0.0) for sequence in range(3))
    outbox = dataclasses.replace(outbox, flights=flights)
    intake.report(make_report(outbox), 0.0)
    assert intake.ledgers()["actor-0", 1].lost == 3
    intake.seen("actor-0", 1)

    assert intake.ledgers()["actor-0", 1].lost == 0


def test_an_actor_of_the_same_name_in_another_run_gets_no_account():
    intake = make_intake()

    assert intake.arrive(make_header(run="day"), ROLLOUT, 0.0).credit_limit == 0
    assert intake.ledgers() == {}


def test_limits_add_up_to_the_needed_rollouts_and_the_window():
    intake = make_intake(dataset_rollouts=3, max_lag=0, window=2)
    limits = [intake.arrive(make_header(actor=f"actor-{i}"), ROLLOUT, 0.0).credit_limit for i in range(3)]

    # of 3 needed, the first arrival leaves 2: both go to actor-0, which may publish numbers 1 and 2
    assert limits == [3, 0, 0]


def test_nothing_is_collected_for_the_time_after_a_stage_change():
    learner = dataclasses.replace(LEARNER_STATE, datasets_left=1)
    intake = make_intake(learner=learner, dataset_rollouts=1, max_lag=2)

    assert intake.arrive(make_header(0), ROLLOUT, 0.0).credit_limit == 0
    intake.take_dataset()
    assert intake.arrive(make_header(1), ROLLOUT, 0.0).credit_limit == 0


def test_credits_of_silent_and_dead_actors_go_to_others():
    intake = make_intake(dataset_rollouts=4, max_lag=0, window=2, credit_patience_s=30.0)
    intake.arrive(make_header(actor="silent"), ROLLOUT, now=0.0)

    # 4 needed, 2 arrived, 2 credits of the silent one
    assert intake.arrive(make_header(actor="eager"), ROLLOUT, now=29.0).credit_limit == 0
    assert intake.arrive(make_header(1, actor="eager"), ROLLOUT, now=31.0).credit_limit == 3
    intake = make_intake(dataset_rollouts=4, max_lag=0, window=2)
    intake.arrive(make_header(actor="dead"), ROLLOUT, now=0.0)
    intake.gone("dead", 1)
    assert intake.arrive(make_header(actor="eager"), ROLLOUT, now=1.0).credit_limit == 3


def test_a_rollout_that_cannot_be_read_is_named_if_its_header_can():
    kind, version, fields = msgpack.unpackb(encode(make_rollout())[12:])
    fields["log_mu"] = 3
    payload = sealed(msgpack.packb([kind, version, fields]))

    header, rollout = open_rollout(payload, LIMIT, 37)

    assert rollout is None
    assert (header.actor, header.sequence) == ("actor-0", 11)
    assert "Rollout.log_mu: 3" in header.fault
    assert open_rollout(payload[:-1], LIMIT, 37) is None
    header, rollout = open_rollout(encode(make_full_rollout(sequence=11)), LIMIT, 37)
    assert header.fault == ""
    assert rollout.sequence == 11


def test_a_checkpoint_keeps_every_outcome_and_queued_rollouts_are_lost():
    intake = make_intake(dataset_rollouts=2)
    for sequence in (0, 1, 2, 5):
        intake.arrive(make_header(sequence), ROLLOUT, 0.0)
    intake.arrive(make_header(6, stage_number=0), ROLLOUT, 0.0)
    intake.take_dataset()
    intake.finish_update(dataclasses.replace(LEARNER_STATE, version=11))

    accounts = [
        AccountSnapshot.from_json(json.loads(json.dumps(entry.to_json()))) for entry in intake.snapshots()
    ]
    again = Intake(IntakeConfig(), dataclasses.replace(LEARNER_STATE, generation=2), accounts)

    ledger = again.ledgers()["actor-0", 1]
    assert (ledger.published, ledger.trained, ledger.lost) == (7, 2, 4)
    assert ledger.refused == {VerdictKind.STALE_STAGE: 1}
    assert ledger.balance == 0
    verdict = again.arrive(make_header(0), ROLLOUT, 0.0)
    assert (verdict.kind, verdict.first) == (VerdictKind.DUPLICATE, VerdictKind.ACCEPTED)


def test_a_restored_account_settles_nothing_twice():
    account = Account("a", 1)
    account.settle(0, Fate.QUEUED)
    account.settle(0, Fate.TRAINED)

    assert account.ledger().trained == 1
    assert account.ledger() == restored(account.snapshot()).ledger()

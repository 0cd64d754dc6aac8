import dataclasses
import json

import msgpack
import pytest

from benchmarks.fuzz.message_examples import make_rollout
from common.comms.codec import encode
from common.comms.messages import ActorReport, VerdictKind
from services.actor.config import OutboxConfig
from services.actor.outbox import Flight, Outbox, report
from services.learner import accounts as accounts_module
from services.learner.accounts import BEYOND_CREDITS, EARLIER, FOLD_AFTER_S
from services.learner.admission import RULES, open_rollout
from services.learner.config import IntakeConfig
from services.learner.intake import IDLE_REPORTS_HZ, SOONEST_REPORT_S, Intake
from services.learner.ledger import Account, AccountSnapshot, Fate, Ledger, restored
from tests.unit.comms.test_codec import sealed
from tests.unit.services.accounting import LEARNER_STATE, ROLLOUT, make_header, make_intake, take_dataset
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
    others = {VerdictKind.UNREADABLE, VerdictKind.CREDITS, VerdictKind.LIFE_ENDED}

    assert [kind for kind, _ in RULES][-1] is VerdictKind.ACCEPTED
    assert {kind for kind, _ in RULES} == set(VerdictKind) - others


def test_a_report_of_a_life_whose_account_is_closed_gets_a_verdict_of_its_own():
    intake = make_intake(dataset_rollouts=1)
    intake.arrive(make_header(0), ROLLOUT, 0.0)
    take_dataset(intake)
    intake.finish_update(LEARNER_STATE)
    said = make_report(Outbox(OutboxConfig(), next_sequence=1, generation=1))
    intake.gone(said.actor, said.incarnation)
    intake.tidy(86_401.0)

    verdict = intake.report(said, 86_402.0)

    assert (verdict.kind, verdict.credit_limit) == (VerdictKind.LIFE_ENDED, 0)
    assert verdict.reason.endswith("ended, and its account is closed: start the actor again")


def test_a_retry_gets_the_recorded_verdict_whatever_has_changed_since():
    intake = make_intake(dataset_rollouts=1)
    intake.arrive(make_header(0), ROLLOUT, 0.0)
    intake.arrive(make_header(1, stage_number=1), ROLLOUT, 0.0)
    take_dataset(intake)
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
    take_dataset(intake)
    assert intake.arrive(make_header(1), ROLLOUT, 0.0).kind is VerdictKind.ACCEPTED


def test_lag_is_counted_to_the_version_at_use():
    intake = make_intake(dataset_rollouts=2, max_lag=1)
    kinds = [intake.arrive(make_header(sequence), ROLLOUT, 0.0).kind for sequence in range(5)]

    # numbers 0, 1 are used at version 10, numbers 2, 3 at 11, number 4 would be at 12
    assert kinds == [VerdictKind.ACCEPTED] * 4 + [VerdictKind.TOO_OLD]


def test_with_no_lag_allowed_nothing_is_accepted_during_an_update():
    intake = make_intake(dataset_rollouts=1, max_lag=0)
    intake.arrive(make_header(0), ROLLOUT, 0.0)
    take_dataset(intake)

    assert intake.arrive(make_header(1), ROLLOUT, 0.0).kind is VerdictKind.TOO_OLD


def test_datasets_are_complete_in_order_and_one_at_a_time():
    intake = make_intake(dataset_rollouts=2)
    intake.arrive(make_header(0), ROLLOUT, 0.0)
    assert take_dataset(intake) == ()
    intake.arrive(make_header(1), ROLLOUT, 0.0)

    assert [entry.header.sequence for entry in take_dataset(intake)] == [0, 1]
    with pytest.raises(RuntimeError, match="an update of 2 rollouts is running"):
        intake.take(2)


def test_rollouts_that_wait_at_a_stage_change_are_lost_and_counted():
    intake = make_intake(dataset_rollouts=1)
    for sequence in range(3):
        intake.arrive(make_header(sequence), ROLLOUT, 0.0)
    take_dataset(intake)
    intake.finish_update(dataclasses.replace(LEARNER_STATE, version=11, stage_number=3))

    ledger = intake.ledgers()["actor-0", 1]
    assert (ledger.trained, ledger.lost, ledger.in_flight, ledger.balance) == (1, 2, 0, 0)


def make_report(outbox: Outbox, leaving: bool = False) -> ActorReport:
    return report(
        outbox,
        run="night",
        actor="actor-0",
        incarnation=1,
        version=10,
        training_hash=LEARNER_STATE.training_hash,
        leaving=leaving,
    )


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
    intake = make_intake(window=5)
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
    take_dataset(intake)
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
    take_dataset(intake)
    intake.finish_update(dataclasses.replace(LEARNER_STATE, version=11))

    accounts = [
        AccountSnapshot.from_json(json.loads(json.dumps(entry.to_json()))) for entry in intake.snapshots()
    ]
    again = Intake(IntakeConfig(), dataclasses.replace(LEARNER_STATE, generation=2), accounts)

    ledger = again.ledgers()["actor-0", 1]
    # numbers 3 and 4 may still arrive: their actor has not been heard yet
    assert (ledger.published, ledger.trained, ledger.lost, ledger.in_flight) == (7, 2, 2, 2)
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


def kept(intake: Intake, **changes) -> Intake:
    """Return the intake of the next learner after a planned stop."""
    accounts = [
        AccountSnapshot.from_json(json.loads(json.dumps(entry.to_json()))) for entry in intake.snapshots()
    ]
    learner = dataclasses.replace(intake.learner, generation=2, **changes)
    config = IntakeConfig(dataset_rollouts=2)
    return Intake(config, learner, accounts, intake.waiting, intake.closed)


def test_rollouts_that_wait_at_a_planned_stop_are_trained_by_the_next_learner():
    intake = make_intake(dataset_rollouts=2)
    intake.arrive(make_header(0), ROLLOUT, 0.0)
    again = kept(intake)
    assert again.total().in_flight == 1
    again.arrive(make_header(1, generation=2), ROLLOUT, 0.0)
    dataset = take_dataset(again)
    again.finish_update(dataclasses.replace(again.learner, version=11))

    assert [entry.header.sequence for entry in dataset] == [0, 1]
    assert (again.total().trained, again.total().lost, again.total().balance) == (2, 0, 0)


def test_kept_rollouts_that_do_not_fit_the_new_settings_are_refused_with_the_reason():
    intake = make_intake(dataset_rollouts=2)
    intake.arrive(make_header(0), ROLLOUT, 0.0)
    again = kept(intake, training_hash="f00")

    assert again.queued == 0
    assert again.total().refused == {VerdictKind.WRONG_CONTRACT: 1}
    assert (again.total().lost, again.total().balance) == (0, 0)


def test_missing_rollouts_of_a_checkpoint_are_lost_only_when_their_actor_stays_away():
    intake = make_intake()
    intake.report(make_report(Outbox(OutboxConfig(), next_sequence=1, generation=1, flights=(FLIGHT,))), 0.0)
    again = kept(intake)
    again.tidy(100.0)
    again.tidy(129.0)
    assert (again.total().in_flight, again.total().lost) == (1, 0)
    again.tidy(131.0)

    assert (again.total().in_flight, again.total().lost) == (0, 1)


def test_an_actor_of_another_contract_gets_no_credits_and_is_named_once():
    intake = make_intake(dataset_rollouts=2, max_lag=0)
    misfit = dataclasses.replace(make_report(Outbox(OutboxConfig())), actor="misfit", training_hash="f00")
    verdicts = [intake.report(misfit, float(second)) for second in range(8)]
    eager = intake.report(make_report(Outbox(OutboxConfig())), 8.0)

    assert {verdict.credit_limit for verdict in verdicts} == {0}
    assert verdicts[0].kind is VerdictKind.WRONG_CONTRACT
    assert verdicts[0].reason == "training f00; allowed: c0ffee"
    assert eager.credit_limit == 2
    assert [found.actor for found in intake.take_new_misfits()] == ["misfit"]
    assert intake.take_new_misfits() == []
    assert len(intake.misfits) == 1
    intake.gone("misfit", 1)
    assert intake.misfits == ()


def test_a_report_for_another_run_makes_no_account():
    intake = make_intake()
    verdict = intake.report(dataclasses.replace(make_report(Outbox(OutboxConfig())), run="day"), 0.0)

    assert (verdict.kind, verdict.credit_limit) == (VerdictKind.WRONG_RUN, 0)
    assert intake.ledgers() == {}


def test_credits_that_are_not_used_age_out_although_their_holder_reports():
    intake = make_intake(dataset_rollouts=2, max_lag=0, credit_patience_s=30.0)
    idle, eager = make_report(Outbox(OutboxConfig())), make_report(Outbox(OutboxConfig()))
    eager = dataclasses.replace(eager, actor="eager")
    for second in range(29):
        assert intake.report(idle, float(second)).credit_limit == 2
        assert intake.report(eager, float(second)).credit_limit == 0
    intake.report(idle, 31.0)

    assert intake.report(eager, 31.0).credit_limit == 2


def test_a_claim_of_many_rollouts_in_flight_holds_no_more_than_the_window():
    intake = make_intake(dataset_rollouts=4, max_lag=0, window=2)
    wild = make_report(Outbox(OutboxConfig(), next_sequence=2**53, generation=1))
    intake.report(dataclasses.replace(wild, actor="wild", generation=0), 0.0)

    assert intake.report(make_report(Outbox(OutboxConfig())), 0.0).credit_limit == 2


def test_an_actor_whose_rollouts_are_refused_in_a_row_pauses_and_the_others_get_its_credits():
    intake = make_intake(dataset_rollouts=1, max_lag=0)
    limits = [
        intake.arrive(make_header(n, actor="bad", fault="nan"), None, 0.0).credit_limit for n in range(3)
    ]

    assert limits == [2, 3, 3]
    assert intake.report(make_report(Outbox(OutboxConfig())), 0.0).credit_limit == 1


def test_waiting_actors_report_less_often_the_more_they_are():
    intake = make_intake(dataset_rollouts=1)
    report_ = make_report(Outbox(OutboxConfig()))
    few = intake.report(report_, 0.0).report_after_s
    for number in range(1000):
        many = intake.report(dataclasses.replace(report_, actor=f"a{number}"), 0.0).report_after_s

    assert few == SOONEST_REPORT_S
    assert many == pytest.approx(1001 / IDLE_REPORTS_HZ)


def test_earlier_lives_are_one_account_and_the_total_stays():
    intake = make_intake(dataset_rollouts=1, window=2)
    for life in range(1, 51):
        header = make_header(0, incarnation=life)
        intake.arrive(header, ROLLOUT, 0.0)
        intake.arrive(dataclasses.replace(header, sequence=3, stage_number=0), ROLLOUT, 0.0)
        if take_dataset(intake):
            intake.finish_update(intake.learner)
        intake.gone("actor-0", life)
    before = intake.total()
    intake.tidy(0.0)
    assert len(intake.ledgers()) == 50
    intake.tidy(FOLD_AFTER_S + 1.0)

    assert set(intake.ledgers()) == {EARLIER, ("actor-0", 50)}
    assert intake.total() == before == sum(intake.ledgers().values(), Ledger())
    assert (before.published, before.balance) == (200, 0)
    late = intake.arrive(make_header(1, incarnation=3), ROLLOUT, 700.0)
    assert late.kind is VerdictKind.INVALID
    assert "life 3 of actor actor-0 ended" in late.reason
    assert intake.total() == before
    again = kept(intake)
    assert again.total().published == 200
    assert again.arrive(make_header(1, incarnation=3), ROLLOUT, 0.0).kind is VerdictKind.INVALID


def test_a_number_far_beyond_those_of_its_actor_changes_no_account():
    intake = make_intake()
    intake.arrive(make_header(0), ROLLOUT, 0.0)
    before = intake.total()
    wild = intake.arrive(make_header(2**53), ROLLOUT, 0.0)
    claim = make_report(Outbox(OutboxConfig(), next_sequence=2**53, generation=1))
    answer = intake.report(claim, 0.0)

    assert wild.kind is VerdictKind.INVALID
    assert wild.reason == f"number {2**53}; allowed: up to {3 + BEYOND_CREDITS}"
    assert answer.credit_limit == 0
    assert intake.total() == before


def test_an_actor_that_sends_without_credits_fills_no_queue():
    intake = make_intake(dataset_rollouts=2, max_lag=64, window=2)
    verdicts = [intake.arrive(make_header(number), ROLLOUT, 0.0) for number in range(40)]
    accepted = sum(verdict.kind is VerdictKind.ACCEPTED for verdict in verdicts)

    assert accepted == intake.queued == 2 * 2 + 2  # two datasets, and a window of slack
    assert "number 6 without a credit; allowed: less than 6" in verdicts[6].reason


def test_a_peer_of_many_names_gets_a_bounded_number_of_accounts(monkeypatch):
    monkeypatch.setattr(accounts_module, "MOST_ACCOUNTS", 20)
    intake = make_intake(dataset_rollouts=1)
    claim = make_report(Outbox(OutboxConfig(), next_sequence=1, generation=1, flights=(FLIGHT,)))
    for number in range(100):
        intake.report(dataclasses.replace(claim, actor=f"a{number}", leaving=number % 2 == 0), 0.0)

    assert len(intake.ledgers()) <= 21  # with that of earlier lives
    assert intake.total() == sum(intake.ledgers().values(), Ledger())
    refused = intake.report(dataclasses.replace(claim, actor="last"), 0.0)
    assert refused.reason == "actor last is one too many; allowed: 20 with an account"
    assert refused.credit_limit == 0

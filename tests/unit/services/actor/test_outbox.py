import pytest

from common.comms.budgets import LISTED_REFUSALS
from common.comms.messages import FINAL_VERDICTS, Refusal, VerdictKind
from services.actor import outbox as ob
from services.actor.config import OutboxConfig
from services.actor.outbox import Outbox, OutboxFullError
from tests.unit.services.accounting import make_verdict

FAR = 2**62
CONFIG = OutboxConfig(retry_first_s=1.0, retry_max_s=5.0, give_up_s=100.0)


def one_pending(config: OutboxConfig = CONFIG) -> Outbox:
    return ob.sent(ob.offer(Outbox(config), b"rollout", now=0.0), 0)


def test_rollouts_are_numbered_from_zero_and_due_at_once_in_order():
    outbox = ob.offer(ob.offer(Outbox(CONFIG), b"a", 0.0), b"b", 0.0)

    assert [(flight.sequence, flight.payload) for flight in ob.due(outbox, 0.0)] == [(0, b"a"), (1, b"b")]


def test_no_more_rollouts_are_in_flight_than_the_window():
    outbox = one_pending(OutboxConfig(window=1))

    with pytest.raises(OutboxFullError, match="1 rollouts in flight; allowed: 1"):
        ob.offer(outbox, b"", 0.0)


def test_a_pending_rollout_is_not_sent_again_until_its_request_ends():
    outbox = one_pending()
    assert ob.due(outbox, 1e9) == ()

    outbox = ob.unanswered(outbox, 0, now=10.0)

    assert ob.due(outbox, 10.9) == ()
    assert [flight.payload for flight in ob.due(outbox, 11.0)] == [b"rollout"]


def test_pauses_between_tries_double_up_to_a_bound():
    outbox, pauses = ob.offer(Outbox(CONFIG), b"", 0.0), []
    for _ in range(5):
        outbox = ob.unanswered(ob.sent(outbox, 0), 0, now=0.0)
        pauses.append(outbox.flights[0].next_try)

    assert pauses == [1.0, 2.0, 4.0, 5.0, 5.0]


@pytest.mark.parametrize("kind", sorted(FINAL_VERDICTS))
def test_a_final_verdict_ends_the_flight_once(kind):
    outbox = ob.answered(one_pending(), 0, make_verdict(kind), now=1.0)
    again = ob.answered(outbox, 0, make_verdict(VerdictKind.ACCEPTED), now=2.0)

    assert outbox.flights == ()
    assert again.counts == outbox.counts
    assert outbox.counts.accepted == (kind is VerdictKind.ACCEPTED)
    assert outbox.counts.balance == 0


@pytest.mark.parametrize("kind", sorted(set(VerdictKind) - FINAL_VERDICTS - {VerdictKind.DUPLICATE}))
def test_any_other_verdict_means_try_again_later(kind):
    outbox = ob.answered(one_pending(), 0, make_verdict(kind), now=1.0)

    assert outbox.counts.in_flight == 1
    assert outbox.flights[0].next_try == 2.0


@pytest.mark.parametrize("first", [VerdictKind.ACCEPTED, VerdictKind.TOO_OLD])
def test_a_duplicate_counts_as_the_recorded_verdict(first):
    outbox = ob.answered(one_pending(), 0, make_verdict(VerdictKind.DUPLICATE, first=first), now=1.0)

    assert outbox.counts.accepted == (first is VerdictKind.ACCEPTED)
    assert outbox.counts.refused == ({} if first is VerdictKind.ACCEPTED else {first: 1})


def test_a_rollout_is_dropped_at_its_age_but_not_while_a_request_is_pending():
    outbox = one_pending()
    assert ob.expired(outbox, 1e6) == outbox

    outbox = ob.unanswered(outbox, 0, now=50.0)

    assert ob.expired(outbox, 99.0).counts.dropped == 0
    assert ob.expired(outbox, 100.0).dropped == (0,)
    assert ob.expired(outbox, 100.0).counts.balance == 0


def test_a_rollout_that_was_never_sent_is_not_dropped():
    assert ob.expired(ob.offer(Outbox(CONFIG), b"", 0.0), 1e6).counts.in_flight == 1


def test_the_actor_names_what_it_waits_for():
    fresh = Outbox(CONFIG)
    credited = ob.credited(fresh, make_verdict(VerdictKind.CREDITS, credit_limit=1, credit_version=10))

    assert ob.idle_reason(fresh, generation=1, version=10) == "the learner's first answer"
    assert ob.idle_reason(credited, generation=1, version=9) == "policy version 10"
    assert ob.idle_reason(credited, generation=1, version=10) == ""
    assert ob.idle_reason(credited, generation=0, version=10) == "policy and credits of one learner"
    used = ob.offer(credited, b"", 0.0)
    assert ob.idle_reason(used, generation=1, version=10) == "the learner's credits"
    full = ob.offer(used, b"", 0.0)
    assert ob.idle_reason(full, generation=1, version=10) == "the learner's verdict on rollout 0"


def test_credits_never_shrink_within_a_generation_and_restart_with_the_next():
    outbox = ob.credited(Outbox(CONFIG), make_verdict(VerdictKind.CREDITS, credit_limit=5))
    assert ob.credited(outbox, make_verdict(VerdictKind.CREDITS, credit_limit=3)).credit_limit == 5

    outbox = ob.credited(outbox, make_verdict(VerdictKind.CREDITS, generation=2, credit_limit=2))

    assert outbox.credit_limit == 2


def test_credits_that_the_learner_did_not_give_end_with_its_next_answer():
    given = ob.credited(Outbox(CONFIG), make_verdict(VerdictKind.CREDITS, credit_limit=1, credit_version=10))
    forged = ob.credited(given, make_verdict(VerdictKind.CREDITS, credit_limit=FAR, credit_version=FAR))
    true = make_verdict(VerdictKind.CREDITS, credit_limit=2, credit_version=11)
    refused = make_verdict(VerdictKind.INVALID, credit_limit=0)

    assert ob.idle_reason(forged, generation=1, version=11) == f"policy version {FAR}"
    assert ob.idle_reason(ob.credited(forged, true, (FAR, FAR)), generation=1, version=11) == ""
    beyond = ob.offer(ob.offer(forged, b"", 0.0), b"", 0.0)
    assert ob.answered(beyond, 1, refused, 0.0).credit_limit == 0


def test_a_report_lists_what_the_current_learner_cannot_know():
    outbox = ob.answered(one_pending(), 0, make_verdict(VerdictKind.TOO_OLD), now=1.0)
    outbox = ob.sent(ob.offer(outbox, b"", 1.0), 1)

    same = ob.report(outbox, run="night", actor="a", incarnation=1, version=10, training_hash="c0ffee")
    outbox = ob.answered(outbox, 1, make_verdict(VerdictKind.BUSY, generation=2), now=2.0)
    other = ob.report(outbox, run="night", actor="a", incarnation=1, version=10, training_hash="c0ffee")

    assert (same.published, same.in_flight, same.refused, same.generation) == (2, (1,), (), 1)
    assert (other.refused, other.generation) == ((Refusal(0, VerdictKind.TOO_OLD, 1),), 2)


def test_what_an_actor_remembers_does_not_grow_with_its_refusals_and_drops():
    """In a fleet that is refused for weeks, each verdict would cost more than the last."""
    outbox, kinds = Outbox(CONFIG), (VerdictKind.TOO_OLD, VerdictKind.STALE_STAGE)
    for n in range(3 * LISTED_REFUSALS):
        sequence, generation = outbox.next_sequence, 1 + (n > 2 * LISTED_REFUSALS)
        outbox = ob.sent(ob.offer(outbox, b"", 0.0), sequence)
        outbox = ob.answered(outbox, sequence, make_verdict(kinds[n % 2], generation=generation), 0.0)
        sequence = outbox.next_sequence
        outbox = ob.unanswered(ob.sent(ob.offer(outbox, b"", 0.0), sequence), sequence, 0.0)
        outbox = ob.expired(outbox, 1e6)

    counts = outbox.counts
    assert counts.balance == 0
    assert sum(counts.refused.values()) == counts.dropped == 3 * LISTED_REFUSALS
    assert counts.refused == {kind: 3 * LISTED_REFUSALS / 2 for kind in kinds}
    assert len(outbox.refused) <= 2 * LISTED_REFUSALS
    said = ob.report(outbox, run="r", actor="a", incarnation=1, version=1, training_hash="h")
    assert said.dropped == tuple(range(4 * LISTED_REFUSALS + 1, 6 * LISTED_REFUSALS, 2))
    # Refusals of the learner before, the newest; those of the present learner are in its own ledger
    assert [r.sequence for r in said.refused] == [
        2 * n for n in range(LISTED_REFUSALS + 1, 2 * LISTED_REFUSALS + 1)
    ]

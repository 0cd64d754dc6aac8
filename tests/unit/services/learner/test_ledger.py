"""An account's memory: hundreds of millions of rollouts are few ranges, and no outcome is lost."""

import dataclasses
from collections import Counter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.comms.messages import ActorReport, Refusal, VerdictKind
from services.learner.accounts import EARLIER, Accounts
from services.learner.ledger import FATES, Account, AccountSnapshot, Fate, Ledger, Outcome, restored

OUTCOMES = (Fate.TRAINED, Fate.TRAINED, Fate.TRAINED, Fate.DROPPED, VerdictKind.TOO_OLD)
HIGHEST = 2**53


def settled(count: int, seed: int = 0) -> tuple[Account, list[Outcome]]:
    """Return an account of ``count`` rollouts that arrived a little out of order, and the true outcomes."""
    rng = np.random.default_rng(seed)
    truth = [OUTCOMES[k] for k in rng.integers(len(OUTCOMES), size=count)]
    account = Account("a", 1)
    for sequence in np.argsort(np.arange(count) + rng.uniform(0, 3, count)):
        account.settle(int(sequence), Fate.QUEUED)
        account.settle(int(sequence), truth[sequence])
    return account, truth


def make_report(published: int, **changes) -> ActorReport:
    report = ActorReport("night", "a", 1, 0, published, (), (), 1, (), False)
    return dataclasses.replace(report, **changes)


@pytest.mark.parametrize("count", [1, 5, 6, 200])
def test_every_outcome_is_returned_and_counted(count):
    account, truth = settled(count)
    book = account.ledger()

    assert [account.outcome(sequence) for sequence in range(count)] == truth
    assert account.outcome(count) is None
    assert book.published == count
    assert book.balance == 0
    assert book.trained == truth.count(Fate.TRAINED)


def test_a_checkpoint_restores_every_outcome():
    account, truth = settled(200)
    snapshot = account.snapshot()
    again = restored(type(snapshot).from_json(snapshot.to_json()))

    assert [again.outcome(sequence) for sequence in range(200)] == truth
    assert again.ledger() == account.ledger()
    assert again.snapshot() == snapshot


def test_the_sum_of_two_accounts_adds_every_number():
    one = Ledger(31, 2, {VerdictKind.TOO_OLD: 3, VerdictKind.BUSY: 1}, 5, 7, 13)
    other = Ledger(280, 20, {VerdictKind.TOO_OLD: 30}, 50, 70, 110)

    assert one + other == Ledger(311, 22, {VerdictKind.TOO_OLD: 33, VerdictKind.BUSY: 1}, 55, 77, 123)
    assert (one.balance, other.balance, (one + other).balance) == (0, 0, 0)


def test_an_outcome_that_is_final_is_not_overwritten():
    account, truth = settled(50)
    for sequence in range(50):
        account.settle(sequence, Fate.LOST)

    assert [account.outcome(sequence) for sequence in range(50)] == truth
    assert account.ledger().balance == 0


def test_memory_does_not_grow_with_trained_rollouts():
    account = Account("a", 1)
    for sequence in range(20_000):
        account.settle(sequence, Fate.QUEUED)
        account.settle(sequence, Fate.TRAINED)

    assert account.ranges == 1
    assert account.snapshot().outcomes == (("trained", ((0, 20_000),)),)


def test_an_extreme_number_costs_no_memory_and_hides_no_other():
    account = Account("a", 1)
    account.settle(0, Fate.TRAINED)
    account.settle(HIGHEST, VerdictKind.INVALID)
    account.hear(make_report(HIGHEST, generation=0), generation=1)

    assert account.missing == account.gaps == HIGHEST - 1
    assert account.outcome(1) is None
    account.settle(1, Fate.QUEUED)
    assert account.ledger().in_flight == HIGHEST - 1
    assert account.ledger().balance == 0
    assert account.ranges == 3


def test_rollouts_of_a_long_life_for_an_earlier_learner_are_one_range():
    account = Account("a", 1)
    account.hear(make_report(10**9, in_flight=(10**9 - 2,), dropped=(7,)), generation=1)

    book = account.ledger()
    assert (book.published, book.dropped, book.in_flight, book.lost) == (10**9, 1, 1, 10**9 - 2)
    assert account.ranges == 4
    again = restored(account.snapshot()).ledger()  # its actor may still send the one in flight
    assert (again.lost, again.in_flight) == (10**9 - 2, 1)


NUMBERS = st.integers(0, 30)
OPERATIONS = st.one_of(
    st.tuples(st.just("settle"), NUMBERS, st.sampled_from((*OUTCOMES, Fate.QUEUED, Fate.LOST))),
    st.tuples(st.just("hear"), NUMBERS, st.tuples(st.sets(NUMBERS), st.sets(NUMBERS), st.sets(NUMBERS))),
    st.tuples(st.just("restart"), NUMBERS, st.none()),
)


class Plain:
    """The same account, number by number."""

    def __init__(self) -> None:
        self.published = 0
        self.known: dict[int, Outcome] = {}

    def missing(self) -> list[int]:
        return [sequence for sequence in range(self.published) if sequence not in self.known]

    def settle(self, sequence: int, outcome: Outcome) -> None:
        self.published = max(self.published, sequence + 1)
        if self.known.get(sequence, Fate.QUEUED) is Fate.QUEUED:
            self.known[sequence] = outcome

    def hear(self, report: ActorReport) -> None:
        self.published = max(self.published, report.published)
        elsewhere = {refusal.sequence: refusal.kind for refusal in report.refused}
        elsewhere |= dict.fromkeys(report.dropped, Fate.DROPPED)
        for sequence in self.missing():
            if sequence in elsewhere:
                self.known[sequence] = elsewhere[sequence]
            elif report.generation == 1 and sequence < report.published and sequence not in report.in_flight:
                self.known[sequence] = Fate.LOST


@settings(max_examples=300, deadline=None)
@given(st.lists(OPERATIONS, max_size=25), st.integers(0, 1))
def test_ranges_equal_a_plain_list_of_numbers(operations, generation):
    account, plain = Account("a", 1), Plain()
    for kind, number, what in operations:
        if kind == "settle":
            account.settle(number, what)
            plain.settle(number, what)
        elif kind == "hear":
            flying, dropped, refused = what
            report = make_report(
                number,
                generation=generation,
                in_flight=tuple(flying),
                dropped=tuple(dropped),
                refused=tuple(Refusal(n, VerdictKind.TOO_OLD, 0) for n in refused),
            )
            account.hear(report, generation=1)
            plain.hear(report)
        else:
            account = restored(AccountSnapshot.from_json(account.snapshot().to_json()))
            account.is_alive = True
            plain.known = {n: Fate.LOST if o is Fate.QUEUED else o for n, o in plain.known.items()}

        outcomes = [plain.known.get(sequence) for sequence in range(32)]
        counts = Counter(plain.known.values())
        assert [account.outcome(sequence) for sequence in range(32)] == outcomes
        assert account.published == plain.published
        assert account.missing == len(plain.missing())
        assert account.gaps == sum(n < max(plain.known, default=0) for n in plain.missing())
        book = account.ledger()
        assert book.in_flight == len(plain.missing()) + counts[Fate.QUEUED]
        assert (book.trained, book.lost, book.dropped) == (
            *(counts[fate] for fate in (Fate.TRAINED, Fate.LOST, Fate.DROPPED)),
        )
        assert dict(book.refused) == {k: n for k, n in counts.items() if k.value not in FATES}
        # no two neighbours could be one range
        assert account.ranges == sum(
            outcomes[n] is not None and (n == 0 or outcomes[n - 1] is not outcomes[n]) for n in range(32)
        )


def test_the_closed_lives_of_every_learner_of_a_group_are_kept():
    """Each of them has an account of its own for all closed lives; the next leader gets them all."""
    memories = []
    for trained in (10, 5):
        account = Account(*EARLIER)
        for sequence in range(trained):
            account.settle(sequence, Fate.QUEUED)
            account.settle(sequence, Fate.TRAINED)
        memories.append(account.snapshot())

    total = Accounts(memories, {}, ()).total()

    assert (total.trained, total.published, total.balance) == (15, 15, 0)

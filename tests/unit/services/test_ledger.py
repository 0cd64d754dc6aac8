"""An account's memory: of millions of rollouts, the old ones fold into spans, and nothing is forgotten."""

import numpy as np
import pytest

from common.comms.messages import VerdictKind
from services.learner import ledger
from services.learner.ledger import Account, Fate, restored

OUTCOMES = (Fate.TRAINED, Fate.TRAINED, Fate.TRAINED, Fate.DROPPED, VerdictKind.TOO_OLD)


@pytest.fixture
def few(monkeypatch):
    """Fold all but the last four."""
    monkeypatch.setattr(ledger, "RECENT", 4)


def settled(count: int, seed: int = 0) -> tuple[Account, list[Fate | VerdictKind]]:
    """Return an account of ``count`` rollouts that came a little out of order, and the truth."""
    rng = np.random.default_rng(seed)
    truth = [OUTCOMES[k] for k in rng.integers(len(OUTCOMES), size=count)]
    account = Account("a", 1)
    for sequence in np.argsort(np.arange(count) + rng.uniform(0, 3, count)):
        account.settle(int(sequence), Fate.QUEUED)
        account.settle(int(sequence), truth[sequence])
    return account, truth


@pytest.mark.parametrize("count", [1, 5, 6, 200])
def test_what_is_folded_is_answered_and_counted_as_before(few, count):
    account, truth = settled(count)
    book = account.ledger()

    assert [account.outcome(sequence) for sequence in range(count)] == truth
    assert account.outcome(count) is None
    assert book.published == count
    assert book.balance == 0
    assert book.trained == truth.count(Fate.TRAINED)
    assert len(account._outcomes) <= 8


def test_a_checkpoint_of_folded_rollouts_brings_them_all_back(few):
    account, truth = settled(200)
    memory = account.remember()
    again = restored(type(memory).from_json(memory.to_json()))

    assert [again.outcome(sequence) for sequence in range(200)] == truth
    assert again.ledger().trained == account.ledger().trained
    assert again.remember() == memory


def test_a_queued_or_missing_rollout_holds_the_fold_up(few):
    account = Account("a", 1)
    for sequence in range(40):
        if sequence != 12:
            account.settle(sequence, Fate.QUEUED if sequence == 20 else Fate.TRAINED)

    assert account.missing == 1
    account.settle(12, Fate.TRAINED)
    assert account.outcome(20) is Fate.QUEUED
    account.settle(20, Fate.LOST)

    assert account.outcome(20) is Fate.LOST
    assert account.ledger().trained == 39
    assert account.ledger().lost == 1


def test_an_outcome_that_is_long_final_is_not_overwritten(few):
    account, truth = settled(50)
    account.settle(3, Fate.LOST)

    assert account.outcome(3) == truth[3]
    assert account.ledger().balance == 0


def test_memory_does_not_grow_with_what_was_trained():
    account = Account("a", 1)
    for sequence in range(20_000):
        account.settle(sequence, Fate.TRAINED)

    assert len(account._outcomes) <= ledger.RECENT + 1
    assert account.remember().outcomes == (("trained", ((0, 20_000),)),)

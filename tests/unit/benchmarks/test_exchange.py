"""The search of all states finds none that breaks an invariant, and finds what is planted."""

import pytest

from benchmarks.exchange.invariants import INVARIANTS
from benchmarks.exchange.model import Bounds
from benchmarks.exchange.search import explore
from common.comms.messages import VerdictKind
from services.learner import admission

SMALLEST = Bounds(rollouts=1, losses=0, repeats=0, deaths=0)


def without(monkeypatch, kind):
    rules = tuple(rule for rule in admission.RULES if rule[0] is not kind)
    monkeypatch.setattr(admission, "RULES", rules)


def test_every_state_within_the_smallest_bounds_keeps_every_invariant():
    found = explore(SMALLEST, 10_000)

    assert found.is_whole
    assert found.broken == []
    assert found.states > 1000
    assert found.ends > 0
    assert {"play", "deliver", "report", "train", "save", "adopt"} <= set(found.kinds)


def test_the_nearest_states_with_losses_repeats_and_a_death_do_too():
    found = explore(Bounds(rollouts=2), 6000)

    assert not found.is_whole
    assert found.broken == []
    assert {"lose", "time out", "deliver twice", "die and resume", "send again"} <= set(found.kinds)


def test_without_the_rule_for_repeated_numbers_a_rollout_is_trained_twice(monkeypatch):
    without(monkeypatch, VerdictKind.DUPLICATE)
    found = explore(Bounds(rollouts=1, losses=0, repeats=1, deaths=0), 4000)

    broken = {invariant for invariant, _ in found.broken}
    assert broken & set(INVARIANTS)


def test_an_actor_that_gets_no_credits_is_found_waiting_for_ever(monkeypatch):
    monkeypatch.setattr("services.learner.intake.Intake._wanted", lambda self: 0)
    found = explore(SMALLEST, 10_000)

    assert {invariant for invariant, _ in found.broken} == {"nobody waits for ever"}


@pytest.mark.parametrize("most", [10, 100])
def test_a_search_ends_at_its_limit_and_says_so(most):
    assert not explore(SMALLEST, most).is_whole

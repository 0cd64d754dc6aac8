from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.comms.messages import ActorReport, VerdictKind
from services.learner.admission import Header, LearnerState
from services.learner.config import IntakeConfig
from services.learner.intake import Intake
from services.learner.turns import Rank, parts, taken
from tests.unit.services.accounting import ROLLOUT

RANKS = st.lists(
    st.builds(
        lambda queued, able, idle: Rank(queued, able, max(able - idle, 0), 0),
        st.integers(0, 9),
        st.integers(0, 6),
        st.integers(0, 6),
    ),
    min_size=1,
    max_size=5,
)


def rank(queued=0, able=1, active=1):
    return Rank(queued, able, active, 0)


def test_an_update_waits_for_a_whole_dataset_over_all_ranks():
    assert taken([rank(2), rank(1)], 4) == (0, 0)
    assert taken([rank(2), rank(2)], 4) == (2, 2)


def test_the_work_is_divided_evenly_where_the_rollouts_allow_it():
    assert taken([rank(4), rank(4)], 4) == (2, 2)
    assert taken([rank(7), rank(1)], 4) == (3, 1)
    assert taken([rank(4), rank(0)], 4) == (4, 0)


def test_a_rank_first_gives_what_it_has_asked_for():
    assert taken([rank(6, able=3, active=3), rank(6)], 4) == (3, 1)
    assert taken([rank(1, able=3, active=3), rank(6)], 4) == (1, 3)  # the other has what is missing


def test_a_rank_asks_for_as_much_as_its_share_of_the_actors():
    assert parts([rank(able=2, active=2), rank(able=1, active=1)], 6) == (4, 2)
    assert parts([rank(able=3, active=3), rank(able=0, active=0)], 6) == (6, 0)
    assert parts([rank(able=4, active=4), rank(able=3, active=3)], 8) == (5, 3)  # 4.6 and 3.4
    assert parts([rank(able=3, active=3), rank(able=3, active=3), rank()], 8) == (4, 3, 1)  # 3.4, 3.4, 1.1


def test_actors_that_hang_hold_nobody_up_and_may_come_back():
    assert parts([rank(able=2, active=2), rank(able=1, active=0)], 4) == (4, 1)


def test_at_the_start_nobody_has_brought_anything():
    assert parts([rank(able=0, active=0), rank(able=1, active=0)], 3) == (2, 2)


@given(RANKS, st.integers(1, 12))
def test_a_dataset_has_its_size_and_no_rank_gives_more_than_it_has(ranks, dataset):
    counts = taken(ranks, dataset)
    waiting = sum(one.queued for one in ranks)
    assert sum(counts) == (dataset if waiting >= dataset else 0)
    assert all(0 <= count <= one.queued for count, one in zip(counts, ranks, strict=True))


@given(RANKS, st.integers(1, 12))
def test_what_the_ranks_ask_for_makes_a_whole_dataset(ranks, dataset):
    asked = parts(ranks, dataset)
    assert sum(asked) >= dataset
    if any(one.active for one in ranks):  # beyond it only what a rank of idle actors asks for
        idle = sum(one.able > 0 for one in ranks)
        assert sum(asked) <= dataset + idle
    if all(one.active * dataset >= sum(other.active for other in ranks) > 0 for one in ranks):
        assert sum(asked) == dataset
    assert all(part > 0 for part, one in zip(asked, ranks, strict=True) if one.able)


def played(actors, dataset, max_lag, epochs=60):
    """Return ledger, refusals and mean lag of a group whose ranks have so many actors, without any fault."""
    state = LearnerState("r", 1, 0, 0, 1, "h")
    config = IntakeConfig(dataset_rollouts=dataset, max_lag=max_lag, target_lag=min(1, max_lag))
    intakes = [Intake(config, state) for _ in actors]
    names = [(intake, f"{k}-{n}") for k, intake in enumerate(intakes) for n in range(actors[k])]
    sent, limit = dict.fromkeys(names, 0), dict.fromkeys(names, 0)
    now, refused, lags = 0.0, 0, []

    def play(version):
        nonlocal now, refused
        now += 0.05
        for actor in names:
            intake, name = actor
            if sent[actor] >= limit[actor]:
                report = ActorReport("r", name, 1, version, sent[actor], (), (), 1, (), False, "h")
                limit[actor] = intake.report(report, now).credit_limit
            if sent[actor] < limit[actor]:
                header = Header("r", 1, version, 0, name, 1, sent[actor], "h")
                verdict = intake.arrive(header, ROLLOUT, now)
                if verdict.kind is not VerdictKind.BUSY:
                    sent[actor] += 1
                    refused += verdict.kind is not VerdictKind.ACCEPTED
                limit[actor] = max(limit[actor], verdict.credit_limit)

    version = 0
    while version < epochs:
        ranks = [Rank(intake.queued, *intake.contributors(now), 0) for intake in intakes]
        for intake, part in zip(intakes, parts(ranks, dataset), strict=True):
            intake.part = part
        counts = taken(ranks, dataset)
        play(version)
        if any(counts):
            for intake, count in zip(intakes, counts, strict=True):
                lags += [version - entry.header.version for entry in intake.take(count)]
            for _ in range(6):  # within the update
                play(version)
            version += 1
            for intake in intakes:
                intake.finish_update(replace(state, version=version))
    ledgers = [intake.total() for intake in intakes]
    return sum(one.lost for one in ledgers), refused, sum(lags) / len(lags)


@pytest.mark.parametrize("max_lag", [1, 2])
@pytest.mark.parametrize("actors", [(4, 4), (4, 3), (7, 1), (3, 3, 1), (8,)])
def test_no_rollout_of_a_healthy_group_waits_until_it_is_too_old(actors, max_lag):
    """Such as after the death of one actor. Alarms stand for lost rollouts, and for a lag over 1.5."""
    lost, refused, lag = played(actors, 8, max_lag)

    assert lost == 0
    assert refused <= len(actors) + 1  # at the start, before the ranks know how many actors each has
    assert lag <= 1.0

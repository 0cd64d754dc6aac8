"""The checker of histories finds each planted fault, and nothing in a sound history."""

import copy
import json

import pytest

from benchmarks.chaos.check import RULES, actor_lives, check, group_lives, judge, learner_lives
from benchmarks.chaos.schedule import KINDS, schedule


def started(generation, version, waiting=(), stage=0):
    place = {"generation": generation, "version": version, "epoch": version, "stage_number": stage}
    return {"event": "start", "t": 0.0, **place, "waiting": list(waiting)}


def gave(rollout, kind="accepted"):
    return {"event": "verdict", "t": 1.0, "rollout": list(rollout), "kind": kind, "generation": 0}


def trained(version, rollouts, lost=(), stage=0):
    names = {"rollouts": [list(name) for name in rollouts], "lost": [list(name) for name in lost]}
    return {
        "event": "trained",
        "t": 2.0,
        "version": version,
        "epoch": version,
        "stage_number": stage,
        **names,
    }


def saved(version, waiting=()):
    return {"event": "saved", "t": 3.0, "version": version, "waiting": [list(name) for name in waiting]}


def ended(count, balance=0):
    return {"event": "end", "t": 4.0, "trained": count, "balance": balance}


def actor(life, numbers, version=0):
    events = [{"event": "start", "t": 0.0, "actor": "a", "incarnation": life, "process": 1}]
    events.append({"event": "policy", "t": 0.1, "generation": 1, "version": version, "stage_number": 0})
    for number, (kind, generation) in enumerate(numbers):
        events.append({"event": "played", "t": 0.2, "number": number, "generation": 1, "version": version})
        if kind:
            events.append(
                {"event": "verdict", "t": 0.3, "number": number, "kind": kind, "generation": generation}
            )
    return events


def name(number, life=7):
    return ("a", life, number)


# Generation 1 saves version 1, trains version 2 and is killed: version 2 is rolled back. Generation 2 goes on from
# version 1, trains the rollout whose verdict was lost, and ends in order with one rollout in its last checkpoint.
LEARNER = [
    started(1, 0),
    *(gave(name(n)) for n in range(4)),
    trained(1, [name(0), name(1)]),
    saved(1),
    trained(2, [name(2), name(3)]),
    started(2, 1),
    gave(name(3)),  # its answer was lost with generation 1, and its actor sent it again
    gave(name(4)),
    gave(name(5), "stale_version"),
    gave(name(6)),
    trained(2, [name(3), name(4)]),
    saved(2, [name(6)]),
    ended(4),
]
ACTOR = [
    *actor(
        7,
        [
            *[("accepted", 1)] * 3,
            ("accepted", 2),
            ("accepted", 2),
            ("stale_version", 2),
            ("accepted", 2),
        ],
    ),
    {"event": "end", "t": 9.0, "in_flight": []},
    *actor(8, [("", 0), ("", 0)]),  # killed with two in flight
]


def judged(learner, played, ended_actors=1, ended_learners=1):
    return judge(actor_lives(played), learner_lives(learner), 2, {"a": ended_actors}, ended_learners)


def test_a_sound_history_breaks_no_rule_and_its_sums_are_right():
    result = judged(LEARNER, ACTOR)

    assert result.violations == ()
    assert result.counts == {
        **{"played": 9, "trained": 4, "rolled_back": 2, "lost": 0, "dropped": 0, "refused": 1},
        **{"died_with_actor": 2, "actor_lives": 2, "learner_lives": 2, "epochs": 2},
    }


def trained_twice(learner, played):
    learner[13]["rollouts"] = [list(name(0)), list(name(4))]


def unasked(learner, played):
    learner[13]["rollouts"] = [list(name(5)), list(name(4))]


def invented(learner, played):
    learner[2] = gave(("ghost", 1, 0))
    learner[5]["rollouts"] = [list(name(0)), ["ghost", 1, 0]]


def accepted_and_gone(learner, played):
    learner[14] = saved(2)


def unsettled(learner, played):
    del played[3]


def three_in_flight(learner, played):
    played.append({"event": "played", "t": 0.2, "number": 2, "generation": 1, "version": 0})


def verdict_unfounded(learner, played):
    played[3]["kind"] = "invalid"


def gap(learner, played):
    played[-1]["number"] = 5


def stale(learner, played):
    for event in played:
        if event["event"] == "played" and event["number"] == 4:
            event["version"] = -2


def version_back(learner, played):
    learner[13]["version"] = 1


def stage_back(learner, played):
    learner[8]["stage_number"] = learner[6]["stage_number"] = 1
    learner[0]["stage_number"] = 2


def policy_back(learner, played):
    played.insert(2, played[1] | {"version": 3})
    played.insert(3, played[1] | {"version": 2})


def life_back(learner, played):
    learner[8]["generation"] = 1


def life_from_nowhere(learner, played):
    learner[8]["version"] = 5


def ledger(learner, played):
    learner[15]["trained"] = 6


def unbalanced(learner, played):
    learner[15]["balance"] = -1


def died_unasked(learner, played):
    del learner[15]


PLANTED = {
    trained_twice: "trained_twice",
    unasked: "unasked",
    invented: "invented",
    accepted_and_gone: "accepted_and_gone",
    unsettled: "unsettled",
    three_in_flight: "unsettled",
    verdict_unfounded: "verdict_unfounded",
    gap: "gap",
    stale: "stale",
    version_back: "version_back",
    stage_back: "version_back",
    policy_back: "version_back",
    life_back: "life_back",
    life_from_nowhere: "life_back",
    ledger: "ledger",
    unbalanced: "ledger",
    died_unasked: "died_unasked",
}


@pytest.mark.parametrize("plant", PLANTED, ids=lambda plant: plant.__name__)
def test_a_planted_fault_is_found_under_its_rule(plant):
    learner, played = copy.deepcopy(LEARNER), copy.deepcopy(ACTOR)
    plant(learner, played)

    assert PLANTED[plant] in {violation.rule for violation in judged(learner, played).violations}


def test_every_rule_has_a_planted_fault():
    assert set(PLANTED.values()) == set(RULES)


def test_an_actor_that_was_not_ended_by_the_schedule_is_named():
    result = judged(LEARNER, ACTOR, ended_actors=0)

    assert [violation.text for violation in result.violations] == ["actor a: 1 of 0"]


def test_histories_are_read_from_their_files_up_to_a_line_that_was_being_written(tmp_path):
    for file, events in (("learner-0", LEARNER), ("actor-a", ACTOR)):
        lines = "".join(json.dumps(event) + "\n" for event in events)
        (tmp_path / f"{file}.jsonl").write_text(lines + '{"event": "pla')

    assert check(tmp_path, 2, {"a": 1}, 1) == judged(LEARNER, ACTOR)


def test_a_schedule_is_a_function_of_its_seed_and_has_every_kind_before_any_comes_twice():
    faults = schedule(3, KINDS, 2 * len(KINDS))

    assert faults == schedule(3, KINDS, 2 * len(KINDS))
    assert faults != schedule(4, KINDS, 2 * len(KINDS))
    for cycle in (faults[: len(KINDS)], faults[len(KINDS) :]):
        assert {fault.kind for fault in cycle} == set(KINDS)
    assert all(fault.kind.seconds[0] <= fault.seconds <= fault.kind.seconds[1] for fault in faults)


def of_rank(rank, generation, *events):
    """Return the events of one rank's life; actor "a" belongs to rank 0, "b" to rank 1."""
    place = started(generation, 0)
    return [place, *events, ended(len([event for event in events if event["event"] == "trained"]))]


def test_the_ranks_of_a_group_are_one_learner():
    own, other = ("a", 7, 0), ("b", 8, 0)
    late = ("b", 8, 1)
    ranks = [
        learner_lives(of_rank(0, 5, gave(own), trained(1, [own]), saved(1))),
        learner_lives(of_rank(1, 5, gave(other), trained(1, [other]), gave(late), saved(1, [late]))),
    ]
    (life,) = group_lives(ranks)

    assert life.accepted == {own, other, late}
    assert [(epoch["version"], epoch["rollouts"]) for epoch in life.epochs] == [(1, [list(own), list(other)])]
    assert life.saved[-1]["waiting"] == [list(late)]
    assert (life.end["trained"], life.end["balance"]) == (2, 0)


def test_a_group_one_of_whose_ranks_was_killed_has_not_ended_in_order():
    whole, killed = of_rank(0, 5, trained(1, [name(0)])), of_rank(1, 5, trained(1, [name(1)]))[:-1]
    again = [of_rank(rank, 6) for rank in (0, 1)]
    lives = group_lives([learner_lives([*whole, *again[0]]), learner_lives([*killed, *again[1]])])

    assert [(life.generation, life.end is None) for life in lives] == [(5, True), (6, False)]


def test_a_learner_alone_is_no_group():
    lives = learner_lives(LEARNER)

    assert group_lives([lives]) == lives

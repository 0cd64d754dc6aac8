"""One misconfigured, hung or hostile peer: training goes on, and the log names the cause once."""

import dataclasses
import logging

import pytest

from common.comms.codec import decode, encode
from common.comms.keys import Keys
from common.comms.messages import ActorReport, PolicySnapshot, Verdict, VerdictKind
from common.comms.transport import Flow, Reply
from common.task.config import TaskConfig
from services.learner.config import IntakeConfig, LearnerConfig
from services.learner.members import LearnerAliveError
from services.learner.service import LearnerService
from tests.integration.in_process_run import LONG, local_run, progress
from tests.waiting import wait_until

KEYS = Keys("test")
ONE = {"intake": IntakeConfig(dataset_rollouts=1), "curriculum": LONG}


def trains_on(learner, epochs=4):
    epoch = progress(learner).epoch
    wait_until(lambda: progress(learner).epoch >= epoch + epochs, 60, "training to go on")


def started(s):
    """Return a learner that trains, its only actor, and a peer of theirs."""
    learner = s.learner()
    s.generator()
    actor = s.actor(0)
    trains_on(learner, 2)
    return learner, actor, s.peer()


def newest_policy(peer):
    return decode(peer.request(KEYS.policy(), b"", 5.0, Flow.POLICY).wait().payload, PolicySnapshot)


def test_an_actor_of_another_contract_holds_no_credits_and_is_named_once(tmp_path, caplog):
    with caplog.at_level(logging.INFO), local_run(tmp_path, **ONE) as s:
        learner = s.learner()
        s.generator()
        misfit = s.actor(1, task=TaskConfig(control_rate_hz=100), silence_warning_s=0.5)
        wait_until(lambda: learner.metric("topspin_misfit_actors") == 1, 30, "the misfit to be counted")
        s.actor(0)
        trains_on(learner, 12)
        wait_until(lambda: "with_another_contract" not in caplog.text, 1, "no silence")
        published = misfit.service.counts.published
        lines = [line for line in caplog.messages if "kind=contract" in line]
        policies = [line for line in caplog.messages if "kind=policy" in line]
        waits = [line for line in caplog.messages if "waiting for=" in line and "contract" in line]

    assert published == 0
    assert len(lines) == 1
    assert "actor=1 has training" in lines[0]
    assert len(policies) == 1  # and not one for each version
    assert waits
    assert len(waits) == len(set(waits)) <= 2  # its own view and the learner's, each once


def test_credits_of_an_actor_that_reports_and_never_plays_go_to_others(tmp_path):
    intake = IntakeConfig(dataset_rollouts=1, max_lag=0, credit_patience_s=1.0)
    with local_run(tmp_path, intake=intake, curriculum=LONG) as s:
        learner = s.learner()
        s.generator()
        peer = s.peer()
        idle = ActorReport("test", "idle", 1, 0, 0, (), (), 0, (), False, newest_policy(peer).training_hash)

        def report():
            outcome = peer.request(KEYS.report("idle"), encode(idle), 5.0, Flow.CONTROL).wait()
            return decode(outcome.payload, Verdict) if isinstance(outcome, Reply) else None

        assert report().credit_limit == 1
        s.actor(0)
        wait_until(lambda: (report(), progress(learner).epoch >= 3)[1], 60, "training beside it")


def test_a_forged_policy_of_a_higher_generation_is_ignored(tmp_path):
    with local_run(tmp_path, **ONE) as s:
        learner, actor, peer = started(s)
        forged = dataclasses.replace(newest_policy(peer), generation=2**62, version=2**61)
        for _ in range(5):
            peer.publish(KEYS.policy(), encode(forged), Flow.POLICY)
            trains_on(learner, 2)
        refused = actor.metric("topspin_messages_refused_total", kind="policy")
        verdicts = actor.service.counts.refused

    assert refused >= 1
    assert verdicts == {}


def test_an_actor_comes_back_from_a_forged_version_of_its_own_learner(tmp_path, caplog):
    with local_run(tmp_path, **ONE) as s:
        learner, actor, peer = started(s)

        def forge():
            forged = dataclasses.replace(newest_policy(peer), version=2**61)
            peer.publish(KEYS.policy(), encode(forged), Flow.POLICY)
            return actor.service.counts.refused.get(VerdictKind.INVALID, 0) > 0

        wait_until(forge, 30, "the forged version to be played")
        trains_on(learner, 6)

    assert "is not from the learner" in caplog.text


def test_an_actor_comes_back_from_forged_answers(tmp_path):
    """At an open hub a peer can answer faster than the learner."""
    with local_run(tmp_path, **ONE) as s:
        learner, actor, peer = started(s)
        kind = VerdictKind.CREDITS
        forged = encode(Verdict(kind, kind, "", newest_policy(peer).generation, 0, 0, 1, 2**61, 2**61))
        servers = [peer.serve(key, 64) for key in (KEYS.report("0"), KEYS.rollout("0"))]

        def answer():
            for server in servers:
                for request in server.waiting(64):
                    request.reply(forged)
            return actor.service._delivery.outbox.credit_version == 2**61

        wait_until(answer, 30, "forged credits")
        for server in servers:
            server.close()
        trains_on(learner, 6)


def test_a_second_learner_of_a_run_ends_with_one_line_and_the_first_goes_on(tmp_path, caplog):
    with local_run(tmp_path / "first", **ONE) as s:
        learner = s.learner()
        s.generator()
        s.actor(0)
        trains_on(learner, 1)
        with pytest.raises(LearnerAliveError, match="run 'test' has another learner, generation") as caught:
            s.learner(run=False, mode="client", folder=str(tmp_path / "second"), lease_s=0.5)
        token = s.peer().declare_alive(KEYS.alive("learner", "0", 2**61))
        wait_until(lambda: f"generation {2**61}" in caplog.text, 10, "the first to name a forged token")
        trains_on(learner)
        token.close()

    assert "\n" not in str(caught.value)


def test_actors_follow_the_next_learner_whatever_its_number(tmp_path):
    """A new folder begins to count again: its generation may be the lower one."""
    with local_run(tmp_path / "first", **ONE) as s:
        first = s.learner()
        s.generator()
        actor = s.actor(0)
        trains_on(first, 1)
        high = tmp_path / "first" / ".generation"
        high.write_text(str(2**61))
        s.take_down(first)
        second = s.learner(resume=True)
        trains_on(second, 2)
        s.take_down(second)
        third = s.learner(folder=str(tmp_path / "third"))
        trains_on(third, 3)
        generations = [entry.service._generation for entry in (first, second, third)]
        actor.end()

    assert generations[1] > generations[0] > 0
    assert generations[2] < generations[1]


def test_both_sides_log_a_lost_peer_a_lost_link_and_their_return(tmp_path, caplog):
    with caplog.at_level(logging.INFO), local_run(tmp_path, **ONE) as s:
        learner = s.learner()
        s.generator()
        s.actor(0, silence_warning_s=0.3)
        trains_on(learner, 1)
        s.take_down(learner)
        wait_until(
            lambda: "waiting for='the link to the hub at" in caplog.text, 10, "what the actor waits for"
        )
        again = s.learner(resume=True)
        trains_on(again, 2)
        s.cut_off(s.actor(1))
        wait_until(lambda: "gone=1 actor/1" in caplog.text, 10, "the learner to name the lost actor")

    assert "joined=1 actor/0" in caplog.text
    assert "link to the hub lost endpoint=" in caplog.text
    assert "link to the hub is back endpoint=" in caplog.text
    assert "learner gone generation=" in caplog.text
    assert caplog.text.count("learner found generation=") >= 2


def test_only_who_listens_says_so(tmp_path, caplog):
    """A learner behind a router is connected to it."""
    with caplog.at_level(logging.INFO), local_run(tmp_path / "hub", **ONE) as s:
        s.learner()
        wait_until(lambda: f"listening endpoint={s.endpoint}" in caplog.text, 5, "the hub's line")
        behind = {"run": "behind", "mode": "client", "folder": str(tmp_path / "behind")}
        s.start(LearnerService, LearnerConfig(**s.common() | s.learner_settings | behind), "learner")
        wait_until(
            lambda: f"connected endpoint={s.endpoint} run=behind" in caplog.text, 5, "the client's line"
        )

    assert caplog.text.count("listening endpoint=") == 1

"""Messages that no service of this project sends: each is refused with its reason, and work continues."""

import dataclasses

import msgpack
import numpy as np
import torch
from safetensors.torch import load, save

from common.comms.codec import decode, encode
from common.comms.keys import Keys
from common.comms.messages import ActorReport, PolicySnapshot, RallyBatch, StageChange, Status, Verdict
from common.comms.transport import Flow, NoReply
from common.task.config import TaskConfig
from common.task.observation import PAPER_OBSERVATION
from tests.integration.in_process_run import CURRICULUM, DATASET, local_run
from tests.unit.comms.test_codec import sealed
from tests.unit.services.learner.rollouts import make_rollout
from tests.waiting import wait_until

KEYS = Keys("test")
REPORT = ActorReport("test", "client", 1, 0, 0, (), (), 0, (), leaving=False)
PAPER = TaskConfig(observation=PAPER_OBSERVATION)  # the task of the client's rollouts
LONG = CURRICULUM.model_copy(update={"stage_1": 500 * DATASET})


class ForeignClient:
    """A program with a connection that can write rollouts."""

    def __init__(self, transport, name="client"):
        self.transport, self.name = transport, name
        self.sent = 0

    def policy(self):
        return decode(
            self.transport.request(KEYS.policy(), b"", 60.0, Flow.POLICY).wait().payload, PolicySnapshot
        )

    def rollout(self, **changes):
        """Return a rollout that the learner accepts, except for ``changes``."""
        newest, values = self.policy(), {"actor": self.name, "run": "test", "sequence": self.sent}
        for name in ("generation", "version", "stage_number", "training_hash"):
            values[name] = getattr(newest, name)
        self.sent += 1
        return make_rollout(**(values | changes))

    def send(self, payload, key=None):
        return self.transport.request(key or KEYS.rollout(self.name), payload, 60.0, Flow.ROLLOUT).wait()

    def verdict(self, payload):
        return decode(self.send(payload).payload, Verdict)


def nan_in(array):
    spoilt = array.copy()
    spoilt.flat[7] = np.nan
    return spoilt


def reworded(payload, change):
    """Return a rollout's bytes after ``change`` to its [type, version, fields], with a new checksum."""
    content = msgpack.unpackb(payload[12:])
    change(content)
    return sealed(msgpack.packb(content))


def test_the_learner_refuses_each_bad_rollout_with_its_reason_and_trains_on(tmp_path):
    with local_run(tmp_path, curriculum=LONG, task=PAPER) as s:
        learner = s.learner()
        client = ForeignClient(s.peer())
        for _ in range(4):  # so that there are older versions
            assert client.verdict(encode(client.rollout())).kind == "accepted"
            assert client.verdict(encode(client.rollout())).kind == "accepted"
            version = client.sent // 2
            wait_until(lambda v=version: client.policy().version == v, 20, "the update")
        newest = client.policy()
        whole = encode(client.rollout())
        spoilt = bytearray(whole)
        spoilt[len(whole) // 2] ^= 1
        bad = [
            ("stale_stage", "stage number 7; allowed: 0", encode(client.rollout(stage_number=7))),
            ("too_old", "allowed lag: 2", encode(client.rollout(version=newest.version - 3))),
            ("invalid", "the newest is", encode(client.rollout(version=newest.version + 1))),
            ("wrong_contract", "training c0de", encode(client.rollout(training_hash="c0de"))),
            ("wrong_generation", "generation 3", encode(client.rollout(generation=3))),
            ("wrong_run", "run other", encode(client.rollout(run="other"))),
            ("invalid", "Rollout.obs", encode(client.rollout(obs=nan_in(make_rollout().obs)))),
            (
                "invalid",
                "Rollout.rewards",
                encode(client.rollout(rewards=make_rollout().rewards + np.float32(np.inf))),
            ),
            ("invalid", "36 observations; allowed: 37", encode(narrower(client.rollout()))),
            ("invalid", "3 reward terms", encode(client.rollout(reward_terms=np.zeros(3, np.float32)))),
            (
                "invalid",
                "rewards of 1e+30",
                encode(client.rollout(rewards=np.full((16, 8), 1e30, np.float32))),
            ),
            ("invalid", "outcome 200", encode(client.rollout(episodes=bad_outcome()))),
            ("invalid", "version 99", reworded(encode(client.rollout()), lambda c: c.__setitem__(1, 99))),
            ("unreadable", "not readable", bytes(spoilt)),
            ("unreadable", "not readable", b""),
            ("unreadable", "not readable", encode(status())),
            ("unreadable", "actor other; allowed: client", encode(client.rollout(actor="other"))),
        ]
        before = dict(learner.scrape())
        verdicts = [client.verdict(payload) for _, _, payload in bad]
        after = learner.scrape()
        refusal = client.send(b"nonsense", KEYS.ctl("learner", "0"))
        forged = client.send(encode(dataclasses.replace(REPORT, actor="other")), KEYS.report("client"))
        token = client.transport.declare_alive("topspin/v3/test/alive/actor/x/²")
        wait_until(
            lambda: learner.metric("topspin_messages_refused_total", kind="alive") == 1,
            5,
            "the invalid token",
        )
        token.close()
        paused = client.verdict(encode(client.rollout()))  # after so many refusals it has no credits
        other = ForeignClient(s.peer(), "other")
        for _ in range(2):
            other.verdict(encode(other.rollout()))
        wait_until(lambda: client.policy().version == newest.version + 1, 20, "one more update")
        learner.end()
        ledger = learner.service.ledger()

    assert [verdict.kind.value for verdict in verdicts] == [kind for kind, _, _ in bad]
    for verdict, (_, reason, _) in zip(verdicts, bad, strict=True):
        assert reason in verdict.reason
    for kind in {kind for kind, _, _ in bad}:
        name = f'topspin_rollouts_received_total{{verdict="{kind}"}}'
        assert after[name] - before.get(name, 0.0) == sum(k == kind for k, _, _ in bad)
    assert "without a credit" in paused.reason
    assert refusal is NoReply.NO_SERVER
    assert forged is NoReply.NO_SERVER
    assert ledger.balance == 0
    assert ledger.trained == 10
    assert ledger.lost == 0


def test_a_message_over_the_limit_is_dropped_and_others_are_still_served(tmp_path):
    with local_run(tmp_path, curriculum=LONG, task=PAPER, max_message_mib=1) as s:
        learner = s.learner()
        client, other = ForeignClient(s.peer()), ForeignClient(s.peer())
        big = encode(client.rollout(**{n: getattr(make_rollout(steps=128, envs=96), n) for n in BLOCK}))
        outcome = client.transport.request(KEYS.rollout("client"), big, 2.0, Flow.ROLLOUT).wait()
        for _ in range(2):
            assert other.verdict(encode(other.rollout())).kind == "accepted"
        wait_until(lambda: other.policy().version == 1, 20, "an update")
        learner.end()

    assert len(big) > 2**20
    assert isinstance(outcome, NoReply) or decode(outcome.payload, Verdict).kind == "invalid"
    assert learner.service.ledger().balance == 0


def test_workers_refuse_bad_messages_and_play_on(tmp_path):
    with local_run(tmp_path, curriculum=LONG) as s:
        learner = s.learner()
        s.generator()
        actor, evaluator = s.actor(shards=1), s.evaluator(interval_s=0.1)
        wait_until(lambda: learner.service.training.progress.epoch >= 2, 60, "training")
        client = ForeignClient(s.peer())
        publish, request = client.transport.publish, client.transport.request
        newest = client.policy()
        tensors = {name: torch.full_like(value, torch.nan) for name, value in load(newest.weights).items()}
        higher = {"generation": newest.generation + 9, "version": 10**6}
        bad_policies = [
            encode(dataclasses.replace(newest, **higher, weights=save(tensors))),
            encode(dataclasses.replace(newest, **higher, weights=b"rubbish")),
            encode(dataclasses.replace(newest, **higher, obs_mean=np.zeros(3), obs_var=np.ones(3))),
            encode(newest)[:-9],
        ]

        def refused(entry, kind):
            return entry.metric("topspin_messages_refused_total", kind=kind)

        for payload in bad_policies:
            seen = refused(actor, "policy")
            wait_until(
                lambda n=seen, p=payload: (
                    publish(KEYS.policy(), p, Flow.POLICY),
                    refused(actor, "policy") > n,
                )[1],
                20,
                "the actor to refuse a policy",
            )
        publish(KEYS.stage(), b"nonsense", Flow.STAGE)
        publish(KEYS.stage(), encode(StageChange("test", 1, 50, 3, 0, 0, "wrong")), Flow.STAGE)
        for role in ("actor", "evaluator", "generator"):
            assert request(KEYS.ctl(role, "0"), b"nonsense", 60.0, Flow.CONTROL).wait() is NoReply.NO_SERVER
        request(KEYS.rally(0), b"nonsense", 5.0, Flow.RALLY).wait()
        wait_until(lambda: refused(actor, "stage") == 1, 10, "the actor to refuse a stage")
        for payload in (
            b"nonsense",
            encode(bad_rallies()),
        ):  # sent until it is refused: newer batches push it out
            seen = refused(actor, "rally")
            wait_until(
                lambda n=seen, p=payload: (
                    publish(KEYS.rally(0), p, Flow.RALLY),
                    refused(actor, "rally") > n,
                )[1],
                30,
                "the actor to refuse rallies",
            )
        epoch, evaluations = learner.service.training.progress.epoch, evaluator.service.evaluations
        wait_until(lambda: learner.service.training.progress.epoch > epoch + 3, 30, "more training")
        wait_until(lambda: evaluator.service.evaluations > evaluations, 30, "another evaluation")
        actor.end()
        learner.end()

    assert learner.service.ledger().balance == 0
    assert learner.service.ledger().lost == 0


BLOCK = (  # the fields of a rollout whose size is that of its block
    "obs",
    "actions",
    "log_mu",
    "rewards",
    "terminated",
    "truncated",
    "final_obs",
    "final_index",
    "last_obs",
    "corrections",
)


def narrower(rollout):
    return dataclasses.replace(
        rollout,
        obs=np.ascontiguousarray(rollout.obs[..., :36]),
        last_obs=np.ascontiguousarray(rollout.last_obs[..., :36]),
        final_obs=np.ascontiguousarray(rollout.final_obs[..., :36]),
    )


def bad_outcome():
    episodes = make_rollout().episodes
    return dataclasses.replace(episodes, outcome=np.full_like(episodes.outcome, 200))


def bad_rallies():
    rallies = np.zeros((4, 12))
    rallies[:, 3] = 1e200
    return RallyBatch(
        source="wild",
        incarnation=1,
        sequence=0,
        shard=0,
        block=0,
        rallies=rallies,
        seeds=np.arange(4, dtype=np.uint64),
        candidates=4,
        launch="paper",
        randomization="standard",
    )


def status():
    return Status("actor", "0", 1, 1.8e9, "playing", {}, {})

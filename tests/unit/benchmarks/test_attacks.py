"""The attacks of `benchmarks.hostile`: each can be sent, and what is called bad the decoder refuses."""

from types import SimpleNamespace

import pytest

from benchmarks.attacker import OWN, Attacker
from benchmarks.attacks import ATTACKS
from benchmarks.fuzz.message_examples import EXAMPLES
from common.comms.codec import DecodeError, decode
from common.comms.keys import Keys
from common.comms.messages import ActorReport, PolicySnapshot, Rollout
from services.learner.admission import content_fault

KEYS = Keys("night")
POLICY = next(message for message in EXAMPLES if isinstance(message, PolicySnapshot))
WITH_LINKS = {"30 links", "200 silent connections"}
REFUSED = {
    KEYS.report(OWN): (
        ActorReport,
        *("oversized report", "report of empty maps", "deep nesting", "array of 4 billion", "wrong types"),
        *(
            "id of 60,000 characters",
            "escape codes in an id",
            "report with 65,000 refusals",
            "negative numbers",
        ),
    ),
    KEYS.rollout(OWN): (
        Rollout,
        *("oversized rollout", "rollout of empty maps", "wrong types", "number 2^62", "NaN in a rollout"),
    ),
}


class Recorder:
    """A session that keeps what is sent."""

    def __init__(self):
        self.sent = []

    def get(self, key, _handler, payload, timeout):
        self.sent.append((key, payload))

    def put(self, key, payload):
        self.sent.append((key, payload))

    def delete(self, key):
        self.sent.append((key, b""))

    def declare_queryable(self, key, _handler):
        self.sent.append((key, b""))

    declare_subscriber = declare_queryable

    def liveliness(self):
        return SimpleNamespace(declare_token=lambda key: self.sent.append((key, b"")))


def sent(name):
    session = Recorder()
    ATTACKS[name].send(Attacker(session, None, KEYS, POLICY))
    return session.sent


def test_there_are_enough_attacks_and_each_sends_something():
    assert len(ATTACKS) >= 25
    for name in ATTACKS.keys() - WITH_LINKS:
        assert sent(name), name


@pytest.mark.parametrize(
    ("key", "name"), [(key, name) for key, (_, *names) in REFUSED.items() for name in names]
)
def test_the_decoder_refuses_a_bad_message(key, name):
    kind = REFUSED[key][0]
    payloads = [payload for to, payload in sent(name) if to == key]

    assert payloads
    for payload in payloads:
        with pytest.raises(DecodeError) as caught:
            decode(payload, kind)
        assert str(caught.value).isprintable()


def test_a_rollout_that_is_only_forged_is_readable():
    ((_, payload),) = {item for item in sent("replayed rollouts")}
    rollout = decode(payload, Rollout)

    assert content_fault(rollout, POLICY.obs_mean.size) == ""

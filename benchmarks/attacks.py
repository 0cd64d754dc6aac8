"""Attacks on a run, one literal table: what a hostile peer sends.

The peer has a session of its own that nothing restrains. With TLS it owns the certificate of an actor, so it may speak
as that actor; all else is dropped at the hub. At an open hub everything arrives.
"""

import dataclasses
import os
import socket
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import zenoh
from zenoh.handlers import Callback

from benchmarks.attacker import (
    NAME,
    OWN,
    VICTIM,
    Attacker,
    fields_of,
    nested,
    open_session,
    over,
    raw,
    sealed,
    status_fields,
    wrong_types,
)
from common.comms.budgets import KIB, MIB
from common.comms.codec import encode
from common.comms.keys import ROLES
from common.comms.messages import (
    RALLY_WIDTH,
    ActorReport,
    Command,
    Control,
    PolicySnapshot,
    RallyBatch,
    Rollout,
    StageChange,
    Status,
    Verdict,
    VerdictKind,
)

FAR: Final = 2**62
ESCAPES: Final = "a\n\x1b[2J\x1b]0;owned\x07\r"


def _wrong_types(a: Attacker) -> None:
    a.ask(a.keys.report(OWN), wrong_types(ActorReport))
    a.ask(a.keys.rollout(OWN), wrong_types(Rollout))
    a.put(a.keys.status("actor", OWN), wrong_types(Status))


def _escape_codes(a: Attacker) -> None:
    a.ask(a.keys.report(OWN), raw(ActorReport, **fields_of(a.report(), actor=ESCAPES)))
    a.put(a.keys.status("actor", OWN), raw(Status, **status_fields() | {"state": ESCAPES}))
    a.put(a.keys.status("actor", OWN), raw(Status, **status_fields() | {"id": ESCAPES}))


def _beyond_credits(a: Attacker) -> None:
    a.ask(a.keys.rollout(OWN), encode(a.rollout(incarnation=3)))
    a.ask(a.keys.rollout(OWN), encode(a.rollout(incarnation=3, sequence=2**50)))
    a.ask(a.keys.report(OWN), encode(a.report(incarnation=3, published=2**50)))


def _forged_policy(a: Attacker, **changes: Any) -> None:
    a.put(a.keys.policy(), encode(dataclasses.replace(a.policy, **changes)), times=20)


def _forged_learner(a: Attacker) -> None:
    a.kept.append(a.session.liveliness().declare_token(a.keys.alive("learner", VICTIM, FAR - 1)))
    _forged_policy(a, generation=FAR - 1, version=FAR)


def _forged_stage(a: Attacker) -> None:
    change = StageChange(a.policy.run, a.policy.generation, 50, 3, 0, 0, "forged")
    a.put(a.keys.stage(), encode(change), times=200)


def _forged_answers(a: Attacker) -> None:
    """Answer every request of others at once, with a verdict that stops an actor."""
    verdict = encode(
        Verdict(VerdictKind.CREDITS, VerdictKind.CREDITS, "", a.policy.generation, 0, 0, 1, FAR, FAR, 3600.0)
    )

    def answer(query: zenoh.Query) -> None:
        query.reply(query.key_expr, verdict)
        query.drop()  # type: ignore[no-untyped-call]

    for key in (a.keys.every_rollout(), a.keys.every_report(), a.keys.rollout(VICTIM), a.keys.report(VICTIM)):
        a.kept.append(a.session.declare_queryable(key, Callback(answer, indirect=False)))


def _forged_heartbeats(a: Attacker) -> None:
    for role in ROLES:
        status = Status(role, VICTIM, 1, 1.8e9, "done", {"frames": 1e300}, {"epoch": -1.0})
        a.put(a.keys.status(role, VICTIM), encode(status), times=50)


def _commands(a: Attacker) -> None:
    for role in ROLES:
        a.ask(a.keys.ctl(role, VICTIM), encode(Control(Command.DRAIN)), times=5)


def _tokens(a: Attacker) -> None:
    tokens = a.session.liveliness()
    for number in range(1000):
        for role, id_ in (("actor", OWN), ("actor", f"forged{number}"), ("learner", VICTIM)):
            a.kept.append(tokens.declare_token(a.keys.alive(role, id_, number)))


def _replays(a: Attacker) -> None:
    a.ask(a.keys.rollout(OWN), encode(a.rollout()), times=200)


def _without_credits(a: Attacker) -> None:
    for number in range(500):
        a.ask(a.keys.rollout(OWN), encode(a.rollout(incarnation=2, sequence=number)))


def _of_another(a: Attacker) -> None:
    forged = encode(a.rollout(actor=VICTIM))
    for id_ in (OWN, VICTIM):
        a.ask(a.keys.rollout(id_), forged, times=20)


def _reports_of_another(a: Attacker) -> None:
    leaving = encode(a.report(actor=VICTIM, leaving=True, published=FAR >> 10))
    for id_ in (OWN, VICTIM):
        a.ask(a.keys.report(id_), leaving, times=20)


def _many_lives(a: Attacker) -> None:
    for life in range(3000):
        a.ask(a.keys.report(OWN), encode(a.report(incarnation=life, published=life)))


def _hoarded_credits(a: Attacker) -> None:
    a.ask(a.keys.report(OWN), encode(a.report(incarnation=5)), times=50)


def _bad_rallies(a: Attacker) -> None:
    rallies = np.full((4096, RALLY_WIDTH), 1e200)
    seeds = np.zeros(4096, np.uint64)
    batch = RallyBatch("wild", 1, FAR, 0, FAR, rallies, seeds, FAR, "paper", "standard")
    a.put(a.keys.rally(0), encode(batch), times=50)


def _subscriptions(a: Attacker) -> None:
    for key in ("**", a.keys.everything(), *a.all_keys()):
        a.kept.append(a.session.declare_subscriber(key, zenoh.handlers.FifoChannel(1)))  # never read


def _query_and_hang(a: Attacker) -> None:
    a.ask(a.keys.policy(), b"", times=200)


def _wild_requests(a: Attacker) -> None:
    for key in ("**", a.keys.everything(), a.keys.every_rollout(), a.keys.every_report(), a.keys.every_ctl()):
        a.ask(key, os.urandom(KIB), times=100)


def _deletions(a: Attacker) -> None:
    for key in a.all_keys():
        for _ in range(20):
            a.session.delete(key)


def _links(a: Attacker) -> None:
    for _ in range(30):
        open_session(a.config, NAME).close()  # type: ignore[no-untyped-call]


def _port(a: Attacker) -> None:
    """Open links that say nothing, or no Zenoh."""
    host, _, port = a.config.endpoint.partition("/")[2].rpartition(":")
    for number in range(200):
        link = socket.create_connection((host, int(port)), 5.0)
        if number % 2:
            link.sendall(b"GET / HTTP/1.1\r\nHost: hub\r\n\r\n" + os.urandom(KIB))
        a.kept.append(link)


@dataclass(frozen=True, slots=True)
class Attack:
    """One attack, and for how long the attacker's process is stopped after it."""

    send: Callable[[Attacker], None]
    hang_s: float = 0.0


def _report(*payloads: Callable[[Attacker], bytes]) -> Attack:
    def send(a: Attacker) -> None:
        for payload in payloads:
            a.ask(a.keys.report(OWN), payload(a))

    return Attack(send)


def _rollout(payload: Callable[[Attacker], bytes]) -> Attack:
    return Attack(lambda a: a.ask(a.keys.rollout(OWN), payload(a)))


ATTACKS: Final[dict[str, Attack]] = {
    # sizes
    "oversized report": _report(lambda _: over(ActorReport)),
    "oversized rollout": _rollout(lambda _: over(Rollout)),
    "largest rollout": _rollout(lambda a: encode(a.rollout(700, 300, generation=1))),
    "oversized policy": Attack(lambda a: a.put(a.keys.policy(), over(PolicySnapshot))),
    "oversized stage": Attack(lambda a: a.put(a.keys.stage(), over(StageChange), 50)),
    "oversized rallies": Attack(lambda a: a.put(a.keys.rally(0), over(RallyBatch), 10)),
    "oversized command": Attack(lambda a: a.ask(a.keys.ctl("learner", VICTIM), over(Control), 50)),
    "oversized heartbeat": Attack(lambda a: a.put(a.keys.status("actor", OWN), over(Status), 50)),
    # bytes that are no message
    "report of empty maps": _report(lambda _: sealed(b"\xdc\xea\x60" + b"\x80" * 60_000)),
    "rollout of empty maps": _rollout(lambda _: sealed(b"\xdd\x00\x60\x00\x00" + b"\x80" * (6 * MIB))),
    "deep nesting": _report(lambda _: nested(2000), lambda _: nested(60_000)),
    "array of 4 billion": _report(
        lambda _: sealed(b"\xdd\xff\xff\xff\xff"), lambda _: sealed(b"\xdf\xff\xff\xff\xff")
    ),
    "garbage on every key": Attack(lambda a: a.everywhere(os.urandom(4 * KIB))),
    "nothing on every key": Attack(lambda a: a.everywhere(b"")),
    "deletions on every key": Attack(_deletions),
    # fields
    "wrong types": Attack(_wrong_types),
    "id of 60,000 characters": _report(
        lambda a: raw(ActorReport, **fields_of(a.report(), actor="a" * 60_000))
    ),
    "escape codes in an id": Attack(_escape_codes),
    "report with 65,000 refusals": _report(
        lambda a: raw(ActorReport, **fields_of(a.report(), refused=[{}] * 65_000)),
        lambda a: raw(ActorReport, **fields_of(a.report(), in_flight=list(range(10_000)))),
    ),
    "negative numbers": _report(
        lambda a: raw(ActorReport, **fields_of(a.report(), dropped=[-1], published=-5))
    ),
    "number 2^62": _rollout(lambda a: raw(Rollout, **fields_of(a.rollout(), sequence=FAR))),
    "numbers beyond all credits": Attack(_beyond_credits),
    "NaN in a rollout": _rollout(
        lambda a: raw(Rollout, **fields_of(a.rollout(), rewards=["<f4", [4, 4], b"\xff" * 64]))
    ),
    "extreme values": _rollout(lambda a: encode(a.rollout(rewards=np.full((4, 4), 1e30, np.float32)))),
    # in another's name
    "forged policy, newer version": Attack(lambda a: _forged_policy(a, version=FAR)),
    "forged policy and learner": Attack(_forged_learner),
    "forged stage": Attack(_forged_stage),
    "forged commands": Attack(_commands),
    "forged answers": Attack(_forged_answers),
    "forged heartbeats": Attack(_forged_heartbeats),
    "3,000 forged tokens": Attack(_tokens),
    "rollouts of another": Attack(_of_another),
    "reports of another": Attack(_reports_of_another),
    "bad rallies": Attack(_bad_rallies),
    # floods
    "replayed rollouts": Attack(_replays),
    "rollouts without credits": Attack(_without_credits),
    "3,000 lives": Attack(_many_lives),
    "hoarded credits": Attack(_hoarded_credits),
    "flood of policy requests": Attack(lambda a: a.ask(a.keys.policy(), b"", 2000)),
    "flood of reports": Attack(
        lambda a: a.ask(a.keys.report(OWN), encode(a.report(training_hash="c0de")), 3000)
    ),
    "requests for everything": Attack(_wild_requests),
    "query and hang": Attack(_query_and_hang, hang_s=5.0),
    "subscribe to everything and hang": Attack(_subscriptions, hang_s=5.0),
    "30 links": Attack(_links),
    "200 silent connections": Attack(_port),
}

"""Trying everything that the owner of a certificate could say to a hub, and hear from it.

Each verb of `common.comms.roles.Rights` is tried on each kind of key, for its own id and for another one, and on wide
expressions. A trial counts as passed if the message arrived: at the hub, or from the hub. What may not pass is always
sent before what may, so it would have arrived too.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from functools import partial
from typing import Final

import zenoh
from zenoh.handlers import Callback

from common.comms.keys import PREFIX, ROLES, Keys, matches
from common.comms.roles import Rights
from common.comms.transport import Flow, PendingReply, Reply, Server, Transport
from common.errors import ReportedError

HUB: Final = b"hub"
CAPACITY: Final = 4096
OTHER: Final = "x7"  # an id that no certificate has
WITHIN_S: Final = 20.0
PAUSE_S: Final = 0.02
ASK_S: Final = 2.0
UNANSWERED: Final = (
    10  # times that all is said where nothing may pass, so that nothing says when it was received
)

Trial = tuple[str, str]  # verb, key


def keys_to_try(keys: Keys, id_: str) -> tuple[str, ...]:
    """Return one key of each kind, for a service's own id and for another one."""
    ids = (id_, OTHER)
    return (
        *(keys.policy(), keys.stage(), keys.rally(0)),
        *(key for i in ids for key in (keys.rollout(i), keys.report(i))),
        *(key for role in ROLES for i in ids for key in (keys.ctl(role, i), keys.status(role, i))),
        f"{PREFIX}/another-run/policy",
        "anything/else",
    )


def wide(keys: Keys) -> tuple[str, ...]:
    """Return expressions that match keys of others."""
    return (
        "**",
        keys.everything(),
        keys.every_rollout(),
        keys.every_report(),
        keys.every_ctl(),
        keys.every_status(),
    )


def trials(keys: Keys, id_: str) -> Iterator[Trial]:
    """Yield every verb on every kind of key."""
    for verb in ("publish", "subscribe", "ask", "answer"):
        for key in keys_to_try(keys, id_):
            yield verb, key
    for verb, incarnation in (("show", 1), ("watch", 2)):
        for role in ROLES:
            for i in (id_, OTHER):
                yield verb, keys.alive(role, i, incarnation)


def allowed(rights: Rights, trial: Trial) -> bool:
    """Return whether a trial is within these rights."""
    verb, key = trial
    return any(matches(expression, key) for expression in getattr(rights, verb))


@dataclass(slots=True)
class Stage:
    """A hub and two sessions of one certificate: one that speaks, and one that hears."""

    hub: Transport
    speaker: zenoh.Session
    hearer: Transport
    keys: Keys
    id: str
    tried: tuple[Trial, ...]
    passed: set[Trial] = field(default_factory=set)
    answered: set[str] = field(default_factory=set)  # keys whose requests got the hub's answer
    asked: list[tuple[str, PendingReply]] = field(default_factory=list)  # by the hub

    def note(self, key: str, reply: zenoh.Reply) -> None:
        """Record the hub's answer to a request. A thread of Zenoh calls it."""
        if reply.ok is not None and reply.ok.payload.to_bytes() == HUB:
            self.answered.add(key)

    def of(self, verb: str) -> list[str]:
        """Return the keys that a verb is tried on."""
        return [key for tried, key in self.tried if tried == verb]


def open_stage(
    hub: Transport,
    speak: Callable[[], zenoh.Session],
    hear: Callable[[], Transport],
    keys: Keys,
    id_: str,
    rights: Rights,
    stack: ExitStack,
) -> tuple[Stage, Callable[[], None]]:
    """Return a stage with all declarations, and what reads all that has arrived. ``stack`` closes it."""
    tried = tuple(sorted(trials(keys, id_), key=lambda trial: allowed(rights, trial)))
    speaker, hearer = stack.enter_context(closing(speak())), stack.enter_context(closing(hear()))
    stage = Stage(hub, speaker, hearer, keys, id_, tried)
    at_hub, asked_hub = hub.subscribe("**", CAPACITY), hub.serve("**", CAPACITY)
    tokens = hub.watch_alive("**")
    for held in (at_hub, asked_hub, tokens):
        stack.enter_context(closing(held))
    heard = [hearer.subscribe(key, CAPACITY) for key in (*wide(keys), *stage.of("subscribe"))]
    served = [hearer.serve(key, CAPACITY) for key in (*wide(keys), *stage.of("answer"))]
    watched = [hearer.watch_alive(key) for key in ("**", *stage.of("watch"))]
    tokens_of_it = [speaker.liveliness().declare_token(key) for key in stage.of("show")]
    stack.callback(tokens_of_it.clear)  # a token stands as long as it has a reference
    for key in stage.of("watch"):
        stack.enter_context(closing(hub.declare_alive(key)))

    def read() -> None:
        passed = stage.passed
        passed.update(("publish", sample.key) for sample in at_hub.poll() if sample.payload != HUB)
        passed.update(("ask", key) for key in _take(asked_hub, theirs=True))
        passed.update(("show", event.key) for event in tokens.poll() if event.alive)
        for subscription in heard:
            passed.update(
                ("subscribe", sample.key) for sample in subscription.poll() if sample.payload == HUB
            )
        for server in served:
            passed.update(("answer", key) for key in _take(server, theirs=False))
        for watch in watched:
            passed.update(("watch", event.key) for event in watch.poll() if event.alive)
        for key, pending in stage.asked:
            if isinstance(pending.poll(), Reply):
                stage.passed.add(("answer", key))

    return stage, read


def _take(server: Server, *, theirs: bool) -> Iterator[str]:
    """Answer the requests of the other side, refuse the own ones, and yield the keys of those that were answered."""
    for request in server.waiting(CAPACITY):
        if (request.payload != HUB) == theirs:
            request.reply(HUB if theirs else b"theirs")
            yield request.key
        else:
            request.refuse()


def say_all(stage: Stage) -> None:
    """Send everything once, from both sides."""
    for key in (*wide(stage.keys), *stage.of("publish")):
        stage.speaker.put(key, b"theirs")
    for key in (*wide(stage.keys), *stage.of("ask")):
        stage.speaker.get(
            key, Callback(partial(stage.note, key), indirect=False), payload=b"theirs", timeout=ASK_S
        )
    for key in stage.of("subscribe"):
        stage.hub.publish(key, HUB, Flow.CONTROL)
    for key in stage.of("answer"):
        stage.asked.append((key, stage.hub.request(key, HUB, ASK_S, Flow.CONTROL)))


def try_all(
    hub: Transport,
    speak: Callable[[], zenoh.Session],
    hear: Callable[[], Transport],
    keys: Keys,
    id_: str,
    rights: Rights,
) -> tuple[set[Trial], set[Trial]]:
    """Return what was tried with a certificate, and what passed.

    Args:
        hub: The hub.
        speak: Opens a session with the certificate that sends without any check of its own.
        hear: Opens another one.
        keys: Of the run.
        id_: Of the certificate.
        rights: What should pass: the trials end when all of it has passed twice.

    Raises:
        ReportedError: Something that is allowed did not pass.
    """
    with ExitStack() as stack:
        stage, read = open_stage(hub, speak, hear, keys, id_, rights, stack)
        wanted = {trial for trial in stage.tried if allowed(rights, trial)}
        passed: set[Trial] = set()
        for _ in range(2):  # the declarations are known in the second round
            stage.answered.clear()
            passed |= stage.passed
            stage.passed -= {trial for trial in stage.passed if trial[0] not in ("show", "watch")}
            deadline, times = time.monotonic() + WITHIN_S, 0
            while True:
                say_all(stage)
                time.sleep(PAUSE_S)
                read()
                times += 1
                missing = wanted - stage.passed
                missing |= {
                    ("ask", key) for verb, key in wanted if verb == "ask" and key not in stage.answered
                }
                if not missing and times >= (1 if wanted else UNANSWERED):
                    break
                if time.monotonic() > deadline:
                    raise ReportedError(f"allowed, and yet not passed: {sorted(missing)}")
        return set(stage.tried), passed | stage.passed

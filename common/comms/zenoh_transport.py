"""The transport over Zenoh. Only this file imports it.

The topology is a star: one hub (the learner's session, or a site's router) listens, and all others are its clients.
The code works around these properties of Zenoh, all of them measured:

* A full Zenoh channel blocks one of the two receiving threads of the process. So callbacks fill `Mailbox` rings,
  which never block, and there are 8 threads.
* A callback on its own Python thread prevents the process from exiting. A direct callback has no thread.
* `zenoh.open` can't be interrupted. So it is called in a loop, with a short time-out.
* A session inherited by a fork discards everything without an error. So the process id is checked.
* Callbacks continue for a moment after a queryable is undeclared. So a server's mailbox is closed too. A request
  that is inside Zenoh at that moment is lost (6 of 9,000 sent while their server closed) and times out.
* `close` waits for a hung hub. So it runs on a thread of its own, which may outlive the call.
* An answer may wait 50 ms for a client that hangs. So large ones are sent by a thread of their own, at most
  `_ANSWERS_WAITING` at a time; the hub's settings bound the wait.
* A link may stand although nothing comes back. So a session whose requests time out in a row is opened again.
* A refused certificate looks like a hub that is not there. So a client then opens a TLS link of its own to learn why.
"""

import json
import logging
import os
import queue
import re
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

import zenoh
from zenoh.handlers import Callback

from common.comms.budgets import LONGEST_ID, one_line
from common.comms.certificates import checked, names_in, refusal, speaks_tls, valid_until
from common.comms.mailbox import Bell, Mailbox
from common.comms.roles import access_control
from common.comms.transport import (
    MAX_ALIVE_EVENTS,
    AliveEvent,
    AliveWatch,
    Flow,
    NoReply,
    PendingReply,
    Reply,
    Request,
    Sample,
    Server,
    Subscription,
    TransportError,
    Unanswered,
    check_size,
    is_stuck,
)
from common.comms.zenoh_config import Security, ZenohConfig, session_settings

log = logging.getLogger(__name__)

# Zenoh reads this when it opens its first session, not when it is imported.
os.environ.setdefault(
    "ZENOH_RUNTIME", "(rx: (worker_threads: 8), app: (worker_threads: 2), net: (worker_threads: 2))"
)

_OPEN_ATTEMPT_S: Final = 2.0
_WAITING_LOG_S: Final = 10.0
_MIB: Final = 1024 * 1024
_LARGE_ANSWER: Final = 64 * 1024  # [bytes] from here on the thread for answers sends it
_ANSWERS_WAITING: Final = 32  # large ones; more are refused, and their clients ask again
_CLOSE_OLD_S: Final = 2.0
_STRANGERS_LOGGED: Final = 20


@dataclass(frozen=True, slots=True)
class _Service:
    """How Zenoh treats one flow."""

    priority: zenoh.Priority
    express: bool = False  # sent at once, not in a batch with later messages


_SERVICES: Final = {
    Flow.POLICY: _Service(zenoh.Priority.DATA_HIGH),
    Flow.STAGE: _Service(zenoh.Priority.INTERACTIVE_HIGH, express=True),
    Flow.ROLLOUT: _Service(zenoh.Priority.DATA),
    Flow.RALLY: _Service(zenoh.Priority.DATA_LOW),
    Flow.CONTROL: _Service(zenoh.Priority.INTERACTIVE_HIGH, express=True),
    Flow.STATUS: _Service(zenoh.Priority.BACKGROUND),
}


def open_zenoh(
    config: ZenohConfig, stop: threading.Event | None = None, *, name: str = "", run: str = ""
) -> "ZenohTransport":
    """Return an open transport. A client waits for its hub, at most ``connect_timeout_s`` or until ``stop``.

    Args:
        config: Where the hub is.
        stop: Ends the wait.
        name: With TLS, the name of the certificate to use, such as ``actor-0``.
        run: With TLS, the run whose access rules a hub applies.

    Raises:
        TransportError: The hub's port is taken, no hub answered in time, or one side refuses the other's certificate.
        CertificateError: The own certificate can't be used.
    """
    security = _security(config, name, run) if config.tls else None
    if config.mode == "hub":
        try:
            return _opened(config, security, _OPEN_ATTEMPT_S)
        except zenoh.ZError as error:
            reason = _reason(error)
            advice = (
                "stop the learner that listens there, or choose another endpoint"
                if "in use" in reason
                else "allowed: an address of this machine, and a port that may be served"
            )
            raise TransportError(f"can't listen at {config.endpoint}: {reason}; {advice}") from error
    started = time.monotonic()
    next_log = started
    while True:
        now = time.monotonic()
        left = started + config.connect_timeout_s - now
        if stop is not None and stop.is_set():
            raise TransportError(f"stopped while waiting for the hub at {config.endpoint}")
        if left <= 0:
            raise TransportError(
                f"no hub answered at {config.endpoint} in {now - started:.0f} s: "
                "start the learner (python -m services.learner) or correct the endpoint"
                + (", or start the learner with --tls too" if security else "")
            )
        if now >= next_log:
            log.info("waiting for the hub endpoint=%s waited_s=%.0f", config.endpoint, now - started)
            next_log = now + _WAITING_LOG_S
        try:
            return _opened(config, security, min(left, _OPEN_ATTEMPT_S))
        except zenoh.ZError as error:
            log.debug("no hub yet endpoint=%s reason=%s", config.endpoint, _reason(error))
        if why := _refusal(config, security):
            raise TransportError(f"no link to the hub at {config.endpoint}: {why}")


def _security(config: ZenohConfig, name: str, run: str) -> Security:
    files = checked(config.tls, name)
    log.info("link secured certificate=%s valid_until=%s", files.certificate, valid_until(files.certificate))
    if config.mode == "client":
        return Security(files)
    admitted = names_in(config.tls)
    return Security(files, admitted, access_control(admitted, run))


def _refusal(config: ZenohConfig, security: Security | None) -> str:
    """Return why the hub that listens at the endpoint is no hub for this client, or ""."""
    if security is not None:
        return one_line(refusal(config.endpoint, security.files))
    if config.endpoint.startswith("tcp/") and speaks_tls(config.endpoint):
        return "it wants TLS; give an endpoint tls/... and --tls DIR"
    return ""


def _opened(config: ZenohConfig, security: Security | None, attempt_s: float) -> "ZenohTransport":
    session = zenoh.open(_zenoh_config(config, security, attempt_s))
    return ZenohTransport(session, config, security)


def _zenoh_config(config: ZenohConfig, security: Security | None, attempt_s: float) -> zenoh.Config:
    settings = zenoh.Config()
    for path, value in session_settings(config, attempt_s, security).items():
        try:
            settings.insert_json5(path, json.dumps(value))
        except zenoh.ZError as error:
            raise TransportError(f"Zenoh refuses {path} = {value!r}: {_reason(error)}") from error
    return settings


def _reason(error: zenoh.ZError) -> str:
    """Return the innermost cause that the first line of Zenoh's message names, without source positions."""
    first = str(error).splitlines()[0].split(" at /")[0]
    return re.sub(r"^.*\[\S+: | \(os error \d+\)$", "", first)


@dataclass(slots=True, eq=False)
class _Entity:
    """A declaration, which a new session repeats."""

    declare: Callable[[zenoh.Session], Any]
    handle: Any
    watch: AliveWatch | None = None


@dataclass(frozen=True, slots=True)
class _ZenohToken:
    close: Callable[[], None]


class ZenohTransport:
    """One service's session. `Transport` documents its methods."""

    def __init__(self, session: zenoh.Session, config: ZenohConfig, security: Security | None = None) -> None:
        self._session = session
        self._config = config
        self._security = security
        self._process = os.getpid()
        self._is_closed = False
        self._bell = Bell()
        self._publishers: dict[tuple[str, Flow], zenoh.Publisher] = {}
        self._own_tokens: set[str] = set()
        self._entities: list[
            _Entity
        ] = []  # in order of declaration; also Zenoh undeclares what has no reference
        self._answers: queue.SimpleQueue[tuple[zenoh.Query, bytes]] | None = None
        self._unanswered = Unanswered()
        self._links: dict[str, bool] = {}
        self._times_up = 0
        self._strangers: set[str] = set()
        self._link_events: Mailbox[tuple[str, bool]] = Mailbox(self._bell, MAX_ALIVE_EVENTS, keep="newest")
        self._declare("watch the links", self._watch_links)

    @property
    def connected(self) -> bool:
        """Whether the hub is reachable now. For a hub it always is."""
        self._update_links()
        return not self._is_closed and (self._config.mode == "hub" or any(self._links.values()))

    @property
    def reconnect_count(self) -> int:
        """How often the link to the hub was restored; 0 for a hub."""
        self._update_links()
        return 0 if self._config.mode == "hub" else max(0, self._times_up - 1)

    def publish(self, key: str, payload: bytes, flow: Flow) -> None:
        """Send to all current subscribers. Never waits for a slow receiver, and does not report loss."""
        check_size(key, payload, self._config.max_message_mib * _MIB)
        with self._zenoh(f"publish on {key}"):
            self._publisher(key, flow).put(payload)

    def matching(self, key: str, flow: Flow) -> bool:
        """Return whether ``key`` has a subscriber now."""
        with self._zenoh(f"look for subscribers of {key}"):
            # a MatchingStatus, though Zenoh's type stub declares bool
            status: Any = self._publisher(key, flow).matching_status
            return bool(status.matching)

    def subscribe(self, key_expr: str, capacity: int) -> Subscription:
        """Return a subscription that holds the newest ``capacity`` samples."""
        inbox: Mailbox[zenoh.Sample] = Mailbox(self._bell, capacity, keep="newest")

        def receive(sample: zenoh.Sample) -> None:
            inbox.put(sample, len(sample.payload))

        entity = self._declare(
            f"subscribe to {key_expr}",
            lambda session: session.declare_subscriber(key_expr, Callback(receive, indirect=False)),
        )
        return Subscription(inbox, _read_sample, partial(self._undeclare, entity))

    def serve(self, key_expr: str, capacity: int) -> Server:
        """Return a server that holds up to ``capacity`` waiting requests."""
        inbox: Mailbox[zenoh.Query] = Mailbox(self._bell, capacity, keep="oldest")

        def receive(query: zenoh.Query) -> None:
            if not inbox.put(query, 0 if query.payload is None else len(query.payload)):
                _answer(query, None)

        entity = self._declare(
            f"serve {key_expr}",
            lambda session: session.declare_queryable(key_expr, Callback(receive, indirect=False)),
        )
        return Server(inbox, self._read_query, partial(self._undeclare, entity))

    def request(self, key: str, payload: bytes, timeout_s: float, flow: Flow) -> PendingReply:
        """Send a request to one server of ``key``; return its pending reply.

        A hung hub can block the caller of a large request for at most 15 s. Then the link is closed.
        """
        check_size(key, payload, self._config.max_message_mib * _MIB)
        pending = PendingReply(self._bell, timeout_s)
        service = _SERVICES[flow]
        with self._zenoh(f"ask {key}"):
            self._session.get(
                key,
                Callback(
                    partial(self._settle, pending), partial(pending.settle, NoReply.NO_SERVER), indirect=False
                ),
                target=zenoh.QueryTarget.BEST_MATCHING,
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=timeout_s,
                # BLOCK: one client, one server, one reply each; the reply inherits it
                congestion_control=zenoh.CongestionControl.BLOCK,
                priority=service.priority,
                express=service.express,
                payload=payload,
            )
        return pending

    def declare_alive(self, key: str) -> _ZenohToken:
        """Return a token that the others see until it or this transport is closed."""
        entity = self._declare(f"declare {key}", lambda session: session.liveliness().declare_token(key))
        self._own_tokens.add(key)
        return _ZenohToken(partial(self._undeclare, entity))

    def watch_alive(self, key_expr: str) -> AliveWatch:
        """Return a watch on tokens. Its first events are the tokens that exist already."""
        inbox: Mailbox[AliveEvent] = Mailbox(self._bell, MAX_ALIVE_EVENTS, keep="newest")

        def receive(sample: zenoh.Sample) -> None:
            inbox.put(AliveEvent(key=str(sample.key_expr), alive=sample.kind == zenoh.SampleKind.PUT))

        entity = self._declare(
            f"watch {key_expr}",
            lambda session: session.liveliness().declare_subscriber(
                key_expr, Callback(receive, indirect=False), history=True
            ),
        )
        entity.watch = AliveWatch(inbox, self._own_tokens.__contains__, lambda: self._undeclare(entity))
        return entity.watch

    def wait(self, timeout_s: float) -> bool:
        """Return whether anything arrived since the last call. Wait for it at most ``timeout_s``.

        A client whose requests time out in a row although its link is up opens its session again here.
        """
        if self._config.mode == "client" and is_stuck(self._unanswered, self.connected, time.monotonic()):
            self._reopen()
        return self._bell.wait(timeout_s)

    def close(self, timeout_s: float = 5.0) -> bool:
        """Flush and close the session; return whether it took less than ``timeout_s``."""
        if self._is_closed or os.getpid() != self._process:
            return True
        self._is_closed = True
        closer = threading.Thread(target=self._session.close, name="zenoh-close", daemon=True)
        closer.start()
        closer.join(timeout_s)
        if closer.is_alive():
            log.warning("close timed out endpoint=%s after_s=%.1f", self._config.endpoint, timeout_s)
        return not closer.is_alive()

    def _publisher(self, key: str, flow: Flow) -> zenoh.Publisher:
        if (key, flow) not in self._publishers:
            service = _SERVICES[flow]
            self._publishers[key, flow] = self._session.declare_publisher(
                key,
                # with BLOCK, one hung subscriber blocks the publisher and so all other subscribers
                congestion_control=zenoh.CongestionControl.DROP,
                priority=service.priority,
                express=service.express,
            )
        return self._publishers[key, flow]

    def _declare(self, action: str, declare: Callable[[zenoh.Session], Any]) -> _Entity:
        with self._zenoh(action):
            entity = _Entity(declare, declare(self._session))
        self._entities.append(entity)
        return entity

    def _undeclare(self, entity: _Entity) -> None:
        if not self._is_closed and entity in self._entities:
            self._entities.remove(entity)
            with self._zenoh("undeclare"):
                entity.handle.undeclare()

    def _reopen(self) -> None:
        """Replace the session by a new one with the same declarations; keep it if the hub does not answer."""
        unanswered, self._unanswered = self._unanswered, Unanswered()
        log.warning(
            "requests without answer count=%d on a live link endpoint=%s; opening the session again",
            unanswered.count,
            self._config.endpoint,
        )
        try:
            fresh = zenoh.open(_zenoh_config(self._config, self._security, _OPEN_ATTEMPT_S))
        except zenoh.ZError as error:
            log.warning("hub does not answer endpoint=%s reason=%s", self._config.endpoint, _reason(error))
            return
        closer = threading.Thread(target=self._session.close, name="zenoh-close", daemon=True)
        closer.start()  # its tokens end before the new ones are declared
        closer.join(_CLOSE_OLD_S)
        self._session = fresh
        self._publishers.clear()
        self._update_links()
        self._links.clear()
        for entity in self._entities:
            if entity.watch is not None:
                entity.watch.forget()
            entity.handle = entity.declare(fresh)

    def _read_query(self, query: zenoh.Query) -> Request:
        payload = b"" if query.payload is None else query.payload.to_bytes()
        return Request(str(query.key_expr), payload, partial(self._reply, query))

    def _reply(self, query: zenoh.Query, payload: bytes | None) -> None:
        if payload is None or len(payload) < _LARGE_ANSWER:
            _answer(query, payload)
            return
        if self._answers is None:
            self._answers = queue.SimpleQueue()
            work = partial(_send_answers, self._answers)
            threading.Thread(target=work, name="answers", daemon=True).start()
        if self._answers.qsize() >= _ANSWERS_WAITING:
            _answer(query, None)
        else:
            self._answers.put((query, payload))

    def _settle(self, pending: PendingReply, reply: zenoh.Reply) -> None:
        # All error replies are Zenoh's own: its time-out.
        if reply.ok is None:
            pending.settle(NoReply.TIMEOUT)
            before = self._unanswered
            self._unanswered = Unanswered(
                before.count + 1, before.since if before.count else time.monotonic()
            )
        else:
            pending.settle(Reply(reply.ok.payload.to_bytes()))
            self._unanswered = Unanswered()

    def _watch_links(self, session: zenoh.Session) -> Any:
        listener = Callback(self._record_link_event, indirect=False)
        return session.info.declare_transport_events_listener(listener, history=True)

    @contextmanager
    def _zenoh(self, action: str) -> Iterator[None]:
        """Turn Zenoh's errors into one line, and raise where Zenoh fails without an error."""
        if self._is_closed:
            raise TransportError(f"can't {action}: this transport is closed")
        if os.getpid() != self._process:
            raise TransportError(
                f"can't {action}: the session belongs to process {self._process} and does not survive "
                "a fork; start processes with the spawn method and open a transport in each"
            )
        try:
            yield
        except zenoh.ZError as error:
            raise TransportError(f"can't {action} at {self._config.endpoint}: {_reason(error)}") from error

    def _record_link_event(self, event: zenoh.TransportEvent) -> None:
        self._link_events.put((str(event.transport.zid), event.kind == zenoh.SampleKind.PUT))

    def _update_links(self) -> None:
        for peer, up in self._link_events.take_all():
            self._times_up += up
            self._links[peer] = up
            if up and self._security is not None and self._security.access_control is not None:
                self._name_strangers(self._security.admitted)

    def _name_strangers(self, admitted: tuple[str, ...]) -> None:
        """Log, once for each name, which linked certificates the hub does not know."""
        for link in self._session.info.links():
            name = one_line(str(link.auth_identifier or ""), LONGEST_ID)
            if name in admitted or name in self._strangers or len(self._strangers) >= _STRANGERS_LOGGED:
                continue
            self._strangers.add(name)
            log.warning(
                "certificate %r is not in the folder %s: its owner may do nothing", name, self._config.tls
            )


def _read_sample(sample: zenoh.Sample) -> Sample:
    return Sample(key=str(sample.key_expr), payload=sample.payload.to_bytes())


def _send_answers(answers: "queue.SimpleQueue[tuple[zenoh.Query, bytes]]") -> None:
    """Send large answers one after the other, as long as the process lives."""
    while True:
        _answer(*answers.get())


def _answer(query: zenoh.Query, payload: bytes | None) -> None:
    try:
        if payload is not None:
            query.reply(query.key_expr, payload)
    except zenoh.ZError as error:
        key = one_line(str(query.key_expr))  # a peer's text
        log.debug("reply not sent, the client has left key=%s reason=%s", key, _reason(error))
    finally:
        query.drop()  # type: ignore[no-untyped-call]  # ends the query; without it the client waits for its time-out

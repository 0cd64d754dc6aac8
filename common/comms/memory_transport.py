"""The transport between services of one process, with a hub that can go away and links that can be cut.

Not a mock: tests and single-process runs use it, and the contract suite holds it to what Zenoh does. In
particular a client without a link loses its puts in silence, gets NO_SERVER at once and sees all tokens go.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from threading import RLock
from typing import TypeVar

from common.comms.keys import matches
from common.comms.transport import (
    MAX_ALIVE_EVENTS,
    MAX_MESSAGE_BYTES,
    AliveEvent,
    AliveWatch,
    Bell,
    Flow,
    Mailbox,
    NoReply,
    PendingReply,
    Reply,
    Request,
    Sample,
    Server,
    Subscription,
    TransportError,
    check_size,
)


@dataclass(slots=True, eq=False)
class _Declared:
    """Something that one transport declared on a key expression."""

    owner: "MemoryTransport"
    key_expr: str


@dataclass(slots=True, eq=False)
class _Subscriber(_Declared):
    inbox: Mailbox[Sample]


@dataclass(slots=True, eq=False)
class _Servant(_Declared):
    inbox: Mailbox["_Question"]


@dataclass(slots=True, eq=False)
class _Token(_Declared):
    pass


@dataclass(slots=True, eq=False)
class _Watcher(_Declared):
    inbox: Mailbox[AliveEvent]
    seen: set[str] = field(default_factory=set)


@dataclass(slots=True, eq=False)
class _Question:
    """A request on its way between two transports."""

    asker: "MemoryTransport"
    servant: _Servant
    key: str
    payload: bytes
    pending: PendingReply


@dataclass(slots=True)
class _Link:
    """Whether a transport is tied to the hub, and how often it came back."""

    is_cut: bool = False
    up: bool = False
    times_up: int = 0


_Kind = TypeVar("_Kind", bound=_Declared)


class MemoryBroker:
    """What the transports of one process share. The first `open` must be the hub, as with processes."""

    def __init__(self) -> None:
        self._lock = RLock()
        self._hub: MemoryTransport | None = None
        self._links: dict[MemoryTransport, _Link] = {}
        self._declared: list[_Declared] = []
        self._questions: list[_Question] = []

    def open(self, *, hub: bool = False, max_message_bytes: int = MAX_MESSAGE_BYTES) -> "MemoryTransport":
        """Return a new transport. Raises TransportError for a second hub, or a client without a hub."""
        with self._lock:
            if hub and self._hub is not None:
                raise TransportError("the broker has a hub already: close it before another is opened")
            if not hub and self._hub is None:
                raise TransportError("the broker has no hub: open one with hub=True first")
            transport = MemoryTransport(self, max_message_bytes)
            self._links[transport] = _Link()
            if hub:
                self._hub = transport
            self._settle()
            return transport

    def cut(self, transport: "MemoryTransport") -> None:
        """Break the link of one client, as a network or a frozen process would."""
        with self._lock:
            self._links[transport].is_cut = True
            self._settle()

    def mend(self, transport: "MemoryTransport") -> None:
        """Bring the link of one client back."""
        with self._lock:
            self._links[transport].is_cut = False
            self._settle()

    # What follows is the transports' side of it.

    def leave(self, transport: "MemoryTransport") -> None:
        """Take a transport and all it declared out."""
        with self._lock:
            if self._hub is transport:
                self._hub = None
            self._links.pop(transport, None)
            self._declared = [entry for entry in self._declared if entry.owner is not transport]
            self._settle()

    def link(self, transport: "MemoryTransport") -> _Link:
        """Return the state of a transport's link; a closed one's is down."""
        with self._lock:
            return self._links.get(transport, _Link())

    def declare(self, entry: _Declared) -> None:
        """Make something reachable for the others."""
        with self._lock:
            self._declared.append(entry)
            self._settle()

    def withdraw(self, entry: _Declared) -> None:
        """Undo `declare`; twice is allowed."""
        with self._lock:
            self._declared = [other for other in self._declared if other is not entry]
            self._settle()

    def subscribers(self, transport: "MemoryTransport", key: str) -> list[_Subscriber]:
        """Return who would get a put of ``transport`` on ``key`` now."""
        with self._lock:
            return list(self._reachable(_Subscriber, transport, key))

    def put(self, transport: "MemoryTransport", sample: Sample) -> None:
        """Deliver a put to whoever subscribes now."""
        with self._lock:
            for entry in self._reachable(_Subscriber, transport, sample.key):
                entry.inbox.put(sample)

    def ask(self, transport: "MemoryTransport", key: str, payload: bytes, pending: PendingReply) -> None:
        """Hand a request to one server of ``key``, or end it."""
        with self._lock:
            servant = next(self._reachable(_Servant, transport, key), None)
            if servant is None:
                pending.settle(NoReply.NO_SERVER)
                return
            question = _Question(transport, servant, key, payload, pending)
            self._questions.append(question)
            if not servant.inbox.put(question):
                self.answer(question, None)

    def answer(self, question: _Question, payload: bytes | None) -> None:
        """End a request: with an answer, or without one."""
        with self._lock:
            if question in self._questions:  # else its link broke meanwhile, and it has ended
                self._questions.remove(question)
                question.pending.settle(NoReply.NO_SERVER if payload is None else Reply(payload))

    def _reach(self, a: "MemoryTransport", b: "MemoryTransport") -> bool:
        return a in self._links and b in self._links and (a is b or (self._links[a].up and self._links[b].up))

    def _reachable(self, kind: type[_Kind], transport: "MemoryTransport", key: str) -> Iterator[_Kind]:
        for entry in self._declared:
            if not isinstance(entry, kind) or not matches(entry.key_expr, key):
                continue
            if self._reach(transport, entry.owner):
                yield entry

    def _settle(self) -> None:
        """Bring everybody up to date after any change: links, tokens in sight, requests under way."""
        for link in self._links.values():
            up = self._hub is not None and not link.is_cut
            link.times_up += up and not link.up
            link.up = up
        tokens = [entry for entry in self._declared if isinstance(entry, _Token)]
        for watcher in [entry for entry in self._declared if isinstance(entry, _Watcher)]:
            in_sight = {
                token.key_expr
                for token in tokens
                if matches(watcher.key_expr, token.key_expr) and self._reach(watcher.owner, token.owner)
            }
            for key in sorted(in_sight ^ watcher.seen):
                watcher.inbox.put(AliveEvent(key=key, alive=key in in_sight))
            watcher.seen = in_sight
        for question in list(self._questions):
            servant = question.servant
            if servant not in self._declared or not self._reach(question.asker, servant.owner):
                self.answer(question, None)


@dataclass(frozen=True, slots=True)
class _MemoryToken:
    close: Callable[[], None]


class MemoryTransport:
    """One service's connection to a `MemoryBroker`; `Transport` says what its methods promise."""

    def __init__(self, broker: MemoryBroker, max_message_bytes: int) -> None:
        self._broker = broker
        self._max_message_bytes = max_message_bytes
        self._bell = Bell()
        self._own_tokens: set[str] = set()
        self._is_closed = False

    @property
    def connected(self) -> bool:
        """Whether the hub is reachable now."""
        return self._broker.link(self).up

    @property
    def reconnect_count(self) -> int:
        """How often the link came back."""
        return max(0, self._broker.link(self).times_up - 1)

    def publish(self, key: str, payload: bytes, flow: Flow) -> None:
        """Send to whoever subscribes now."""
        self._check_open()
        check_size(key, payload, self._max_message_bytes)
        self._broker.put(self, Sample(key=key, payload=payload))

    def matching(self, key: str, flow: Flow) -> bool:
        """Return whether somebody subscribes to ``key`` now."""
        self._check_open()
        return bool(self._broker.subscribers(self, key))

    def subscribe(self, key_expr: str, capacity: int) -> Subscription:
        """Return a subscription that holds the newest ``capacity`` samples."""
        self._check_open()
        entry = _Subscriber(self, key_expr, Mailbox(self._bell, capacity, keep="newest"))
        self._broker.declare(entry)
        return Subscription(entry.inbox, lambda sample: sample, partial(self._broker.withdraw, entry))

    def serve(self, key_expr: str, capacity: int) -> Server:
        """Return a server that holds up to ``capacity`` waiting requests."""
        self._check_open()
        entry = _Servant(self, key_expr, Mailbox(self._bell, capacity, keep="oldest"))
        self._broker.declare(entry)
        return Server(entry.inbox, self._take_request, partial(self._broker.withdraw, entry))

    def request(self, key: str, payload: bytes, timeout_s: float, flow: Flow) -> PendingReply:
        """Return a request on its way to one server of ``key``."""
        self._check_open()
        check_size(key, payload, self._max_message_bytes)
        pending = PendingReply(self._bell, timeout_s)
        self._broker.ask(self, key, payload, pending)
        return pending

    def declare_alive(self, key: str) -> _MemoryToken:
        """Return a token that others see while this transport lives."""
        self._check_open()
        entry = _Token(self, key)
        self._own_tokens.add(key)
        self._broker.declare(entry)
        return _MemoryToken(partial(self._broker.withdraw, entry))

    def watch_alive(self, key_expr: str) -> AliveWatch:
        """Return a watch on tokens; it starts with those that are there."""
        self._check_open()
        entry = _Watcher(self, key_expr, Mailbox(self._bell, MAX_ALIVE_EVENTS, keep="newest"))
        self._broker.declare(entry)
        return AliveWatch(entry.inbox, self._own_tokens.__contains__, partial(self._broker.withdraw, entry))

    def wait(self, timeout_s: float) -> bool:
        """Return whether anything arrived since the last call, at the latest after ``timeout_s``."""
        return self._bell.wait(timeout_s)

    def close(self, timeout_s: float = 5.0) -> bool:
        """Return True: all is closed."""
        self._is_closed = True
        self._broker.leave(self)
        return True

    def _take_request(self, question: _Question) -> Request:
        return Request(question.key, question.payload, partial(self._broker.answer, question))

    def _check_open(self) -> None:
        if self._is_closed:
            raise TransportError("this transport is closed")

"""The transport between services of one process, with a hub that can close and links that can be cut.

It is not a mock: tests and single-process runs use it, and the contract suite requires the same behaviour as from
Zenoh. For example, without a link a client loses its puts without an error, gets NO_SERVER at once and sees all
tokens end.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from threading import RLock
from typing import TypeVar

from common.comms.budgets import LARGEST
from common.comms.keys import matches
from common.comms.mailbox import Bell, Mailbox
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
    check_size,
)


@dataclass(slots=True, eq=False)
class _Declared:
    """A declaration of one transport on a key expression."""

    owner: "MemoryTransport"
    key_expr: str


@dataclass(slots=True, eq=False)
class _Subscriber(_Declared):
    inbox: Mailbox[Sample]


@dataclass(slots=True, eq=False)
class _Queryable(_Declared):
    inbox: Mailbox["_Query"]


@dataclass(slots=True, eq=False)
class _Token(_Declared):
    pass


@dataclass(slots=True, eq=False)
class _Watcher(_Declared):
    inbox: Mailbox[AliveEvent]
    alive: set[str] = field(default_factory=set)


@dataclass(slots=True, eq=False)
class _Query:
    """A request in progress between two transports."""

    client: "MemoryTransport"
    queryable: _Queryable
    key: str
    payload: bytes
    pending: PendingReply


@dataclass(slots=True)
class _Link:
    """Whether a transport is connected to the hub, and how often it connected."""

    is_cut: bool = False
    up: bool = False
    times_up: int = 0


_Kind = TypeVar("_Kind", bound=_Declared)


class MemoryBroker:
    """The state that the transports of one process share. The first `open` must be the hub, as with processes."""

    def __init__(self) -> None:
        self._lock = RLock()
        self._hub: MemoryTransport | None = None
        self._links: dict[MemoryTransport, _Link] = {}
        self._declared: list[_Declared] = []
        self._queries: list[_Query] = []

    def open(self, *, hub: bool = False, max_message_bytes: int = LARGEST) -> "MemoryTransport":
        """Return a new transport. Raises TransportError for a second hub, or a client without a hub."""
        with self._lock:
            if hub and self._hub is not None:
                raise TransportError("the broker has a hub already: close it before you open another")
            if not hub and self._hub is None:
                raise TransportError("the broker has no hub: open one with hub=True first")
            transport = MemoryTransport(self, max_message_bytes)
            self._links[transport] = _Link()
            if hub:
                self._hub = transport
            self._update()
            return transport

    def cut(self, transport: "MemoryTransport") -> None:
        """Break the link of one client, as a network failure or a hung process does."""
        with self._lock:
            self._links[transport].is_cut = True
            self._update()

    def mend(self, transport: "MemoryTransport") -> None:
        """Restore the link of one client."""
        with self._lock:
            self._links[transport].is_cut = False
            self._update()

    # Only transports call the methods that follow.

    def leave(self, transport: "MemoryTransport") -> None:
        """Remove a transport and all its declarations."""
        with self._lock:
            if self._hub is transport:
                self._hub = None
            self._links.pop(transport, None)
            self._declared = [entry for entry in self._declared if entry.owner is not transport]
            self._update()

    def link(self, transport: "MemoryTransport") -> _Link:
        """Return the state of a transport's link. The link of a closed transport is down."""
        with self._lock:
            return self._links.get(transport, _Link())

    def declare(self, entry: _Declared) -> None:
        """Add a declaration, so that the others reach it."""
        with self._lock:
            self._declared.append(entry)
            self._update()

    def withdraw(self, entry: _Declared) -> None:
        """Remove a declaration. A second call has no effect."""
        with self._lock:
            self._declared = [other for other in self._declared if other is not entry]
            self._update()

    def subscribers(self, transport: "MemoryTransport", key: str) -> list[_Subscriber]:
        """Return the subscribers that a put of ``transport`` on ``key`` reaches now."""
        with self._lock:
            return list(self._reachable(_Subscriber, transport, key))

    def put(self, transport: "MemoryTransport", sample: Sample) -> None:
        """Deliver a put to all current subscribers."""
        with self._lock:
            for entry in self._reachable(_Subscriber, transport, sample.key):
                entry.inbox.put(sample, len(sample.payload))

    def request(self, transport: "MemoryTransport", key: str, payload: bytes, pending: PendingReply) -> None:
        """Give a request to one server of ``key``, or end it."""
        with self._lock:
            queryable = next(self._reachable(_Queryable, transport, key), None)
            if queryable is None:
                pending.settle(NoReply.NO_SERVER)
                return
            query = _Query(transport, queryable, key, payload, pending)
            self._queries.append(query)
            if not queryable.inbox.put(query, len(payload)):
                self.answer(query, None)

    def answer(self, query: _Query, payload: bytes | None) -> None:
        """End a request, with or without an answer."""
        with self._lock:
            if query in self._queries:  # if it is not there, its link broke before, and the request has ended
                self._queries.remove(query)
                query.pending.settle(NoReply.NO_SERVER if payload is None else Reply(payload))

    def _reach(self, a: "MemoryTransport", b: "MemoryTransport") -> bool:
        return a in self._links and b in self._links and (a is b or (self._links[a].up and self._links[b].up))

    def _reachable(self, kind: type[_Kind], transport: "MemoryTransport", key: str) -> Iterator[_Kind]:
        for entry in self._declared:
            if not isinstance(entry, kind) or not matches(entry.key_expr, key):
                continue
            if self._reach(transport, entry.owner):
                yield entry

    def _update(self) -> None:
        """Apply a change to links, visible tokens and requests in progress."""
        for link in self._links.values():
            up = self._hub is not None and not link.is_cut
            link.times_up += up and not link.up
            link.up = up
        tokens = [entry for entry in self._declared if isinstance(entry, _Token)]
        for watcher in [entry for entry in self._declared if isinstance(entry, _Watcher)]:
            visible = {
                token.key_expr
                for token in tokens
                if matches(watcher.key_expr, token.key_expr) and self._reach(watcher.owner, token.owner)
            }
            for key in sorted(visible ^ watcher.alive):
                watcher.inbox.put(AliveEvent(key=key, alive=key in visible))
            watcher.alive = visible
        for query in list(self._queries):
            queryable = query.queryable
            if queryable not in self._declared or not self._reach(query.client, queryable.owner):
                self.answer(query, None)


@dataclass(frozen=True, slots=True)
class _MemoryToken:
    close: Callable[[], None]


class MemoryTransport:
    """One service's connection to a `MemoryBroker`. `Transport` documents its methods."""

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
        """How often the link was restored."""
        return max(0, self._broker.link(self).times_up - 1)

    def publish(self, key: str, payload: bytes, flow: Flow) -> None:
        """Send to all current subscribers."""
        self._check_open()
        check_size(key, payload, self._max_message_bytes)
        self._broker.put(self, Sample(key=key, payload=payload))

    def matching(self, key: str, flow: Flow) -> bool:
        """Return whether ``key`` has a subscriber now."""
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
        entry = _Queryable(self, key_expr, Mailbox(self._bell, capacity, keep="oldest"))
        self._broker.declare(entry)
        return Server(entry.inbox, self._take_request, partial(self._broker.withdraw, entry))

    def request(self, key: str, payload: bytes, timeout_s: float, flow: Flow) -> PendingReply:
        """Send a request to one server of ``key``; return its pending reply."""
        self._check_open()
        check_size(key, payload, self._max_message_bytes)
        pending = PendingReply(self._bell, timeout_s)
        self._broker.request(self, key, payload, pending)
        return pending

    def declare_alive(self, key: str) -> _MemoryToken:
        """Return a token that the others see until it or this transport is closed."""
        self._check_open()
        entry = _Token(self, key)
        self._own_tokens.add(key)
        self._broker.declare(entry)
        return _MemoryToken(partial(self._broker.withdraw, entry))

    def watch_alive(self, key_expr: str) -> AliveWatch:
        """Return a watch on tokens. Its first events are the tokens that exist already."""
        self._check_open()
        entry = _Watcher(self, key_expr, Mailbox(self._bell, MAX_ALIVE_EVENTS, keep="newest"))
        self._broker.declare(entry)
        return AliveWatch(entry.inbox, self._own_tokens.__contains__, partial(self._broker.withdraw, entry))

    def wait(self, timeout_s: float) -> bool:
        """Return whether anything arrived since the last call. Wait for it at most ``timeout_s``."""
        return self._bell.wait(timeout_s)

    def close(self, timeout_s: float = 5.0) -> bool:
        """Close all declarations at once; return True."""
        self._is_closed = True
        self._broker.leave(self)
        return True

    def _take_request(self, query: _Query) -> Request:
        return Request(query.key, query.payload, partial(self._broker.answer, query))

    def _check_open(self) -> None:
        if self._is_closed:
            raise TransportError("this transport is closed")

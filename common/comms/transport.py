"""The one way services talk: puts, requests with an answer, and who is alive.

Two implementations keep these promises, and one contract suite holds both to them: ``memory_transport.py``
(several services in one process) and ``zenoh_transport.py`` (processes and machines).

* Nothing here runs a caller's code on another thread. What arrives is put into a bounded `Mailbox`; the
  thread that owns the service takes it out. A full mailbox drops and counts; it never holds up the network.
* A put promises nothing: it may be lost, and whoever was not subscribed never sees it.
* A request ends in exactly one outcome, and by its deadline: a `Reply`, or `NoReply` with the reason.
* After a broken link everything declared (subscriptions, servers, tokens) is declared again by itself;
  ``reconnect_count`` tells that something may have been missed meanwhile.
"""

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from threading import Condition
from typing import Any, Generic, Literal, Protocol, TypeVar

_Item = TypeVar("_Item")

MAX_MESSAGE_BYTES = 64 * 1024 * 1024  # one message may take this much memory at the receiver
MAX_ALIVE_EVENTS = 65536  # far above any fleet: an alive event must not be dropped


class TransportError(RuntimeError):
    """The transport can't do what was asked: one line that names the endpoint or key and what to do."""


class Flow(Enum):
    """What a message is for; each transport maps it to priority and behaviour under congestion."""

    POLICY = "policy"
    STAGE = "stage"
    ROLLOUT = "rollout"
    RALLY = "rally"
    CONTROL = "control"
    STATUS = "status"


@dataclass(frozen=True, slots=True)
class Sample:
    """One put as it arrived."""

    key: str
    payload: bytes


@dataclass(frozen=True, slots=True)
class AliveEvent:
    """A liveliness token that came into sight or went out of it (ended, crashed, hung or cut off)."""

    key: str
    alive: bool


@dataclass(frozen=True, slots=True)
class Reply:
    """The answer to a request."""

    payload: bytes


class NoReply(Enum):
    """Why a request ended without an answer."""

    TIMEOUT = "timeout"  # the server may or may not have seen the request
    NO_SERVER = "no server"  # nobody serves the key, its mailbox is full, it refused, or the link broke


Outcome = Reply | NoReply


class Bell:
    """Wakes the thread that owns a transport; one per transport, and the lock of all its mailboxes."""

    def __init__(self) -> None:
        self.lock = Condition()
        self._rings = 0
        self._heard = 0

    def ring(self) -> None:
        """Wake whoever waits. The lock must be held."""
        self._rings += 1
        self.lock.notify_all()

    def wait(self, timeout_s: float) -> bool:
        """Return whether it rang since the last call: what arrived between two calls is not slept over."""
        with self.lock:
            rang = self.lock.wait_for(lambda: self._rings != self._heard, timeout_s)
            self._heard = self._rings
            return rang


class Mailbox(Generic[_Item]):
    """A bounded queue between the network's threads and the thread that owns the service.

    Args:
        bell: Guards the queue and is rung at every arrival; one per transport.
        capacity: Most items held.
        keep: Which ones a full mailbox keeps. ``newest`` pushes the oldest out, so that a capacity of 1 means
            that the latest wins; ``oldest`` refuses the arrival.
    """

    def __init__(self, bell: Bell, capacity: int, keep: Literal["newest", "oldest"]) -> None:
        if capacity < 1:
            raise TransportError(f"capacity {capacity} of a mailbox; allowed: 1 and above")
        self._bell = bell
        self._capacity = capacity
        self._keep = keep
        self._items: deque[_Item] = deque()
        self._dropped = 0
        self._is_closed = False

    @property
    def dropped(self) -> int:
        """How many items were lost because the mailbox was full."""
        return self._dropped

    def put(self, item: _Item) -> bool:
        """Return whether ``item`` was taken in."""
        with self._bell.lock:
            if self._is_closed:
                return False
            if len(self._items) >= self._capacity:
                self._dropped += 1
                if self._keep == "oldest":
                    return False
                self._items.popleft()
            self._items.append(item)
            self._bell.ring()
            return True

    def take(self) -> _Item | None:
        """Return the oldest item, or None."""
        with self._bell.lock:
            return self._items.popleft() if self._items else None

    def take_all(self) -> list[_Item]:
        """Return everything that is waiting, oldest first."""
        with self._bell.lock:
            items = list(self._items)
            self._items.clear()
            return items

    def close(self) -> list[_Item]:
        """Take nothing in from now on; return everything that was waiting, oldest first."""
        with self._bell.lock:
            self._is_closed = True
            return self.take_all()

    def wait(self, timeout_s: float) -> bool:
        """Return whether something is waiting, as soon as it is or after ``timeout_s``."""
        with self._bell.lock:
            return self._bell.lock.wait_for(lambda: bool(self._items), timeout_s)


class Subscription:
    """The samples of one key expression that have arrived and not been taken."""

    def __init__(
        self, inbox: Mailbox[Any], read: Callable[[Any], Sample], undeclare: Callable[[], None]
    ) -> None:
        self._inbox = inbox
        self._read = read
        self._undeclare = undeclare

    @property
    def dropped(self) -> int:
        """How many samples were pushed out by newer ones before they were taken."""
        return self._inbox.dropped

    def poll(self) -> list[Sample]:
        """Return what has arrived, oldest first; never waits."""
        return [self._read(raw) for raw in self._inbox.take_all()]

    def wait(self, timeout_s: float) -> bool:
        """Return whether a sample is there, at the latest after ``timeout_s``."""
        return self._inbox.wait(timeout_s)

    def close(self) -> None:
        """Stop receiving."""
        self._undeclare()


class Request:
    """A question that waits for its answer, which may be given long after it was taken from the server."""

    __slots__ = ("_answer", "_ended", "key", "payload")

    def __init__(self, key: str, payload: bytes, answer: Callable[[bytes | None], None]) -> None:
        self.key = key
        self.payload = payload
        self._answer = answer
        self._ended = False

    def reply(self, payload: bytes) -> None:
        """Answer and end the request. An asker that has gone is no error; a second answer is."""
        self._end(payload)

    def refuse(self) -> None:
        """End the request without an answer: the asker gets NO_SERVER at once."""
        self._end(None)

    def _end(self, payload: bytes | None) -> None:
        if self._ended:
            raise TransportError(f"the request on {self.key} has been answered before")
        self._ended = True
        self._answer(payload)


class Server:
    """The requests on one key expression that have arrived and not been taken."""

    def __init__(
        self, inbox: Mailbox[Any], read: Callable[[Any], Request], undeclare: Callable[[], None]
    ) -> None:
        self._inbox = inbox
        self._read = read
        self._undeclare = undeclare

    @property
    def dropped(self) -> int:
        """How many requests were turned away because the mailbox was full."""
        return self._inbox.dropped

    def poll(self, timeout_s: float = 0.0) -> Request | None:
        """Return the oldest request that waits, or None after ``timeout_s``."""
        if timeout_s > 0.0:
            self._inbox.wait(timeout_s)
        raw = self._inbox.take()
        return None if raw is None else self._read(raw)

    def close(self) -> None:
        """Stop serving; requests that nobody took end with NO_SERVER, those included that are arriving now."""
        self._undeclare()
        for raw in self._inbox.close():
            self._read(raw).refuse()


class PendingReply:
    """A request on its way; ends in one outcome, by its deadline, whatever the network does."""

    def __init__(self, bell: Bell, timeout_s: float) -> None:
        self._bell = bell
        self._deadline = time.monotonic() + timeout_s
        self._outcome: Outcome | None = None

    def settle(self, outcome: Outcome) -> None:
        """End the request; the first outcome stands. Called by the transport."""
        with self._bell.lock:
            if self._outcome is None:
                self._outcome = outcome
                self._bell.ring()

    def poll(self) -> Outcome | None:
        """Return the outcome, or None while the request is on its way."""
        with self._bell.lock:
            if self._outcome is None and time.monotonic() >= self._deadline:
                self._outcome = NoReply.TIMEOUT
            return self._outcome

    def wait(self) -> Outcome:
        """Return the outcome, at the latest at the request's deadline."""
        with self._bell.lock:
            left_s = max(0.0, self._deadline - time.monotonic())
            self._bell.lock.wait_for(lambda: self._outcome is not None, left_s)
            if self._outcome is None:
                self._outcome = NoReply.TIMEOUT
            return self._outcome


class AliveWatch:
    """What changed about the tokens of one key expression; those of the own transport are left out."""

    def __init__(
        self, inbox: Mailbox[AliveEvent], is_own: Callable[[str], bool], undeclare: Callable[[], None]
    ) -> None:
        self._inbox = inbox
        self._is_own = is_own
        self._undeclare = undeclare
        self._alive: set[str] = set()

    def poll(self) -> list[AliveEvent]:
        """Return the changes since the last call, in order; tokens that were there before come first."""
        changes = []
        for event in self._inbox.take_all():
            if self._is_own(event.key) or (event.key in self._alive) == event.alive:
                continue
            (self._alive.add if event.alive else self._alive.discard)(event.key)
            changes.append(event)
        return changes

    def wait(self, timeout_s: float) -> bool:
        """Return whether an event is there, at the latest after ``timeout_s``."""
        return self._inbox.wait(timeout_s)

    def close(self) -> None:
        """Stop watching."""
        self._undeclare()


class AliveToken(Protocol):
    """Says that its owner is alive until it is closed, or the owner's process or link dies."""

    def close(self) -> None:
        """Take the token back."""


class Transport(Protocol):
    """One service's connection. Its methods belong to one thread; they raise TransportError."""

    @property
    def connected(self) -> bool:
        """Whether the hub is reachable now (always true for the hub itself)."""

    @property
    def reconnect_count(self) -> int:
        """How often a broken link came back; at a change, ask again for what may have been missed."""

    def publish(self, key: str, payload: bytes, flow: Flow) -> None:
        """Send to whoever subscribes now; never waits for a slow receiver, never tells about loss."""

    def matching(self, key: str, flow: Flow) -> bool:
        """Return whether somebody subscribes to ``key`` now, so that a publisher can idle."""

    def subscribe(self, key_expr: str, capacity: int) -> Subscription:
        """Return a subscription that holds the newest ``capacity`` samples; 1 means that the latest wins."""

    def serve(self, key_expr: str, capacity: int) -> Server:
        """Return a server that holds up to ``capacity`` waiting requests and turns more away."""

    def request(self, key: str, payload: bytes, timeout_s: float, flow: Flow) -> PendingReply:
        """Return a request on its way to one server of ``key``."""

    def declare_alive(self, key: str) -> AliveToken:
        """Return a token that others see until it or the transport is closed."""

    def watch_alive(self, key_expr: str) -> AliveWatch:
        """Return a watch on tokens; it starts with those that are there."""

    def wait(self, timeout_s: float) -> bool:
        """Return whether anything arrived since the last call, at the latest after ``timeout_s``."""

    def close(self, timeout_s: float = 5.0) -> bool:
        """Return whether everything was closed within ``timeout_s``; never takes longer. Twice is allowed."""


def check_size(key: str, payload: bytes, max_message_bytes: int) -> None:
    """Raise TransportError if the receiver would throw ``payload`` away unseen because of its size."""
    if len(payload) > max_message_bytes:
        raise TransportError(
            f"a message of {len(payload)} bytes on {key} is over the limit of {max_message_bytes}: "
            "send smaller blocks, or raise max_message_mib at every service"
        )

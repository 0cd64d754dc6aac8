"""Communication between services: puts, requests with a reply, and liveliness.

There are two implementations, and one contract suite tests both: ``memory_transport.py`` (several services in one
process) and ``zenoh_transport.py`` (processes and machines). They guarantee:

* The transport never runs a caller's code on another thread. It puts arrivals into a bounded `Mailbox`, and the
  thread that owns the service takes them out. A full mailbox drops and counts; it never blocks the network.
* A put may be lost. Only current subscribers receive it.
* A request ends in exactly one outcome, by its deadline: a `Reply`, or `NoReply` with the reason.
* After a broken link the transport repeats all declarations (subscriptions, servers, tokens). A change of
  ``reconnect_count`` means that messages may have been lost in between.
* An answer never waits for a slow client. It may be lost instead, as a put may.
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import Enum
from typing import Any, Final, Protocol

from common.comms.mailbox import Bell, Mailbox
from common.errors import ReportedError

MAX_ALIVE_EVENTS = 65536  # many more than any fleet has members: an alive event must not be dropped


class TransportError(ReportedError, RuntimeError):
    """The transport can't do what was requested. The text is one line: the endpoint or key, and what to do."""


class Flow(Enum):
    """Purpose of a message. Each transport maps it to a priority and to a behaviour under congestion."""

    POLICY = "policy"
    STAGE = "stage"
    ROLLOUT = "rollout"
    RALLY = "rally"
    CONTROL = "control"
    STATUS = "status"


@dataclass(frozen=True, slots=True)
class Sample:
    """A put that arrived."""

    key: str
    payload: bytes


@dataclass(frozen=True, slots=True)
class AliveEvent:
    """A liveliness token that appeared, or that ended (its owner closed it, crashed, hangs or lost its link)."""

    key: str
    alive: bool


@dataclass(frozen=True, slots=True)
class Reply:
    """The answer to a request."""

    payload: bytes


class NoReply(Enum):
    """Why a request ended without an answer."""

    TIMEOUT = "timeout"  # the server may or may not have seen the request
    NO_SERVER = (
        "no server"  # the key has no server, the server's mailbox is full, it refused, or the link broke
    )


Outcome = Reply | NoReply


class Subscription:
    """The samples of one key expression that arrived and were not taken yet."""

    def __init__(
        self, inbox: Mailbox[Any], read: Callable[[Any], Sample], undeclare: Callable[[], None]
    ) -> None:
        self._inbox = inbox
        self._read = read
        self._undeclare = undeclare

    @property
    def dropped(self) -> int:
        """Number of samples that newer ones replaced before they were taken."""
        return self._inbox.dropped

    def poll(self) -> list[Sample]:
        """Return the samples that arrived, oldest first. Never waits."""
        return [self._read(raw) for raw in self._inbox.take_all()]

    def wait(self, timeout_s: float) -> bool:
        """Return whether a sample is waiting. Wait for one at most ``timeout_s``."""
        return self._inbox.wait(timeout_s)

    def close(self) -> None:
        """Stop receiving."""
        self._undeclare()


class Request:
    """A request that waits for its answer. The answer may come long after the request was taken from the server."""

    __slots__ = ("_answer", "_ended", "key", "payload")

    def __init__(self, key: str, payload: bytes, answer: Callable[[bytes | None], None]) -> None:
        self.key = key
        self.payload = payload
        self._answer = answer
        self._ended = False

    def reply(self, payload: bytes) -> None:
        """Answer and end the request. A client that has left is no error; a second answer is one."""
        self._end(payload)

    def refuse(self) -> None:
        """End the request without an answer: the client gets NO_SERVER at once."""
        self._end(None)

    def _end(self, payload: bytes | None) -> None:
        if self._ended:
            raise TransportError(f"the request on {self.key} was answered before; allowed: one answer")
        self._ended = True
        self._answer(payload)


class Server:
    """The requests on one key expression that arrived and were not taken yet."""

    def __init__(
        self, inbox: Mailbox[Any], read: Callable[[Any], Request], undeclare: Callable[[], None]
    ) -> None:
        self._inbox = inbox
        self._read = read
        self._undeclare = undeclare

    @property
    def dropped(self) -> int:
        """Number of requests refused because the mailbox was full."""
        return self._inbox.dropped

    def poll(self, timeout_s: float = 0.0) -> Request | None:
        """Return the oldest waiting request, or None if none arrives in ``timeout_s``."""
        if timeout_s > 0.0:
            self._inbox.wait(timeout_s)
        raw = self._inbox.take()
        return None if raw is None else self._read(raw)

    def waiting(self, most: int) -> Iterator[Request]:
        """Yield the requests that wait, oldest first, ``most`` at most: those that arrive meanwhile delay nobody.

        Those that are left end the transport's next wait.
        """
        for _ in range(most):
            if (request := self.poll()) is None:
                return
            yield request
        self._inbox.remind()

    def close(self) -> None:
        """Stop serving. Requests that were not taken end with NO_SERVER, also those that arrive during this call."""
        self._undeclare()
        for raw in self._inbox.close():
            self._read(raw).refuse()


class PendingReply:
    """A request in progress. It always ends in one outcome, by its deadline."""

    def __init__(self, bell: Bell, timeout_s: float) -> None:
        self._bell = bell
        self._deadline = time.monotonic() + timeout_s
        self._outcome: Outcome | None = None

    def settle(self, outcome: Outcome) -> None:
        """End the request. Only the first outcome counts. Called by the transport."""
        with self._bell.lock:
            if self._outcome is None:
                self._outcome = outcome
                self._bell.ring()

    def poll(self) -> Outcome | None:
        """Return the outcome, or None while the request is in progress."""
        with self._bell.lock:
            if self._outcome is None and time.monotonic() >= self._deadline:
                self._outcome = NoReply.TIMEOUT
            return self._outcome

    def wait(self) -> Outcome:
        """Wait for the outcome, at most until the request's deadline; return it."""
        with self._bell.lock:
            left_s = max(0.0, self._deadline - time.monotonic())
            self._bell.lock.wait_for(lambda: self._outcome is not None, left_s)
            if self._outcome is None:
                self._outcome = NoReply.TIMEOUT
            return self._outcome


@dataclass(frozen=True, slots=True)
class Unanswered:
    """Requests that timed out in a row on a link that seems alive."""

    count: int = 0
    since: float = 0.0  # [s] time of the first one


STUCK_AFTER: Final = 3  # requests in a row
STUCK_AFTER_S: Final = 20.0  # and no sooner


def is_stuck(unanswered: Unanswered, connected: bool, now: float) -> bool:
    """Return whether a session must be opened again: its link is up, and yet nothing comes back."""
    return connected and unanswered.count >= STUCK_AFTER and now - unanswered.since >= STUCK_AFTER_S


class AliveWatch:
    """Changes of the tokens of one key expression, without the tokens of the own transport."""

    def __init__(
        self, inbox: Mailbox[AliveEvent], is_own: Callable[[str], bool], undeclare: Callable[[], None]
    ) -> None:
        self._inbox = inbox
        self._is_own = is_own
        self._undeclare = undeclare
        self._alive: set[str] = set()

    def poll(self) -> list[AliveEvent]:
        """Return the changes since the last call, in order. In the first call, existing tokens come first."""
        changes = []
        for event in self._inbox.take_all():
            if self._is_own(event.key) or (event.key in self._alive) == event.alive:
                continue
            (self._alive.add if event.alive else self._alive.discard)(event.key)
            changes.append(event)
        return changes

    def wait(self, timeout_s: float) -> bool:
        """Return whether an event is waiting. Wait for one at most ``timeout_s``."""
        return self._inbox.wait(timeout_s)

    def forget(self) -> None:
        """Let all tokens end, before a new session reports those that stand. Called by the transport."""
        for event in self._inbox.take_all():
            if not self._is_own(event.key):
                (self._alive.add if event.alive else self._alive.discard)(event.key)
        for key in sorted(self._alive):
            self._inbox.put(AliveEvent(key, alive=False))

    def close(self) -> None:
        """Stop watching."""
        self._undeclare()


class AliveToken(Protocol):
    """Shows that its owner is alive, until it is closed or the owner's process or link fails."""

    def close(self) -> None:
        """Withdraw the token."""


class Transport(Protocol):
    """One service's connection. Only one thread calls its methods; they raise TransportError."""

    @property
    def connected(self) -> bool:
        """Whether the hub is reachable now (always true for the hub itself)."""

    @property
    def reconnect_count(self) -> int:
        """How often a broken link was restored. After a change, request again what may have been lost."""

    def publish(self, key: str, payload: bytes, flow: Flow) -> None:
        """Send to all current subscribers. Never waits for a slow receiver, and does not report loss."""

    def matching(self, key: str, flow: Flow) -> bool:
        """Return whether ``key`` has a subscriber now. If not, a publisher can idle."""

    def subscribe(self, key_expr: str, capacity: int) -> Subscription:
        """Return a subscription that holds the newest ``capacity`` samples: with 1, the latest."""

    def serve(self, key_expr: str, capacity: int) -> Server:
        """Return a server that holds up to ``capacity`` waiting requests and refuses more."""

    def request(self, key: str, payload: bytes, timeout_s: float, flow: Flow) -> PendingReply:
        """Send a request to one server of ``key``; return its pending reply."""

    def declare_alive(self, key: str) -> AliveToken:
        """Return a token that the others see until it or the transport is closed."""

    def watch_alive(self, key_expr: str) -> AliveWatch:
        """Return a watch on tokens. Its first events are the tokens that exist already."""

    def wait(self, timeout_s: float) -> bool:
        """Return whether anything arrived since the last call. Wait for it at most ``timeout_s``."""

    def close(self, timeout_s: float = 5.0) -> bool:
        """Close everything; return whether it took less than ``timeout_s``. Never takes longer. Twice is allowed."""


def check_size(key: str, payload: bytes, max_message_bytes: int) -> None:
    """Raise TransportError if ``payload`` is so large that the receiver discards it without an error."""
    if len(payload) > max_message_bytes:
        raise TransportError(
            f"a message of {len(payload)} bytes on {key} is over the limit of {max_message_bytes}: "
            "send smaller blocks, or raise max_message_mib at every service, up to 64"
        )

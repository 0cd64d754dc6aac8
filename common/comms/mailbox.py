"""A bounded queue between the network's threads and the thread that owns a service."""

from collections import deque
from threading import Condition
from typing import Final, Generic, Literal, TypeVar

_Item = TypeVar("_Item")

MAILBOX_BYTES: Final = 256 * 1024 * 1024  # most that wait in one mailbox, besides one message


class Bell:
    """Wakes the thread that owns a transport. One per transport; it is also the lock of the transport's mailboxes."""

    def __init__(self) -> None:
        self.lock = Condition()
        self._rings = 0
        self._handled = 0

    def ring(self) -> None:
        """Wake the waiting threads. The caller holds the lock."""
        self._rings += 1
        self.lock.notify_all()

    def wait(self, timeout_s: float) -> bool:
        """Return whether it rang since the last call. A ring between two calls ends the second at once."""
        with self.lock:
            rang = self.lock.wait_for(lambda: self._rings != self._handled, timeout_s)
            self._handled = self._rings
            return rang


class Mailbox(Generic[_Item]):
    """A bounded queue between the network's threads and the thread that owns the service.

    Args:
        bell: Locks the queue, and rings at each arrival; one per transport.
        capacity: Largest number of items.
        keep: Which items a full mailbox keeps. ``newest``: it drops the oldest item, so with a capacity of 1 it holds
            the latest. ``oldest``: it refuses the arrival.
    """

    def __init__(self, bell: Bell, capacity: int, keep: Literal["newest", "oldest"]) -> None:
        if capacity < 1:
            raise ValueError(f"capacity {capacity} of a mailbox; allowed: 1 or more")
        self._bell = bell
        self._capacity = capacity
        self._keep = keep
        self._items: deque[tuple[_Item, int]] = deque()
        self._bytes = 0
        self._dropped = 0
        self._is_closed = False

    @property
    def dropped(self) -> int:
        """Number of items lost because the mailbox was full."""
        return self._dropped

    def put(self, item: _Item, size: int = 0) -> bool:
        """Add ``item`` of ``size`` bytes; return whether the mailbox accepted it."""
        with self._bell.lock:
            if self._is_closed:
                return False
            while self._items and (len(self._items) >= self._capacity or self._bytes + size > MAILBOX_BYTES):
                self._dropped += 1
                if self._keep == "oldest":
                    return False
                self._pop()
            self._items.append((item, size))
            self._bytes += size
            self._bell.ring()
            return True

    def take(self) -> _Item | None:
        """Take out the oldest item; return None if there is none."""
        with self._bell.lock:
            return self._pop() if self._items else None

    def take_all(self) -> list[_Item]:
        """Take out all items; return them, oldest first."""
        with self._bell.lock:
            items = [item for item, _ in self._items]
            self._items.clear()
            self._bytes = 0
            return items

    def remind(self) -> None:
        """Ring for the items that are waiting still."""
        with self._bell.lock:
            if self._items:
                self._bell.ring()

    def _pop(self) -> _Item:
        item, size = self._items.popleft()
        self._bytes -= size
        return item

    def close(self) -> list[_Item]:
        """Refuse all later items; return the waiting ones, oldest first."""
        with self._bell.lock:
            self._is_closed = True
            return self.take_all()

    def wait(self, timeout_s: float) -> bool:
        """Return whether an item is waiting. Wait for one at most ``timeout_s``."""
        with self._bell.lock:
            return self._bell.lock.wait_for(lambda: bool(self._items), timeout_s)

"""The hub in virtual time: one thread that forwards messages in order, and its link to other hosts."""

from collections import deque
from collections.abc import Callable

from benchmarks.scaling.costs import Network
from benchmarks.scaling.machine import Machine, Script, Wait, Work

Act = Callable[[], None]


class Hub:
    """The hub.

    Args:
        machine: Its clock and cores.
        network: Between the hosts.
        remote: Share of the fleet that is on other hosts. Every message takes this share of its bytes over the link, so
            that the link's load is right on average.
        latency_s: Of a message, one way [s].
    """

    def __init__(self, machine: Machine, network: Network, remote: float, latency_s: float) -> None:
        self._machine, self._network, self._remote = machine, network, remote
        self._latency_s = latency_s + (network.latency_s if remote else 0.0)
        self._in_free = self._out_free = 0.0  # [s] when each direction of the link is free
        self._letters: deque[tuple[float, Act]] = deque()  # the work that each is, and what follows
        self._process = machine.start(self._forwarding())

    @property
    def busy(self) -> float:
        """Time in which it had work so far [s]."""
        return self._process.busy(self._machine.now)

    def later(self, act: Act) -> None:
        """Let a small message that costs nothing arrive."""
        self._machine.at(self._machine.now + self._latency_s, act)

    def takes(self, size: float, work: float, act: Act) -> None:
        """Take a message of ``size`` bytes, forward it with ``work`` [s], and call ``act`` where it arrives."""
        self._in_free = max(self._in_free, self._machine.now) + self._link_s(size)
        self._machine.at(self._in_free + self._latency_s, lambda: self._post(work, act))

    def sends(self, size: float, work: float, act: Act) -> None:
        """Send a message of its own process, with ``work`` [s], and call ``act`` where it arrives."""

        def leaves() -> None:
            self._out_free = max(self._out_free, self._machine.now) + self._link_s(size)
            self._machine.at(self._out_free + self._latency_s, act)

        self._post(work, leaves)

    def _link_s(self, size: float) -> float:
        return size * self._remote / self._network.bytes_per_s

    def _post(self, work: float, act: Act) -> None:
        self._letters.append((work, act))
        self._machine.wake(self._process)

    def _forwarding(self) -> Script:
        while True:
            if not self._letters:
                yield Wait()
                continue
            work, act = self._letters.popleft()
            yield Work(work)
            act()

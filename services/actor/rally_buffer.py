"""The actor's stock of valid rallies: a first-in first-out ring; each rally is used once."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from common.comms.messages import RallyBatch
from common.env.rally_env import Launches
from common.task.config import TaskConfig
from common.task.launch import DRAG_FACTOR, LIFT_FACTOR, POSITION, SPIN, VELOCITY, Purpose, draw_rallies

# Far beyond every preset: a ball outside these limits could break the simulation.
LIMITS: Final = (
    ("position", POSITION, -5.0, 5.0),  # m
    ("velocity", VELOCITY, -60.0, 60.0),  # m/s
    ("spin", SPIN, -3000.0, 3000.0),  # rad/s
    ("drag and lift factor", slice(DRAG_FACTOR, LIFT_FACTOR + 1), 0.0, 5.0),
)


def launch_fault(batch: RallyBatch) -> str:
    """Return why a batch's rows can't be launches, or ""."""
    for name, columns, low, high in LIMITS:
        values = batch.rallies[:, columns]
        outside = values[(values < low) | (values > high)]
        if outside.size:
            return f"{name} {outside[0]:g}; allowed: {low:g} to {high:g}"
    return ""


@dataclass(slots=True)
class BufferCounts:
    """Counts of a buffer."""

    received: int = 0  # rallies that arrived in batches
    consumed: int = 0  # rallies given to environments
    overflowed: int = 0  # rallies pushed out of the full ring, oldest first
    underruns: int = 0  # launches drawn at random because the ring was empty
    gaps: int = 0  # batches that a generator numbered and that did not arrive
    repeated: int = 0  # batches that arrived again, and were ignored


class RallyBuffer:
    """Rallies in the order of arrival; when empty, random launches, counted and flagged as unvalidated.

    Args:
        capacity: Target number of rallies in stock: the number of the actor's environments. The batch that fills the
            ring is kept whole, so that batches of any size lose nothing.
        task: Launch preset, randomization and flight of the fallback.
        seed: Of the fallback launches.
        refill: Called when the ring has too few rallies, to add batches that have arrived; may do nothing.
    """

    def __init__(
        self, capacity: int, task: TaskConfig, seed: int, refill: Callable[[], None] = lambda: None
    ) -> None:
        self.counts = BufferCounts()
        self._ring: deque[tuple[np.ndarray, np.uint64]] = deque()
        self._capacity = capacity
        self._task, self._seed = task, seed
        self._refill = refill
        self._fallback_block = 0
        self._last: dict[tuple[str, int, int], int] = {}

    def __len__(self) -> int:
        return len(self._ring)

    @property
    def room(self) -> int:
        """Number of rallies missing in stock. While it is above 0, one more batch pushes no rally out."""
        return max(0, self._capacity - len(self._ring))

    def put(self, batch: RallyBatch) -> None:
        """Add a batch. A repeated batch is counted and ignored."""
        source = (batch.source, batch.incarnation, batch.shard)
        last = self._last.get(source)
        if last is not None:
            if batch.sequence <= last:
                self.counts.repeated += 1
                return
            self.counts.gaps += batch.sequence - last - 1
        self._last[source] = batch.sequence
        self._ring.extend(zip(batch.rallies, batch.seeds, strict=True))
        self.counts.received += len(batch.seeds)
        while len(self._ring) > self._capacity - 1 + len(batch.seeds):
            self._ring.popleft()
            self.counts.overflowed += 1

    def take(self, count: int) -> Launches:
        """Return ``count`` launches, oldest first. Never blocks."""
        while (before := len(self._ring)) < count:
            self._refill()
            if len(self._ring) == before:
                break
        stocked = [self._ring.popleft() for _ in range(min(count, len(self._ring)))]
        launches = np.empty((count, 11))
        seeds = np.empty(count, np.uint64)
        for row, (launch, seed) in enumerate(stocked):
            launches[row], seeds[row] = launch, seed
        missing = count - len(stocked)
        if missing:
            self._draw(launches[len(stocked) :], seeds[len(stocked) :])
            self.counts.underruns += missing
        self.counts.consumed += len(stocked)
        return Launches(launches, seeds, np.arange(count) < len(stocked))

    def _draw(self, launches: np.ndarray, seeds: np.ndarray) -> None:
        block = draw_rallies(
            len(seeds), self._task, seed=self._seed, block=self._fallback_block, purpose=Purpose.FALLBACK
        )
        self._fallback_block += 1
        launches[:], seeds[:] = block.launches, block.seeds

"""The actor's stock of valid rallies: a ring, first in first out, each consumed once."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from common.comms.messages import RallyBatch
from common.env.rally_env import Launches
from common.rally.launch import DRAG_FACTOR, LIFT_FACTOR, POSITION, SPIN, VELOCITY, Purpose, draw_rallies

# Far beyond every preset: a ball from elsewhere than a generator must not blow the simulation up.
LIMITS: Final = (
    ("position", POSITION, -5.0, 5.0),  # m
    ("velocity", VELOCITY, -60.0, 60.0),  # m/s
    ("spin", SPIN, -3000.0, 3000.0),  # rad/s
    ("drag and lift factor", slice(DRAG_FACTOR, LIFT_FACTOR + 1), 0.0, 5.0),
)


def launch_fault(batch: RallyBatch) -> str:
    """Return what about a batch can't be a launch, or ""."""
    for name, columns, low, high in LIMITS:
        values = batch.rallies[:, columns]
        wild = values[(values < low) | (values > high)]
        if wild.size:
            return f"{name} {wild[0]:g}; allowed: {low:g} to {high:g}"
    return ""


@dataclass(slots=True)
class BufferCounts:
    """What went through a buffer."""

    received: int = 0  # rallies that arrived in batches
    consumed: int = 0  # rallies dealt to environments
    overflowed: int = 0  # rallies pushed out of the full ring, oldest first
    underruns: int = 0  # launches that had to be drawn at random
    gaps: int = 0  # batches that a generator numbered and that never came
    repeated: int = 0  # batches that came again, and were not taken


class RallyBuffer:
    """Rallies in the order they came; when empty, random launches, counted and flagged as unvalidated.

    Args:
        capacity: Rallies wanted in stock: as many as the actor has environments. The batch that fills the ring
            is held whole, so that batches of any size lose nothing.
        preset: Launch preset of the fallback.
        noise: Noise profile of the fallback.
        seed: Of the fallback launches.
        refill: Called when the ring runs low, to take in what has arrived; may do nothing.
    """

    def __init__(
        self, capacity: int, preset: str, noise: str, seed: int, refill: Callable[[], None] = lambda: None
    ) -> None:
        self.counts = BufferCounts()
        self._ring: deque[tuple[np.ndarray, np.uint64]] = deque()
        self._capacity = capacity
        self._preset, self._noise, self._seed = preset, noise, seed
        self._refill = refill
        self._fallback_block = 0
        self._last: dict[tuple[str, int, int], int] = {}

    def __len__(self) -> int:
        return len(self._ring)

    @property
    def room(self) -> int:
        """How many rallies the stock lacks; while it lacks any, one more batch pushes nothing out."""
        return max(0, self._capacity - len(self._ring))

    def put(self, batch: RallyBatch) -> None:
        """Take a batch in; a batch that came before is counted and left."""
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
        """Return ``count`` launches, oldest first; never blocks."""
        while (before := len(self._ring)) < count:
            self._refill()
            if len(self._ring) == before:
                break
        stocked = [self._ring.popleft() for _ in range(min(count, len(self._ring)))]
        records = np.empty((count, 11))
        seeds = np.empty(count, np.uint64)
        for row, (record, seed) in enumerate(stocked):
            records[row], seeds[row] = record, seed
        missing = count - len(stocked)
        if missing:
            self._draw(records[len(stocked) :], seeds[len(stocked) :])
            self.counts.underruns += missing
        self.counts.consumed += len(stocked)
        return Launches(records, seeds, np.arange(count) < len(stocked))

    def _draw(self, records: np.ndarray, seeds: np.ndarray) -> None:
        block = draw_rallies(
            len(seeds),
            seed=self._seed,
            block=self._fallback_block,
            preset=self._preset,
            noise=self._noise,
            purpose=Purpose.FALLBACK,
        )
        self._fallback_block += 1
        records[:], seeds[:] = block.launches, block.seeds

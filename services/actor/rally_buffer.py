"""The actor's stock of valid rallies: a first-in first-out ring for each kind of ball; each rally is used once."""

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from common.comms.messages import RallyBatch
from common.env.rally_env import FinishedRallies, Launches
from common.task.config import PresetName, TaskConfig
from common.task.launch import (
    DRAG_FACTOR,
    KIND,
    LAUNCH_SIZE,
    LIFT_FACTOR,
    POSITION,
    SPIN,
    VELOCITY,
    Purpose,
    draw_rallies,
)
from common.task.launch_presets import PRESETS, Kind
from services.actor.ball_mix import BallMix

# Far beyond every preset: a ball outside these limits could break the simulation.
LIMITS: Final = (
    ("position", POSITION, -5.0, 5.0),  # m
    ("velocity", VELOCITY, -60.0, 60.0),  # m/s
    ("spin", SPIN, -3000.0, 3000.0),  # rad/s
    ("drag and lift factor", slice(DRAG_FACTOR, LIFT_FACTOR + 1), 0.0, 5.0),
)


FAR: Final = 4096  # batches: far more than arrive out of order


def launch_fault(batch: RallyBatch, preset: PresetName) -> str:
    """Return why a batch's rows can't be launches of a preset, or ""."""
    for name, columns, low, high in LIMITS:
        values = batch.rallies[:, columns]
        outside = values[(values < low) | (values > high)]
        if outside.size:
            return f"{name} {outside[0]:g}; allowed: {low:g} to {high:g}"
    kinds = batch.rallies[:, KIND]
    known = [kind for kind, share in enumerate(PRESETS[preset]) if share > 0.0]
    strange = kinds[~np.isin(kinds, known)]
    if strange.size:
        return f"kind {strange[0]:g}; allowed in {preset}: {', '.join(map(str, known))}"
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

    Where the launch preset has several kinds of ball, ``ball_mix`` decides which an environment gets. Rallies of a kind
    that is played less often than it arrives are pushed out, oldest first.

    Args:
        capacity: Target number of rallies in stock, and the number of the actor's environments. The batch that fills a
            ring is kept whole, so that batches of any size lose nothing.
        task: Launch preset, randomization and flight of the fallback.
        seed: Of the fallback launches.
        refill: Called when the ring has too few rallies, to add batches that have arrived; may do nothing.
    """

    def __init__(
        self, capacity: int, task: TaskConfig, seed: int, refill: Callable[[], None] = lambda: None
    ) -> None:
        self.counts = BufferCounts()
        self._rings: list[deque[tuple[np.ndarray, np.uint64]]] = [deque() for _ in Kind]
        self._mix = BallMix(task.launch, capacity, seed)
        self._capacity = capacity
        self._task, self._seed = task, seed
        self._refill = refill
        self._fallback_block = 0
        self._last: dict[tuple[str, int, int], int] = {}

    def __len__(self) -> int:
        return sum(map(len, self._rings))

    @property
    def room(self) -> int:
        """Number of rallies missing in stock, of the kind that lacks most. Of one kind, above 0, a batch fits whole."""
        wanted = (math.ceil(share * self._capacity) for share in self._mix.shares.tolist())
        missing: list[int] = [want - len(ring) for want, ring in zip(wanted, self._rings, strict=True)]
        return max(0, *missing)

    def note(self, finished: FinishedRallies) -> None:
        """Take note of rallies that ended: kinds that are lost more often are played more often."""
        self._mix.note(finished)

    def put(self, batch: RallyBatch) -> None:
        """Add a batch. A repeated batch is counted and ignored."""
        source = (batch.source, batch.incarnation, batch.shard)
        last = self._last.get(source)
        if last is not None:
            if 0 <= last - batch.sequence < FAR:
                self.counts.repeated += 1
                return
            # A number far away is a forged one, or the true one after it: it must not hide the batches that follow
            self.counts.gaps += min(max(batch.sequence - last - 1, 0), FAR)
        self._last[source] = batch.sequence
        self.counts.received += len(batch.seeds)
        kinds = batch.rallies[:, KIND].astype(np.int64)
        for rally, seed, kind in zip(batch.rallies, batch.seeds, kinds, strict=True):
            self._rings[kind].append((rally, seed))
        for ring, arrived in zip(self._rings, np.bincount(kinds, minlength=len(Kind)), strict=True):
            while len(ring) > self._capacity - 1 + arrived:
                ring.popleft()
                self.counts.overflowed += 1

    def take(self, rows: npt.NDArray[np.int64]) -> Launches:
        """Return a launch for each of the environments ``rows`` (n,), of each kind the oldest first. Never blocks."""
        count = rows.size
        while (before := len(self)) < count:
            self._refill()
            if len(self) == before:
                break
        stocked = [self._next(int(row)) for row in rows[: min(count, len(self))]]
        launches = np.empty((count, LAUNCH_SIZE))
        seeds = np.empty(count, np.uint64)
        for row, (launch, seed) in enumerate(stocked):
            launches[row], seeds[row] = launch, seed
        missing = count - len(stocked)
        if missing:
            self._draw(launches[len(stocked) :], seeds[len(stocked) :])
            self.counts.underruns += missing
        self.counts.consumed += len(stocked)
        return Launches(launches, seeds, np.arange(count) < len(stocked))

    def _next(self, row: int) -> tuple[np.ndarray, np.uint64]:
        in_stock = np.array([len(ring) > 0 for ring in self._rings])
        return self._rings[self._mix.next_kind(row, in_stock)].popleft()

    def _draw(self, launches: np.ndarray, seeds: np.ndarray) -> None:
        block = draw_rallies(
            len(seeds), self._task, seed=self._seed, block=self._fallback_block, purpose=Purpose.FALLBACK
        )
        self._fallback_block += 1
        launches[:], seeds[:] = block.launches, block.seeds

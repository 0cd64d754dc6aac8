"""The source of an actor's rallies: published batches, or blocks that are requested by index."""

import logging
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Final

from common.comms.codec import DecodeError, decode, encode
from common.comms.messages import RallyBatch, RallyRequest
from common.comms.transport import Flow, Reply, Subscription, Transport
from common.errors import ReportedError
from common.service.member import Member
from services.actor.config import IDLE_WAIT_S, ActorConfig
from services.actor.rally_buffer import RallyBuffer, launch_fault

log = logging.getLogger(__name__)

RALLY_BATCHES: Final = 8  # that wait until the ring has room for them
MOST_RANDOM: Final = 0.05  # [-] share of random launches in a block above which the log warns
REQUEST_RALLIES_S: Final = 2.0  # limit of one request for a block


class NoRalliesError(ReportedError):
    """The generator that a reproducible run needs is missing."""


class StopRequested(Exception):  # noqa: N818 - not an error
    """A stop was requested within a rollout that can't be finished."""


class RallyFeed:
    """Fills an actor's rally buffer.

    Args:
        config: Settings of the actor.
        transport: Connection to the hub.
        member: The actor's membership; counts refused batches.
        is_stopping: Whether the actor must stop.
    """

    def __init__(
        self,
        config: ActorConfig,
        transport: Transport,
        member: Member,
        is_stopping: Callable[[], bool],
    ) -> None:
        self._config, self._transport, self._member = config, transport, member
        self._is_stopping = is_stopping
        self.shard = config.number % config.shard_count
        self._key = member.keys.rally(self.shard)
        self._rallies: Subscription | None = None
        if config.rallies == "subscribe":
            self._rallies = transport.subscribe(self._key, capacity=RALLY_BATCHES)
        self._batches: deque[RallyBatch] = deque()
        self._block = 0
        self._counted, self._runs_short = (
            (0, 0),
            False,
        )  # counts of random launches and of rallies at the last block

    @property
    def asks(self) -> bool:
        """Whether blocks are requested by index."""
        return self._rallies is None

    @property
    def unneeded(self) -> int:
        """Number of batches that newer ones replaced in the mailbox: an actor with rallies enough lets them go."""
        return self._rallies.dropped if self._rallies is not None else 0

    def refill(self, buffer: RallyBuffer) -> None:
        """Fill the buffer with batches that have arrived, or with the next block."""
        if self._rallies is None:
            self._ask(buffer)
            return
        while buffer.room > 0:
            if not self._batches:  # unneeded batches stay in the mailbox, which keeps the newest
                self._batches.extend(filter(None, (self._read(s.payload) for s in self._rallies.poll())))
            if not self._batches:
                return
            buffer.put(self._batches.popleft())

    def note_underruns(self, buffer: RallyBuffer) -> None:
        """Log when rallies run out, and when there are enough again: policies learn little from random launches."""
        counts = buffer.counts
        random_, dealt = counts.underruns - self._counted[0], counts.consumed - self._counted[1]
        self._counted = (counts.underruns, counts.consumed)
        if not self._runs_short and random_ > MOST_RANDOM * (random_ + dealt):
            self._runs_short = True
            log.warning(
                "rallies run out random=%d of=%d launches; raise the generators' rate_hz, or add generators",
                random_,
                random_ + dealt,
            )
        elif self._runs_short and random_ == 0 and dealt > 0:
            self._runs_short = False
            log.info("there are enough rallies again")

    def _read(self, payload: bytes) -> RallyBatch | None:
        """Return the batch in a message, or None if it can't be used."""
        try:
            batch = decode(payload, RallyBatch)
        except DecodeError as error:
            self._member.refuse("rally", error)
            return None
        task = self._config.task
        fault = launch_fault(batch, task.launch)
        if (batch.launch, batch.randomization) != (task.launch, task.randomization):
            fault = f"{batch.launch}/{batch.randomization}; allowed: {task.launch}/{task.randomization}"
        if fault:
            self._member.refuse("rally", f"generator={batch.source} {fault}")
            return None
        return batch

    def _ask(self, buffer: RallyBuffer) -> None:
        """Fetch the next block by index and wait for it, so that the order of rallies does not depend on timing."""
        request = encode(RallyRequest(shard=self.shard, block=self._block))
        deadline = time.monotonic() + self._config.rally_wait_s
        while not self._is_stopping():
            answer = self._transport.request(self._key, request, REQUEST_RALLIES_S, Flow.RALLY).wait()
            batch = self._read(answer.payload) if isinstance(answer, Reply) else None
            if batch is not None and batch.block == self._block:
                # In this mode the request numbers the blocks. Any generator may answer.
                buffer.put(replace(batch, source="asked", incarnation=0, sequence=self._block))
                self._block += 1
                return
            if not buffer.counts.consumed:
                return  # nothing has been played yet: the actor requests it again
            if time.monotonic() > deadline:
                raise NoRalliesError(
                    f"no rally block {self._block} of shard {self.shard} in {self._config.rally_wait_s:.0f} s, and "
                    "a reproducible run needs it: start a generator (python -m services.generator)"
                )
            self._transport.wait(IDLE_WAIT_S)
        raise StopRequested
